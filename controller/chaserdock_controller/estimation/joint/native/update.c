/* SPDX-License-Identifier: Apache-2.0 */
/* Update of mean and covariance by the measurements of one chaser. Equations:
 * docs/estimation.md. */
#include "layout.h"

/* Working memory of an update. residual (18), jacobian (18, SEEN), noise, innovation covariance
 * s (18, 18), cross (18, stride) = H P, white (18, stride), correction (D). values: for each
 * channel the squared residual normalized by its innovation covariance, then the determinant of
 * the sighting's; NaN if that is not positive definite. size: D. stride: D, rounded up to a
 * multiple of 8. */
typedef struct {
    double *residual, *jacobian, *noise, *s, *cross, *white, *correction, *values;
    int64_t stride, size;
} Innovation;
LAYOUT(Innovation, residual, jacobian, noise, s, cross, white, correction, values, stride, size)

static void body_difference(const double *a, const double *b, double *error) {
    for (int i = 0; i < 3; i++) {
        error[POSITION + i] = b[i] - a[i];
        error[VELOCITY + i] = b[3 + i] - a[3 + i];
        error[RATE + i] = b[OMEGA + i] - a[OMEGA + i];
    }
    double q[4];
    relative_quaternion(a + QUATERNION, b + QUATERNION, q);
    logarithmic_map(q, error + ATTITUDE);
}

static void chaser_difference(const double *a, const double *b, double *error) {
    body_difference(a, b, error);
    for (int k = FORCE; k < CHASER; k++) error[k] = b[ADDITIVE + k] - a[ADDITIVE + k];
}

/* Compute the error (D) that takes the mean `a` to `b`. */
EXPORT void NAME(difference)(int64_t n, const double *a, const double *b, double *error) {
    body_difference(a, b, error);
    for (int64_t i = 0; i < n; i++)
        chaser_difference(chaser_of(a, i), chaser_of(b, i), error + first_of(i));
}

static void inject_body(const double *x, const double *error, double *out) {
    double turn[4];
    for (int i = 0; i < 3; i++) {
        out[i] = x[i] + error[POSITION + i];
        out[3 + i] = x[3 + i] + error[VELOCITY + i];
        out[OMEGA + i] = x[OMEGA + i] + error[RATE + i];
    }
    exponential_map(error + ATTITUDE, turn);
    multiply_quaternions(x + QUATERNION, turn, out + QUATERNION);
    normalize_quaternion(out + QUATERNION);
}

/* Correct the mean by an error (D). `out` may be the mean itself. */
EXPORT void NAME(inject)(int64_t n, const double *mean, const double *error, double *out) {
    inject_body(mean, error, out);
    for (int64_t i = 0; i < n; i++) {
        const double *x = chaser_of(mean, i), *own = error + first_of(i);
        double *to = out + TARGET_MEAN + CHASER_MEAN * i;
        inject_body(x, own, to);
        for (int k = FORCE; k < CHASER; k++) to[ADDITIVE + k] = x[ADDITIVE + k] + own[k];
    }
}

/* Copy the rows of the covariance that belong to target and chaser i to `seen` (SEEN, d), from
 * the lower triangle of p. */
static void gather(const double *p, int64_t d, int64_t i, double *seen) {
    const int64_t first = first_of(i);
    for (int64_t r = 0; r < SEEN; r++) {
        const int64_t at = r < TARGET ? r : first + r - TARGET;
        copy(p + d * at, seen + d * r, at + 1);
    }
    for (int64_t c = 1; c < d; c++) {
        const double *row = p + d * c;
        for (int64_t r = 0; r < TARGET && r < c; r++) seen[d * r + c] = row[r];
        for (int64_t r = 0; r < CHASER && first + r < c; r++)
            seen[d * (TARGET + r) + c] = row[first + r];
    }
}

/* Return the squared residual of the rows first .. first + k - 1, normalized by their
 * innovation covariance, and write its determinant. */
static double normalized_square(const double *s, int rows, const double *residual, int first, int k,
                                double *determinant) {
    double factor[SIGHTING_ROWS * SIGHTING_ROWS], b[SIGHTING_ROWS], square = 0.0;
    for (int i = 0; i < k; i++) {
        b[i] = residual[first + i];
        for (int j = 0; j < k; j++) factor[k * i + j] = s[rows * (first + i) + first + j];
    }
    *determinant = __builtin_nan("");
    if (!factorize(factor, k)) return __builtin_nan("");
    solve_factor(factor, k, b);
    *determinant = 1.0;
    for (int i = 0; i < k; i++) {
        square += b[i] * b[i];
        *determinant *= factor[k * i + i] * factor[k * i + i];
    }
    return square;
}

EXPORT int64_t NAME(innovate_workspace)(int64_t d) { return SEEN * d + TARGET + CHASER + 2 * 8; }

