/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of controller/chaserdock_controller/nmpc/native. */
#include "fuzz.h"
#include "kernels.c"

static Model *model(void) {
    Model *m = block(sizeof *m);
    m->step_s = value(0.01, 0.1), m->mass_kg = value(1.0, 40.0), m->per_mass = 1.0 / m->mass_kg;
    fill_inertia(m->inertia, m->inverse);
    m->parts = chance(0.5) ? 4 : 1;
    for (int i = 0; i < 4; i++) m->nodes[i] = i ? 0.5 : 0.0, m->weights[i] = 1.0 / (double)m->parts;
    return m;
}

static void fill_states(double *x, int64_t count) {
    for (int64_t i = 0; i < count; i++, x += 13) {
        fill(x, 6, -1.5, 1.5);
        fill_quaternion(x + 6);
        fill(x + 10, 3, -0.5, 0.5);
    }
}

static double *states(int64_t count) {
    double *x = outputs(13 * count);
    fill_states(x, count);
    return x;
}

static double *references(int64_t count) {
    double *refs = outputs(7 * count);
    for (int64_t i = 0; i < count; i++) {
        fill(refs + 7 * i, 3, -1.5, 1.5);
        fill_quaternion(refs + 7 * i + 3);
    }
    return refs;
}

static Problem *problem(int64_t n, int64_t d, int64_t boxes, int64_t coasts) {
    Problem *p = block(sizeof *p);
    double *corridors = doubles(5 * n * (d + 1), 0.0, 0.5), *limits = doubles(6 * n, 0.0, 3.0);
    double *between = doubles(n * n, 0.0, 0.8), *apart = doubles(n * n, -0.2, 0.3);
    for (int64_t i = 0; i < n * (d + 1); i++) {
        double *c = corridors + 5 * i;
        if (chance(0.5)) zero(c, 3);
        else normalize3(c);
    }
    for (int64_t i = 0; i < 6 * n; i++) limits[i] = abs_of(limits[i]);
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < i; j++) {
            between[i * n + j] = between[j * n + i];
            apart[i * n + j] = apart[j * n + i];
        }
    const int64_t shape = whole(0, 2);
    *p = (Problem){.n = n, .stages = d, .step_s = value(0.01, 0.3),
                   .references = references(n * (d + 1)),
                   .targets = doubles(3 * (d + 1), -0.2, 0.2),
                   .u_ref = doubles(6 * n * d, -1.0, 1.0),
                   .attitude = doubles(d + 1, 0.0, 50.0),
                   .n_coasts = coasts, .coasts = doubles(7 * n * (d + 1) * coasts, -1.0, 1.0),
                   .corridors = corridors, .input = doubles(6 * (d + 1), 0.001, 5.0),
                   .limits = limits, .to_target = doubles(n * (d + 1), -0.2, 1.0),
                   .outer = value(0.5, 30.0), .position = doubles(d + 1, 0.0, 50.0),
                   .between = between, .apart = apart, .n_shape = shape,
                   .shape = doubles(15 * shape, -0.5, 0.5), .n_boxes = boxes,
                   .boxes = doubles(15 * boxes * (d + 1), -0.5, 0.5),
                   .clearance = doubles(n, -0.2, 0.6)};
    return p;
}

static void normalize_rows(void) {
    const int64_t rows = whole(0, 6), width = whole(4, 13), first = whole(0, width - 4);
    double *array = doubles(rows * width, -1.0, 1.0), tolerance = value(0.0, 0.3);
    for (int64_t i = 0; i < rows; i++) fill_quaternion(array + width * i + first);
    int finite_before = all_finite(array, rows * width);
    int64_t code = NAME(normalize_rows)(array, rows, width, first, tolerance);
    CHECK(code == 0 || code == 1 || code == 2);
    CHECK((code == 1) == !finite_before);
    for (int64_t i = 0; i < rows && code == 0 && tolerance < 0.5; i++) {
        const double *q = array + width * i + first;
        CHECK(abs_of((q[0] * q[0] + q[1] * q[1]) + (q[2] * q[2] + q[3] * q[3]) - 1.0) < 1e-14);
    }
}

static void sign_of(void) {
    const int64_t count = whole(0, 20);
    double *array = doubles(count, chance(0.5) ? 0.0 : -1.0, 5.0);
    int64_t code = NAME(sign_of)(array, count), negative = 0;
    for (int64_t i = 0; i < count; i++) negative |= array[i] < 0.0;
    CHECK(code == (all_finite(array, count) ? 2 * negative : 1));
}

