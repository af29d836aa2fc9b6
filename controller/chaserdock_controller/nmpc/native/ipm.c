/* SPDX-License-Identifier: Apache-2.0 */
/* Interior point for the QP of one chaser: Mehrotra's predictor-corrector on the Riccati
 * sweeps.
 *
 * The box on the scaled inputs, -1 <= w <= 1, is hard. A row a' dr_k >= c (dr_k: changes of
 * position and velocity at stage k) is soft: it has a slack s >= 0, priced w1 s + w2/2 s^2, and
 * z = a' dr - c + s >= 0, with multipliers lam (of z) and pi (of s). Slack and multipliers are
 * eliminated row by row. A row then only adds a rank-one term to the position and velocity
 * block of Q_k, and the sparsity of the Riccati sweep stays. Method: S. Mehrotra, SIAM J.
 * Optim. 2 (1992); Nocedal and Wright, "Numerical Optimization", sec. 16.6.
 *
 * All positive quantities are stored in one vector, val: z (R rows), s (R), 1 + w (6 D), 1 - w
 * (6 D). Their multipliers are in mul, in the same order: lam, pi, and those of the box.
 *
 * Most rows are far from the chaser, so only near rows are active. A solution that satisfies
 * the other rows as well solves the whole problem. Otherwise the rows that it came near are
 * activated and the problem is solved again. */
#include "base.h"

/* Tuned numbers of the method. "Flights" are seven closed loops, in which one number was varied
 * at a time (docs/evidence/controller.md). */

/* Complementarity at which to stop, in units of cost. 1e-2 to 1e-4 give the same closed loop. */
#define MU_STOP 1e-3
/* Complementarity at the start, relative to the largest slope there. With half or twice, a plan
 * in 150 of one flight ends at its iteration limit. */
#define MU_START 0.1
/* Upper bound of the complementarity at the start, in units of cost. Without it, or with 1e3, a
 * plan for a reference 2 km away ends at its iteration limit; with 1e5 it takes 17 iterations. */
#define MU_START_MAX 1e5
/* Stationarity at which to stop, relative to the gradient at the start. Half takes up to 1 %
 * more iterations; with twice, one plan ends at its iteration limit. */
#define GRADIENT_STOP 1e-6
/* Share of the step to the boundary, below 1 so that all values stay positive. With 0.9 flights
 * take 20 to 45 % more iterations; with 0.999 up to 4 % fewer, but one plan ends at its limit. */
#define STEP_TO_BOUNDARY 0.995
/* Tolerance for rows and bounds of the unconstrained solution (m, or share of a limit): its
 * rounding. Half and twice change no bit of the flights. */
#define FREE_TOLERANCE 1e-9
/* Initial inputs are limited to this share of the box, away from its boundary. With 0.99
 * flights take up to 56 % more iterations, with 0.8 up to 14 % fewer. */
#define START_WITHIN 0.9
/* Rows with less margin than this, m, are active. The solution does not depend on it, since
 * rows that come near are added. Half and twice take up to 2 % more iterations. */
#define NEAR_M 0.1

enum { FREE, CONVERGED, LIMIT, BROKEN };

/* The problem of one chaser. mats (D, 12, 12) = [C B]; q, qx, r_diag, r, w_bar: as in
 * `Quadratic`. Rows: stage (R,), a (R, 6), c (R,). */
typedef struct {
    int64_t stages, n_rows, max_iterations;
    double h, w1, w2;
    const double *mats, *q, *qx, *r_diag, *r, *w_bar;
    const int64_t *stage;
    const double *a, *c;
} Qp;
LAYOUT(Qp, stages, n_rows, max_iterations, h, w1, w2, mats, q, qx, r_diag, r, w_bar, stage, a, c)

/* The solution: dx (D+1, 12), dw (D, 6), multipliers mul (2 R + 12 D), scaled stationarity,
 * complementarity. */
typedef struct {
    double *dx, *dw, *mul, residual, mu;
    int64_t iterations;
} Answer;
LAYOUT(Answer, dx, dw, mul, residual, mu, iterations)

/* Active rows, and working vectors of an iteration. */
typedef struct {
    int64_t count, n, *stage, *index;
    double *a, *c;
    double *val, *mul, *d_val, *d_mul, *res, *inverse, *w;
    double *gx, *gw, *grad_x, *grad_w, *step_x, *step_w, *r_eff, *q_eff;
    Factor *factors;
} Iterate;

