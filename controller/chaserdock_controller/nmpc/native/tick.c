/* SPDX-License-Identifier: Apache-2.0 */
/* One tick of the real-time iteration for all chasers: rollout, linearization and rows, then
 * one QP per chaser. */
#include "base.h"

/* Arguments of a tick. inputs (N, D, 6): initial plan, replaced by the solution. states (N,
 * 13). reach (D+1,): displacement by each stage per 1 N on each axis, m. w1 (N,): slack
 * weights. budget: total iterations; each chaser may use an even share of the remaining ones,
 * at most `most`. code, iterations (N,): outputs. A chaser whose inputs would not be finite
 * keeps the given ones and gets the code BROKEN. */
typedef struct {
    const Model *model;
    const Problem *problem;
    const double *states, *reach, *w1;
    double *inputs;
    double w2;
    int64_t budget, most, *code, *iterations;
} Tick;
LAYOUT(Tick, model, problem, states, reach, w1, inputs, w2, budget, most, code, iterations)

/* Return the number of rows of a chaser. `extra`: number of cuboids and coasts. */
static int64_t tick_width(int64_t n, int64_t d, int64_t extra) { return d * (n + 2 + extra); }

EXPORT int64_t NAME(tick_workspace)(int64_t n, int64_t d, int64_t extra) {
    int64_t width = tick_width(n, d, extra);
    return n * (14 * (d + 1) + 8 * width + 2) + 144 * n * d + (72 + 12 + 12) * (d + 1) + 4 * 6 * d +
           2 * width + 12 * d + ipm_workspace(d, width) + width + 41 * 8;
}

EXPORT void NAME(solve_tick)(const Tick *tick, double *work) {
    const Problem *problem = tick->problem;
    const int64_t n = problem->n, d = problem->stages;
    const int64_t width = tick_width(n, d, problem->n_boxes + problem->n_coasts);
    double *x = allocate(&work, 13 * n * (d + 1)), *mats = allocate(&work, 144 * n * d);
    double *reach = allocate(&work, n * (d + 1));
    Rows rows = {width, d + 1, reach, 0, 0, 0, 0, allocate(&work, n)};
    rows.stage = (int64_t *)allocate(&work, n * width);
    rows.n_rows = (int64_t *)allocate(&work, n);
    rows.a = allocate(&work, 6 * n * width);
    rows.c = allocate(&work, n * width);
    double *q = allocate(&work, 72 * (d + 1)), *qx = allocate(&work, 12 * (d + 1));
    double *r_diag = allocate(&work, 6 * d), *r = allocate(&work, 6 * d);
    double *w_bar = allocate(&work, 6 * d);
    Answer answer = {allocate(&work, 12 * (d + 1)), allocate(&work, 6 * d),
                     allocate(&work, 2 * width + 12 * d), 0.0, 0.0, 0};

    for (int64_t i = 0; i < n; i++) {
        const double *top = problem->limits + 6 * i, force = max_of(max_of(top[0], top[1]), top[2]);
        for (int64_t k = 0; k <= d; k++) reach[(d + 1) * i + k] = force * tick->reach[k];
        copy(tick->states + 13 * i, x + 13 * (d + 1) * i, 13);
    }
    NAME(roll_linearized)(tick->model, n, d, tick->inputs, problem->limits, x, mats);
    NAME(build_rows)(problem, x, &rows);
    int64_t left = tick->budget;
    for (int64_t i = 0; i < n; i++) {
        double *u = tick->inputs + 6 * d * i;
        const double *limits = problem->limits + 6 * i;
        const int64_t share = (left + n - i - 1) / (n - i);
        NAME(quadratic_model)(problem, i, x + 13 * (d + 1) * i, u, q, qx, r_diag, r, w_bar);
        Qp qp = {d, rows.n_rows[i], share < tick->most ? share : tick->most,
                 tick->model->step_s, tick->w1[i], tick->w2, mats + 144 * d * i, q, qx, r_diag, r,
                 w_bar, rows.stage + width * i, rows.a + 6 * width * i, rows.c + width * i};
        tick->code[i] = solve_one(&qp, &answer, work);
        tick->iterations[i] = answer.iterations;
        left -= answer.iterations;
        for (int64_t m = 0; m < 6 * d; m++)
            if (!finite(answer.dw[m] * limits[m % 6])) tick->code[i] = BROKEN;
        if (tick->code[i] == BROKEN) continue;
        for (int64_t m = 0; m < 6 * d; m++)
            u[m] = min_of(max_of(w_bar[m] + answer.dw[m], -1.0), 1.0) * limits[m % 6];
    }
}

/* Shift piecewise constant inputs (N, D, 6) by `whole + part` steps on the same grid. Each new
 * value is the mean of the old plan over its interval, which preserves the impulse; the last value
 * is held beyond the old horizon. */
EXPORT void NAME(shift_inputs)(int64_t n, int64_t d, int64_t whole, double part,
                               const double *inputs, double *out) {
    for (int64_t i = 0; i < n; i++, inputs += 6 * d, out += 6 * d)
        for (int64_t k = 0; k < d; k++) {
            int64_t first = k + whole < d ? k + whole : d - 1,
                    second = first + 1 < d ? first + 1 : d - 1;
            for (int c = 0; c < 6; c++)
                out[6 * k + c] =
                    (1.0 - part) * inputs[6 * first + c] + part * inputs[6 * second + c];
        }
}
