/* SPDX-License-Identifier: Apache-2.0 */
/* Linearized measurements of a chaser. Models: measurements.py. */
#include "layout.h"

/* Measurements of chaser i of n. lens (3), axes (3, 3), camera (4): nominal mounting. odometry
 * (13): position, velocity, attitude, rate; noise (12, 12). sighting (7): position, attitude in
 * IRF; stated covariance (6, 6) with the floor. view (6, 6): covariance that defines the unit
 * of the view error. Either odometry or sighting may be null. */
typedef struct {
    int64_t n, i;
    const double *lens, *axes, *camera, *odometry, *odometry_noise, *sighting, *stated, *view;
    double white_ratio, view_ratio;
} Measurement;
LAYOUT(Measurement, n, i, lens, axes, camera, odometry, odometry_noise, sighting, stated, view,
       white_ratio, view_ratio)

static int rows_of(const Measurement *z) {
    return (z->sighting ? SIGHTING_ROWS : 0) + (z->odometry ? ODOMETRY_ROWS : 0);
}

/* Predict the sighting of the target (mean `t`) by a chaser (mean `x`): position and attitude
 * (4) in IRF, and the Jacobian (6, SEEN) by the errors of target and chaser, without the view
 * error. */
static void predict_pose(const double *t, const double *x, const double *lens,
                         const double *mounting, const double *camera, double *position,
                         double *attitude, double *h) {
    const double *additive = x + ADDITIVE, *delta = additive + TURN;
    const double minus[3] = {-delta[0], -delta[1], -delta[2]};
    double c[9], rt[9], c_t[9], rt_t[9], mounting_t[9], axes_t[9], turned[9], jr[9], line[9], m[9],
        n[9], q[4], offset[3];
    matrix_of(x + QUATERNION, c);
    matrix_of(t + QUATERNION, rt);
    transpose_matrix(c, c_t);
    transpose_matrix(rt, rt_t);
    transpose_matrix(mounting, mounting_t);
    multiply_matrices(c, mounting, m);
    transpose_matrix(m, axes_t);
    exponential_map(minus, q);
    matrix_of(q, turned);
    right_jacobian(minus, jr);
    double to_target[3], in_camera[3];
    subtract3(t, x, offset);
    multiply3(c_t, offset, to_target); /* CRF */
    subtract3(to_target, lens, offset);
    multiply3(mounting_t, offset, in_camera);
    subtract3(in_camera, additive + SHIFT, in_camera);
    const double scale = 1.0 / (1.0 + additive[FOCAL]);
    copy(turned, line, 9);
    for (int j = 0; j < 3; j++) line[6 + j] *= scale;
    multiply3(line, in_camera, position);
    zero(h, SIGHTING_ROWS * SEEN);
    multiply_matrices(line, axes_t, m);
    put(h, SEEN, POSITION, 1.0, m);
    put_identity(h + 3 * SEEN, SEEN, ATTITUDE);
    double *by_chaser = h + TARGET, *rotation = by_chaser + 3 * SEEN;
    put(by_chaser, SEEN, POSITION, -1.0, m);
    multiply_matrices(line, mounting_t, m);
    skew(to_target, n);
    multiply_matrices(m, n, m);
    put(by_chaser, SEEN, ATTITUDE, 1.0, m);
    skew(in_camera, n);
    multiply_matrices(line, n, m);
    multiply_matrices(m, jr, m);
    put(by_chaser, SEEN, TURN, 1.0, m);
    put(by_chaser, SEEN, SHIFT, -1.0, line);
    by_chaser[2 * SEEN + FOCAL] = -position[2] * scale;
    multiply_matrices(rt_t, c, m);
    put(rotation, SEEN, ATTITUDE, -1.0, m);
    multiply_matrices(m, mounting, m);
    multiply_matrices(m, jr, m);
    put(rotation, SEEN, TURN, -1.0, m);
    double turn[4], q_camera[4];
    exponential_map(delta, turn);
    multiply_quaternions(x + QUATERNION, camera, q_camera);
    multiply_quaternions(q_camera, turn, q_camera);
    relative_quaternion(q_camera, t + QUATERNION, attitude);
}

/* Return in `turn` the rotation vector from the predicted to the measured attitude. */
static void turn_between(const double *predicted, const double *measured, double *turn) {
    double q[4];
    relative_quaternion(predicted, measured, q);
    normalize_quaternion(q);
    logarithmic_map(q, turn);
}