static int64_t padded(int64_t count) { return (count + 3) / 4 * 4; }

static int64_t ipm_workspace(int64_t d, int64_t rows) {
    int64_t count = padded(2 * rows + 12 * d), x = 12 * (d + 1), w = 6 * d;
    return 22 * 8 + 6 * count + 9 * rows + 3 * x + 5 * w + 72 * (d + 1) +
           d * (int64_t)(sizeof(Factor) / 8);
}

static Iterate lay_out(int64_t d, int64_t rows, double *work) {
    int64_t count = padded(2 * rows + 12 * d), x = 12 * (d + 1), w = 6 * d;
    Iterate it = {0};
    it.factors = (Factor *)allocate(&work, d * (int64_t)(sizeof(Factor) / 8));
    double **vectors[] = {&it.val, &it.mul, &it.d_val, &it.d_mul, &it.res, &it.inverse};
    for (int i = 0; i < 6; i++) *vectors[i] = allocate(&work, count);
    double **inputs[] = {&it.w, &it.gw, &it.grad_w, &it.step_w, &it.r_eff};
    for (int i = 0; i < 5; i++) *inputs[i] = allocate(&work, w);
    double **states[] = {&it.gx, &it.grad_x, &it.step_x};
    for (int i = 0; i < 3; i++) *states[i] = allocate(&work, x);
    it.q_eff = allocate(&work, 72 * (d + 1));
    it.a = allocate(&work, 6 * rows);
    it.c = allocate(&work, rows);
    it.stage = (int64_t *)allocate(&work, rows);
    it.index = (int64_t *)allocate(&work, rows);
    return it;
}

static inline double dot6(const double *a, const double *b) {
    return dot3(a, b) + dot3(a + 3, b + 3);
}

/* Gradients of the cost: gx (D+1, 12) = Q dx + qx, gw (D, 6) = R dw + r. */
static void gradients(const Qp *qp, const double *dx, const double *dw, double *gx, double *gw) {
    copy(qp->qx, gx, 12 * (qp->stages + 1));
    for (int64_t k = 0; k <= qp->stages; k++)
        for (int i = 0; i < 6; i++) {
            gx[12 * k + i] += dot6(qp->q + 72 * k + 6 * i, dx + 12 * k);
            gx[12 * k + 6 + i] += dot6(qp->q + 72 * k + 36 + 6 * i, dx + 12 * k + 6);
        }
    for (int64_t i = 0; i < 6 * qp->stages; i++) gw[i] = madd(qp->r_diag[i], dw[i], qp->r[i]);
}

static inline double margin_of(const Qp *qp, const double *dx, int64_t j) {
    return dot6(qp->a + 6 * j, dx + 12 * qp->stage[j]) - qp->c[j];
}

/* Return the margin of the active row j. */
static inline double active_margin(const Iterate *it, const double *dx, int64_t j) {
    return dot6(it->a + 6 * j, dx + 12 * it->stage[j]) - it->c[j];
}

/* Add force along the normal of the active row j to the gradient gx. */
static inline void add_row_force(const Iterate *it, double *gx, int64_t j, double force) {
    double *g = gx + 12 * it->stage[j];
    for (int i = 0; i < 6; i++) g[i] = madd(force, it->a[6 * j + i], g[i]);
}

static int is_free(const Qp *qp, const double *dx, const double *w) {
    for (int64_t i = 0; i < 6 * qp->stages; i++)
        if (!(abs_of(w[i]) <= 1.0 + FREE_TOLERANCE)) return 0;
    for (int64_t j = 0; j < qp->n_rows; j++)
        if (!(margin_of(qp, dx, j) >= -FREE_TOLERANCE)) return 0;
    return 1;
}

/* Activate, in addition, the rows that dx (D+1, 12) comes near. `active` (R,): flags of all
 * rows. */
static void activate_rows(const Qp *qp, const double *dx, double *active, Iterate *it) {
    it->n = 0;
    for (int64_t j = 0; j < qp->n_rows; j++) {
        if (!(margin_of(qp, dx, j) >= NEAR_M)) active[j] = 1.0;
        if (active[j] == 0.0) continue;
        copy(qp->a + 6 * j, it->a + 6 * it->n, 6);
        it->c[it->n] = qp->c[j];
        it->stage[it->n] = qp->stage[j];
        it->index[it->n++] = j;
    }
    it->count = 2 * it->n + 12 * qp->stages;
}

