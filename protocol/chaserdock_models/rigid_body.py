# SPDX-License-Identifier: Apache-2.0
"""Rigid-body motion: the Newton-Euler equations and their integration by the classical Runge-Kutta
method (RK4).

Three functions cover the uses in simulator and flight software; all have the same equations.
``propagate`` integrates one body under a constant wrench. ``free_rotation`` tabulates the rotation
of a free body at many times, several hundred steps a tick, so a C kernel does it
(native/rigid_body.c). ``rk4_step`` is the method itself, for states with further components (the
estimator adds the transition matrix). The NMPC has its own discretization with derivatives by state
and input (chaserdock_controller/nmpc/native/dynamics.c), as its solver needs both in one pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from ctypes import c_double, c_int64
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array, Vector3
from .native import address, function
from .rotations import normalize

MAX_STEP_S = 0.02
"""Longest integration step of ``propagate``, s. Larger: faster; smaller: a smaller error of the
attitude, which grows with its fourth power.
"""


@dataclass(frozen=True)
class BodyState:
    """Position (3,) and velocity (3,) in WRF, attitude (4,) body to WRF, angular rate (3,) in body
    axes.
    """

    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array


class RigidBody(Protocol):
    """Mass and principal moments of inertia of a body whose axes are its principal axes."""

    @property
    def mass_kg(self) -> float: ...
    @property
    def inertia(self) -> Vector3: ...


def rk4_step(derivative: Callable[[Array], Array], y: Array, step_s: float) -> Array:
    """Return ``y`` after one step of the classical Runge-Kutta method for y' =
    ``derivative(y)``.
    """
    k1 = derivative(y)
    k2 = derivative(y + 0.5 * step_s * k1)
    k3 = derivative(y + 0.5 * step_s * k2)
    k4 = derivative(y + step_s * k3)
    return y + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def propagate(state: Array, wrench: Array, body: RigidBody, duration_s: float) -> Array:
    """Return the state (13,) after ``duration_s`` under a constant wrench.

    The state is position and velocity (WRF), q_wxyz (body to WRF) and angular rate (body axes); the
    wrench (6,) is force and torque in body axes.
    """
    steps, y = max(1, math.ceil(duration_s / MAX_STEP_S)), np.array(state, dtype=float)
    step, moving = function("rigid_step"), (address(y), address(np.array(wrench, dtype=float)))
    with_inertia = (
        c_double(body.mass_kg),
        (c_double * 3)(*body.inertia),
        c_double(duration_s / steps),
    )
    for _ in range(steps):
        step(*moving, *with_inertia)
        y[6:10] /= math.hypot(*y[6:10].tolist())
    return y


def free_rotation(
    q_wxyz: ArrayLike, omega_rad_s: ArrayLike, inertia: Array, step_s: float, count: int
) -> tuple[Array, Array, Array]:
    """Return attitudes (K, 4), rates and angular accelerations (K, 3) of a free body at 0, step_s,
    ... (K = ``count``).

    Euler's equations I w' = (I w) x w with the inertia tensor ``inertia`` (3, 3) in body axes. The
    error is below 1e-9 rad for steps of 0.05 s and rates of 0.2 rad/s. Raises ValueError for a zero
    quaternion.
    """
    q, omega = normalize(q_wxyz), np.array(omega_rad_s, dtype=float)
    inertia = np.ascontiguousarray(inertia)
    inverse = np.linalg.inv(inertia)
    attitudes, rates, accelerations = (
        np.empty((count, 4)),
        np.empty((count, 3)),
        np.empty((count, 3)),
    )
    function("free_rotation")(
        address(q),
        address(omega),
        address(inertia),
        address(inverse),
        c_double(step_s),
        c_int64(count),
        address(attitudes),
        address(rates),
        address(accelerations),
    )
    return attitudes, rates, accelerations
