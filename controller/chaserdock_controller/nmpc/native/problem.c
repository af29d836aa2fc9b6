/* SPDX-License-Identifier: Apache-2.0 */
/* The problem of a tick, and the terms of its cost. The terms that restrict motion are in
 * planes.c.
 *
 * Each term is declared in nmpc/terms/NAME.py. A term of the cost has two functions here:
 * NAME_model adds its quadratic model at a stage, NAME_value returns its cost there.
 * `quadratic_model` and `plan_cost` sum the terms. */
#include "base.h"

/* Cosine of half of 150 degrees. A larger attitude error is treated as one of this angle about
 * the same axis: the gradient of sin^2(angle / 2) vanishes at 180 degrees, where the cost would
 * have no effect. With 120 and 165 degrees chasers turn as fast. */
#define ETA_MIN 0.25881904510252074
/* Sine of the same angle. */
#define EPS_MAX 0.9659258262890683

/* The problem of N chasers over D stages: members that all terms use (as in `NmpcInput`, all
 * expanded), then those of each term, in the order of the files in nmpc/terms. */
typedef struct {
    int64_t n, stages;
    double step_s;
    const double *references, *targets, *u_ref; /* (N, D+1, 7), (D+1, 3), (N, D, 6) */
    const double *attitude;                     /* weights (D+1,) */
    int64_t n_coasts;
    const double *coasts;    /* (N, D+1, n_coasts, 7): a (3), b (3), d; a and b zero for none */
    const double *corridors; /* (N, D+1, 5) */
    const double *input;     /* weights (D+1, 6) */
    const double *limits;    /* (N, 6) */
    const double *to_target; /* (N, D+1) */
    double outer;
    const double *position;         /* weights (D+1,) */
    const double *between, *apart;  /* (N, N): distances of centres and of shapes */
    int64_t n_shape;
    const double *shape; /* (n_shape, 15): a chaser's cuboids, as boxes but in body axes */
    int64_t n_boxes;
    const double *boxes;     /* (D+1, n_boxes, 15): centre, rotation to WRF, half edges */
    const double *clearance; /* (N,) */
} Problem;
LAYOUT(Problem, n, stages, step_s, references, targets, u_ref, attitude, n_coasts, coasts,
       corridors, input, limits, to_target, outer, position, between, apart, n_shape, shape,
       n_boxes, boxes, clearance)

/* Quadratic model of one chaser's cost in changes of its state, [dp, dv, dtheta, domega], and
 * scaled inputs w = u / limits. q (D+1, 2, 6, 6), symmetric: blocks of [dp, dv] and [dtheta,
 * domega]. Gradients qx (D+1, 12) and r (D, 6). r_diag (D, 6). w_bar (D, 6): the present
 * inputs. */
typedef struct {
    double *q, *qx, *r_diag, *r, *w_bar;
} Quadratic;

/* Weight |p - p_ref|^2. */
static inline double position_value(const Problem *problem, int64_t i, int64_t k, const double *x) {
    double away[3];
    subtract3(x, problem->references + 7 * ((problem->stages + 1) * i + k), away);
    return problem->position[k] * dot3(away, away);
}

static inline void position_model(const Problem *problem, int64_t i, int64_t k, const double *x,
                                  const Quadratic *model) {
    const double *reference = problem->references + 7 * ((problem->stages + 1) * i + k);
    const double weight = 2.0 * problem->position[k];
    for (int c = 0; c < 3; c++) {
        model->q[72 * k + 7 * c] += weight;
        model->qx[12 * k + c] += weight * (x[c] - reference[c]);
    }
}

/* e (4) = q_ref* (x) q. */
static inline void attitude_error(const double *q, const double *q_ref, double *e) {
    e[0] = madd(q_ref[0], q[0], dot3(q_ref + 1, q + 1));
    for (int i = 0; i < 3; i++) {
        int a = (i + 1) % 3 + 1, b = (i + 2) % 3 + 1;
        double along = q_ref[0] * q[1 + i] - q_ref[1 + i] * q[0];
        e[1 + i] = along - (q_ref[a] * q[b] - q_ref[b] * q[a]);
    }
}