/* Test whether dx violates an inactive row. */
static int violates_inactive(const Qp *qp, const double *dx, const double *active) {
    for (int64_t j = 0; j < qp->n_rows; j++)
        if (active[j] == 0.0 && !(margin_of(qp, dx, j) >= 0.0)) return 1;
    return 0;
}

/* Curvature of the price of row j: d in z, e in s, after elimination of z's slope. */
static inline void curvature(const Iterate *it, int64_t j, double w2, double *d, double *e) {
    *d = it->mul[j] * it->inverse[j];
    *e = madd(it->mul[it->n + j], it->inverse[it->n + j], w2);
}

/* Set the starting point: inputs inside the box, with centred slacks and multipliers. Return the
 * scale of the gradient there. */
static double set_start(const Qp *qp, Answer *answer, Iterate *it) {
    const int64_t inputs = 6 * qp->stages, bottom = 2 * it->n, top = bottom + inputs;
    for (int64_t i = 0; i < inputs; i++) {
        it->w[i] = min_of(max_of(it->w[i], -START_WITHIN), START_WITHIN);
        answer->dw[i] = it->w[i] - qp->w_bar[i];
        it->val[bottom + i] = 1.0 + it->w[i];
        it->val[top + i] = 1.0 - it->w[i];
    }
    advance(qp->stages, qp->mats, qp->h, answer->dx, answer->dw);
    gradients(qp, answer->dx, answer->dw, it->gx, it->gw);
    double scale =
        max_of(1.0, reduced_gradient(qp->stages, qp->mats, qp->h, it->gx, it->gw, it->grad_w));
    /* Rows that are violated at the start contribute their full slack weight. A much smaller
     * initial complementarity would start close to the boundary, where steps are short (27 to
     * 40 iterations instead of 12). */
    for (int64_t j = 0; j < it->n; j++)
        if (active_margin(it, answer->dx, j) < 0.0) add_row_force(it, it->gx, j, -qp->w1);
    double slope =
        max_of(scale, reduced_gradient(qp->stages, qp->mats, qp->h, it->gx, it->gw, it->grad_w));
    double mu = min_of(max_of(MU_START * slope, MU_START), MU_START_MAX);
    for (int64_t j = 0; j < it->n; j++) {
        double g = active_margin(it, answer->dx, j);
        double price = qp->w1 + qp->w2 * max_of(-g, 0.0), t = price * g;
        double s = (2.0 * mu + (sqrt_of(t * t + 4.0 * mu * mu) - t)) / (2.0 * price);
        it->val[j] = g + s;
        it->val[it->n + j] = s;
        it->mul[j] = mu / it->val[j];
        it->mul[it->n + j] = qp->w1 + qp->w2 * s - it->mul[j];
    }
    for (int64_t j = bottom; j < it->count; j++) it->mul[j] = mu / it->val[j];
    for (int64_t j = it->count; j < padded(it->count); j++) {
        it->val[j] = 1.0; /* padding: never limits a step */
        it->mul[j] = it->d_val[j] = it->d_mul[j] = it->res[j] = 0.0;
    }
    return scale;
}

static inline double sum4(v4 s) { return (s[0] + s[2]) + (s[1] + s[3]); }

/* Set res to val mul, element by element; return the mean. */
static double complementarity(const Iterate *it) {
    v4 sum = splat(0.0);
    for (int64_t j = 0; j < it->count; j += 4) {
        v4 product = load(it->val + j) * load(it->mul + j);
        store(it->res + j, product);
        sum += product;
    }
    return sum4(sum) / (double)it->count;
}

