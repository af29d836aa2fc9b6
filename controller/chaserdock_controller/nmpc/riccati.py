"""Riccati sweeps for one chaser's linear-quadratic problem, exploiting the double integrator in A.

    minimize  sum_k 1/2 dx_k' Q_k dx_k + qx_k' dx_k + 1/2 dw_k' R_k dw_k + r_k' dw_k
    subject to dx_{k+1} = A_k dx_k + B_k dw_k, dx_0 = 0,  k = 0..D-1

A_k = [[I, hI], [0, I], [0, 0], [0, 0] | C_k] with C_k (12, 6); Q_k holds a 3 x 3 block for position and
one for attitude; R_k is diagonal. Standard discrete-time recursion, e.g. Rawlings, Mayne and Diehl, "Model
Predictive Control", 2nd ed., section 8.8.3.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def _times_six(left, transposed, right, shift, out, first):
    """out[first + i, j] = sum_m left[i, m] right[m, shift + j], six columns at a time, in registers.

    ``transposed``: left[m, i] instead. Written out because six accumulators vectorize and an inner loop
    over six memory cells does not.
    """
    rows = left.shape[1] if transposed else left.shape[0]
    for i in range(rows):
        a0 = a1 = a2 = a3 = a4 = a5 = 0.0
        for m in range(12):
            f = left[m, i] if transposed else left[i, m]
            a0 += f * right[m, shift]
            a1 += f * right[m, shift + 1]
            a2 += f * right[m, shift + 2]
            a3 += f * right[m, shift + 3]
            a4 += f * right[m, shift + 4]
            a5 += f * right[m, shift + 5]
        out[first + i, shift] = a0
        out[first + i, shift + 1] = a1
        out[first + i, shift + 2] = a2
        out[first + i, shift + 3] = a3
        out[first + i, shift + 4] = a4
        out[first + i, shift + 5] = a5


@njit(cache=True, error_model="numpy")
def factor(c_mats, b_mats, h, q_pos, q_att, r_diag, gain, chol):
    """Backward sweep over the matrices: gain (D, 6, 12) = -Rt^-1 B'PA, chol (D, 6, 6) lower with Rt = LL'.

    Returns False where Rt is not positive definite.
    """
    stages = len(c_mats)
    p = np.zeros((12, 12))
    w = np.empty((12, 6))  # P C
    v = np.empty((12, 6))  # P B
    st = np.empty((12, 6))  # A'PB
    y = np.empty((6, 12))  # L^-1 B'PA
    low = np.empty((6, 6))
    corner = np.empty((6, 6))  # C'PC
    for i in range(3):
        for j in range(3):
            p[i, j] = q_pos[stages, i, j]
            p[6 + i, 6 + j] = q_att[stages, i, j]
    for k in range(stages - 1, -1, -1):
        c, b = c_mats[k], b_mats[k]
        _times_six(p, False, c, 0, w, 0)
        _times_six(p, False, b, 0, v, 0)
        _times_six(b, True, v, 0, low, 0)
        _times_six(c, True, v, 0, st, 6)
        _times_six(c, True, w, 0, corner, 0)
        for i in range(3):
            for j in range(6):
                st[i, j] = v[i, j]
                st[3 + i, j] = h * v[i, j] + v[3 + i, j]
        for j in range(6):  # Cholesky of Rt = R + B'PB
            s = low[j, j] + r_diag[k, j]
            for m in range(j):
                s -= low[j, m] * low[j, m]
            if not s > 0.0:
                return False
            s = np.sqrt(s)
            low[j, j] = s
            for i in range(j + 1, 6):
                t = low[i, j]
                for m in range(j):
                    t -= low[i, m] * low[j, m]
                low[i, j] = t / s
        d0, d1, d2 = 1.0 / low[0, 0], 1.0 / low[1, 1], 1.0 / low[2, 2]
        d3, d4, d5 = 1.0 / low[3, 3], 1.0 / low[4, 4], 1.0 / low[5, 5]
        for n in range(12):
            y0 = st[n, 0] * d0
            y1 = (st[n, 1] - low[1, 0] * y0) * d1
            y2 = (st[n, 2] - low[2, 0] * y0 - low[2, 1] * y1) * d2
            y3 = (st[n, 3] - low[3, 0] * y0 - low[3, 1] * y1 - low[3, 2] * y2) * d3
            y4 = (st[n, 4] - low[4, 0] * y0 - low[4, 1] * y1 - low[4, 2] * y2 - low[4, 3] * y3) * d4
            y5 = st[n, 5] - low[5, 0] * y0 - low[5, 1] * y1 - low[5, 2] * y2 - low[5, 3] * y3
            y5 = (y5 - low[5, 4] * y4) * d5
            y[0, n], y[1, n], y[2, n], y[3, n], y[4, n], y[5, n] = y0, y1, y2, y3, y4, y5
            z5 = y5 * d5
            z4 = (y4 - low[5, 4] * z5) * d4
            z3 = (y3 - low[4, 3] * z4 - low[5, 3] * z5) * d3
            z2 = (y2 - low[3, 2] * z3 - low[4, 2] * z4 - low[5, 2] * z5) * d2
            z1 = (y1 - low[2, 1] * z2 - low[3, 1] * z3 - low[4, 1] * z4 - low[5, 1] * z5) * d1
            z0 = y0 - low[1, 0] * z1 - low[2, 0] * z2 - low[3, 0] * z3 - low[4, 0] * z4
            z0 = (z0 - low[5, 0] * z5) * d0
            gain[k, 0, n], gain[k, 1, n], gain[k, 2, n] = -z0, -z1, -z2
            gain[k, 3, n], gain[k, 4, n], gain[k, 5, n] = -z3, -z4, -z5
        for i in range(6):
            for j in range(i + 1):
                chol[k, i, j] = low[i, j]
        # P <- Q + A'PA - y'y: A'PA by its blocks, lower triangle, from the bottom up
        for i in range(6):
            for j in range(6):
                p[6 + i, 6 + j] = corner[i, j]
            for j in range(3):
                p[6 + i, j] = w[j, i]
                p[6 + i, 3 + j] = h * w[j, i] + w[3 + j, i]
        for i in range(3):
            for j in range(3):
                p[3 + i, 3 + j] += h * (h * p[i, j] + p[3 + i, j] + p[3 + j, i])
        for i in range(3):
            for j in range(3):
                p[3 + i, j] += h * p[i, j]
        for i in range(12):
            e0, e1, e2, e3, e4, e5 = y[0, i], y[1, i], y[2, i], y[3, i], y[4, i], y[5, i]
            for j in range(i + 1):
                s = e0 * y[0, j] + e1 * y[1, j] + e2 * y[2, j] + e3 * y[3, j] + e4 * y[4, j] + e5 * y[5, j]
                p[i, j] -= s
        for i in range(3):
            for j in range(i + 1):
                p[i, j] += q_pos[k, i, j]
                p[6 + i, 6 + j] += q_att[k, i, j]
        for i in range(12):
            for j in range(i):
                p[j, i] = p[i, j]
    return True


@njit(cache=True, error_model="numpy")
def transpose_apply(c, h, y, out):
    """out (12) = A' y (12)."""
    for i in range(3):
        out[i] = y[i]
        out[3 + i] = h * y[i] + y[3 + i]
        out[6 + i] = 0.0
        out[9 + i] = 0.0
    for m in range(12):
        f = y[m]
        for i in range(6):
            out[6 + i] += f * c[m, i]


