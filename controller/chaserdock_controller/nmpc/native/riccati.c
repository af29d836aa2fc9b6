/* SPDX-License-Identifier: Apache-2.0 */
/* Riccati sweeps for one chaser's linear-quadratic problem, exploiting the double integrator in A.
 *
 *     minimize  sum_k 1/2 dx_k' Q_k dx_k + qx_k' dx_k + 1/2 dw_k' R_k dw_k + r_k' dw_k
 *     subject to dx_{k+1} = A_k dx_k + B_k dw_k, dx_0 = 0,  k = 0..D-1
 *
 * A_k = [[I, hI], [0, I], [0, 0], [0, 0] | C_k]; M_k = [C_k B_k] (12, 12) is what is stored. Q_k
 * holds a 6 x 6 block for position and velocity and one for attitude and rate; R_k is diagonal.
 * Standard discrete-time recursion, e.g. Rawlings, Mayne and Diehl, "Model Predictive Control", 2nd
 * ed., section 8.8.3.
 */
#include "base.h"

/* Factors of a stage from `factor`, with Rt = R + B'PB = L D L': -Rt^-1 B'PA; L (unit lower,
 * row by row); 1 / D. */
typedef struct {
    double gain[6][12], low[15], inverse[6], spare[3];
} Factor;

#define LOW(i, j) low[(i) * ((i) - 1) / 2 + (j)]

/* Write rows first.. of left' right (12, 12) to out: three rows and `width` vectors of columns
 * at a time. */
static inline void gram_rows(const row12 *left, const row12 *right, row12 *out, int first,
                             int width) {
    v4 sum[3][3];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < width; j++)
            sum[i][j] = splat(left[0][first + i]) * load(right[0] + 4 * j);
    for (int m = 1; m < 12; m++)
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < width; j++)
                sum[i][j] = madd4(splat(left[m][first + i]), load(right[m] + 4 * j), sum[i][j]);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < width; j++) store(out[first + i] + 4 * j, sum[i][j]);
}

/* Write rows first.. of left right (12, 12) to out. */
static inline void product_rows(const row12 *left, const row12 *right, row12 *out, int first,
                                int width) {
    v4 sum[3][3];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < width; j++)
            sum[i][j] = splat(left[first + i][0]) * load(right[0] + 4 * j);
    for (int m = 1; m < 12; m++)
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < width; j++)
                sum[i][j] = madd4(splat(left[first + i][m]), load(right[m] + 4 * j), sum[i][j]);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < width; j++) store(out[first + i] + 4 * j, sum[i][j]);
}

/* Factor L D L' = gram[6:, 6:] + diag(r); return 0 if that is not positive definite. */
static inline int decompose(const row12 *gram, const double *r, double *low, double *inverse) {
    double scaled[6][6]; /* L D */
    for (int j = 0; j < 6; j++) {
        double d = gram[6 + j][6 + j] + r[j];
        for (int m = 0; m < j; m++) d = madd(-scaled[j][m], LOW(j, m), d);
        if (!(d > 0.0)) return 0;
        inverse[j] = 1.0 / d;
        for (int i = j + 1; i < 6; i++) {
            double t = gram[6 + i][6 + j];
            for (int m = 0; m < j; m++) t = madd(-scaled[i][m], LOW(j, m), t);
            scaled[i][j] = t;
            LOW(i, j) = t * inverse[j];
        }
    }
    return 1;
}

/* Backward sweep over the matrices q (D+1, 2, 6, 6) and r_diag (D, 6). Only the lower triangles
 * of q are read, at the last stage those of the diagonal blocks. Return 0 if an Rt is not
 * positive definite. */
