/* SPDX-License-Identifier: Apache-2.0 */
/* Covariance (D, D) of the error vector: prediction, and reduction by measured rows. */
#include "layout.h"

/* Copy the lower triangle of a (d, d) to its upper one. */
static void mirror(double *a, int64_t d) {
    for (int64_t r0 = 0; r0 < d; r0 += 8)
        for (int64_t c0 = 0; c0 <= r0; c0 += 8)
            for (int64_t r = r0; r < r0 + 8 && r < d; r++)
                for (int64_t c = c0; c < c0 + 8 && c < r; c++) a[d * c + r] = a[d * r + c];
}

/* Write the first `columns` (at least 12) elements of F x to the rows 0 .. 11 of `out` (rows of
 * length d). F' = `f` (k, 12); x: the k rows of `p`. */
static void transform_rows(const double *f, int k, const double *p, int64_t d, int64_t columns,
                           double *out) {
    for (int64_t at = 0; at < columns; at += 4) {
        const int64_t c = at + 4 <= columns ? at : columns - 4; /* the last columns once more */
        v4 sum[12];
        for (int r = 0; r < 12; r++) sum[r] = splat(0.0);
        for (int m = 0; m < k; m++) {
            const v4 x = load(p + d * m + c);
            for (int r = 0; r < 12; r++) sum[r] = madd4(splat(f[12 * m + r]), x, sum[r]);
        }
        for (int r = 0; r < 12; r++) store(out + d * r + c, sum[r]);
    }
}

/* Write x F' to out (12). F' = `f` (k, 12), x (k). */
static void transform_row(const double *f, int k, const double *x, double *out) {
    v4 a = splat(0.0), b = a, c = a;
    for (int m = 0; m < k; m++) {
        const v4 s = splat(x[m]);
        a = madd4(s, load(f + 12 * m), a);
        b = madd4(s, load(f + 12 * m + 4), b);
        c = madd4(s, load(f + 12 * m + 8), c);
    }
    store(out, a), store(out + 4, b), store(out + 8, c);
}

/* Write the lower triangle of F P F' to `out`, P = `p` (d, d). F is block diagonal: the
 * transpose of `target` (12, 12); for each chaser its rows from `motion_transition`, in
 * `motion` (n, MOTION, COUPLED), and factors `fade` (n, CHASER) of its components from MOTION
 * on; identity for what follows the chasers. `g`: working memory (d, d). */
static void propagate(int64_t n, int64_t d, const double *target, const double *motion,
                      const double *fade, const double *p, double *g, double *out) {
    const int64_t end = size_of(n);
    transform_rows(target, TARGET, p, d, TARGET, g);
    for (int64_t i = 0; i < n; i++) {
        const int64_t first = first_of(i), columns = first + CHASER;
        const double *own = p + d * first;
        double *rows = g + d * first;
        transform_rows(motion + MOTION * COUPLED * i, MOTION, own, d, columns, rows);
        copy(own + d * COUPLED, rows + d * COUPLED, d * (MOTION - COUPLED));
        for (int64_t r = MOTION; r < CHASER; r++)
            for (int64_t c = 0; c < columns; c++)
                rows[d * r + c] = fade[CHASER * i + r] * own[d * r + c];
    }
    copy(p + d * end, g + d * end, d * (d - end));
    for (int64_t r = 0; r < d; r++) {
        const double *row = g + d * r;
        double *to = out + d * r;
        for (int64_t c = end; c <= r; c++) to[c] = row[c];
        transform_row(target, TARGET, row, to);
        for (int64_t j = 0; j < n && first_of(j) <= r; j++) {
            const double *x = row + first_of(j), *f = fade + CHASER * j;
            double *y = to + first_of(j);
            transform_row(motion + MOTION * COUPLED * j, MOTION, x, y);
            for (int c = COUPLED; c < MOTION; c++) y[c] = x[c];
            for (int c = MOTION; c < CHASER; c++) y[c] = f[c] * x[c];
        }
    }
}

