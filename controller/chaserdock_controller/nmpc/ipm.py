"""Mehrotra's predictor-corrector interior point for one chaser's QP, on top of the Riccati sweeps.

The box on the scaled inputs, -1 <= w <= 1, is hard. A row a' dp_k >= c (a unit normal, dp_k the change
of position at stage k) is soft: with a slack s >= 0, priced w1 s + w2/2 s^2, and z = a' dp - c + s >= 0,
multipliers lam (of z) and pi (of s). Slack and multipliers are eliminated row by row, so a row only adds
a rank-one term to the position block of Q_k and the sparsity of the Riccati sweep stays.
Method: S. Mehrotra, SIAM J. Optim. 2 (1992); Nocedal and Wright, "Numerical Optimization", sec. 16.6.
"""

from __future__ import annotations

import numpy as np
from numba import njit

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


@njit(error_model="numpy")
def state_gradient(dx, q_pos, q_att, qx, out):
    """out (D+1, 12) = Q dx + qx."""
    for k in range(len(dx)):
        for n in range(12):
            out[k, n] = qx[k, n]
        for i in range(3):
            for j in range(3):
                out[k, i] += q_pos[k, i, j] * dx[k, j]
                out[k, 6 + i] += q_att[k, i, j] * dx[k, 6 + j]


@njit(error_model="numpy")
def _is_free(dx, dw, w_bar, row_a, row_c, n_rows):
    for k in range(len(dw)):
        for i in range(6):
            if not abs(w_bar[k, i] + dw[k, i]) <= 1.0 + FREE_TOLERANCE:
                return False
    for k in range(1, len(dx)):
        for m in range(n_rows[k]):
            a = row_a[k, m]
            if not a[0] * dx[k, 0] + a[1] * dx[k, 1] + a[2] * dx[k, 2] - row_c[k, m] >= -FREE_TOLERANCE:
                return False
    return True