/* Factor the Newton system: add the curvatures of rows and box to those of the cost. */
static int factor_newton(const Qp *qp, Iterate *it) {
    const int64_t inputs = 6 * qp->stages, bottom = 2 * it->n, top = bottom + inputs;
    copy(qp->q, it->q_eff, 72 * (qp->stages + 1));
    for (int64_t j = 0; j < it->n; j++) {
        double d, e, *q = it->q_eff + 72 * it->stage[j];
        const double *a = it->a + 6 * j;
        curvature(it, j, qp->w2, &d, &e);
        double f = d * e / (d + e);
        for (int m = 0; m < 6; m++)
            for (int n = 0; n < 6; n++) q[6 * m + n] = madd(f * a[m], a[n], q[6 * m + n]);
    }
    for (int64_t i = 0; i < inputs; i++)
        it->r_eff[i] = qp->r_diag[i] + (it->mul[bottom + i] * it->inverse[bottom + i] +
                                        it->mul[top + i] * it->inverse[top + i]);
    return factor(qp->stages, qp->mats, qp->h, it->q_eff, it->r_eff, it->factors);
}

/* Compute the step that reduces the products val mul by res. Return the largest share of it
 * that keeps all values positive. */
static double newton_step(const Qp *qp, Iterate *it) {
    const int64_t inputs = 6 * qp->stages, bottom = 2 * it->n, top = bottom + inputs;
    copy(it->gx, it->grad_x, 12 * (qp->stages + 1));
    for (int64_t j = 0; j < it->n; j++) {
        double d, e, rz = it->res[j] * it->inverse[j],
                     rs = it->res[it->n + j] * it->inverse[it->n + j];
        curvature(it, j, qp->w2, &d, &e);
        add_row_force(it, it->grad_x, j, rz - d * (rs + rz) / (d + e));
    }
    for (int64_t i = 0; i < inputs; i++)
        it->grad_w[i] = it->gw[i] + (it->res[bottom + i] * it->inverse[bottom + i] -
                                     it->res[top + i] * it->inverse[top + i]);
    minimize(qp->stages, qp->mats, qp->h, it->factors, it->grad_x, it->grad_w, it->step_x,
             it->step_w);
    for (int64_t j = 0; j < it->n; j++) {
        double d, e, rz = it->res[j] * it->inverse[j],
                     rs = it->res[it->n + j] * it->inverse[it->n + j];
        curvature(it, j, qp->w2, &d, &e);
        double dg = dot6(it->a + 6 * j, it->step_x + 12 * it->stage[j]);
        it->d_val[it->n + j] = -(rs + rz + d * dg) / (d + e);
        it->d_val[j] = dg + it->d_val[it->n + j];
    }
    for (int64_t i = 0; i < inputs; i++) {
        it->d_val[bottom + i] = it->step_w[i];
        it->d_val[top + i] = -it->step_w[i];
    }
    v4 steepest = splat(0.0);
    for (int64_t j = 0; j < it->count; j += 4) {
        v4 inverse = load(it->inverse + j), change = load(it->d_val + j), mul = load(it->mul + j);
        v4 change_mul = -(madd4(mul, change, load(it->res + j))) * inverse;
        store(it->d_mul + j, change_mul);
        /* the padding has a multiplier of zero */
        v4 of_mul = -change_mul / max4(mul, splat(1e-300));
        steepest = max4(steepest, max4(-change * inverse, of_mul));
    }
    return 1.0 / max_of(max_of(steepest[0], steepest[1]), max_of(steepest[2], steepest[3]));
}

/* Return the mean complementarity after a share alpha of the step. */
static double after_step(const Iterate *it, double alpha) {
    v4 sum = splat(0.0);
    for (int64_t j = 0; j < it->count; j += 4)
        sum += madd4(splat(alpha), load(it->d_val + j), load(it->val + j)) *
               madd4(splat(alpha), load(it->d_mul + j), load(it->mul + j));
    return sum4(sum) / (double)it->count;
}

