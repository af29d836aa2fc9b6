/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of controller/chaserdock_controller/estimation/joint/native. */
#include "fuzz.h"
#include "kernels.c"

static double *means(int64_t n) {
    double *mean = doubles(TARGET_MEAN + CHASER_MEAN * n, -0.2, 0.2);
    fill_quaternion(mean + QUATERNION);
    for (int64_t i = 0; i < n; i++)
        fill_quaternion(mean + TARGET_MEAN + CHASER_MEAN * i + QUATERNION);
    return mean;
}

/* A symmetric matrix (d, d), positive definite without special values. */
static double *covariances(int64_t d) {
    double *a = doubles(d * d, -0.01, 0.01);
    for (int64_t i = 0; i < d; i++) {
        a[d * i + i] = value(1.0, 2.0);
        for (int64_t j = 0; j < i; j++) a[d * j + i] = a[d * i + j];
    }
    return a;
}

static Measurement *measurement_of(int64_t n) {
    Measurement *z = block(sizeof *z);
    const int kind = (int)whole(1, 3);
    double *camera = outputs(4), *odometry = doubles(13, -0.2, 0.2),
           *sighting = doubles(7, -0.2, 0.2);
    fill_quaternion(camera);
    fill_quaternion(odometry + QUATERNION);
    fill_quaternion(sighting + 3);
    double *axes = doubles(9, -1.0, 1.0), *stated = covariances(6),
           *view = whole(0, 1) ? stated : covariances(6);
    *z = (Measurement){n,
                       whole(0, n - 1),
                       doubles(3, -0.1, 0.1),
                       axes,
                       camera,
                       kind & 1 ? odometry : NULL,
                       covariances(12),
                       kind & 2 ? sighting : NULL,
                       stated,
                       view,
                       value(0.5, 2.0),
                       value(0.2, 2.0)};
    return z;
}

/* Size of an error vector of n chasers, with or without further components. */
static int64_t any_size(int64_t n) { return size_of(n) + 8 * whole(0, 1); }

static Innovation *innovation_of(int64_t d) {
    const int64_t stride = (d + 7) / 8 * 8;
    Innovation *out = block(sizeof *out);
    *out = (Innovation){outputs(MOST_ROWS),
                        outputs(MOST_ROWS * SEEN),
                        outputs(MOST_ROWS * MOST_ROWS),
                        outputs(MOST_ROWS * MOST_ROWS),
                        outputs(MOST_ROWS * stride),
                        outputs(MOST_ROWS * stride),
                        outputs(d),
                        outputs(CHANNELS + 1),
                        stride,
                        d};
    return out;
}

static void wrench_at_origin(void) {
    double *wrench = doubles(6, -1.0, 1.0), *centre = doubles(3, -0.1, 0.1),
           *omega = doubles(3, -1.0, 1.0);
    double *inertia = doubles(3, 0.3, 1.0), *out = outputs(6);
    NAME(wrench_at_origin)(wrench, centre, omega, value(5.0, 20.0), inertia, out);
    if (!special_drawn) CHECK(all_finite(out, 6));
}

static void predict(void) {
    const int64_t n = whole(1, 2), d = any_size(n);
    Motion *m = block(sizeof *m);
    fill((double *)m, (int64_t)(sizeof *m / sizeof(double)), 0.01, 1.0);
    int64_t *alive = block((size_t)n * 8), *latched = block((size_t)n * 8);
    for (int64_t i = 0; i < n; i++) alive[i] = whole(0, 1), latched[i] = whole(0, 1);
    double *mean = means(n), *out = outputs(d * d);
    NAME(predict)(m, n, d, doubles(144, -1.0, 1.0), covariances(12), doubles(GIVEN * n, -0.1, 0.1),
                  doubles(6 * n, -0.1, 0.1), doubles(n, 0.0, 1.0), doubles(CHASER - 12, 0.0, 1.0),
                  alive, latched, mean, covariances(d), out,
                  outputs(NAME(predict_workspace)(n, d)));
    if (!special_drawn)
        CHECK(all_finite(out, d * d) && all_finite(mean, TARGET_MEAN + CHASER_MEAN * n));
    for (int64_t i = 0; i < d; i++)
        for (int64_t j = 0; j < i; j++) CHECK(same_bits(out + d * i + j, out + d * j + i, 1));
}