/* Linearize the measurements at `mean` and compute the innovation with the lower triangle of
 * `covariance` (D, D). In an iterated update the residual is, to first order, that of the prior
 * mean `prior`; in the first iteration `prior` equals `mean`. */
EXPORT void NAME(innovate)(const Measurement *z, const double *mean, const double *prior,
                           const double *covariance, Innovation *out, double *work) {
    const int64_t d = out->size, first = first_of(z->i), stride = out->stride;
    const int k = rows_of(z);
    double *seen = allocate(&work, SEEN * d), *error = allocate(&work, SEEN), *s = out->s;
    NAME(linearize)(z, mean, out->residual, out->jacobian, out->noise);
    if (mean != prior) {
        body_difference(prior, mean, error);
        chaser_difference(chaser_of(prior, z->i), chaser_of(mean, z->i), error + TARGET);
        for (int r = 0; r < k; r++)
            for (int j = 0; j < SEEN; j++)
                out->residual[r] += out->jacobian[SEEN * r + j] * error[j];
    }
    gather(covariance, d, z->i, seen);
    zero(out->cross, k * stride);
    for (int r = 0; r < k; r++) {
        const double *h = out->jacobian + SEEN * r;
        double *cross = out->cross + stride * r;
        for (int j = 0; j < SEEN; j++) {
            const double *row = seen + d * j;
            if (h[j] == 0.0) continue; /* most of them */
            for (int64_t c = 0; c < d; c++) cross[c] += h[j] * row[c];
        }
    }
    for (int r = 0; r < k; r++)
        for (int l = 0; l <= r; l++) {
            const double *h = out->jacobian + SEEN * l, *cross = out->cross + stride * r;
            double sum = 0.0;
            for (int j = 0; j < SEEN; j++)
                if (h[j] != 0.0) sum += h[j] * cross[j < TARGET ? j : first + j - TARGET];
            sum += out->noise[k * r + l];
            s[k * r + l] = s[k * l + r] = sum;
        }
    double unused;
    for (int c = 0; c <= CHANNELS; c++) out->values[c] = __builtin_nan("");
    int row = 0;
    if (z->sighting) {
        out->values[0] =
            normalized_square(s, k, out->residual, 0, SIGHTING_ROWS, out->values + CHANNELS);
        row = SIGHTING_ROWS;
    }
    if (z->odometry)
        for (int c = 1; c < CHANNELS; c++, row += 3)
            out->values[c] = normalized_square(s, k, out->residual, row, 3, &unused);
}

/* Correct the mean `prior` by the `used` rows (m) of an innovation of k rows, and write the
 * result to `mean`; keep white = L^-1 H P and the correction in `z`. Return 0, with `mean`
 * unchanged, if their innovation covariance is not positive definite. */
EXPORT int64_t NAME(correct)(int64_t n, int64_t k, const int64_t *used, int64_t m, Innovation *z,
                             const double *prior, double *mean) {
    double factor[MOST_ROWS * MOST_ROWS], y[MOST_ROWS];
    const int64_t d = z->size, stride = z->stride;
    for (int64_t i = 0; i < m; i++) {
        y[i] = z->residual[used[i]];
        for (int64_t j = 0; j < m; j++) factor[m * i + j] = z->s[k * used[i] + used[j]];
    }
    if (!factorize(factor, (int)m)) return 0;
    solve_factor(factor, (int)m, y);
    zero(z->correction, d);
    for (int64_t i = 0; i < m; i++) {
        double *row = z->white + stride * i;
        copy(z->cross + stride * used[i], row, stride);
        for (int64_t j = 0; j < i; j++) {
            const double *other = z->white + stride * j, f = factor[m * i + j];
            for (int64_t c = 0; c < d; c++) row[c] -= f * other[c];
        }
        const double pivot = factor[m * i + i];
        for (int64_t c = 0; c < d; c++) row[c] /= pivot;
        for (int64_t c = 0; c < d; c++) z->correction[c] += y[i] * row[c];
    }
    NAME(inject)(n, prior, z->correction, mean);
    return 1;
}

/* Reduce the lower triangle of `covariance` by the m rows of white, and refer the rotation
 * errors of target and chaser i to their corrected attitudes. */
EXPORT void NAME(reduce)(int64_t i, int64_t m, const Innovation *z, double *covariance) {
    const int64_t d = z->size, own = first_of(i) + ATTITUDE;
    subtract_square(z->white, (int)m, z->stride, covariance, d);
    turn_error(covariance, d, ATTITUDE, z->correction + ATTITUDE);
    turn_error(covariance, d, own, z->correction + own);
}

/* Fill the upper triangle of a covariance (D, D) from the lower one. */
EXPORT void NAME(complete)(int64_t d, double *covariance) { mirror(covariance, d); }
