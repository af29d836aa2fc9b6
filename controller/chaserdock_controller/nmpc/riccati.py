"""Riccati sweeps for one chaser's linear-quadratic problem, exploiting the double integrator in A.

    minimize  sum_k 1/2 dx_k' Q_k dx_k + qx_k' dx_k + 1/2 dw_k' R_k dw_k + r_k' dw_k
    subject to dx_{k+1} = A_k dx_k + B_k dw_k, dx_0 = 0,  k = 0..D-1

A_k = [[I, hI], [0, I], [0, 0], [0, 0] | C_k]; M_k = [C_k B_k] (12, 12) is what is stored. Q_k holds a 3 x 3 block
for position and one for attitude; R_k is diagonal. Standard discrete-time recursion, e.g. Rawlings, Mayne and
Diehl, "Model Predictive Control", 2nd ed., section 8.8.3.
"""

from __future__ import annotations

import numpy as np

from chaserdock_controller.nmpc.compiled import part


@part
def _product(left, right, out):
    """out = left right, 12 x 12."""
    for i in range(12):
        for j in range(12):
            out[i, j] = 0.0
        for m in range(12):
            f = left[i, m]
            for j in range(12):
                out[i, j] += f * right[m, j]


@part
def _gram(left, right, out):
    """out = left' right, 12 x 12."""
    for i in range(12):
        for j in range(12):
            out[i, j] = 0.0
    for m in range(12):
        for i in range(12):
            f = left[m, i]
            for j in range(12):
                out[i, j] += f * right[m, j]


@part
def _cholesky(matrix, first, diagonal, low):
    """low (6, 6) with low low' = matrix[first:, first:] + diag(diagonal); False where that is not positive."""
    for j in range(6):
        for i in range(j, 6):
            t = matrix[first + i, first + j]
            if i == j:
                t += diagonal[j]
            for m in range(j):
                t -= low[i, m] * low[j, m]
            if i == j:
                if not t > 0.0:
                    return False
                low[j, j] = np.sqrt(t)
            else:
                low[i, j] = t / low[j, j]
    return True


@part
def factor(mats, h, q_pos, q_att, r_diag, gain, chol):
    """Backward sweep over the matrices: gain (D, 6, 12) = -Rt^-1 B'PA, chol (D, 6, 6) lower with Rt = LL'.

    Returns False where Rt is not positive definite.
    """
    stages = len(mats)
    p = np.zeros((12, 12))
    w = np.empty((12, 12))  # P M
    gram = np.empty((12, 12))  # M'PM
    y = np.empty((6, 12))  # L^-1 B'PA
    for i in range(3):
        for j in range(3):
            p[i, j] = q_pos[stages, i, j]
            p[6 + i, 6 + j] = q_att[stages, i, j]
    for k in range(stages - 1, -1, -1):
        low, g = chol[k], gain[k]
        _product(p, mats[k], w)
        _gram(mats[k], w, gram)
        if not _cholesky(gram, 6, r_diag[k], low):
            return False
        for i in range(6):
            for n in range(3):
                y[i, n] = w[n, 6 + i]
                y[i, 3 + n] = h * w[n, 6 + i] + w[3 + n, 6 + i]
            for n in range(6):
                y[i, 6 + n] = gram[6 + i, n]
        for i in range(6):
            for m in range(i):
                for n in range(12):
                    y[i, n] -= low[i, m] * y[m, n]
            f = 1.0 / low[i, i]
            for n in range(12):
                y[i, n] *= f
        for i in range(5, -1, -1):
            f = 1.0 / low[i, i]
            for n in range(12):
                g[i, n] = -y[i, n]
            for m in range(i + 1, 6):
                for n in range(12):
                    g[i, n] -= low[m, i] * g[m, n]
            for n in range(12):
                g[i, n] *= f
        # P <- Q + A'PA - y'y: A'PA by its blocks, lower triangle, from the bottom up
        for i in range(6):
            for j in range(6):
                p[6 + i, 6 + j] = gram[i, j]
            for j in range(3):
                p[6 + i, j] = w[j, i]
                p[6 + i, 3 + j] = h * w[j, i] + w[3 + j, i]
        for i in range(3):
            for j in range(3):
                p[3 + i, 3 + j] += h * (h * p[i, j] + p[3 + i, j] + p[3 + j, i])
        for i in range(3):
            for j in range(3):
                p[3 + i, j] += h * p[i, j]
        for m in range(6):
            for i in range(12):
                f = y[m, i]
                for j in range(12):
                    p[i, j] -= f * y[m, j]
        for i in range(3):
            for j in range(3):
                p[i, j] += q_pos[k, i, j]
                p[6 + i, 6 + j] += q_att[k, i, j]
        for i in range(12):
            for j in range(i):
                p[j, i] = p[i, j]
    return True


@part
def _adjoint(m_mat, h, y, out):
    """out (18) = [A B]' y (12)."""
    for i in range(3):
        out[i] = y[i]
        out[3 + i] = h * y[i] + y[3 + i]
    for i in range(12):
        out[6 + i] = 0.0
    for m in range(12):
        f = y[m]
        for i in range(12):
            out[6 + i] += f * m_mat[m, i]


@part
def advance(mats, h, dx, dw):
    """dx (D+1, 12) by dw (D, 6), from zero: dx_{k+1} = A_k dx_k + B_k dw_k."""
    for n in range(12):
        dx[0, n] = 0.0
    for k in range(len(mats)):
        forward(mats[k], h, dx[k], dw[k], dx[k + 1])


@part
def forward(m_mat, h, dx, dw, out):
    """out (12) = A dx + B dw."""
    for i in range(12):
        s = 0.0
        for j in range(6):
            s += m_mat[i, j] * dx[6 + j] + m_mat[i, 6 + j] * dw[j]
        out[i] = s
    for i in range(3):
        out[i] += dx[i] + h * dx[3 + i]
        out[3 + i] += dx[3 + i]


@part
def solve(mats, h, gain, chol, qx, r, dx, dw):
    """With `factor`'s result: the minimizer dx (D+1, 12), dw (D, 6) for the gradients qx (D+1, 12), r (D, 6)."""
    stages = len(mats)
    p = np.empty(12)
    t = np.empty(18)
    for n in range(12):
        p[n] = qx[stages, n]
        dx[0, n] = 0.0
    for k in range(stages - 1, -1, -1):
        low, g, f = chol[k], gain[k], dw[k]
        _adjoint(mats[k], h, p, t)
        for n in range(12):
            p[n] = t[n] + qx[k, n]
        for i in range(6):
            f[i] = r[k, i] + t[12 + i]
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
    for k in range(stages):
        for i in range(6):
            s = -dw[k, i]
            for n in range(12):
                s += gain[k, i, n] * dx[k, n]
            dw[k, i] = s
        forward(mats[k], h, dx[k], dw[k], dx[k + 1])


@part
def reduced_gradient(mats, h, qx, r, out):
    """Gradient (D, 6) with respect to the inputs alone, states eliminated, for gradients qx and r.

    Returns its greatest absolute value; NaN if any value is.
    """
    stages = len(mats)
    p = np.empty(12)
    t = np.empty(18)
    greatest = 0.0
    for n in range(12):
        p[n] = qx[stages, n]
    for k in range(stages - 1, -1, -1):
        _adjoint(mats[k], h, p, t)
        for n in range(12):
            p[n] = t[n] + qx[k, n]
        for i in range(6):
            out[k, i] = r[k, i] + t[12 + i]
            if not abs(out[k, i]) <= greatest and greatest == greatest:
                greatest = abs(out[k, i])
    return greatest
