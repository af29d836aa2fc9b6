/* SPDX-License-Identifier: Apache-2.0 */
/* Cost of the paper's eq. 6: quadratic model about a rollout, and value along a plan. */
#include "base.h"

/* An attitude error beyond 150 degrees is treated as one of this angle about the same axis: the gradient of
 * sin^2(angle / 2) vanishes at 180 degrees, where the cost would not act. Cosine and sine of 75 degrees. */
#define ETA_MIN 0.25881904510252074
#define EPS_MAX 0.9659258262890683

typedef struct {
    int64_t stages;
    const double *position, *orientation, *input; /* (D+1,), (D+1,), (6,) */
} Weights;

/* e (4) = q_ref* (x) q. */
static inline void attitude_error(const double *q, const double *q_ref, double *e) {
    e[0] = madd(q_ref[0], q[0], dot3(q_ref + 1, q + 1));
    for (int i = 0; i < 3; i++) {
        int a = (i + 1) % 3 + 1, b = (i + 2) % 3 + 1;
        e[1 + i] = (q_ref[0] * q[1 + i] - q_ref[1 + i] * q[0]) - (q_ref[a] * q[b] - q_ref[b] * q[a]);
    }
}

/* Quadratic model in dtheta of weight |vec(q (x) q_ref*)|^2: with q_ref* (x) q = (eta, eps), gradient
 * weight eta eps (3,) and Hessian weight / 2 (I - eps eps') (3, 3). */
static void attitude_model(const double *q, const double *q_ref, double weight, double *gradient, double *hessian) {
    double e[4];
    attitude_error(q, q_ref, e);
    double eta = e[0], f = 1.0;
    if (abs_of(eta) < ETA_MIN) {
        eta = eta >= 0.0 ? ETA_MIN : -ETA_MIN;
        f = EPS_MAX / sqrt_of(dot3(e + 1, e + 1));
    }
    for (int i = 1; i < 4; i++) e[i] *= f;
    for (int i = 0; i < 3; i++) {
        gradient[i] = weight * eta * e[1 + i];
        for (int j = 0; j < 3; j++) hessian[3 * i + j] = -0.5 * weight * e[1 + i] * e[1 + j];
        hessian[4 * i] += 0.5 * weight;
    }
}

/* Quadratic cost model of one chaser about x (D+1, 13), u (D, 6), in dp, dtheta and scaled inputs w = u / limits.
 * Write q_pos and q_att (D+1, 3, 3), qx (D+1, 12), r_diag, r and w_bar (D, 6). */
EXPORT void NAME(quadratic_model)(const Weights *weights, const double *x, const double *u, const double *refs,
                             const double *u_ref, const double *limits, double *q_pos, double *q_att, double *qx,
                             double *r_diag, double *r, double *w_bar) {
    zero(qx, 12 * (weights->stages + 1));
    zero(q_pos, 9 * (weights->stages + 1));
    for (int64_t k = 0; k <= weights->stages; k++) {
        const double weight = 2.0 * weights->position[k];
        for (int c = 0; c < 3; c++) {
            q_pos[9 * k + 4 * c] = weight;
            qx[12 * k + c] = weight * (x[13 * k + c] - refs[7 * k + c]);
        }
        attitude_model(x + 13 * k + 6, refs + 7 * k + 3, weights->orientation[k], qx + 12 * k + 6, q_att + 9 * k);
    }
    for (int c = 0; c < 6; c++) {
        const double top = limits[c], slope = 2.0 * weights->input[c] * top;
        for (int64_t i = c; i < 6 * weights->stages; i += 6) {
            /* an axis without authority has a zero column of B and stays at zero */
            w_bar[i] = top > 0.0 ? u[i] / top : 0.0;
            r_diag[i] = top > 0.0 ? slope * top : 1.0;
            r[i] = slope * (u[i] - u_ref[i]);
        }
    }
}

/* Write the cost (eq. 6) of every chaser: cost (N,) of x (N, D+1, 13), u (N, D, 6). */
EXPORT void NAME(plan_cost)(const Weights *weights, int64_t n, const double *x, const double *u, const double *refs,
                       const double *u_ref, double *cost) {
    for (int64_t i = 0; i < n; i++) {
        double total = 0.0, e[4], away[3];
        for (int64_t k = 0; k <= weights->stages; k++, x += 13, refs += 7) {
            /* |vec(q (x) q_ref*)| = |vec(q_ref* (x) q)|: the vectors differ by a rotation */
            attitude_error(x + 6, refs + 3, e);
            subtract3(x, refs, away);
            total = madd(weights->position[k], dot3(away, away), total);
            total = madd(weights->orientation[k], dot3(e + 1, e + 1), total);
        }
        for (int64_t k = 0; k < weights->stages; k++, u += 6, u_ref += 6)
            for (int c = 0; c < 6; c++) {
                double d = u_ref[c] - u[c];
                total = madd(weights->input[c], d * d, total);
            }
        cost[i] = total;
    }
}
