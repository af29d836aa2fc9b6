"""The cost of eq. 3 for Numba: its quadratic model about a rollout, and its value along a plan."""

from __future__ import annotations

import numpy as np
from numba import njit

# An attitude error beyond this angle is treated as one of this angle about the same axis: the gradient of
# sin^2(angle / 2) vanishes at 180 degrees, where nothing would move.
BREAK_ANGLE_RAD = np.deg2rad(150.0)
_ETA_MIN = float(np.cos(BREAK_ANGLE_RAD / 2.0))
_EPS_MAX = float(np.sin(BREAK_ANGLE_RAD / 2.0))


@njit(cache=True, error_model="numpy")
def attitude_cost(q, q_ref, weight, gradient, hessian):
    """Quadratic model in dtheta of weight |vec(q (x) q_ref*)|^2 at ``q``.

    With q_ref* (x) q = (eta, eps): gradient weight eta eps (3,), hessian weight/2 (I - eps eps') (3, 3).
    """
    eta = q_ref[0] * q[0] + q_ref[1] * q[1] + q_ref[2] * q[2] + q_ref[3] * q[3]
    e0 = q_ref[0] * q[1] - q_ref[1] * q[0] - (q_ref[2] * q[3] - q_ref[3] * q[2])
    e1 = q_ref[0] * q[2] - q_ref[2] * q[0] - (q_ref[3] * q[1] - q_ref[1] * q[3])
    e2 = q_ref[0] * q[3] - q_ref[3] * q[0] - (q_ref[1] * q[2] - q_ref[2] * q[1])
    square = e0 * e0 + e1 * e1 + e2 * e2
    if abs(eta) < _ETA_MIN:
        eta = _ETA_MIN if eta >= 0.0 else -_ETA_MIN
        f = _EPS_MAX / np.sqrt(square)
        e0, e1, e2 = f * e0, f * e1, f * e2
    gradient[0], gradient[1], gradient[2] = weight * eta * e0, weight * eta * e1, weight * eta * e2
    half = 0.5 * weight
    hessian[0, 0], hessian[1, 1], hessian[2, 2] = (
        half * (1.0 - e0 * e0),
        half * (1.0 - e1 * e1),
        half * (1.0 - e2 * e2),
    )
    hessian[0, 1] = hessian[1, 0] = -half * e0 * e1
    hessian[0, 2] = hessian[2, 0] = -half * e0 * e2
    hessian[1, 2] = hessian[2, 1] = -half * e1 * e2


@njit(cache=True, error_model="numpy")
def quadratic_model(
    x, u, refs, u_ref, limits, weights_p, weights_q, weights_u, q_pos, q_att, qx, r_diag, r, w_bar
):
    """Cost of one chaser about x (D+1, 13), u (D, 6), in dp, dtheta and scaled inputs w = u / limits.

    Writes q_pos and q_att (D+1, 3, 3), qx (D+1, 12), r_diag, r and w_bar (D, 6).
    """
    q_pos[:] = 0.0
    qx[:] = 0.0
    for k in range(len(x)):
        for c in range(3):
            q_pos[k, c, c] = 2.0 * weights_p[k]
            qx[k, c] = 2.0 * weights_p[k] * (x[k, c] - refs[k, c])
        attitude_cost(x[k, 6:10], refs[k, 3:7], weights_q[k], qx[k, 6:9], q_att[k])
    for k in range(len(u)):
        for c in range(6):
            top = limits[c]
            if top > 0.0:
                w_bar[k, c] = u[k, c] / top
                r_diag[k, c] = 2.0 * weights_u[c] * top * top
                r[k, c] = 2.0 * weights_u[c] * top * (u[k, c] - u_ref[k, c])
            else:  # an axis without authority: its column of B is zero, it stays at zero
                w_bar[k, c], r_diag[k, c], r[k, c] = 0.0, 1.0, 0.0


@njit(cache=True, error_model="numpy")
def plan_cost(x, u, refs, u_ref, weights_p, weights_q, weights_u, cost):
    """Writes eq. 3 for every chaser: cost (N,) of x (N, D+1, 13), u (N, D, 6)."""
    for i in range(len(x)):
        total = 0.0
        for k in range(x.shape[1]):
            for c in range(3):
                total += weights_p[k] * (refs[i, k, c] - x[i, k, c]) ** 2
            e1 = refs[i, k, 3] * x[i, k, 7] - refs[i, k, 4] * x[i, k, 6]
            e2 = refs[i, k, 3] * x[i, k, 8] - refs[i, k, 5] * x[i, k, 6]
            e3 = refs[i, k, 3] * x[i, k, 9] - refs[i, k, 6] * x[i, k, 6]
            e1 -= refs[i, k, 5] * x[i, k, 9] - refs[i, k, 6] * x[i, k, 8]
            e2 -= refs[i, k, 6] * x[i, k, 7] - refs[i, k, 4] * x[i, k, 9]
            e3 -= refs[i, k, 4] * x[i, k, 8] - refs[i, k, 5] * x[i, k, 7]
            total += weights_q[k] * (e1 * e1 + e2 * e2 + e3 * e3)
        for k in range(u.shape[1]):
            for c in range(6):
                total += weights_u[c] * (u_ref[i, k, c] - u[i, k, c]) ** 2
        cost[i] = total
