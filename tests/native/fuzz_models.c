/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of protocol/chaserdock_models/native. */
#include "fuzz.h"
#include "kernels.c"

static void free_rotation(void) {
    const int64_t count = whole(0, 6);
    double *q = outputs(4), *omega = doubles(3, -3.0, 3.0), *inertia = outputs(9), *inverse = outputs(9), h = value(0.0, 0.1);
    fill_quaternion(q);
    fill_inertia(inertia, inverse);
    double *attitudes = outputs(4 * count), *rates = outputs(3 * count), *accelerations = outputs(3 * count);
    NAME(free_rotation)(q, omega, inertia, inverse, h, count, attitudes, rates, accelerations);
    if (count) CHECK(same_bits(attitudes, q, 4) && same_bits(rates, omega, 3));
    for (int64_t i = 1; i < count; i++) {
        const double *a = attitudes + 4 * i;
        double square = (a[0] * a[0] + a[1] * a[1]) + (a[2] * a[2] + a[3] * a[3]);
        CHECK(abs_of(square - 1.0) < 1e-9 || any_nan(a, 4) || special_drawn || !all_finite(rates, 3 * count));
        if (any_nan(q, 4) || any_nan(omega, 3) || h != h) CHECK(any_nan(a, 4));
    }
}

static const Target TARGETS[] = {{"free_rotation", free_rotation}};
FUZZ_MAIN(TARGETS)
