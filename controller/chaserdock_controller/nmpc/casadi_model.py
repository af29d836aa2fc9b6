# SPDX-License-Identifier: Apache-2.0
"""Dynamics of a chaser in CasADi, following the paper (section 4).

State x = [p (3, WRF), v (3, WRF), q_wxyz (4, body to world), omega (3, body)], input u = [F (3),
tau (3)] in body axes. native/dynamics.c has the same dynamics in C, which the tests compare.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from .casadi_vectors import multiply, rotate
from .problem import NmpcParameters
from .types import INTEGRATORS


def derivative(x: Any, u: Any, params: NmpcParameters) -> Any:
    """Return x' (13) from the Newton-Euler equations (paper, eq. 1 and 2, with q' in the
    body-to-world convention).
    """
    inertia = ca.DM(np.array(params.inertia_kg_m2))
    v, q, omega = x[3:6], x[6:10], x[10:13]
    force, torque = u[0:3], u[3:6]
    return ca.vertcat(
        v,
        rotate(q, force) / params.mass_kg,
        0.5 * multiply(q, ca.vertcat(0, omega)),
        ca.inv(inertia) @ (torque - ca.cross(omega, inertia @ omega)),
    )


def dynamics(params: NmpcParameters, integrator: str | None = None) -> ca.Function:
    """Return the discrete dynamics (x (13), u (6)) -> x_next (13) over ``params.dt_s``, the input
    held.

    ``integrator``: "euler" (the paper's) or "rk4"; ``params.integrator`` if None. The quaternion is
    normalized after the step. Raises ValueError for another integrator.
    """
    integrator = params.integrator if integrator is None else integrator
    if integrator not in INTEGRATORS:
        raise ValueError(f"integrator must be one of {', '.join(INTEGRATORS)}, not {integrator!r}")
    x, u, h = ca.SX.sym("x", 13), ca.SX.sym("u", 6), params.dt_s
    k1 = derivative(x, u, params)
    if integrator == "euler":
        x_next = x + h * k1
    else:
        k2 = derivative(x + h / 2 * k1, u, params)
        k3 = derivative(x + h / 2 * k2, u, params)
        k4 = derivative(x + h * k3, u, params)
        x_next = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    q = x_next[6:10]
    x_next = ca.vertcat(x_next[0:6], q / ca.norm_2(q), x_next[10:13])
    return ca.Function("step", [x, u], [x_next], ["x", "u"], ["x_next"])
