/* SPDX-License-Identifier: Apache-2.0 */
/* Discrete dynamics of a chaser and their Jacobians; the tests compare them with casadi_model.py.
 *
 * The Jacobians share intermediate results with the step itself, so the NMPC has its own integrator
 * beside chaserdock_models.rigid_body.
 *
 * State x (13) = [p, v (WRF), q_wxyz (body to world), omega (body)], input u (6) = [force, torque]
 * (body axes). Jacobians are taken in the tangent space [dp, dv, dtheta, domega] with q_true = q
 * (x) exp(dtheta): A is 12 x 12 and B 12 x 6. The first six columns of A are those of a double
 * integrator (identity and step), so only its last six, C, are computed; M = [C B], 12 x 12, is
 * stored. Its columns: dtheta, domega, force, torque, three each.
 */
#include "base.h"

/* Rates at y (7) = [q, omega]: q', omega', acceleration (WRF); and intermediate results R(q) /
 * m (9) and I omega (3). */
typedef struct {
    double q[4], omega[3], a[3], turn[9], momentum[3];
} Rates;

static inline void rates(const Model *model, const double *y, const double *u, Rates *k) {
    const double w = y[0], x = y[1], v = y[2], z = y[3], f = model->per_mass, *o = y + 4;
    k->turn[0] = f * (1.0 - 2.0 * (v * v + z * z));
    k->turn[4] = f * (1.0 - 2.0 * (x * x + z * z));
    k->turn[8] = f * (1.0 - 2.0 * (x * x + v * v));
    k->turn[1] = f * 2.0 * (x * v - w * z);
    k->turn[3] = f * 2.0 * (x * v + w * z);
    k->turn[2] = f * 2.0 * (x * z + w * v);
    k->turn[6] = f * 2.0 * (x * z - w * v);
    k->turn[5] = f * 2.0 * (v * z - w * x);
    k->turn[7] = f * 2.0 * (v * z + w * x);
    k->q[0] = -0.5 * dot3(y + 1, o);
    double turning[3], torque[3];
    cross3(y + 1, o, turning);
    for (int i = 0; i < 3; i++) k->q[1 + i] = 0.5 * madd(w, o[i], turning[i]);
    multiply3(k->turn, u, k->a);
    multiply3(model->inertia, o, k->momentum);
    cross3(o, k->momentum, torque);
    for (int i = 0; i < 3; i++) torque[i] = u[3 + i] - torque[i];
    multiply3(model->inverse, torque, k->omega);
}

static inline double normalize_quaternion(double *q) {
    double length = sqrt_of((q[0] * q[0] + q[2] * q[2]) + (q[1] * q[1] + q[3] * q[3])),
           f = 1.0 / length;
    for (int i = 0; i < 4; i++) q[i] *= f;
    return length;
}

/* One Runge-Kutta stage: evaluate the rates at x + c k (k: rates of the previous stage, unused
 * if c is 0) and add them to out with weight b. */
static inline void part(const Model *model, const double *x, const double *u, double b, double c,
                        double *y, Rates *k, double *out) {
    for (int i = 0; i < 3; i++) out[i] = madd(b, madd(c, k->a[i], x[3 + i]), out[i]);
    for (int i = 0; i < 4; i++) y[i] = madd(c, k->q[i], x[6 + i]);
    for (int i = 0; i < 3; i++) y[4 + i] = madd(c, k->omega[i], x[10 + i]);
    rates(model, y, u, k);
    for (int i = 0; i < 3; i++) out[3 + i] = madd(b, k->a[i], out[3 + i]);
    for (int i = 0; i < 4; i++) out[6 + i] = madd(b, k->q[i], out[6 + i]);
    for (int i = 0; i < 3; i++) out[10 + i] = madd(b, k->omega[i], out[10 + i]);
}

static void step(const Model *model, const double *x, const double *u, double *out) {
    Rates k = {0};
    double y[7];
    copy(x, out, 13);
    for (int64_t s = 0; s < model->parts; s++)
        part(model, x, u, model->step_s * model->weights[s], model->step_s * model->nodes[s], y, &k,
             out);
    normalize_quaternion(out + 6);
}

/* A row of sensitivities to [omega, torque], and two spare elements. */
typedef struct {
    v4 a, b;
} Row;

static inline void add(Row *out, double f, Row r) {
    out->a = madd4(splat(f), r.a, out->a);
    out->b = madd4(splat(f), r.b, out->b);
}
static inline double entry(const Row *r, int i) { return i < 4 ? r->a[i] : r->b[i - 4]; }

/* Compute the sensitivities of [q', omega', a] to [omega, torque] at y; those of y itself are
 * `here` (7). torque (3): I^-1 in its columns.
 *
 * q' = 1/2 q (0, omega); omega' = I^-1 (tau - omega x I omega); a = (1 - |q|^2) F / m + q F q*
 * / m. Hence m da = 2 [ s dv x F + (v . F) dv + v (F . dv) - 2 F (v . dv) + ds v x F ] for q =
 * (s, v). */
