/* SPDX-License-Identifier: Apache-2.0 */
/* Seeded random inputs for the kernels of one library, to be run under sanitizers
 * (tests/sanitizers.py).
 *
 *     PROGRAM                              lists the targets
 *     PROGRAM TARGET FIRST COUNT SEED      runs a target on inputs FIRST .. FIRST + COUNT - 1
 *
 * An input depends on target, seed and number only. What a sanitizer finds, a failed CHECK and an
 * input that takes more than 10 s of processor time abort; the last line on stderr then names
 * target, input and seed. Arrays have their exact size, so that every access beyond them is
 * found. */
#ifndef CHASERDOCK_FUZZ_H
#define CHASERDOCK_FUZZ_H

#define _POSIX_C_SOURCE 200809L
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <unistd.h>
#include "base.h"

#define COUNT_OF(a) ((int)(sizeof(a) / sizeof *(a)))

typedef struct {
    const char *name;
    void (*run)(void);
} Target;

static const char *target_name;
static uint64_t input_number, input_seed, random_state;
/* Share of special values in this input, and whether one was drawn. */
static double special_share;
static int special_drawn;
static void *blocks[64];
static int block_count;

#define CHECK(condition)                                                          \
    do {                                                                          \
        if (!(condition)) {                                                       \
            fprintf(stderr, "%s:%d: violated: %s\n", __FILE__, __LINE__, #condition); \
            abort();                                                              \
        }                                                                         \
    } while (0)

/* SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, 2014). */
static uint64_t random_bits(void) {
    uint64_t z = random_state += 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

/* A whole number from low to high, both included. */
static int64_t whole(int64_t low, int64_t high) {
    return low + (int64_t)(random_bits() % (uint64_t)(high - low + 1));
}

static double uniform(double low, double high) {
    return low + (high - low) * ((double)(random_bits() >> 11) * 0x1p-53);
}

static int chance(double share) { return uniform(0.0, 1.0) < share; }

/* NaN, infinities, zeros, denormals, the ends of ranges, and any bits. */
static double special(void) {
    static const uint64_t patterns[] = {
        0x7ff8000000000000u, 0xfff8000000000001u, 0x7ff0000000000000u,
        0xfff0000000000000u, /* NaN, infinity */
        0x0000000000000000u, 0x8000000000000000u, 0x0000000000000001u,
        0x800000000000abcdu,                                           /* zero, denormal */
        0x0010000000000000u, 0x7fefffffffffffffu, 0xffefffffffffffffu, /* smallest, largest */
        0x43e0000000000000u, 0xc3e0000000000001u, 0x41e0000000000000u,
        0xc1e0000000200000u, /* 2^63, 2^31 */
        0x3ff0000000000000u, 0xbff0000000000000u, 0x01a56e1fc2f8f359u,
        0x7e37e43c8800759cu, /* 1, 1e-300, 1e300 */
    };
    uint64_t bits = chance(0.8) ? patterns[whole(0, COUNT_OF(patterns) - 1)] : random_bits();
    double value;
    memcpy(&value, &bits, sizeof value);
    special_drawn = 1;
    return value;
}

static double value(double low, double high) {
    return chance(special_share) ? special() : uniform(low, high);
}

/* Memory of exactly this size until the end of the input. */
static void *block(size_t size) {
    CHECK(block_count < COUNT_OF(blocks));
    void *memory = malloc(size);
    if (memory) memset(memory, 0xff, size); /* as doubles: NaN */
    return blocks[block_count++] = memory;
}

static void fill(double *array, int64_t count, double low, double high) {
    for (int64_t i = 0; i < count; i++) array[i] = value(low, high);
}

static double *doubles(int64_t count, double low, double high) {
    double *array = block((size_t)count * sizeof *array);
    fill(array, count, low, high);
    return array;
}

static double *outputs(int64_t count) { return block((size_t)count * sizeof(double)); }

static uint8_t *bytes(int64_t count) {
    uint8_t *array = block((size_t)count);
    for (int64_t i = 0; i < count; i++) array[i] = (uint8_t)random_bits();
    return array;
}

/* A quaternion of unit length, or of special values. */
static void fill_quaternion(double *q) {
    double square = 0.0;
    for (int i = 0; i < 4; i++) q[i] = uniform(-1.0, 1.0), square += q[i] * q[i];
    for (int i = 0; i < 4; i++)
        q[i] = chance(special_share) ? special() : q[i] / sqrt_of(square + 1e-9);
}

/* An inertia tensor (3, 3) in its main axes, and its inverse. */
static void fill_inertia(double *inertia, double *inverse) {
    for (int i = 0; i < 9; i++) {
        inertia[i] = i % 4 ? value(0.0, 0.0) : value(0.3, 1.0);
        inverse[i] = i % 4 ? value(0.0, 0.0) : 1.0 / inertia[i];
    }
}

static int any_nan(const double *a, int64_t count) {
    for (int64_t i = 0; i < count; i++)
        if (a[i] != a[i]) return 1;
    return 0;
}

static int same_bits(const double *a, const double *b, int64_t count) {
    return count == 0 || memcmp(a, b, (size_t)count * sizeof *a) == 0;
}

static double *copy_of(const double *a, int64_t count) {
    double *same = outputs(count);
    if (count) memcpy(same, a, (size_t)count * sizeof *a);
    return same;
}

static void report_input(int number) {
    char line[200];
    int length =
        snprintf(line, sizeof line, "%s: %s, input %llu, seed %llu\n",
                 number == SIGPROF ? "no end after 10 s of processor time" : "aborted", target_name,
                 (unsigned long long)input_number, (unsigned long long)input_seed);
    if (length > 0 && write(2, line, (size_t)length) < 0) _exit(2);
    _exit(1);
}

static int run_targets(const Target *targets, int count, int argc, char **argv) {
    if (argc != 5) {
        for (int i = 0; i < count; i++) puts(targets[i].name);
        return 0;
    }
    const Target *chosen = NULL;
    for (int i = 0; i < count; i++)
        if (strcmp(targets[i].name, argv[1]) == 0) chosen = targets + i;
    if (!chosen) return fprintf(stderr, "no target %s\n", argv[1]), 2;
    target_name = chosen->name;
    input_seed = strtoull(argv[4], NULL, 10);
    signal(SIGABRT, report_input);
    signal(SIGPROF, report_input);
    // Processor time: a process may be stopped, or wait for a core.
    const struct itimerval limit = {.it_value = {.tv_sec = 10}};
    const uint64_t first = strtoull(argv[2], NULL, 10), end = first + strtoull(argv[3], NULL, 10);
    for (input_number = first; input_number < end; input_number++) {
        static const double shares[] = {0.0, 0.0, 0.003, 0.03, 0.3, 1.0};
        random_state = input_seed * 0xd1342543de82ef95u + input_number;
        random_state = random_bits();
        special_share = shares[whole(0, COUNT_OF(shares) - 1)];
        special_drawn = 0;
        setitimer(ITIMER_PROF, &limit, NULL);
        chosen->run();
        while (block_count) free(blocks[--block_count]);
    }
    return 0;
}

#define FUZZ_MAIN(targets) \
    int main(int argc, char **argv) { return run_targets(targets, COUNT_OF(targets), argc, argv); }

#endif
