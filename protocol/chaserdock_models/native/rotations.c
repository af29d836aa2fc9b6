/* SPDX-License-Identifier: Apache-2.0 */
/* Rotations of many quaternions or vectors: the array branches of rotations.py, with the bits of
 * its scalar ones.
 *
 * Each function takes ``n`` rows of its result, and operands of fewer rows, which it repeats. */
#include "base.h"

typedef void (*RowFunction)(const double *a, const double *b, double *out);

static inline void by_rows(RowFunction of, int64_t n, const double *a, int64_t a_rows,
                           int64_t a_width, const double *b, int64_t b_rows, int64_t b_width,
                           double *out, int64_t width) {
    for (int64_t i = 0, j = 0, k = 0; i < n; i++, j++, k++) {
        if (j == a_rows) j = 0;
        if (k == b_rows) k = 0;
        of(a + a_width * j, b + b_width * k, out + width * i);
    }
}

static inline void product(const double *a, const double *b, double *out) {
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}
static inline void rotated(const double *q, const double *v, double *out) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double tx = 2.0 * (y * v[2] - z * v[1]), ty = 2.0 * (z * v[0] - x * v[2]),
                 tz = 2.0 * (x * v[1] - y * v[0]);
    out[0] = v[0] + w * tx + (y * tz - z * ty);
    out[1] = v[1] + w * ty + (z * tx - x * tz);
    out[2] = v[2] + w * tz + (x * ty - y * tx);
}

/* Hamilton products (n, 4) of a (., 4) and b (., 4). */
EXPORT void NAME(multiply_rows)(int64_t n, const double *a, int64_t a_rows, const double *b,
                                int64_t b_rows, double *out) {
    by_rows(product, n, a, a_rows, 4, b, b_rows, 4, out, 4);
}

/* Vectors (n, 3): v (., 3) rotated by q (., 4). */
EXPORT void NAME(rotate_rows)(int64_t n, const double *q, int64_t q_rows, const double *v,
                              int64_t v_rows, double *out) {
    by_rows(rotated, n, q, q_rows, 4, v, v_rows, 3, out, 3);
}

/* Cross products (n, 3) of a (., 3) and b (., 3). */
EXPORT void NAME(cross_rows)(int64_t n, const double *a, int64_t a_rows, const double *b,
                             int64_t b_rows, double *out) {
    by_rows(cross3, n, a, a_rows, 3, b, b_rows, 3, out, 3);
}

/* Unit quaternions (n, 4) along q (n, 4). Returns 0 if one is zero or not finite, else 1. */
EXPORT int64_t NAME(unit_rows)(int64_t n, const double *q, double *out) {
    int64_t valid = 1;
    for (int64_t i = 0; i < n; i++, q += 4, out += 4) {
        const double length = sqrt_of(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        valid &= finite(length) && length > 0.0;
        for (int k = 0; k < 4; k++) out[k] = q[k] / length;
    }
    return valid;
}