static inline void rate_rows(const Model *model, const double *y, const double *u, const Rates *k,
                             const Row *torque, const Row *here, Row *rate) {
    const double s = y[0], *v = y + 1, *o = y + 4, f = 2.0 * model->per_mass, along = dot3(v, u);
    const Row none = {{0}, {0}};
    for (int i = 0; i < 10; i++) rate[i] = 4 <= i && i < 7 ? torque[i - 4] : none;
    double spin[9]; /* [I omega]x - [omega]x I, then I^-1 in front */
    for (int j = 0; j < 3; j++) {
        int a = (j + 1) % 3, b = (j + 2) % 3;
        for (int i = 0; i < 3; i++) {
            int m = (i + 1) % 3, n = (i + 2) % 3;
            spin[3 * i + j] =
                madd(o[n], model->inertia[3 * m + j], -(o[m] * model->inertia[3 * n + j]));
        }
        spin[3 * a + j] += k->momentum[b];
        spin[3 * b + j] -= k->momentum[a];
    }
    for (int i = 0; i < 3; i++) {
        int a = (i + 1) % 3, b = (i + 2) % 3;
        add(&rate[0], -0.5 * o[i], here[1 + i]);
        add(&rate[0], -0.5 * v[i], here[4 + i]);
        add(&rate[1 + i], 0.5 * o[i], here[0]);
        add(&rate[1 + i], 0.5 * o[b], here[1 + a]);
        add(&rate[1 + i], -0.5 * o[a], here[1 + b]);
        add(&rate[1 + i], 0.5 * s, here[4 + i]);
        add(&rate[1 + i], -0.5 * v[b], here[4 + a]);
        add(&rate[1 + i], 0.5 * v[a], here[4 + b]);
        for (int j = 0; j < 3; j++) {
            const double *inverse = model->inverse + 3 * i;
            add(&rate[4 + i],
                madd(inverse[2], spin[6 + j], madd(inverse[1], spin[3 + j], inverse[0] * spin[j])),
                here[4 + j]);
        }
        add(&rate[7 + i], f * madd(v[a], u[b], -(v[b] * u[a])), here[0]);
        add(&rate[7 + i], f * along - f * v[i] * u[i], here[1 + i]);
        add(&rate[7 + i], f * (v[i] * u[a] - 2.0 * u[i] * v[a] + s * u[b]), here[1 + a]);
        add(&rate[7 + i], f * (v[i] * u[b] - 2.0 * u[i] * v[b] - s * u[a]), here[1 + b]);
    }
}

/* Advance as `step` and compute the Jacobians m_mat = [C B] (12, 12), B by inputs in shares of
 * `limits` (6).
 *
 * The initial attitude needs no sensitivities: q' = 1/2 q (0, omega) commutes with a rotation
 * from the left. Therefore dtheta propagates as R(q_0* q_1)' dtheta, and the acceleration q F
 * q* rotates as a whole. */
