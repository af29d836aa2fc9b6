/* SPDX-License-Identifier: Apache-2.0 */
/* Elementary functions from + - * / only, which give the same bits on every machine. */
#ifndef CHASERDOCK_ELEMENTARY_H
#define CHASERDOCK_ELEMENTARY_H

#include "base.h"

/* Return e^x to about one unit in the last place; 0 below -700. Powers of two and a Taylor series
 * on |r| <= ln(2) / 2. */
static inline double exponential(double x) {
    if (!(x > -700.0)) return x <= -700.0 ? 0.0 : x;
    if (x > 700.0) x = 700.0;
    double n = x * 1.4426950408889634 + (x < 0.0 ? -0.5 : 0.5);
    int64_t k = (int64_t)n;
    /* ln(2) in two parts, the first short enough for exact products (W. J. Cody, W. Waite,
     * 1980). */
    double r = (x - (double)k * 0.693145751953125) - (double)k * 1.4286068203094172e-06;
    double sum = 1.0;
    for (int i = 13; i >= 1; i--) sum = madd(sum, r / (double)i, 1.0);
    union {
        int64_t bits;
        double value;
    } power = {(k + 1023) << 52};
    return sum * power.value;
}

/* Compute sine and cosine of a non-negative angle with an error of 2e-16 (within half a turn):
 * Taylor series at a quarter of the angle, doubled twice. C libraries differ between versions and
 * processors. */
static inline void sine_cosine(double angle, double *sine, double *cosine) {
    if (angle > 3.141592653589793)
        angle = angle < 1e9 ? angle - (double)(int64_t)(angle * 0.15915494309189535 + 0.5) *
                                          6.283185307179586
                            : 0.0;
    double x = 0.25 * angle, y = x * x, s = 0.0, c = 0.0;
    for (int i = 15; i >= 3; i -= 2) {
        s = y / (i * (i - 1)) * (1.0 - s);
        c = y / ((i - 1) * (i - 2)) * (1.0 - c);
    }
    s = x * (1.0 - s);
    c = 1.0 - c;
    for (int i = 0; i < 2; i++) {
        double twice = 2.0 * s * c;
        c = 1.0 - 2.0 * s * s;
        s = twice;
    }
    *sine = s;
    *cosine = c;
}

/* Return the arc tangent of x >= 0 to about 2e-16: the angle is halved three times, then its Taylor
 * series. */
static inline double arctangent(double x) {
    if (x > 1e16) return 1.5707963267948966;
    for (int i = 0; i < 3; i++) x = x / (1.0 + sqrt_of(1.0 + x * x));
    double y = x * x, sum = 0.0;
    for (int i = 23; i >= 1; i -= 2) sum = 1.0 / i - y * sum;
    return 8.0 * (x * sum);
}

/* Solve A x = b in place (A (n, n) by rows, b (n) becomes x) with row pivoting. Return 0 if A is
 * singular. */
static inline int solve_rows(double *a, double *b, int n) {
    for (int j = 0; j < n; j++) {
        int p = j;
        for (int i = j + 1; i < n; i++)
            if (abs_of(a[i * n + j]) > abs_of(a[p * n + j])) p = i;
        if (!(abs_of(a[p * n + j]) > 0.0)) return 0;
        if (p != j) {
            for (int k = j; k < n; k++) {
                double swap = a[j * n + k];
                a[j * n + k] = a[p * n + k];
                a[p * n + k] = swap;
            }
            double swap = b[j];
            b[j] = b[p];
            b[p] = swap;
        }
        for (int i = j + 1; i < n; i++) {
            double f = a[i * n + j] / a[j * n + j];
            for (int k = j + 1; k < n; k++) a[i * n + k] -= f * a[j * n + k];
            b[i] -= f * b[j];
        }
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) b[i] -= a[i * n + k] * b[k];
        b[i] /= a[i * n + i];
    }
    return 1;
}

#endif
