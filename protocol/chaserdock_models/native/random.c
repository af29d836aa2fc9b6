/* SPDX-License-Identifier: Apache-2.0 */
/* State of a random generator from the words of its seed: the bits of NumPy's SeedSequence. */
#include "base.h"

#define POOL 4

/* The hash of M. E. O'Neill's randutils::seed_seq_fe. */
static inline uint32_t hashed(uint32_t value, uint32_t *constant, uint32_t factor) {
    value ^= *constant;
    *constant *= factor;
    value *= *constant;
    return value ^ value >> 16;
}
static inline uint32_t mixed(uint32_t a, uint32_t b) {
    const uint32_t value = 0xca01f9ddu * a - 0x4973f715u * b;
    return value ^ value >> 16;
}

/* state (4): what ``SeedSequence(words).generate_state(4, uint64)`` returns for `n` words below 2^32. */
EXPORT void NAME(seed_state)(int64_t n, const int64_t *words, uint64_t *state) {
    const uint32_t factor = 0x931e8875u;
    uint32_t pool[POOL], constant = 0x43b0d7e5u;
    for (int i = 0; i < POOL; i++) pool[i] = hashed(i < n ? (uint32_t)words[i] : 0, &constant, factor);
    for (int from = 0; from < POOL; from++)
        for (int to = 0; to < POOL; to++)
            if (from != to) pool[to] = mixed(pool[to], hashed(pool[from], &constant, factor));
    for (int64_t i = POOL; i < n; i++)
        for (int to = 0; to < POOL; to++) pool[to] = mixed(pool[to], hashed((uint32_t)words[i], &constant, factor));
    constant = 0x8b51f9ddu;
    for (int i = 0; i < 4; i++) {
        const uint32_t low = hashed(pool[2 * i % POOL], &constant, 0x58f38dedu);
        state[i] = (uint64_t)hashed(pool[(2 * i + 1) % POOL], &constant, 0x58f38dedu) << 32 | low;
    }
}
