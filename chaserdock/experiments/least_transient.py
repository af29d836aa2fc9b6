# SPDX-License-Identifier: Apache-2.0
"""Lower bound of the transient tracking error for any controller: the optimum under the actuators'
limits.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.rotations import rotate

# Three-point Gauss quadrature is exact for the fourth-degree square of a parabola.
_GAUSS = ((0.5 - np.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + np.sqrt(0.15), 5 / 18))


def least_square_integral(
    position_m: Array,
    velocity_m_s: Array,
    references_m: Array,
    q_wxyz: Array,
    step_s: float,
    acceleration_max_m_s2: float,
) -> float:
    """Return the least integral of |p - p_ref|^2 over the references' time, m^2 s.

    A point mass starts at ``position_m`` with ``velocity_m_s`` (3,), WRF. ``references_m`` (3 K +
    1, 3), WRF: p_ref at the three Gauss points of each of K steps of ``step_s``, then at the end.
    The acceleration is constant in each step and bounded by ``acceleration_max_m_s2`` along each
    body axis; ``q_wxyz`` (K, 4): body to world. This is a convex quadratic program, solved with
    ipopt. Raises ValueError for shapes that do not match, RuntimeError if it is not solved.
    """
    steps = len(q_wxyz)
    if references_m.shape != (3 * steps + 1, 3):
        raise ValueError(
            f"references_m must have shape {(3 * steps + 1, 3)}, not {references_m.shape}"
        )

    p, v = ca.MX.sym("p", 3, steps + 1), ca.MX.sym("v", 3, steps + 1)
    u = ca.MX.sym("u", 3, steps)  # in body axes
    axes = [np.array(rotate(q_wxyz, np.tile(e, (steps, 1)))).T for e in np.eye(3)]
    a = sum((axes[i] * ca.repmat(u[i, :], 3, 1) for i in range(3)), ca.MX.zeros(3, steps))

    # The integral by Gauss quadrature over each step.
    total: ca.MX | int = 0
    for k, (at, weight) in enumerate(_GAUSS):
        t = at * step_s
        position = p[:, :-1] + t * v[:, :-1] + t * t / 2 * a
        total += weight * step_s * ca.sumsqr(position - references_m[k:-1:3].T)

    # Exact motion of a point mass under constant acceleration, and the initial state.
    motion = ca.horzcat(
        p[:, 1:] - p[:, :-1] - step_s * v[:, :-1] - step_s**2 / 2 * a,
        v[:, 1:] - v[:, :-1] - step_s * a,
        p[:, 0] - position_m,
        v[:, 0] - velocity_m_s,
    )

    variables = ca.vertcat(ca.vec(p), ca.vec(v), ca.vec(u))
    options = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_constant": "yes",
    }
    solver = ca.nlpsol("floor", "ipopt", {"x": variables, "f": total, "g": ca.vec(motion)}, options)

    bound = np.full(variables.shape[0], np.inf)
    bound[-3 * steps :] = acceleration_max_m_s2
    solution = solver(lbx=-bound, ubx=bound, lbg=0, ubg=0)
    if not solver.stats()["success"]:
        raise RuntimeError(
            f"the quadratic program was not solved: {solver.stats()['return_status']}"
        )
    return float(solution["f"])


def gauss_times(steps: int, step_s: float) -> Array:
    """Return the times (3 K + 1,) of the references of ``least_square_integral``."""
    inside = (np.arange(steps)[:, None] + np.array([at for at, _ in _GAUSS])) * step_s
    return np.append(inside.ravel(), steps * step_s)
