"""Mehrotra's predictor-corrector interior point for one chaser's QP, on top of the Riccati sweeps.

The box on the scaled inputs, -1 <= w <= 1, is hard. A row a' dp_k >= c (a unit normal, dp_k the change
of position at stage k) is soft: with a slack s >= 0, priced w1 s + w2/2 s^2, and z = a' dp - c + s >= 0,
multipliers lam (of z) and pi (of s). Slack and multipliers are eliminated row by row, so a row only adds
a rank-one term to the position block of Q_k and the sparsity of the Riccati sweep stays.
Method: S. Mehrotra, SIAM J. Optim. 2 (1992); Nocedal and Wright, "Numerical Optimization", sec. 16.6.

Everything that must stay positive lies in one flat vector, ``val``: z (R rows), s (R), 1 + w (6 D), 1 - w (6 D); its
multipliers, in that order, in ``mul``: lam, pi, and those of the box. ``top`` is where 1 - w begins.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from chaserdock_controller.nmpc import riccati
from chaserdock_controller.nmpc.compiled import kernel, part
from chaserdock_controller.nmpc.riccati import advance, factor, reduced_gradient, solve

MAX_ITERATIONS = 40
# Complementarity at which to stop, in units of cost. 1e-2 to 1e-4 fly the same closed loop.
MU_STOP = 1e-3
# Complementarity at the start, relative to the largest slope there, and its upper end.
MU_START = 0.1
MU_START_MAX = 1e5
# Stationarity at which to stop, relative to the gradient at the start.
GRADIENT_STOP = 1e-6
STEP_TO_BOUNDARY = 0.995
# Rows and bounds of the plain linear-quadratic solution may be missed by this much (m, or share of a limit).
FREE_TOLERANCE = 1e-9

FREE, CONVERGED, LIMIT, BROKEN = 0, 1, 2, 3


@part
def gradients(dx, dw, q_pos, q_att, qx, r_diag, r, gx, gw):
    """Of the cost: gx (D+1, 12) = Q dx + qx, gw (D, 6) = R dw + r."""
    for k in range(len(dx)):
        for n in range(12):
            gx[k, n] = qx[k, n]
        for i in range(3):
            for j in range(3):
                gx[k, i] += q_pos[k, i, j] * dx[k, j]
                gx[k, 6 + i] += q_att[k, i, j] * dx[k, 6 + j]
    for k in range(len(dw)):
        for i in range(6):
            gw[k, i] = r[k, i] + r_diag[k, i] * dw[k, i]


@part
def _along(dx, stage, row_a, j):
    """a' dp of row j."""
    k = stage[j]
    return row_a[j, 0] * dx[k, 0] + row_a[j, 1] * dx[k, 1] + row_a[j, 2] * dx[k, 2]


@part
def _push(gx, stage, row_a, j, force):
    """Adds ``force`` along row j's normal to the gradient gx."""
    for i in range(3):
        gx[stage[j], i] += force * row_a[j, i]


@part
def _is_free(dx, w, stage, row_a, row_c, n_rows):
    for i in range(len(w)):
        if not abs(w[i]) <= 1.0 + FREE_TOLERANCE:
            return False
    for j in range(n_rows):  # noqa: SIM110 (Numba knows no generators)
        if not _along(dx, stage, row_a, j) - row_c[j] >= -FREE_TOLERANCE:
            return False
    return True


@part
def _curvature(val, mul, n_rows, j, w2):
    """Of the price of row j in z, d, and in s, e, with z's slope eliminated."""
    return mul[j] / val[j], w2 + mul[n_rows + j] / val[n_rows + j]


