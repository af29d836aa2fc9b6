"""The cost of eq. 3 for Numba: its quadratic model about a rollout, and its value along a plan."""

from __future__ import annotations

import numpy as np

from chaserdock_controller.nmpc.compiled import kernel, part

# An attitude error beyond this angle is treated as one of this angle about the same axis: the gradient of
# sin^2(angle / 2) vanishes at 180 degrees, where nothing would move.
BREAK_ANGLE_RAD = np.deg2rad(150.0)
_ETA_MIN = float(np.cos(BREAK_ANGLE_RAD / 2.0))
_EPS_MAX = float(np.sin(BREAK_ANGLE_RAD / 2.0))


@part
def _attitude_error(q, q_ref, e):
    """e (4) = q_ref* (x) q."""
    e[0] = q_ref[0] * q[0]
    for i in range(3):
        a, b = (i + 1) % 3 + 1, (i + 2) % 3 + 1
        e[0] += q_ref[1 + i] * q[1 + i]
        e[1 + i] = q_ref[0] * q[1 + i] - q_ref[1 + i] * q[0] - (q_ref[a] * q[b] - q_ref[b] * q[a])


@part
def _attitude_cost(q, q_ref, weight, e, gradient, hessian):
    """Quadratic model in dtheta of weight |vec(q (x) q_ref*)|^2 at ``q``.

    With q_ref* (x) q = (eta, eps): gradient weight eta eps (3,), hessian weight/2 (I - eps eps') (3, 3).
    """
    _attitude_error(q, q_ref, e)
    eta, f = e[0], 1.0
    if abs(eta) < _ETA_MIN:
        eta = _ETA_MIN if eta >= 0.0 else -_ETA_MIN
        f = _EPS_MAX / np.sqrt(e[1] * e[1] + e[2] * e[2] + e[3] * e[3])
    for i in range(1, 4):
        e[i] *= f
    for i in range(3):
        gradient[i] = weight * eta * e[1 + i]
        for j in range(3):
            hessian[i, j] = -0.5 * weight * e[1 + i] * e[1 + j]
        hessian[i, i] += 0.5 * weight


@kernel
def quadratic_model(
    x, u, refs, u_ref, limits, weights_p, weights_q, weights_u, q_pos, q_att, qx, r_diag, r, w_bar
):
    """Cost of one chaser about x (D+1, 13), u (D, 6), in dp, dtheta and scaled inputs w = u / limits.

    Writes q_pos and q_att (D+1, 3, 3), qx (D+1, 12), r_diag, r and w_bar (D, 6).
    """
    e = np.empty(4)
    for k in range(len(x)):
        for c in range(12):
            qx[k, c] = 0.0
        for c in range(3):
            for j in range(3):
                q_pos[k, c, j] = 0.0
            q_pos[k, c, c] = 2.0 * weights_p[k]
            qx[k, c] = 2.0 * weights_p[k] * (x[k, c] - refs[k, c])
        _attitude_cost(x[k, 6:10], refs[k, 3:7], weights_q[k], e, qx[k, 6:9], q_att[k])
    for k in range(len(u)):
        for c in range(6):
            top = limits[c]
            # an axis without authority: its column of B is zero, it stays at zero
            w_bar[k, c], r_diag[k, c], r[k, c] = 0.0, 1.0, 0.0
            if top > 0.0:
                w_bar[k, c] = u[k, c] / top
                r_diag[k, c] = 2.0 * weights_u[c] * top * top
                r[k, c] = 2.0 * weights_u[c] * top * (u[k, c] - u_ref[k, c])


@kernel
def plan_cost(x, u, refs, u_ref, weights_p, weights_q, weights_u, cost):
    """Writes eq. 3 for every chaser: cost (N,) of x (N, D+1, 13), u (N, D, 6)."""
    e = np.empty(4)
    for i in range(len(x)):
        total = 0.0
        for k in range(x.shape[1]):
            # |vec(q (x) q_ref*)| = |vec(q_ref* (x) q)|: the one is the other, turned
            _attitude_error(x[i, k, 6:10], refs[i, k, 3:7], e)
            for c in range(3):
                total += weights_p[k] * (refs[i, k, c] - x[i, k, c]) ** 2 + weights_q[k] * e[1 + c] ** 2
        for k in range(u.shape[1]):
            for c in range(6):
                total += weights_u[c] * (u_ref[i, k, c] - u[i, k, c]) ** 2
        cost[i] = total