/* Add `added` to element (r, c), r >= c, relative to component `first` of a covariance (d, d). */
static void add_element(double *p, int64_t d, int64_t first, int r, int c, double added) {
    p[d * (first + r) + first + c] += added;
}

/* Add the process noise of a chaser to the lower triangle. magnitude (6): of the impulses of its
 * actuators, which may cancel. prior (CHASER - 12): variances of additive states. */
static void add_noise(double *p, int64_t d, int64_t first, const double *magnitude,
                      const double *fade, const double *prior, int is_latched, const Motion *m) {
    const double force = length3(magnitude), dt = m->dt;
    for (int k = 0; k < 3; k++) {
        double linear = m->latched_acceleration * dt,
               angular = m->latched_angular_acceleration * dt;
        linear *= linear, angular *= angular;
        if (!is_latched) {
            const double share = m->control_force_share * force / m->mass,
                         unknown = m->force_max * m->unknown_s / m->mass;
            linear = share * share + unknown * unknown;
            const double torque = m->control_torque_share * magnitude[3 + k],
                         arm = m->control_arm * force;
            const double more = m->torque_max * m->unknown_s;
            angular = (torque * torque + arm * arm + more * more) / (m->inertia[k] * m->inertia[k]);
        }
        /* On average an impulse acts in the middle of the interval. */
        add_element(p, d, first, VELOCITY + k, VELOCITY + k, linear);
        add_element(p, d, first, POSITION + k, POSITION + k, linear * dt * dt / 3.0);
        add_element(p, d, first, VELOCITY + k, POSITION + k, linear * dt / 2.0);
        add_element(p, d, first, RATE + k, RATE + k, angular);
        add_element(p, d, first, ATTITUDE + k, ATTITUDE + k, angular * dt * dt / 3.0);
        add_element(p, d, first, RATE + k, ATTITUDE + k, angular * dt / 2.0);
        if (is_latched) continue;
        add_element(p, d, first, FORCE + k, FORCE + k,
                    m->disturbance_force * m->disturbance_force * dt);
        add_element(p, d, first, TORQUE + k, TORQUE + k,
                    m->disturbance_torque * m->disturbance_torque * dt);
    }
    for (int k = CENTRE; k < CHASER; k++)
        add_element(p, d, first, k, k, (1.0 - fade[k] * fade[k]) * prior[k - 12]);
}

EXPORT int64_t NAME(predict_workspace)(int64_t n, int64_t d) {
    return d * d + n * (MOTION * COUPLED + CHASER) + 144 + 4 * 8;
}

/* Predict the chasers' `mean` in place, and `covariance` (D, D) to `out`. target, target_noise (12,
 * 12): of the target. given (n, 3, 6): of the actuators, the impulse (N s, N m s), its first moment
 * about the middle of dt, and the sum of the magnitudes of its parts. orbital (n, 6): wrench of the
 * orbit. fade_view (n,): decay of the view's error. alive, latched (n,): 0 or 1. prior (31):
 * variances of the additive states. */
