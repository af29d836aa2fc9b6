/* SPDX-License-Identifier: Apache-2.0 */
/* Shared by all kernels: vectors of doubles, three-vectors, exported names, working memory.
 *
 * Results are the same to the last bit on every processor. The compiler does not contract or
 * reorder expressions (-ffp-contract=off, no fast-math), the source fixes the order of every sum,
 * and vectors are four wide on every processor. Only operations that IEEE 754 defines exactly are
 * used: + - * / and the square root. Fused multiply-add is exact as well, but it gained 15 % with
 * hardware support and cost a factor of twenty without.
 *
 * Counts, indices and array sizes must be right; a floating-point argument may be anything.
 * Whatever it is, a kernel stays within its arrays, converts no number to an integer that cannot
 * hold it, and ends. NaN passes through arithmetic to the result; a kernel that decides counts it
 * as a failure, and says so in its comment.
 */
#ifndef CHASERDOCK_BASE_H
#define CHASERDOCK_BASE_H

#include <stddef.h>
#include <stdint.h>

#define PASTE_(a, b) a##b
#define PASTE(a, b) PASTE_(a, b)
/* LEVEL: prefix of the exported names for the instruction set of this copy, e.g. v3_. */
#define NAME(name) PASTE(LEVEL, name)
#define EXPORT __attribute__((visibility("default")))

/* Layout of a structure that Python fills: export a table that `KernelLibrary.structure` compares
 * with the ctypes structure when the library is loaded. First the structure's size, then each
 * member's name, size and offset, in order; a name of NULL ends it. LAYOUT(Point, x, y) stands
 * after Point. */
typedef struct {
    const char *name;
    int64_t size, offset;
} Member;
#define LAYOUT(type, ...)                                                                  \
    EXPORT const Member *NAME(layout_##type)(void) {                                       \
        static const Member members[] = {                                                  \
            {#type, sizeof(type), 0}, REPEAT(MEMBERS(type, __VA_ARGS__)){0, 0, 0}};        \
        return members;                                                                    \
    }
#define MEMBERS(type, member, ...)                                            \
    {#member, sizeof(((type *)0)->member), offsetof(type, member)},           \
        __VA_OPT__(MEMBERS_AGAIN NOTHING(type, __VA_ARGS__))
#define MEMBERS_AGAIN() MEMBERS
#define NOTHING ()
/* Rescan the expansion, at least 81 times: each time MEMBERS takes the next member. */
#define REPEAT(...) REPEAT_27(REPEAT_27(REPEAT_27(__VA_ARGS__)))
#define REPEAT_27(...) REPEAT_9(REPEAT_9(REPEAT_9(__VA_ARGS__)))
#define REPEAT_9(...) REPEAT_3(REPEAT_3(REPEAT_3(__VA_ARGS__)))
#define REPEAT_3(...) AGAIN(AGAIN(AGAIN(__VA_ARGS__)))
#define AGAIN(...) __VA_ARGS__

typedef double v4 __attribute__((vector_size(32), aligned(8), may_alias));
typedef double row12[12];

static inline v4 load(const double *a) { return *(const v4 *)a; }
static inline void store(double *a, v4 v) { *(v4 *)a = v; }
static inline v4 splat(double s) { return (v4){s, s, s, s}; }
static inline v4 madd4(v4 a, v4 b, v4 c) { return a * b + c; }
/* Larger element of each pair; of a number and NaN, the number. */
#if defined(__clang__)
static inline v4 max4(v4 a, v4 b) { return __builtin_elementwise_max(a, b); }
#else /* GCC, for the sanitizers */
static inline v4 max4(v4 a, v4 b) {
    for (int i = 0; i < 4; i++) a[i] = a[i] < b[i] || a[i] != a[i] ? b[i] : a[i];
    return a;
}
#endif
static inline double madd(double a, double b, double c) { return a * b + c; }
static inline double sqrt_of(double a) { return __builtin_sqrt(a); }
static inline double min_of(double a, double b) { return a < b ? a : b; }
static inline double max_of(double a, double b) { return a > b ? a : b; }
static inline double abs_of(double a) { return __builtin_fabs(a); }
static inline int finite(double a) { return abs_of(a) <= 1.7976931348623157e308; }

/* The larger value; NaN if either is. */
static inline double max_or_nan(double a, double b) { return b <= a || a != a ? a : b; }

static inline void zero(double *a, int64_t n) {
    for (int64_t i = 0; i < n; i++) a[i] = 0.0;
}
static inline void copy(const double *a, double *out, int64_t n) {
    for (int64_t i = 0; i < n; i++) out[i] = a[i];
}
static inline int all_finite(const double *a, int64_t n) {
    for (int64_t i = 0; i < n; i++)
        if (!finite(a[i])) return 0;
    return 1;
}

/* Dot product of two rows (12). */
static inline double dot12(const double *a, const double *b) {
    v4 s = madd4(load(a + 8), load(b + 8), madd4(load(a + 4), load(b + 4), load(a) * load(b)));
    return (s[0] + s[2]) + (s[1] + s[3]);
}

static inline double dot3(const double *a, const double *b) {
    return madd(a[2], b[2], madd(a[1], b[1], a[0] * b[0]));
}
static inline void subtract3(const double *a, const double *b, double *out) {
    for (int i = 0; i < 3; i++) out[i] = a[i] - b[i];
}
static inline void cross3(const double *a, const double *b, double *out) {
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        out[i] = madd(a[j], b[k], -(a[k] * b[j]));
    }
}
/* out = M v, M (3, 3). */
static inline void multiply3(const double *m, const double *v, double *out) {
    for (int i = 0; i < 3; i++) out[i] = dot3(m + 3 * i, v);
}
/* Normalize v in place and return its length; below 1e-9 leave it unchanged and return 0. */
static inline double normalize3(double *v) {
    double length = sqrt_of(dot3(v, v));
    if (length < 1e-9) return 0.0;
    for (int i = 0; i < 3; i++) v[i] /= length;
    return length;
}

/* Allocate from the caller's working memory in pieces of whole cache lines. */
static inline double *allocate(double **work, int64_t count) {
    double *piece = *work;
    *work += (count + 7) / 8 * 8;
    return piece;
}

#endif
