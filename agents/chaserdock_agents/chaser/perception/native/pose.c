/* SPDX-License-Identifier: Apache-2.0 */
/* Pose of minimum whitened reprojection error: Levenberg-Marquardt. */
#include "base.h"

/* Share of the squared error below which a step's gain ends the iteration: with 32 coordinates, a
 * pose off by 0.02 standard deviations. Larger: fewer steps; smaller: nearer to the minimum. */
#define MIN_GAIN 1e-5
/* The same of the gain that the linear model predicts. Below MIN_GAIN, it saves the last step where
 * that would change nothing. */
#define MIN_PREDICTED_GAIN 2e-6

typedef struct {
    double cost, gradient[6], information[36];
} Normal;

/* Compute squared whitened error, gradient and Gauss-Newton matrix of a pose (position (3),
 * rotation (3, 3)) by a rotation phi in camera axes, R_true = exp([phi]x) R, and by position;
 * return 0 for points behind the camera. */
static int normal_of(const double *lens, const double *points, const double *pixels,
                     const double *whitening, int64_t n, const double *pose, Normal *out) {
    out->cost = 0.0;
    zero(out->gradient, 6);
    zero(out->information, 36);
    for (int64_t m = 0; m < n; m++) {
        double row[8][7]; /* derivatives and residual of each coordinate */
        for (int c = 0; c < 4; c++) {
            double turned[3];
            multiply3(pose + 3, points + 12 * m + 3 * c, turned);
            double x = turned[0] + pose[0], y = turned[1] + pose[1], z = turned[2] + pose[2];
            if (!(z > 1e-6)) return 0;
            double u = x / z, v = y / z;
            double by[2][3] = {{lens[0] / z, 0.0, -lens[0] * u / z},
                               {0.0, lens[1] / z, -lens[1] * v / z}};
            row[2 * c][6] = lens[0] * u + lens[2] - pixels[8 * m + 2 * c];
            row[2 * c + 1][6] = lens[1] * v + lens[3] - pixels[8 * m + 2 * c + 1];
            for (int k = 0; k < 2; k++) {
                cross3(turned, by[k], row[2 * c + k]);
                for (int j = 0; j < 3; j++) row[2 * c + k][3 + j] = by[k][j];
            }
        }
        for (int i = 0; i < 8; i++) {
            const double *w = whitening + 64 * m + 8 * i;
            double white[7] = {0.0};
            for (int k = 0; k < 8; k++)
                for (int j = 0; j < 7; j++) white[j] += w[k] * row[k][j];
            out->cost += white[6] * white[6];
            for (int a = 0; a < 6; a++) {
                out->gradient[a] += white[a] * white[6];
                for (int b = 0; b <= a; b++) out->information[6 * a + b] += white[a] * white[b];
            }
        }
    }
    for (int a = 0; a < 6; a++)
        for (int b = a + 1; b < 6; b++) out->information[6 * a + b] = out->information[6 * b + a];
    return 1;
}

/* out = exp([phi]x) R (Rodrigues' formula). */
static void turned_by(const double *phi, const double *rotation, double *out) {
    double angle = sqrt_of(dot3(phi, phi)), axis[3] = {0.0, 0.0, 0.0}, s, c;
    if (angle > 2.2e-16)
        for (int i = 0; i < 3; i++) axis[i] = phi[i] / angle;
    else
        angle = 0.0;
    sine_cosine(angle, &s, &c);
    for (int j = 0; j < 3; j++) {
        double column[3] = {rotation[j], rotation[3 + j], rotation[6 + j]}, across[3];
        cross3(axis, column, across);
        double along = (1.0 - c) * dot3(axis, column);
        for (int i = 0; i < 3; i++)
            out[3 * i + j] = (c * column[i] + along * axis[i]) + s * across[i];
    }
}

/* Move ``pose`` (position (3), rotation (3, 3), TRF to IRF) to the nearest minimum; return 0 if
 * there is none of finite numbers. ``lens``: fx, fy, cx, cy; of n markers ``points`` (n, 4, 3) TRF,
 * ``pixels`` (n, 4, 2) ideal, ``whitening`` (n, 8, 8): of the errors of their coordinates. */
EXPORT int64_t NAME(refine_pose)(const double *lens, const double *points, const double *pixels,
                                 const double *whitening, int64_t n, double *pose) {
    Normal now, then;
    if (!normal_of(lens, points, pixels, whitening, n, pose, &now) || !finite(now.cost)) return 0;
    double damping = 1e-7;
    for (int iteration = 0; iteration < 20; iteration++) {
        double matrix[36], step[6], trial[12], predicted = 0.0;
        copy(now.information, matrix, 36);
        for (int i = 0; i < 6; i++) {
            matrix[7 * i] = matrix[7 * i] * (1.0 + damping) + 1e-12;
            step[i] = -now.gradient[i];
        }
        if (!solve_rows(matrix, step, 6)) return 0;
        for (int i = 0; i < 6; i++) predicted -= step[i] * now.gradient[i];
        for (int i = 0; i < 3; i++) trial[i] = pose[i] + step[3 + i];
        turned_by(step, pose + 3, trial + 3);
        /* An undamped step whose predicted gain is negligible is the last one and needs no
         * check. */
        if (damping < 1e-3 && predicted <= MIN_PREDICTED_GAIN * now.cost + 1e-12) {
            copy(trial, pose, 12);
            break;
        }
        if (normal_of(lens, points, pixels, whitening, n, trial, &then) && then.cost <= now.cost) {
            double gain = now.cost - then.cost;
            copy(trial, pose, 12);
            now = then;
            damping = max_of(damping * 0.1, 1e-9);
            if (gain <= MIN_GAIN * now.cost + 1e-12) break;
        } else {
            damping *= 100.0;
            if (damping > 1e9) break;
        }
    }
    return all_finite(pose, 12);
}