def _make_kernel(source: str):
    """The compiled QP. ``source``, a digest of the module it calls into, is held in the closure because
    Numba's cache key covers closures but not the functions that are called: without it, an edit in
    `riccati` would go on using the old machine code.
    """

    @kernel
    def solve_qp(
        mats, h, q_pos, q_att, qx, r_diag, r, w_bar, stage, row_a, row_c, n_rows, w1, w2, max_iterations,
        dx, dw, mul,
    ):  # fmt: skip
        """Solves the QP about scaled inputs ``w_bar`` (D, 6); writes dx (D+1, 12), dw (D, 6).

        Arrays: mats (D, 12, 12) = [C B]; q_pos, q_att (D+1, 3, 3); qx (D+1, 12); r_diag, r (D, 6); rows: stage (M,),
        row_a (M, 3), row_c (M,), of which the first n_rows count. |w_bar + dw| <= 1 always holds, but for FREE, where it
        does within FREE_TOLERANCE. mul (2 M + 12 D,) gets the multipliers as in the module's docstring.
        Returns (code, iterations, scaled stationarity residual, complementarity). With CONVERGED and LIMIT the point
        lies strictly within the box; with LIMIT it is the best reached in ``max_iterations``.
        """
        assert len(source) > 0
        stages = len(w_bar)
        bottom = 2 * n_rows
        top = bottom + 6 * stages
        count = top + 6 * stages
        gain = np.empty((stages, 6, 12))
        chol = np.empty((stages, 6, 6))
        w = np.empty(6 * stages)
        flat_w, flat_dw = w_bar.reshape(-1), dw.reshape(-1)
        if not factor(mats, h, q_pos, q_att, r_diag, gain, chol):
            return BROKEN, 0, np.inf, np.inf
        solve(mats, h, gain, chol, qx, r, dx, dw)
        for i in range(len(w)):
            w[i] = flat_w[i] + flat_dw[i]
        if _is_free(dx, w, stage, row_a, row_c, n_rows):
            for j in range(count):
                mul[j] = 0.0
            return FREE, 0, 0.0, 0.0

        gx = np.empty((stages + 1, 12))
        grad_x = np.empty((stages + 1, 12))
        step_x = np.empty((stages + 1, 12))
        gw = np.empty((stages, 6))
        grad_w = np.empty((stages, 6))
        step_w = np.empty((stages, 6))
        r_eff = np.empty((stages, 6))
        q_eff = np.empty((stages + 1, 3, 3))
        flat_gw, flat_grad = gw.reshape(-1), grad_w.reshape(-1)
        flat_step, flat_r = step_w.reshape(-1), r_eff.reshape(-1)
        flat_diag = r_diag.reshape(-1)
        val = np.empty(count)
        d_val = np.zeros(count)
        d_mul = np.zeros(count)
        res = np.empty(count)

        # Start: the free solution, kept a little inside the box, with centred slacks and multipliers.
        for i in range(len(w)):
            w[i] = min(max(w[i], -0.9), 0.9)
            flat_dw[i] = w[i] - flat_w[i]
            val[bottom + i] = 1.0 + w[i]
            val[top + i] = 1.0 - w[i]
        advance(mats, h, dx, dw)
        gradients(dx, dw, q_pos, q_att, qx, r_diag, r, gx, gw)
        scale = max(1.0, reduced_gradient(mats, h, gx, gw, grad_w))
        # Rows missed at the start pull with their full price; a complementarity much below that pull starts the
        # search next to the boundary, where steps are short (27 to 40 iterations instead of 12).
        for j in range(n_rows):
            if _along(dx, stage, row_a, j) < row_c[j]:
                _push(gx, stage, row_a, j, -w1)
        pull = max(scale, reduced_gradient(mats, h, gx, gw, grad_w))
        mu = min(max(MU_START * pull, MU_START), MU_START_MAX)
        for j in range(n_rows):
            g = _along(dx, stage, row_a, j) - row_c[j]
            price = w1 + w2 * max(-g, 0.0)
            s = (2.0 * mu + (np.sqrt(price * price * g * g + 4.0 * mu * mu) - price * g)) / (2.0 * price)
            val[j], val[n_rows + j] = g + s, s
            mul[j] = mu / val[j]
            mul[n_rows + j] = w1 + w2 * s - mul[j]
        for j in range(bottom, count):
            mul[j] = mu / val[j]

        iteration = 0
        while True:
            # complementarity and stationarity of the present point
            gradients(dx, dw, q_pos, q_att, qx, r_diag, r, gx, gw)
            mu = 0.0
            for j in range(count):
                res[j] = val[j] * mul[j]
                mu += res[j] / count
            for j in range(n_rows):
                _push(gx, stage, row_a, j, -mul[j])
            for i in range(len(w)):
                flat_gw[i] += mul[top + i] - mul[bottom + i]
            residual = reduced_gradient(mats, h, gx, gw, grad_w) / scale
            if not (np.isfinite(mu) and np.isfinite(residual)):
                return BROKEN, iteration, residual, mu
            if mu <= MU_STOP and residual <= GRADIENT_STOP:
                return CONVERGED, iteration, residual, mu
            if iteration >= max_iterations:
                return LIMIT, iteration, residual, mu
            iteration += 1

            # matrices of the Newton system
            for k in range(stages + 1):
                for i in range(3):
                    for j in range(3):
                        q_eff[k, i, j] = q_pos[k, i, j]
            for j in range(n_rows):
                d, e = _curvature(val, mul, n_rows, j, w2)
                f = d * e / (d + e)
                for m in range(3):
                    for n in range(3):
                        q_eff[stage[j], m, n] += f * row_a[j, m] * row_a[j, n]
            for i in range(len(w)):
                flat_r[i] = flat_diag[i] + mul[bottom + i] / val[bottom + i] + mul[top + i] / val[top + i]
            if not factor(mats, h, q_eff, q_att, r_eff, gain, chol):
                return BROKEN, iteration, residual, mu

            alpha = 1.0
            for corrector in range(2):
                for k in range(stages + 1):
                    for n in range(12):
                        grad_x[k, n] = gx[k, n]
                for j in range(n_rows):
                    d, e = _curvature(val, mul, n_rows, j, w2)
                    rz, rs = res[j] / val[j], res[n_rows + j] / val[n_rows + j]
                    _push(grad_x, stage, row_a, j, rz - d * (rs + rz) / (d + e))
                for i in range(len(w)):
                    low, high = res[bottom + i] / val[bottom + i], res[top + i] / val[top + i]
                    flat_grad[i] = flat_gw[i] + low - high
                solve(mats, h, gain, chol, grad_x, grad_w, step_x, step_w)
                for j in range(n_rows):
                    d, e = _curvature(val, mul, n_rows, j, w2)
                    rz, rs = res[j] / val[j], res[n_rows + j] / val[n_rows + j]
                    dg = _along(step_x, stage, row_a, j)
                    d_val[n_rows + j] = -(rs + rz + d * dg) / (d + e)
                    d_val[j] = dg + d_val[n_rows + j]
                for i in range(len(w)):
                    d_val[bottom + i] = flat_step[i]
                    d_val[top + i] = -flat_step[i]
                limit = 1e300
                for j in range(count):
                    d_mul[j] = -(res[j] + mul[j] * d_val[j]) / val[j]
                    if d_val[j] < 0.0:
                        limit = min(limit, -val[j] / d_val[j])
                    if d_mul[j] < 0.0:
                        limit = min(limit, -mul[j] / d_mul[j])
                if corrector == 0:
                    alpha = min(1.0, limit)
                    after = 0.0
                    for j in range(count):
                        after += (val[j] + alpha * d_val[j]) * (mul[j] + alpha * d_mul[j]) / count
                    # Never far below the stopping point: smaller gains nothing and spoils the conditioning.
                    centre = max(after**3 / mu**2, 0.1 * MU_STOP)
                    for j in range(count):
                        res[j] += d_val[j] * d_mul[j] - centre
                else:
                    alpha = min(1.0, STEP_TO_BOUNDARY * limit)

            for j in range(count):
                val[j] += alpha * d_val[j]
                mul[j] += alpha * d_mul[j]
            for k in range(stages + 1):
                for n in range(12):
                    dx[k, n] += alpha * step_x[k, n]
            for i in range(len(w)):
                flat_dw[i] += alpha * flat_step[i]

    return solve_qp


solve_qp = _make_kernel(hashlib.sha256(Path(str(riccati.__file__)).read_bytes()).hexdigest())