static int factor(int64_t stages, const double *mats, double h, const double *q,
                  const double *r_diag, Factor *factors) {
    row12 p[12], t[12], gram[12], y[6], scaled[6]; /* t = M'P, gram = M'PM, y = L^-1 B'PA */
    zero(p[0], 144);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) {
            const double *last = q + 72 * stages + (i < 3 && j >= 3 ? 6 * j + i : 6 * i + j);
            p[i][j] = last[0];
            p[6 + i][6 + j] = last[36];
        }
    for (int64_t k = stages - 1; k >= 0; k--) {
        const row12 *m_mat = (const row12 *)(mats + 144 * k);
        double *low = factors[k].low, *inverse = factors[k].inverse;
        row12 *gain = factors[k].gain;
        for (int i = 0; i < 12; i += 3) gram_rows(m_mat, p, t, i, 3);
        /* lower triangle of the symmetric product */
        product_rows(t, m_mat, gram, 0, 1);
        product_rows(t, m_mat, gram, 3, 2);
        product_rows(t, m_mat, gram, 6, 3);
        product_rows(t, m_mat, gram, 9, 3);
        if (!decompose(gram, r_diag + 6 * k, low, inverse)) return 0;
        for (int i = 0; i < 6; i++) {
            for (int n = 0; n < 3; n++) {
                y[i][n] = t[6 + i][n];
                y[i][3 + n] = madd(h, t[6 + i][n], t[6 + i][3 + n]);
            }
            for (int n = 0; n < 6; n++) y[i][6 + n] = gram[6 + i][n];
        }
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 12; j += 4) {
                v4 s = load(y[i] + j);
                for (int m = 0; m < i; m++) s = madd4(splat(-LOW(i, m)), load(y[m] + j), s);
                store(y[i] + j, s);
                store(scaled[i] + j, splat(inverse[i]) * s);
            }
        for (int i = 5; i >= 0; i--)
            for (int j = 0; j < 12; j += 4) {
                v4 s = -load(scaled[i] + j);
                for (int m = i + 1; m < 6; m++) s = madd4(splat(-LOW(m, i)), load(gain[m] + j), s);
                store(gain[i] + j, s);
            }
        /* P <- Q + A'PA - y'D^-1 y: A'PA by its blocks, lower triangle, from the bottom up */
        for (int i = 0; i < 6; i++) {
            for (int j = 0; j <= i; j++) p[6 + i][6 + j] = gram[i][j];
            for (int j = 0; j < 3; j++) {
                p[6 + i][j] = t[i][j];
                p[6 + i][3 + j] = madd(h, t[i][j], t[i][3 + j]);
            }
        }
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                p[3 + i][3 + j] += h * (madd(h, p[i][j], p[3 + i][j]) + p[3 + j][i]);
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) p[3 + i][j] = madd(h, p[i][j], p[3 + i][j]);
        for (int i = 0; i < 12; i++)
            for (int j = 0; j <= i; j += 4) {
                v4 s = load(p[i] + j);
                for (int m = 0; m < 6; m++) s = madd4(splat(-y[m][i]), load(scaled[m] + j), s);
                store(p[i] + j, s);
            }
        for (int i = 0; i < 6; i++)
            for (int j = 0; j <= i; j++) {
                p[i][j] += q[72 * k + 6 * i + j];
                p[6 + i][6 + j] += q[72 * k + 36 + 6 * i + j];
            }
        for (int i = 0; i < 12; i++)
            for (int j = 0; j < i; j++) p[j][i] = p[i][j];
    }
    return 1;
}

/* Write [A B]' p + gx (12) to out (18): 12 elements for the states, then B'p (6). */
static inline void adjoint(const double *m_mat, double h, const double *p, double *out) {
    v4 s[3], t[3];
    for (int j = 0; j < 3; j++) {
        s[j] = splat(p[0]) * load(m_mat + 4 * j);
        t[j] = splat(p[6]) * load(m_mat + 72 + 4 * j);
    }
    for (int m = 1; m < 6; m++)
        for (int j = 0; j < 3; j++) {
            s[j] = madd4(splat(p[m]), load(m_mat + 12 * m + 4 * j), s[j]);
            t[j] = madd4(splat(p[6 + m]), load(m_mat + 72 + 12 * m + 4 * j), t[j]);
        }
    for (int i = 0; i < 3; i++) {
        out[i] = p[i];
        out[3 + i] = madd(h, p[i], p[3 + i]);
    }
    for (int j = 0; j < 3; j++) store(out + 6 + 4 * j, s[j] + t[j]);
}

