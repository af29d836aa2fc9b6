/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of protocol/chaserdock_models/native. */
#include "fuzz.h"
#include "kernels.c"

static void free_rotation(void) {
    const int64_t count = whole(0, 6);
    double *q = outputs(4), *omega = doubles(3, -3.0, 3.0), *inertia = outputs(9),
           *inverse = outputs(9), h = value(0.0, 0.1);
    fill_quaternion(q);
    fill_inertia(inertia, inverse);
    double *attitudes = outputs(4 * count), *rates = outputs(3 * count),
           *accelerations = outputs(3 * count);
    NAME(free_rotation)(q, omega, inertia, inverse, h, count, attitudes, rates, accelerations);
    if (count) CHECK(same_bits(attitudes, q, 4) && same_bits(rates, omega, 3));
    for (int64_t i = 1; i < count; i++) {
        const double *a = attitudes + 4 * i;
        double square = (a[0] * a[0] + a[1] * a[1]) + (a[2] * a[2] + a[3] * a[3]);
        CHECK(abs_of(square - 1.0) < 1e-9 || any_nan(a, 4) || special_drawn ||
              !all_finite(rates, 3 * count));
        if (any_nan(q, 4) || any_nan(omega, 3) || h != h) CHECK(any_nan(a, 4));
    }
}

/* Up to eight coasts in up to six steps. A bulge of the path leaves no more room. */
static void coast_room(void) {
    const int64_t steps = whole(1, 6), m = 4 * whole(1, 2);
    double *transitions = doubles(36 * (steps + 1), -3.0, 3.0), *states = doubles(6 * m, -3.0, 3.0);
    double *straight = outputs(steps), *bent = outputs(steps), *work = outputs(6 * m),
           *drift = doubles(6 * (steps + 1), -1.0, 1.0);
    NAME(coast_room)(steps, transitions, drift, m, states, 0.0, straight, work);
    NAME(coast_room)(steps, transitions, drift, m, states, value(0.0, 1.0), bent, work);
    for (int64_t k = 0; k < steps && !special_drawn; k++) CHECK(bent[k] <= straight[k]);
}

/* Up to eight coasts in up to six steps: no approach is nearer than the room of its step. */
static void coast_closest(void) {
    const int64_t steps = whole(1, 6), m = 4 * whole(1, 2), count = whole(0, steps);
    double *transitions = doubles(36 * (steps + 1), -3.0, 3.0), *states = doubles(6 * m, -3.0, 3.0);
    double *covariances = doubles(18 * count, -1.0, 1.0), *room = outputs(steps),
           *work = outputs(6 * m), *drift = doubles(6 * (steps + 1), -1.0, 1.0),
           bulge_s = value(0.0, 1.0);
    NAME(coast_room)(steps, transitions, drift, m, states, bulge_s, room, work);
    int64_t *columns = block((size_t)count * sizeof *columns);
    for (int64_t c = 0; c < count; c++) columns[c] = whole(0, steps - 1);
    Approaches found = {outputs(m), outputs(m), outputs(m)};
    NAME(coast_closest)(count, columns, transitions, drift, m, states, covariances,
                        value(0.0, 1.0), bulge_s, &found);
    double least = 1e300;
    for (int64_t c = 0; c < count; c++) least = min_of(least, room[columns[c]]);
    for (int64_t n = 0; n < m && count && !special_drawn; n++) CHECK(found.away[n] >= least - 1e-9);
}

static void rigid_step(void) {
    double *y = doubles(13, -2.0, 2.0), *wrench = doubles(6, -1.0, 1.0),
           *inertia = doubles(3, 0.01, 1.0), *before = outputs(13);
    copy(y, before, 13);
    NAME(rigid_step)(y, wrench, value(0.1, 10.0), inertia, value(0.0, 0.1));
    if (special_drawn) return;
    CHECK(all_finite(y, 13));
    NAME(rigid_step)(before, wrench, 1.0, inertia, 0.0);
    CHECK(all_finite(before, 13));
}

typedef void (*Rows)(int64_t, const double *, int64_t, const double *, int64_t, double *);

/* Up to six rows of the result, from operands of which one may have fewer: equal rows give equal
 * results. */
static void by_operands(Rows rows, int64_t a_width, int64_t width) {
    const int64_t a_rows = whole(1, 3), n = a_rows * whole(0, 2);
    double *a = doubles(a_width * a_rows, -2.0, 2.0), *b = doubles(width, -2.0, 2.0),
           *out = outputs(width * n);
    rows(n, a, a_rows, b, 1, out);
    for (int64_t i = a_rows; i < n; i++)
        CHECK(same_bits(out + width * i, out + width * (i - a_rows), width));
    double *whole_b = doubles(width * n, -2.0, 2.0);
    rows(n, a, a_rows, whole_b, n, out);
    if (!special_drawn) CHECK(all_finite(out, width * n));
}
static void multiply_rows(void) { by_operands(NAME(multiply_rows), 4, 4); }
static void rotate_rows(void) { by_operands(NAME(rotate_rows), 4, 3); }
static void cross_rows(void) { by_operands(NAME(cross_rows), 3, 3); }

static void unit_rows(void) {
    const int64_t n = whole(0, 5);
    double *q = doubles(4 * n, -2.0, 2.0), *out = outputs(4 * n);
    const int64_t valid = NAME(unit_rows)(n, q, out);
    for (int64_t i = 0; i < n && valid; i++) {
        const double *u = out + 4 * i;
        /* The square of a denormal number is inexact. */
        CHECK(special_drawn ||
              abs_of((u[0] * u[0] + u[1] * u[1]) + (u[2] * u[2] + u[3] * u[3]) - 1.0) < 1e-9);
    }
    if (any_nan(q, 4 * n)) CHECK(!valid);
}

static const Target TARGETS[] = {{"free_rotation", free_rotation}, {"coast_room", coast_room},
                                 {"coast_closest", coast_closest}, {"rigid_step", rigid_step},
                                 {"multiply_rows", multiply_rows}, {"rotate_rows", rotate_rows},
                                 {"cross_rows", cross_rows},       {"unit_rows", unit_rows}};
FUZZ_MAIN(TARGETS)