static void linearize(const Model *model, const double *x, const double *u, const double *limits,
                      double *out, double *m_mat) {
    const Row none = {{0}, {0}},
              unit[3] = {{{1, 0, 0, 0}, {0}}, {{0, 1, 0, 0}, {0}}, {{0, 0, 1, 0}, {0}}};
    Rates k = {0};
    Row torque[3], here[7], rate[10], sum[13]; /* sums over the parts: p, v, q, omega */
    double y[7], along_p[3] = {0}, along_v[3] = {0}, turn_0[9], force_p[9] = {0}, force_v[9] = {0};
    for (int i = 0; i < 10; i++) rate[i] = none;
    for (int i = 0; i < 13; i++) sum[i] = none;
    for (int i = 0; i < 3; i++) {
        const double *row = model->inverse + 3 * i;
        sum[10 + i] = unit[i];
        torque[i] = (Row){{0, 0, 0, row[0]}, {row[1], row[2], 0, 0}};
    }
    zero(m_mat, 144);
    copy(x, out, 13);
    for (int64_t s = 0; s < model->parts; s++) {
        const double c = model->step_s * model->nodes[s], b = model->step_s * model->weights[s],
                     bc = b * c;
        for (int i = 0; i < 7; i++) {
            here[i] = i < 4 ? none : unit[i - 4];
            add(&here[i], c, rate[i]);
        }
        for (int i = 0; i < 3; i++) {
            add(&sum[i], bc, rate[7 + i]);
        }
        /* Columns of the force, and the rotating acceleration: those of the previous stage
         * enter p ... */
        if (s > 0) {
            double excess = 1.0 - ((y[0] * y[0] + y[2] * y[2]) + (y[1] * y[1] + y[3] * y[3]));
            for (int i = 0; i < 9; i++) force_p[i] = madd(bc, k.turn[i], force_p[i]);
            for (int i = 0; i < 3; i++)
                along_p[i] = madd(bc, k.a[i] - excess * u[i] * model->per_mass, along_p[i]);
        }
        part(model, x, u, b, c, y, &k, out);
        if (s == 0)
            for (int i = 0; i < 9; i++) turn_0[i] = model->mass_kg * k.turn[i];
        rate_rows(model, y, u, &k, torque, here, rate);
        /* ... and those of this stage enter v. */
        double excess = 1.0 - ((y[0] * y[0] + y[2] * y[2]) + (y[1] * y[1] + y[3] * y[3]));
        for (int i = 0; i < 9; i++) force_v[i] = madd(b, k.turn[i], force_v[i]);
        for (int i = 0; i < 3; i++) {
            along_v[i] = madd(b, k.a[i] - excess * u[i] * model->per_mass, along_v[i]);
            add(&sum[3 + i], b, rate[7 + i]);
            add(&sum[10 + i], b, rate[4 + i]);
        }
        for (int i = 0; i < 4; i++) add(&sum[6 + i], b, rate[i]);
    }
    const double scale = 2.0 / normalize_quaternion(out + 6), *q = out + 6;
    /* dtheta_next = 2 vec(q_next* (x) dq) / |q|: projection on the tangent space, which
     * includes the normalization. */
    Row turn[3];
    for (int i = 0; i < 3; i++) {
        int a = (i + 1) % 3, b = (i + 2) % 3;
        turn[i] = none;
        add(&turn[i], scale * q[0], sum[7 + i]);
        add(&turn[i], -scale * q[1 + i], sum[6]);
        add(&turn[i], -scale * q[1 + a], sum[7 + b]);
        add(&turn[i], scale * q[1 + b], sum[7 + a]);
    }
    /* r = q_0* (x) q_1 and R(r)' */
    const double *p = x + 6;
    double r[4], back[9];
    r[0] = (p[0] * q[0] + p[2] * q[2]) + (p[1] * q[1] + p[3] * q[3]);
    for (int i = 0; i < 3; i++) {
        int a = (i + 1) % 3, b = (i + 2) % 3;
        r[1 + i] =
            (p[0] * q[1 + i] - p[1 + i] * q[0]) - (p[1 + a] * q[1 + b] - p[1 + b] * q[1 + a]);
    }
    for (int i = 0; i < 3; i++) {
        int a = (i + 1) % 3, b = (i + 2) % 3;
        back[4 * i] = 1.0 - 2.0 * (r[1 + a] * r[1 + a] + r[1 + b] * r[1 + b]);
        back[3 * i + a] = 2.0 * (r[1 + i] * r[1 + a] + r[0] * r[1 + b]);
        back[3 * i + b] = 2.0 * (r[1 + i] * r[1 + b] - r[0] * r[1 + a]);
    }
    for (int i = 0; i < 3; i++) {
        int a = (i + 1) % 3, b = (i + 2) % 3;
        double *rows[4] = {m_mat + 12 * i, m_mat + 12 * (3 + i), m_mat + 12 * (6 + i),
                           m_mat + 12 * (9 + i)};
        const Row *of[4] = {&sum[i], &sum[3 + i], &turn[i], &sum[10 + i]};
        for (int j = 0; j < 3; j++) {
            /* (R_0 dtheta) x g = -[g]x R_0 dtheta */
            const double ra = turn_0[3 * a + j], rb = turn_0[3 * b + j];
            rows[0][j] = madd(ra, along_p[b], -(rb * along_p[a]));
            rows[1][j] = madd(ra, along_v[b], -(rb * along_v[a]));
            rows[2][j] = back[3 * i + j];
            rows[0][6 + j] = limits[j] * force_p[3 * i + j];
            rows[1][6 + j] = limits[j] * force_v[3 * i + j];
            for (int m = 0; m < 4; m++) {
                rows[m][3 + j] = entry(of[m], j);
                rows[m][9 + j] = limits[3 + j] * entry(of[m], 3 + j);
            }
        }
    }
}

/* Roll u (N, D, 6) out from x[:, 0] through x (N, D+1, 13). */
EXPORT void NAME(roll)(const Model *model, int64_t n, int64_t stages, const double *u, double *x) {
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = 0; k < stages; k++) {
            double *here = x + 13 * (i * (stages + 1) + k);
            step(model, here, u + 6 * (i * stages + k), here + 13);
        }
}

/* Roll out and linearize: mats (N, D, 12, 12) = [C B], B for inputs scaled by limits (N, 6). */
EXPORT void NAME(roll_linearized)(const Model *model, int64_t n, int64_t stages, const double *u,
                                  const double *limits, double *x, double *mats) {
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = 0; k < stages; k++) {
            double *here = x + 13 * (i * (stages + 1) + k);
            linearize(model, here, u + 6 * (i * stages + k), limits + 6 * i, here + 13,
                      mats + 144 * (i * stages + k));
        }
}