@njit(cache=True, error_model="numpy")
def solve(c_mats, b_mats, h, gain, chol, qx, r, dx, dw):
    """With `factor`'s result: the minimizer dx (D+1, 12), dw (D, 6) for the gradients qx (D+1, 12), r (D, 6)."""
    stages = len(c_mats)
    p = np.empty(12)
    t = np.empty(12)
    for i in range(12):
        p[i] = qx[stages, i]
    for k in range(stages - 1, -1, -1):
        b, low, g, f = b_mats[k], chol[k], gain[k], dw[k]
        for i in range(6):
            f[i] = r[k, i]
        for m in range(12):
            for i in range(6):
                f[i] += b[m, i] * p[m]
        transpose_apply(c_mats[k], h, p, t)
        for n in range(12):
            p[n] = t[n] + qx[k, n]
        for i in range(6):
            for n in range(12):
                p[n] += g[i, n] * f[i]
        for i in range(6):
            for m in range(i):
                f[i] -= low[i, m] * f[m]
            f[i] /= low[i, i]
        for i in range(5, -1, -1):
            for m in range(i + 1, 6):
                f[i] -= low[m, i] * f[m]
            f[i] /= low[i, i]
        for i in range(6):
            f[i] = -f[i]
    for n in range(12):
        dx[0, n] = 0.0
    for k in range(stages):
        for i in range(6):
            s = dw[k, i]
            for n in range(12):
                s += gain[k, i, n] * dx[k, n]
            dw[k, i] = s
        advance(c_mats[k], b_mats[k], h, dx[k], dw[k], dx[k + 1])


@njit(cache=True, error_model="numpy")
def advance(c, b, h, dx, dw, out):
    """out (12) = A dx + B dw."""
    for i in range(3):
        out[i] = dx[i] + h * dx[3 + i]
        out[3 + i] = dx[3 + i]
        out[6 + i] = 0.0
        out[9 + i] = 0.0
    for i in range(12):
        s = out[i]
        for j in range(6):
            s += c[i, j] * dx[6 + j] + b[i, j] * dw[j]
        out[i] = s


@njit(cache=True, error_model="numpy")
def reduced_gradient(c_mats, b_mats, h, qx, r, out):
    """Gradient (D, 6) with respect to the inputs alone, states eliminated, for gradients qx and r."""
    stages = len(c_mats)
    p = np.empty(12)
    t = np.empty(12)
    for i in range(12):
        p[i] = qx[stages, i]
    for k in range(stages - 1, -1, -1):
        for i in range(6):
            s = r[k, i]
            for m in range(12):
                s += b_mats[k, m, i] * p[m]
            out[k, i] = s
        transpose_apply(c_mats[k], h, p, t)
        for n in range(12):
            p[n] = t[n] + qx[k, n]