@njit(error_model="numpy")
def solve_qp(c_mats, b_mats, h, q_pos, q_att, qx, r_diag, r, w_bar, row_a, row_c, n_rows, w1, w2, dx, dw):
    """Solves the QP about scaled inputs ``w_bar`` (D, 6); writes dx (D+1, 12), dw (D, 6).

    Arrays: c_mats, b_mats (D, 12, 6); q_pos, q_att (D+1, 3, 3); qx (D+1, 12); r_diag, r (D, 6); row_a (D+1, M, 3),
    row_c (D+1, M), of which stage k uses the first n_rows[k] (stage 0 none). |w_bar + dw| <= 1 always holds.
    Returns (code, iterations, scaled stationarity residual, complementarity, multipliers (D+1, M) of the
    rows, multipliers (D, 6, 2) of the box).
    """
    stages = len(w_bar)
    width = row_c.shape[1]
    gain = np.empty((stages, 6, 12))
    chol = np.empty((stages, 6, 6))
    lam = np.zeros((stages + 1, width))
    box = np.zeros((stages, 6, 2))
    if not factor(c_mats, b_mats, h, q_pos, q_att, r_diag, gain, chol):
        return BROKEN, 0, np.inf, np.inf, lam, box
    solve(c_mats, b_mats, h, gain, chol, qx, r, dx, dw)
    if _is_free(dx, dw, w_bar, row_a, row_c, n_rows):
        return FREE, 0, 0.0, 0.0, lam, box

    gx = np.empty((stages + 1, 12))
    gw = np.empty((stages, 6))
    grad_x = np.empty((stages + 1, 12))
    grad_w = np.empty((stages, 6))
    q_eff = np.empty((stages + 1, 3, 3))
    r_eff = np.empty((stages, 6))
    step_x = np.empty((stages + 1, 12))
    step_w = np.empty((stages, 6))
    z = np.ones((stages + 1, width))
    s = np.ones((stages + 1, width))
    pi = np.zeros((stages + 1, width))
    dz = np.zeros((stages + 1, width))
    ds = np.zeros((stages + 1, width))
    dlam = np.zeros((stages + 1, width))
    dpi = np.zeros((stages + 1, width))
    dbox = np.zeros((stages, 6, 2))
    dw_aff = np.zeros((stages, 6))

    # Start: the free solution, kept a little inside the box, with centred slacks and multipliers.
    dx[0, :] = 0.0
    for k in range(stages):
        for i in range(6):
            target = min(max(w_bar[k, i] + dw[k, i], -0.9), 0.9)
            dw[k, i] = target - w_bar[k, i]
        advance(c_mats[k], b_mats[k], h, dx[k], dw[k], dx[k + 1])
    state_gradient(dx, q_pos, q_att, qx, gx)
    for k in range(stages):
        for i in range(6):
            gw[k, i] = r[k, i] + r_diag[k, i] * dw[k, i]
    reduced_gradient(c_mats, b_mats, h, gx, gw, grad_w)
    scale = 1.0
    for k in range(stages):
        for i in range(6):
            scale = max(scale, abs(grad_w[k, i]))
    # Rows missed at the start pull with their full price; a complementarity much below that pull starts the
    # search next to the boundary, where steps are short (27 to 40 iterations instead of 12).
    for k in range(1, stages + 1):
        for m in range(n_rows[k]):
            a = row_a[k, m]
            if a[0] * dx[k, 0] + a[1] * dx[k, 1] + a[2] * dx[k, 2] < row_c[k, m]:
                for i in range(3):
                    gx[k, i] -= w1 * a[i]
    reduced_gradient(c_mats, b_mats, h, gx, gw, grad_w)
    pull = scale
    for k in range(stages):
        for i in range(6):
            pull = max(pull, abs(grad_w[k, i]))
    mu = min(max(MU_START * pull, MU_START), MU_START_MAX)
    count = 12 * stages
    for k in range(1, stages + 1):
        for m in range(n_rows[k]):
            a = row_a[k, m]
            g = a[0] * dx[k, 0] + a[1] * dx[k, 1] + a[2] * dx[k, 2] - row_c[k, m]
            price = w1 + w2 * max(-g, 0.0)
            s[k, m] = (2.0 * mu + (np.sqrt(price * price * g * g + 4.0 * mu * mu) - price * g)) / (
                2.0 * price
            )
            z[k, m] = g + s[k, m]
            lam[k, m] = mu / z[k, m]
            pi[k, m] = w1 + w2 * s[k, m] - lam[k, m]
            count += 2
    for k in range(stages):
        for i in range(6):
            w = w_bar[k, i] + dw[k, i]
            box[k, i, 0] = mu / (1.0 + w)
            box[k, i, 1] = mu / (1.0 - w)

    residual = np.inf
    for iteration in range(MAX_ITERATIONS + 1):
        # complementarity and stationarity of the present point
        state_gradient(dx, q_pos, q_att, qx, gx)
        mu = 0.0
        for k in range(1, stages + 1):
            for m in range(n_rows[k]):
                mu += z[k, m] * lam[k, m] + s[k, m] * pi[k, m]
                for i in range(3):
                    gx[k, i] -= lam[k, m] * row_a[k, m, i]
        for k in range(stages):
            for i in range(6):
                w = w_bar[k, i] + dw[k, i]
                mu += box[k, i, 0] * (1.0 + w) + box[k, i, 1] * (1.0 - w)
                gw[k, i] = r[k, i] + r_diag[k, i] * dw[k, i] - box[k, i, 0] + box[k, i, 1]
        mu /= count
        reduced_gradient(c_mats, b_mats, h, gx, gw, grad_w)
        residual = 0.0
        for k in range(stages):
            for i in range(6):
                residual = max(residual, abs(grad_w[k, i]) / scale)
        if not (np.isfinite(mu) and np.isfinite(residual)):
            return BROKEN, iteration, residual, mu, lam, box
        if mu <= MU_STOP and residual <= GRADIENT_STOP:
            return CONVERGED, iteration, residual, mu, lam, box
        if iteration == MAX_ITERATIONS:
            break

        # matrices of the Newton system
        for k in range(stages + 1):
            for i in range(3):
                for j in range(3):
                    q_eff[k, i, j] = q_pos[k, i, j]
            if k > 0:
                for m in range(n_rows[k]):
                    a = row_a[k, m]
                    d = lam[k, m] / z[k, m]
                    e = w2 + pi[k, m] / s[k, m]
                    f = d * e / (d + e)
                    for i in range(3):
                        for j in range(3):
                            q_eff[k, i, j] += f * a[i] * a[j]
        for k in range(stages):
            for i in range(6):
                w = w_bar[k, i] + dw[k, i]
                r_eff[k, i] = r_diag[k, i] + box[k, i, 0] / (1.0 + w) + box[k, i, 1] / (1.0 - w)
        if not factor(c_mats, b_mats, h, q_eff, q_att, r_eff, gain, chol):
            return BROKEN, iteration, residual, mu, lam, box

        centre = 0.0
        alpha = 1.0
        for corrector in range(2):
            for k in range(stages + 1):
                for n in range(12):
                    grad_x[k, n] = gx[k, n]
                if k > 0:
                    for m in range(n_rows[k]):
                        d = lam[k, m] / z[k, m]
                        e = w2 + pi[k, m] / s[k, m]
                        rz = lam[k, m] * z[k, m] - centre
                        rp = pi[k, m] * s[k, m] - centre
                        if corrector == 1:
                            rz += dlam[k, m] * dz[k, m]
                            rp += dpi[k, m] * ds[k, m]
                        f = -rz / z[k, m] + d * (rp / s[k, m] + rz / z[k, m]) / (d + e)
                        # kept for the back-substitution below
                        dz[k, m] = rz
                        dpi[k, m] = rp
                        for i in range(3):
                            grad_x[k, i] -= f * row_a[k, m, i]
            for k in range(stages):
                for i in range(6):
                    w = w_bar[k, i] + dw[k, i]
                    r0 = box[k, i, 0] * (1.0 + w) - centre
                    r1 = box[k, i, 1] * (1.0 - w) - centre
                    if corrector == 1:
                        r0 += dbox[k, i, 0] * dw_aff[k, i]
                        r1 -= dbox[k, i, 1] * dw_aff[k, i]
                    grad_w[k, i] = gw[k, i] + r0 / (1.0 + w) - r1 / (1.0 - w)
                    dbox[k, i, 0] = r0
                    dbox[k, i, 1] = r1
            solve(c_mats, b_mats, h, gain, chol, grad_x, grad_w, step_x, step_w)

            limit = 1e300
            for k in range(1, stages + 1):
                for m in range(n_rows[k]):
                    a = row_a[k, m]
                    dg = a[0] * step_x[k, 0] + a[1] * step_x[k, 1] + a[2] * step_x[k, 2]
                    d = lam[k, m] / z[k, m]
                    e = w2 + pi[k, m] / s[k, m]
                    rz, rp = dz[k, m], dpi[k, m]
                    ds[k, m] = -(rp / s[k, m] + rz / z[k, m] + d * dg) / (d + e)
                    dz[k, m] = dg + ds[k, m]
                    dlam[k, m] = -(rz + lam[k, m] * dz[k, m]) / z[k, m]
                    dpi[k, m] = -(rp + pi[k, m] * ds[k, m]) / s[k, m]
                    if dz[k, m] < 0.0:
                        limit = min(limit, -z[k, m] / dz[k, m])
                    if ds[k, m] < 0.0:
                        limit = min(limit, -s[k, m] / ds[k, m])
                    if dlam[k, m] < 0.0:
                        limit = min(limit, -lam[k, m] / dlam[k, m])
                    if dpi[k, m] < 0.0:
                        limit = min(limit, -pi[k, m] / dpi[k, m])
            for k in range(stages):
                for i in range(6):
                    w = w_bar[k, i] + dw[k, i]
                    t = step_w[k, i]
                    b0 = -(dbox[k, i, 0] + box[k, i, 0] * t) / (1.0 + w)
                    b1 = -(dbox[k, i, 1] - box[k, i, 1] * t) / (1.0 - w)
                    dbox[k, i, 0] = b0
                    dbox[k, i, 1] = b1
                    dw_aff[k, i] = t
                    if t < 0.0:
                        limit = min(limit, -(1.0 + w) / t)
                    elif t > 0.0:
                        limit = min(limit, (1.0 - w) / t)
                    if b0 < 0.0:
                        limit = min(limit, -box[k, i, 0] / b0)
                    if b1 < 0.0:
                        limit = min(limit, -box[k, i, 1] / b1)
            if corrector == 0:
                alpha = min(1.0, limit)
                after = 0.0
                for k in range(1, stages + 1):
                    for m in range(n_rows[k]):
                        after += (z[k, m] + alpha * dz[k, m]) * (lam[k, m] + alpha * dlam[k, m])
                        after += (s[k, m] + alpha * ds[k, m]) * (pi[k, m] + alpha * dpi[k, m])
                for k in range(stages):
                    for i in range(6):
                        w = w_bar[k, i] + dw[k, i]
                        t = alpha * step_w[k, i]
                        after += (1.0 + w + t) * (box[k, i, 0] + alpha * dbox[k, i, 0])
                        after += (1.0 - w - t) * (box[k, i, 1] + alpha * dbox[k, i, 1])
                sigma = (after / count / mu) ** 3
                # Never far below the stopping point: smaller gains nothing and spoils the conditioning.
                centre = max(sigma * mu, 0.1 * MU_STOP)
            else:
                alpha = min(1.0, STEP_TO_BOUNDARY * limit)

        for k in range(stages + 1):
            for n in range(12):
                dx[k, n] += alpha * step_x[k, n]
            if k > 0:
                for m in range(n_rows[k]):
                    z[k, m] += alpha * dz[k, m]
                    s[k, m] += alpha * ds[k, m]
                    lam[k, m] += alpha * dlam[k, m]
                    pi[k, m] += alpha * dpi[k, m]
        for k in range(stages):
            for i in range(6):
                dw[k, i] += alpha * step_w[k, i]
                box[k, i, 0] += alpha * dbox[k, i, 0]
                box[k, i, 1] += alpha * dbox[k, i, 1]
    return LIMIT, MAX_ITERATIONS, residual, mu, lam, box