EXPORT void NAME(predict)(const Motion *m, int64_t n, int64_t d, const double *target,
                          const double *target_noise, const double *given, const double *orbital,
                          const double *fade_view, const double *prior, const int64_t *alive,
                          const int64_t *latched, double *mean, const double *covariance,
                          double *out, double *work) {
    double *g = allocate(&work, d * d), *motion = allocate(&work, n * MOTION * COUPLED),
           *fade = allocate(&work, n * CHASER);
    double *transposed = allocate(&work, 144);
    for (int i = 0; i < 12; i++)
        for (int j = 0; j < 12; j++) transposed[12 * j + i] = target[12 * i + j];
    for (int64_t i = 0; i < n; i++) {
        double *x = mean + TARGET_MEAN + CHASER_MEAN * i, *own = fade + CHASER * i, wrench[6] = {0},
               lead[6] = {0}, centre[3] = {0}, total[6];
        const double *impulse = given + GIVEN * i, *moment = impulse + 6;
        double *additive = x + ADDITIVE;
        for (int k = 0; k < CHASER; k++) own[k] = k >= VIEW ? fade_view[i] : 1.0;
        for (int k = 0; k < 3; k++)
            own[POSITION_DRIFT + k] = m->fade_position, own[ATTITUDE_DRIFT + k] = m->fade_attitude;
        if (!latched[i]) {
            for (int k = 0; k < 6; k++) {
                wrench[k] = impulse[k] / m->dt + additive[FORCE + k];
                lead[k] = moment[k] / m->dt;
            }
            copy(additive + CENTRE, centre, 3);
        }
        shift_wrench(wrench, centre, x + OMEGA, m->mass, m->inertia, total);
        motion_transition(x, wrench, total, lead, centre, m, motion + MOTION * COUPLED * i);
        for (int k = 0; k < 6; k++) total[k] += orbital[6 * i + k];
        /* A constant wrench has no moment: impulses at both ends that cancel add it. */
        push(x, lead, 1.0, centre, m);
        move(x, total, m);
        push(x, lead, -1.0, centre, m);
        for (int k = FORCE; k < CHASER; k++) additive[k] *= own[k];
    }
    propagate(n, d, transposed, motion, fade, covariance, g, out);
    for (int i = 0; i < TARGET; i++)
        for (int j = 0; j <= i; j++) out[d * i + j] += target_noise[12 * i + j];
    for (int64_t i = 0; i < n; i++)
        if (alive[i])
            add_noise(out, d, first_of(i), given + GIVEN * i + 12, fade + CHASER * i, prior,
                      latched[i] != 0, m);
    mirror(out, d);
}

/* Subtract W'W from the lower triangle of p (d, d). W: the k rows of `w`, of length `stride`,
 * with zeros from d on (stride: a multiple of 8, at least d + 3). */
static void subtract_square(const double *w, int k, int64_t stride, double *p, int64_t d) {
    for (int64_t r = 0; r < d; r += 4)
        for (int64_t c = 0; c <= r + 3 && c < d; c += 8) {
            v4 sum[8];
            for (int i = 0; i < 8; i++) sum[i] = splat(0.0);
            for (int m = 0; m < k; m++) {
                const double *row = w + stride * m;
                const v4 left = load(row + c), right = load(row + c + 4);
                for (int i = 0; i < 4; i++) {
                    const v4 s = splat(row[r + i]);
                    sum[2 * i] = madd4(s, left, sum[2 * i]);
                    sum[2 * i + 1] = madd4(s, right, sum[2 * i + 1]);
                }
            }
            for (int i = 0; i < 4 && r + i < d; i++) {
                double *to = p + d * (r + i) + c;
                if (c + 8 <= d) {
                    store(to, load(to) - sum[2 * i]);
                    store(to + 4, load(to + 4) - sum[2 * i + 1]);
                } else {
                    for (int64_t j = 0; c + j < d; j++) to[j] -= sum[2 * i + j / 4][j % 4];
                }
            }
        }
}

/* Refer the rotation error at `first` to an attitude that was corrected by `correction` (3):
 * update the lower triangle of p (Sola eq. 287). */
static void turn_error(double *p, int64_t d, int64_t first, const double *correction) {
    double reset[9], transposed[9];
    right_jacobian(correction, reset);
    transpose_matrix(reset, transposed);
    double *rows = p + d * first;
    for (int64_t c = 0; c < first; c++) {
        const double column[3] = {rows[c], rows[d + c], rows[2 * d + c]};
        for (int i = 0; i < 3; i++) rows[d * i + c] = dot3(reset + 3 * i, column);
    }
    double own[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            own[3 * i + j] = i >= j ? rows[d * i + first + j] : rows[d * j + first + i];
    multiply_matrices(reset, own, own);
    multiply_matrices(own, transposed, own);
    put(rows, d, first, 1.0, own);
    for (int64_t r = first + 3; r < d; r++) {
        double *row = p + d * r + first;
        const double before[3] = {row[0], row[1], row[2]};
        for (int i = 0; i < 3; i++) row[i] = dot3(reset + 3 * i, before);
    }
}
