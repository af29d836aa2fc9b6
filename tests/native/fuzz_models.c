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

/* Up to eight coasts in up to six steps. A bulge of the path leaves no more room. */
static void coast_room(void) {
    const int64_t steps = whole(1, 6), m = 4 * whole(1, 2);
    double *transitions = doubles(36 * (steps + 1), -3.0, 3.0), *states = doubles(6 * m, -3.0, 3.0);
    double *straight = outputs(steps), *bent = outputs(steps), *work = outputs(6 * m);
    NAME(coast_room)(steps, transitions, m, states, 0.0, straight, work);
    NAME(coast_room)(steps, transitions, m, states, value(0.0, 1.0), bent, work);
    for (int64_t k = 0; k < steps && !special_drawn; k++) CHECK(bent[k] <= straight[k]);
}

/* Up to eight coasts in up to six steps: no approach is nearer than the room of its step. */
static void coast_closest(void) {
    const int64_t steps = whole(1, 6), m = 4 * whole(1, 2), count = whole(0, steps);
    double *transitions = doubles(36 * (steps + 1), -3.0, 3.0), *states = doubles(6 * m, -3.0, 3.0);
    double *covariance = doubles(36, -1.0, 1.0), *room = outputs(steps), *work = outputs(6 * m), bulge_s = value(0.0, 1.0);
    NAME(coast_room)(steps, transitions, m, states, bulge_s, room, work);
    int64_t *columns = block((size_t)count * sizeof *columns);
    for (int64_t c = 0; c < count; c++) columns[c] = whole(0, steps - 1);
    Approaches found = {outputs(m), outputs(m), outputs(m)};
    NAME(coast_closest)(count, columns, transitions, m, states, covariance, value(0.0, 1.0), bulge_s, &found);
    double least = 1e300;
    for (int64_t c = 0; c < count; c++) least = min_of(least, room[columns[c]]);
    for (int64_t n = 0; n < m && count && !special_drawn; n++) CHECK(found.away[n] >= least - 1e-9);
}

static const Target TARGETS[] = {{"free_rotation", free_rotation}, {"coast_room", coast_room}, {"coast_closest", coast_closest}};
FUZZ_MAIN(TARGETS)