/* Iterate to the solution for the active rows; at most max_iterations in total. */
static int iterate(const Qp *qp, Answer *answer, Iterate *it) {
    const int64_t inputs = 6 * qp->stages, bottom = 2 * it->n, top = bottom + inputs;
    const double scale = set_start(qp, answer, it);
    for (;;) {
        /* complementarity and stationarity of the current point */
        double mu = complementarity(it);
        gradients(qp, answer->dx, answer->dw, it->gx, it->gw);
        for (int64_t j = 0; j < it->n; j++) add_row_force(it, it->gx, j, -it->mul[j]);
        for (int64_t i = 0; i < inputs; i++) it->gw[i] += it->mul[top + i] - it->mul[bottom + i];
        answer->mu = mu;
        answer->residual =
            reduced_gradient(qp->stages, qp->mats, qp->h, it->gx, it->gw, it->grad_w) / scale;
        if (!(finite(mu) && finite(answer->residual))) return BROKEN;
        if (mu <= MU_STOP && answer->residual <= GRADIENT_STOP) return CONVERGED;
        if (answer->iterations >= qp->max_iterations) return LIMIT;
        answer->iterations++;

        for (int64_t j = 0; j < it->count; j += 4)
            store(it->inverse + j, splat(1.0) / load(it->val + j));
        if (!factor_newton(qp, it)) return BROKEN;
        double after = after_step(it, min_of(1.0, newton_step(qp, it)));
        /* Not far below the stopping point: smaller values worsen the conditioning. */
        double centre = max_of(after * after * after / (mu * mu), 0.1 * MU_STOP);
        for (int64_t j = 0; j < it->count; j++) it->res[j] += it->d_val[j] * it->d_mul[j] - centre;
        double alpha = min_of(1.0, STEP_TO_BOUNDARY * newton_step(qp, it));

        for (int64_t j = 0; j < it->count; j++) {
            it->val[j] = madd(alpha, it->d_val[j], it->val[j]);
            it->mul[j] = madd(alpha, it->d_mul[j], it->mul[j]);
        }
        for (int64_t i = 0; i < 12 * (qp->stages + 1); i++)
            answer->dx[i] = madd(alpha, it->step_x[i], answer->dx[i]);
        for (int64_t i = 0; i < inputs; i++)
            answer->dw[i] = madd(alpha, it->step_w[i], answer->dw[i]);
    }
}

/* Write the multipliers of all rows. An inactive row has lam = 0 and pi = w1. */
static void expand_multipliers(const Qp *qp, const Iterate *it, double *mul) {
    for (int64_t j = 0; j < qp->n_rows; j++) {
        mul[j] = 0.0;
        mul[qp->n_rows + j] = qp->w1;
    }
    for (int64_t j = 0; j < it->n; j++) {
        mul[it->index[j]] = it->mul[j];
        mul[qp->n_rows + it->index[j]] = it->mul[it->n + j];
    }
    copy(it->mul + 2 * it->n, mul + 2 * qp->n_rows, 12 * qp->stages);
}

/* Solve the QP of one chaser. |w_bar + dw| <= 1 holds up to rounding; for FREE within
 * FREE_TOLERANCE. CONVERGED and LIMIT: the point lies strictly within the box; LIMIT: it is the
 * best of max_iterations. BROKEN: the solution would not be finite. work: `ipm_workspace`
 * doubles, and R more. */
static int solve_one(const Qp *qp, Answer *answer, double *work) {
    const int64_t inputs = 6 * qp->stages;
    double *active = allocate(&work, qp->n_rows);
    Iterate it = lay_out(qp->stages, qp->n_rows, work);
    answer->iterations = 0;
    answer->residual = answer->mu = 0.0;
    if (!factor(qp->stages, qp->mats, qp->h, qp->q, qp->r_diag, it.factors)) return BROKEN;
    minimize(qp->stages, qp->mats, qp->h, it.factors, qp->qx, qp->r, answer->dx, answer->dw);
    for (int64_t i = 0; i < inputs; i++) it.w[i] = qp->w_bar[i] + answer->dw[i];
    if (is_free(qp, answer->dx, it.w)) {
        zero(answer->mul, 2 * qp->n_rows + 2 * inputs);
        return FREE;
    }
    /* near the rollout or the unconstrained solution */
    zero(active, qp->n_rows);
    for (int64_t j = 0; j < qp->n_rows; j++) active[j] = -qp->c[j] < NEAR_M ? 1.0 : 0.0;
    for (;;) {
        activate_rows(qp, answer->dx, active, &it);
        int code = iterate(qp, answer, &it);
        expand_multipliers(qp, &it, answer->mul);
        if (code != CONVERGED || !violates_inactive(qp, answer->dx, active)) return code;
        for (int64_t i = 0; i < inputs; i++) it.w[i] = qp->w_bar[i] + answer->dw[i];
    }
}

EXPORT int64_t NAME(qp_workspace)(int64_t stages, int64_t rows) {
    return ipm_workspace(stages, rows) + rows + 16;
}

EXPORT int NAME(solve_qp)(const Qp *qp, Answer *answer, double *work) {
    return solve_one(qp, answer, work);
}