/* Weight |vec(q (x) q_ref*)|^2, which is |vec(q_ref* (x) q)|^2: the vectors differ by a
 * rotation. */
static inline double attitude_value(const Problem *problem, int64_t i, int64_t k, const double *x) {
    double e[4];
    attitude_error(x + 6, problem->references + 7 * ((problem->stages + 1) * i + k) + 3, e);
    return problem->attitude[k] * dot3(e + 1, e + 1);
}

/* With q_ref* (x) q = (eta, eps): gradient weight eta eps in dtheta; Hessian weight / 2 (I -
 * eps eps'). */
static inline void attitude_model(const Problem *problem, int64_t i, int64_t k, const double *x,
                                  const Quadratic *model) {
    const double weight = problem->attitude[k];
    double e[4], *gradient = model->qx + 12 * k + 6, *hessian = model->q + 72 * k + 36;
    attitude_error(x + 6, problem->references + 7 * ((problem->stages + 1) * i + k) + 3, e);
    double eta = e[0], f = 1.0;
    if (abs_of(eta) < ETA_MIN) {
        eta = eta >= 0.0 ? ETA_MIN : -ETA_MIN;
        f = EPS_MAX / sqrt_of(dot3(e + 1, e + 1));
    }
    for (int j = 1; j < 4; j++) e[j] *= f;
    for (int j = 0; j < 3; j++) {
        gradient[j] += weight * eta * e[1 + j];
        for (int m = 0; m < 3; m++) hessian[6 * j + m] += -0.5 * weight * e[1 + j] * e[1 + m];
        hessian[7 * j] += 0.5 * weight;
    }
}

/* The weighted squares of u - u_ref, added to `total`. */
static inline double input_value(const Problem *problem, int64_t i, int64_t k, const double *u,
                                 double total) {
    for (int c = 0; c < 6; c++) {
        double d = problem->u_ref[6 * (problem->stages * i + k) + c] - u[c];
        total = madd(problem->input[6 * k + c], d * d, total);
    }
    return total;
}

static inline void input_model(const Problem *problem, int64_t i, int64_t k, const double *u,
                               const Quadratic *model) {
    for (int c = 0; c < 6; c++) {
        const double top = problem->limits[6 * i + c];
        const double slope = 2.0 * problem->input[6 * k + c] * top;
        model->r_diag[6 * k + c] += slope * top;
        model->r[6 * k + c] += slope * (u[c] - problem->u_ref[6 * (problem->stages * i + k) + c]);
    }
}

/* Write the quadratic model of chaser i about x (D+1, 13), u (D, 6). */
EXPORT void NAME(quadratic_model)(const Problem *problem, int64_t i, const double *x,
                                  const double *u, double *q, double *qx, double *r_diag, double *r,
                                  double *w_bar) {
    const int64_t d = problem->stages;
    const Quadratic model = {q, qx, r_diag, r, w_bar};
    zero(q, 72 * (d + 1));
    zero(qx, 12 * (d + 1));
    zero(r, 6 * d);
    for (int64_t m = 0; m < 6 * d; m++) {
        /* An axis without authority has a zero column of B and stays at zero. */
        const double top = problem->limits[6 * i + m % 6];
        w_bar[m] = top > 0.0 ? u[m] / top : 0.0;
        r_diag[m] = top > 0.0 ? 0.0 : 1.0;
    }
    for (int64_t k = 0; k <= d; k++) {
        position_model(problem, i, k, x + 13 * k, &model);
        attitude_model(problem, i, k, x + 13 * k, &model);
        if (k < d) input_model(problem, i, k, u + 6 * k, &model);
    }
}

/* Write the cost (eq. 6) of every chaser: cost (N,) of x (N, D+1, 13), u (N, D, 6). */
EXPORT void NAME(plan_cost)(const Problem *problem, const double *x, const double *u,
                            double *cost) {
    for (int64_t i = 0; i < problem->n; i++) {
        double total = 0.0;
        for (int64_t k = 0; k <= problem->stages; k++, x += 13) {
            total += position_value(problem, i, k, x);
            total += attitude_value(problem, i, k, x);
        }
        for (int64_t k = 0; k < problem->stages; k++, u += 6)
            total = input_value(problem, i, k, u, total);
        cost[i] = total;
    }
}