/* Write residual (6), Jacobian (6, SEEN) and noise of a sighting, in rows of length `k`. If a
 * covariance is not positive definite, the noise is NaN and the view error is left out. */
static void linearize_sighting(const Measurement *z, const double *t, const double *x,
                               double *residual, double *h, double *noise, int k) {
    double position[3], attitude[4], factor[36], turn[3];
    predict_pose(t, x, z->lens, z->axes, z->camera, position, attitude, h);
    copy(z->stated, factor, 36);
    int valid = factorize(factor, SIGHTING_ROWS);
    if (z->view != z->stated) {
        copy(z->view, factor, 36);
        valid = factorize(factor, SIGHTING_ROWS) && valid;
    }
    turn_between(attitude, z->sighting + 3, turn);
    for (int i = 0; i < SIGHTING_ROWS; i++) {
        residual[i] = i < 3 ? z->sighting[i] - position[i] : turn[i - 3];
        for (int j = 0; j <= i && valid; j++) {
            h[SEEN * i + TARGET + VIEW + j] = z->view_ratio * factor[6 * i + j];
            residual[i] -= z->view_ratio * factor[6 * i + j] * x[ADDITIVE + VIEW + j];
        }
        for (int j = 0; j < SIGHTING_ROWS; j++)
            noise[k * i + j] =
                valid ? z->white_ratio * z->white_ratio * z->stated[6 * i + j] : __builtin_nan("");
    }
}

static void linearize_odometry(const Measurement *z, const double *x, double *residual, double *h,
                               double *noise, int k) {
    const double *additive = x + ADDITIVE, *drift = additive + ATTITUDE_DRIFT, *o = z->odometry;
    const double minus[3] = {-drift[0], -drift[1], -drift[2]};
    double q[4], m[9];
    zero(h, ODOMETRY_ROWS * SEEN);
    double *by_chaser = h + TARGET;
    for (int i = 0; i < 3; i++) {
        residual[i] = o[i] - x[i] - additive[POSITION_DRIFT + i];
        residual[3 + i] = o[3 + i] - x[3 + i];
        residual[9 + i] = o[OMEGA + i] - x[OMEGA + i] - additive[GYRO_BIAS + i];
    }
    exponential_map(drift, q);
    multiply_quaternions(x + QUATERNION, q, q);
    turn_between(q, o + QUATERNION, residual + 6);
    put_identity(by_chaser, SEEN, POSITION);
    put_identity(by_chaser, SEEN, POSITION_DRIFT);
    put_identity(by_chaser + 3 * SEEN, SEEN, VELOCITY);
    exponential_map(minus, q);
    matrix_of(q, m);
    put(by_chaser + 6 * SEEN, SEEN, ATTITUDE, 1.0, m);
    right_jacobian(drift, m);
    put(by_chaser + 6 * SEEN, SEEN, ATTITUDE_DRIFT, 1.0, m);
    put_identity(by_chaser + 9 * SEEN, SEEN, RATE);
    put_identity(by_chaser + 9 * SEEN, SEEN, GYRO_BIAS);
    for (int i = 0; i < ODOMETRY_ROWS; i++) copy(z->odometry_noise + 12 * i, noise + k * i, 12);
}

/* Write residual (k), Jacobian (k, SEEN) by the errors of target and chaser, and noise (k, k).
 * The sighting comes first. */
EXPORT void NAME(linearize)(const Measurement *z, const double *mean, double *residual, double *h,
                            double *noise) {
    const double *x = chaser_of(mean, z->i);
    const int k = rows_of(z), first = z->sighting ? SIGHTING_ROWS : 0;
    zero(noise, k * k);
    if (z->sighting) linearize_sighting(z, mean, x, residual, h, noise, k);
    if (z->odometry)
        linearize_odometry(z, x, residual + first, h + SEEN * first, noise + (k + 1) * first, k);
}

/* Predict the sighting of chaser i as `predict_pose`: pose (7) and Jacobian (6, SEEN). */
EXPORT void NAME(predict_sighting)(const double *mean, int64_t i, const double *lens,
                                   const double *axes, const double *camera, double *pose,
                                   double *h) {
    predict_pose(mean, chaser_of(mean, i), lens, axes, camera, pose, pose + 3, h);
}