static void linearize(void) {
    const int64_t n = whole(1, 2);
    const Measurement *z = measurement_of(n);
    const int k = rows_of(z);
    double *residual = outputs(k), *h = outputs(k * SEEN), *noise = outputs(k * k);
    NAME(linearize)(z, means(n), residual, h, noise);
    if (!special_drawn)
        CHECK(all_finite(residual, k) && all_finite(h, k * SEEN) && all_finite(noise, k * k));
}

static void predict_sighting(void) {
    const int64_t n = whole(1, 2);
    double *camera = outputs(4), *pose = outputs(7), *h = outputs(SIGHTING_ROWS * SEEN);
    fill_quaternion(camera);
    NAME(predict_sighting)(means(n), whole(0, n - 1), doubles(3, -0.1, 0.1), doubles(9, -1.0, 1.0),
                           camera, pose, h);
    if (!special_drawn) CHECK(all_finite(pose, 7) && all_finite(h, SIGHTING_ROWS * SEEN));
}

static void difference(void) {
    const int64_t n = whole(0, 3), d = size_of(n);
    double *error = outputs(d);
    NAME(difference)(n, means(n), means(n), error);
    if (!special_drawn) CHECK(all_finite(error, d));
}

static void inject(void) {
    const int64_t n = whole(0, 3), size = TARGET_MEAN + CHASER_MEAN * n;
    double *mean = means(n), *error = doubles(size_of(n), -0.2, 0.2), *out = outputs(size);
    NAME(inject)(n, mean, error, out);
    if (!special_drawn) CHECK(all_finite(out, size));
    if (mean[0] != mean[0]) CHECK(out[0] != out[0]);
}

static void innovate(void) {
    const int64_t n = whole(1, 2);
    const Measurement *z = measurement_of(n);
    const int k = rows_of(z);
    double *mean = means(n), *prior = chance(0.5) ? mean : means(n);
    const int64_t d = any_size(n);
    Innovation *out = innovation_of(d);
    NAME(innovate)(z, mean, prior, covariances(d), out, outputs(NAME(innovate_workspace)(d)));
    if (!special_drawn) CHECK(all_finite(out->s, k * k) && all_finite(out->cross, k * out->stride));
    if (!special_drawn && z->sighting) CHECK(out->values[0] >= 0.0 && out->values[CHANNELS] > 0.0);
    for (int c = 0; c < CHANNELS; c++)
        CHECK(out->values[c] >= 0.0 || out->values[c] != out->values[c]);
}

/* Random rows of a random innovation, by a covariance that is not always positive definite. */
static void correct(void) {
    const int64_t n = whole(1, 2), k = whole(1, MOST_ROWS), size = TARGET_MEAN + CHASER_MEAN * n;
    Innovation *z = innovation_of(any_size(n));
    int64_t *used = block((size_t)k * sizeof *used), m = 0;
    for (int64_t r = 0; r < k; r++)
        if (chance(0.7)) used[m++] = r;
    z->s = covariances(k);
    fill(z->residual, k, -0.1, 0.1);
    fill(z->cross, k * z->stride, -0.1, 0.1);
    double *mean = outputs(size), *given = copy_of(mean, size);
    const int64_t valid = NAME(correct)(n, k, used, m, z, means(n), mean);
    CHECK(valid ? special_drawn || all_finite(mean, size)
                : special_drawn && same_bits(mean, given, size));
}

static void reduce(void) {
    const int64_t n = whole(1, 2), m = whole(0, MOST_ROWS), d = any_size(n);
    Innovation *z = innovation_of(d);
    double *p = covariances(d);
    fill(z->white, m * z->stride, -0.01, 0.01);
    fill(z->correction, d, -0.1, 0.1);
    NAME(reduce)(whole(0, n - 1), m, z, p);
    for (int64_t i = 0; i < d && !special_drawn; i++) CHECK(finite(p[d * i + i]));
}

static void complete(void) {
    const int64_t d = any_size(whole(0, 3));
    double *p = doubles(d * d, -1.0, 1.0);
    NAME(complete)(d, p);
    for (int64_t i = 0; i < d; i++)
        for (int64_t j = 0; j < i; j++) CHECK(same_bits(p + d * i + j, p + d * j + i, 1));
}

static const Target TARGETS[] = {
    {"predict", predict},
    {"linearize", linearize},
    {"difference", difference},
    {"inject", inject},
    {"innovate", innovate},
    {"correct", correct},
    {"reduce", reduce},
    {"complete", complete},
    {"wrench_at_origin", wrench_at_origin},
    {"predict_sighting", predict_sighting},
};
FUZZ_MAIN(TARGETS)
