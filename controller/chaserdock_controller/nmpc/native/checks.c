/* SPDX-License-Identifier: Apache-2.0 */
/* Checks of a problem before it is solved. */
#include "base.h"

/* Normalize the quaternions in columns first..first+3 of array (K, width) in place. Return 1
 * for a value that is not finite, 2 for a quaternion farther off unit length than the
 * tolerance, else 0. */
EXPORT int64_t NAME(normalize_rows)(double *array, int64_t rows, int64_t width, int64_t first,
                              double tolerance) {
    int64_t bad = 0;
    for (int64_t i = 0; i < rows; i++) {
        double *row = array + width * i, *q = row + first;
        for (int64_t j = 0; j < width; j++)
            if (!finite(row[j])) return 1;
        double length = sqrt_of((q[0] * q[0] + q[2] * q[2]) + (q[1] * q[1] + q[3] * q[3]));
        if (abs_of(length - 1.0) > tolerance) bad = 2;
        else
            for (int j = 0; j < 4; j++) q[j] /= length;
    }
    return bad;
}

/* Return 1 if a value is not finite, else 2 if one is negative, else 0. */
EXPORT int64_t NAME(sign_of)(const double *array, int64_t count) {
    int64_t negative = 0;
    for (int64_t i = 0; i < count; i++) {
        if (!finite(array[i])) return 1;
        if (array[i] < 0.0) negative = 2;
    }
    return negative;
}
