/* SPDX-License-Identifier: Apache-2.0 */
/* Cholesky factors of small matrices. */
#include "layout.h"

/* Replace the lower triangle of a symmetric matrix a (k, k) by its Cholesky factor; the upper
 * one is untouched. Return 0 if a is not positive definite or not finite. */
static int factorize(double *a, int k) {
    for (int j = 0; j < k; j++) {
        double d = a[k * j + j];
        for (int m = 0; m < j; m++) d -= a[k * j + m] * a[k * j + m];
        if (!(d > 0.0) || !finite(d)) return 0;
        a[k * j + j] = d = sqrt_of(d);
        for (int i = j + 1; i < k; i++) {
            double s = a[k * i + j];
            for (int m = 0; m < j; m++) s -= a[k * i + m] * a[k * j + m];
            a[k * i + j] = s / d;
        }
    }
    return 1;
}

/* Replace b by L^-1 b, where L is the factor (k, k) of `factorize`. */
static void solve_factor(const double *factor, int k, double *b) {
    for (int i = 0; i < k; i++) {
        for (int m = 0; m < i; m++) b[i] -= factor[k * i + m] * b[m];
        b[i] /= factor[k * i + i];
    }
}