static void shift_inputs(void) {
    const int64_t n = whole(0, 3), d = whole(1, 6), shift = whole(0, d + 2);
    double *inputs = doubles(6 * n * d, -3.0, 3.0), *out = outputs(6 * n * d),
           part = uniform(0.0, 1.0);
    NAME(shift_inputs)(n, d, shift, part, inputs, out);
    if (all_finite(inputs, 6 * n * d)) CHECK(all_finite(out, 6 * n * d));
    for (int64_t i = 0; i < 6 * n && shift >= d; i++) /* the last value is held */
        CHECK(any_nan(out, 6 * n * d) || special_drawn ||
              abs_of(out[6 * d * (i / 6) + i % 6] - inputs[6 * d * (i / 6) + 6 * (d - 1) + i % 6]) <
                  1e-12);
}

static void check_rolled(const double *x, const double *given, int64_t n, int64_t d) {
    for (int64_t i = 0; i < n; i++) {
        CHECK(same_bits(x + 13 * (d + 1) * i, given + 13 * (d + 1) * i, 13));
        int unknown = 0;
        for (int64_t k = 0; k <= d; k++) {
            const double *at = x + 13 * ((d + 1) * i + k);
            if (!special_drawn) CHECK(all_finite(at, 13));
            CHECK(!unknown || any_nan(at, 13)); /* NaN stays */
            unknown |= any_nan(at, 13);
        }
    }
}

static void roll(void) {
    const int64_t n = whole(0, 2), d = whole(1, 5);
    double *u = doubles(6 * n * d, -3.0, 3.0), *x = states(n * (d + 1)),
           *given = copy_of(x, 13 * n * (d + 1));
    NAME(roll)(model(), n, d, u, x);
    check_rolled(x, given, n, d);
}

static void roll_linearized(void) {
    const int64_t n = whole(0, 2), d = whole(1, 3);
    const Model *m = model();
    double *u = doubles(6 * n * d, -3.0, 3.0), *x = states(n * (d + 1)),
           *given = copy_of(x, 13 * n * (d + 1));
    double *limits = doubles(6 * n, 0.0, 3.0), *mats = outputs(144 * n * d);
    NAME(roll_linearized)(m, n, d, u, limits, x, mats);
    check_rolled(x, given, n, d);
    if (!special_drawn) CHECK(all_finite(mats, 144 * n * d));
}

static void quadratic_model(void) {
    const int64_t n = whole(1, 3), d = whole(1, 5), i = whole(0, n - 1);
    double *x = states(d + 1), *u = doubles(6 * d, -3.0, 3.0);
    double *q = outputs(72 * (d + 1)), *qx = outputs(12 * (d + 1));
    double *r_diag = outputs(6 * d), *r = outputs(6 * d), *w_bar = outputs(6 * d);
    NAME(quadratic_model)(problem(n, d, 0, 0), i, x, u, q, qx, r_diag, r, w_bar);
    if (special_drawn) return;
    CHECK(all_finite(q, 72 * (d + 1)) && all_finite(qx, 12 * (d + 1)));
    CHECK(all_finite(r_diag, 6 * d) && all_finite(r, 6 * d) && all_finite(w_bar, 6 * d));
}

static void plan_cost(void) {
    const int64_t n = whole(0, 3), d = whole(1, 4);
    double *x = states(n * (d + 1)), *u = doubles(6 * n * d, -3.0, 3.0), *cost = outputs(n);
    NAME(plan_cost)(problem(n, d, 0, 0), x, u, cost);
    for (int64_t i = 0; i < n; i++) {
        CHECK(special_drawn || (finite(cost[i]) && cost[i] >= 0.0));
        if (any_nan(u + 6 * d * i, 6 * d)) CHECK(cost[i] != cost[i]);
    }
}

static void plan_violation(void) {
    const int64_t n = whole(1, 3), d = whole(1, 4);
    double *x = states(n * (d + 1)), *worst = outputs(n);
    NAME(plan_violation)(problem(n, d, whole(0, 2), 0), x, worst);
    for (int64_t i = 0; i < n; i++) {
        CHECK(worst[i] >= 0.0 || worst[i] != worst[i]);
        for (int64_t k = 0; k <= d; k++)
            if (any_nan(x + 13 * ((d + 1) * i + k), 3)) CHECK(worst[i] != worst[i]);
    }
}