/* Write A dx + B dw to out (12). */
static inline void forward(const double *m_mat, double h, const double *dx, const double *dw,
                           double *out) {
    double v[12], s[12];
    for (int i = 0; i < 6; i++) {
        v[i] = dx[6 + i];
        v[6 + i] = dw[i];
    }
    for (int i = 0; i < 12; i++) s[i] = dot12(m_mat + 12 * i, v);
    for (int i = 0; i < 3; i++) {
        out[i] = s[i] + madd(h, dx[3 + i], dx[i]);
        out[3 + i] = s[3 + i] + dx[3 + i];
        out[6 + i] = s[6 + i];
        out[9 + i] = s[9 + i];
    }
}

/* Propagate dw (D, 6) to dx (D+1, 12) from zero. */
static void advance(int64_t stages, const double *mats, double h, double *dx, const double *dw) {
    zero(dx, 12);
    for (int64_t k = 0; k < stages; k++)
        forward(mats + 144 * k, h, dx + 12 * k, dw + 6 * k, dx + 12 * (k + 1));
}

/* Solve with the result of `factor`: write the minimizer dx (D+1, 12), dw (D, 6) for the
 * gradients qx (D+1, 12), r (D, 6). */
static void minimize(int64_t stages, const double *mats, double h, const Factor *factors,
                     const double *qx, const double *r, double *dx, double *dw) {
    double p[12], t[18];
    copy(qx + 12 * stages, p, 12);
    for (int64_t k = stages - 1; k >= 0; k--) {
        const double *low = factors[k].low;
        double *f = dw + 6 * k;
        adjoint(mats + 144 * k, h, p, t);
        for (int i = 0; i < 6; i++) f[i] = r[6 * k + i] + t[12 + i];
        for (int j = 0; j < 12; j += 4) {
            v4 s = load(t + j) + load(qx + 12 * k + j);
            for (int i = 0; i < 6; i++) s = madd4(splat(f[i]), load(factors[k].gain[i] + j), s);
            store(p + j, s);
        }
        for (int i = 1; i < 6; i++)
            for (int m = 0; m < i; m++) f[i] = madd(-LOW(i, m), f[m], f[i]);
        for (int i = 5; i >= 0; i--) {
            f[i] *= factors[k].inverse[i];
            for (int m = i + 1; m < 6; m++) f[i] = madd(-LOW(m, i), f[m], f[i]);
        }
    }
    zero(dx, 12);
    for (int64_t k = 0; k < stages; k++) {
        for (int i = 0; i < 6; i++)
            dw[6 * k + i] = dot12(factors[k].gain[i], dx + 12 * k) - dw[6 * k + i];
        forward(mats + 144 * k, h, dx + 12 * k, dw + 6 * k, dx + 12 * (k + 1));
    }
}

/* Compute the gradient (D, 6) by the inputs alone, states eliminated, from the gradients qx and
 * r. Return its largest absolute value; NaN if any value is. */
static double reduced_gradient(int64_t stages, const double *mats, double h, const double *qx,
                               const double *r, double *out) {
    double p[12], t[18], greatest = 0.0;
    copy(qx + 12 * stages, p, 12);
    for (int64_t k = stages - 1; k >= 0; k--) {
        adjoint(mats + 144 * k, h, p, t);
        for (int j = 0; j < 12; j += 4) store(p + j, load(t + j) + load(qx + 12 * k + j));
        for (int i = 0; i < 6; i++) {
            double g = r[6 * k + i] + t[12 + i];
            out[6 * k + i] = g;
            if (!(abs_of(g) <= greatest) && greatest == greatest) greatest = abs_of(g);
        }
    }
    return greatest;
}
