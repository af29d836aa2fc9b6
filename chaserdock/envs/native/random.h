/* SPDX-License-Identifier: Apache-2.0 */
/* Random numbers of one environment. */
#ifndef CHASERDOCK_RANDOM_H
#define CHASERDOCK_RANDOM_H

#include "base.h"

/* SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, 2014). */
static inline uint64_t next_bits(uint64_t *state) {
    uint64_t z = *state += 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

/* A number in [-1, 1). */
static inline double next_uniform(uint64_t *state) {
    return (double)(int64_t)(next_bits(state) >> 11) * 0x1p-52 - 1.0;
}

/* Natural logarithm of 0 < x < 1e300 to about 2e-16 relative to 1: exponent, and a series of the
 * inverse hyperbolic tangent for the rest. */
static inline double logarithm(double x) {
    union {
        double value;
        uint64_t bits;
    } number = {x};
    double exponent = (double)((int64_t)(number.bits >> 52) - 1022);
    number.bits = (number.bits & 0xfffffffffffffu) | 0x3fe0000000000000u;
    if (number.value < 0.7071067811865476) number.value *= 2.0, exponent -= 1.0;
    double s = (number.value - 1.0) / (number.value + 1.0), y = s * s, sum = 0.0;
    for (int i = 21; i >= 1; i -= 2) sum = sum * y + 1.0 / i;
    return exponent * 0.6931471805599453 + 2.0 * s * sum;
}

/* Standard normal numbers (count), count even: the polar method (G. Marsaglia, T. A. Bray, 1964).
 * Of 64 pairs in a row one lies within the circle but for a chance of 1e-42: the loop ends. */
static inline void next_normal(uint64_t *state, double *out, int count) {
    for (int i = 0; i < count; i += 2) {
        double a = 0.5, b = 0.5, square = 0.5;
        for (int trial = 0; trial < 64; trial++) {
            a = next_uniform(state), b = next_uniform(state), square = a * a + b * b;
            if (square < 1.0 && square > 0.0) break;
        }
        if (!(square < 1.0 && square > 0.0)) a = b = square = 0.5;
        double scale = sqrt_of(-2.0 * logarithm(square) / square);
        out[i] = a * scale, out[i + 1] = b * scale;
    }
}

#endif