static void build_rows(void) {
    const int64_t n = whole(1, 3), d = whole(1, 4), boxes = whole(0, 2), coasts = whole(0, 2);
    const int64_t width = d * (n + 2 + boxes + coasts);
    double *x = states(n * (d + 1)), *reach = doubles(n * (d + 1), 0.0, 5.0);
    int64_t *stage = block((size_t)(n * width) * 8), *n_rows = block((size_t)n * 8);
    Rows rows = {width, d + 1, reach, stage, n_rows, outputs(6 * n * width), outputs(n * width),
                 outputs(n)};
    NAME(build_rows)(problem(n, d, boxes, coasts), x, &rows);
    for (int64_t i = 0; i < n; i++) {
        CHECK(0 <= rows.n_rows[i] && rows.n_rows[i] <= width);
        for (int64_t m = width * i; m < width * i + rows.n_rows[i]; m++)
            CHECK(1 <= rows.stage[m] && rows.stage[m] <= d && rows.c[m] == rows.c[m]);
    }
}

static void check_answer(int64_t code, int64_t iterations, int64_t most) {
    CHECK(FREE <= code && code <= BROKEN);
    CHECK(0 <= iterations && iterations <= most);
}

static void solve_qp(void) {
    const int64_t d = whole(1, 4), rows = whole(0, 6), most = whole(0, 12);
    const int64_t n_mul = 2 * rows + 12 * d;
    double *q = doubles(72 * (d + 1), 0.0, 0.1), *a = doubles(6 * rows, -1.0, 1.0);
    int64_t *stage = block((size_t)rows * sizeof *stage);
    for (int64_t block_of = 0; block_of < 2 * (d + 1); block_of++)
        for (int i = 0; i < 6; i++) q[36 * block_of + 7 * i] = value(0.0, 20.0);
    for (int64_t j = 0; j < rows; j++) stage[j] = whole(1, d);
    Qp qp = {d, rows, most, value(0.01, 0.3), value(1.0, 1e4), value(0.0, 1e4),
             doubles(144 * d, -0.3, 0.3), q, doubles(12 * (d + 1), -5.0, 5.0),
             doubles(6 * d, 0.01, 5.0), doubles(6 * d, -5.0, 5.0), doubles(6 * d, -1.0, 1.0),
             stage, a, doubles(rows, -1.0, 0.3)};
    Answer answer = {outputs(12 * (d + 1)), outputs(6 * d), outputs(n_mul), 0.0, 0.0, 0};
    int code = NAME(solve_qp)(&qp, &answer, outputs(NAME(qp_workspace)(d, rows)));
    check_answer(code, answer.iterations, most);
    for (int64_t i = 0; i < 6 * d && code != BROKEN; i++)
        CHECK(abs_of(qp.w_bar[i] + answer.dw[i]) <= 1.0 + 1e-8 + 1e-15 * abs_of(qp.w_bar[i]));
}

static void solve_tick(void) {
    const int64_t n = whole(1, 2), d = whole(1, 3), budget = whole(0, 20);
    const int64_t boxes = whole(0, 2), coasts = whole(0, 2);
    const Problem *stated = problem(n, d, boxes, coasts);
    const double *limits = stated->limits;
    double *inputs = doubles(6 * n * d, -1.0, 1.0);
    for (int64_t i = 0; i < 6 * n * d; i++) inputs[i] *= limits[6 * (i / (6 * d)) + i % 6];
    double *given = copy_of(inputs, 6 * n * d);
    int64_t *code = block((size_t)n * 8), *iterations = block((size_t)n * 8), left = budget;
    Tick tick = {model(), stated, states(n), doubles(d + 1, 0.0, 1.0), doubles(n, 1.0, 1e4), inputs,
                 value(0.0, 1e4), budget, whole(0, 40), code, iterations};
    NAME(solve_tick)(&tick, outputs(NAME(tick_workspace)(n, d, boxes + coasts)));
    for (int64_t i = 0; i < n; i++, left -= iterations[i - 1]) {
        check_answer(code[i], iterations[i], left);
        if (code[i] == BROKEN) CHECK(same_bits(inputs + 6 * d * i, given + 6 * d * i, 6 * d));
        for (int64_t m = 0; m < 6 * d && code[i] != BROKEN; m++) {
            const double u = inputs[6 * d * i + m];
            CHECK(abs_of(u) <= limits[6 * i + m % 6] && finite(u));
        }
    }
}

static const Target TARGETS[] = {
    {"normalize_rows", normalize_rows},
    {"sign_of", sign_of},
    {"shift_inputs", shift_inputs},
    {"roll", roll},
    {"roll_linearized", roll_linearized},
    {"quadratic_model", quadratic_model},
    {"plan_cost", plan_cost},
    {"plan_violation", plan_violation},
    {"build_rows", build_rows},
    {"solve_qp", solve_qp},
    {"solve_tick", solve_tick},
};
FUZZ_MAIN(TARGETS)
