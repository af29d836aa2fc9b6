# SPDX-License-Identifier: Apache-2.0
"""Bodies, states and covariances in general position, and their motion by definition: rotation
matrices and small steps, none of it from the sources under test.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.interfaces import RelativePose, TargetState
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry
from runge_kutta import rk4

BODY = TargetBody(
    43.0,
    np.array([[1.1, 0.12, -0.08], [0.12, 1.7, 0.15], [-0.08, 0.15, 2.2]]),
    np.array([-0.13, 0.06, 0.09]),
)
"""A target whose principal axes are not TRF's, with its centre of mass aside."""
INERTIA = (0.31, 0.42, 0.53)
"""Principal moments of a chaser, kg m^2."""


def matrix(q: Any) -> Array:
    """Return the rotation matrix of a quaternion (4,), scalar first, by Rodrigues' formula."""
    w, *v = np.asarray(q, dtype=float) / np.linalg.norm(q)
    across = skew(v)
    return np.eye(3) + 2.0 * w * across + 2.0 * across @ across


def skew(v: Any) -> Array:
    """Return the matrix of the cross product with ``v`` (3,)."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turn_between(a: Array, b: Array) -> Array:
    """Return the small rotation vector (3,), axes of ``a``, from the attitude (3, 3) ``a`` to
    ``b``.
    """
    r = a.T @ b
    return 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])


def attitude(rng: np.random.Generator) -> Array:
    """Return an attitude (4,) of any direction."""
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def covariance(rng: np.random.Generator, sigmas: Any) -> Array:
    """Return a covariance with correlations, of about these standard deviations (n,)."""
    n = len(sigmas)
    a = rng.normal(size=(n, n)) / np.sqrt(n)
    return (a @ a.T + 0.3 * np.eye(n)) * np.outer(sigmas, sigmas)


def target_state(rng: np.random.Generator, time_ns: int = 3_200_000_000) -> TargetState:
    """Return a target that tumbles and drifts."""
    return TargetState(
        time_ns,
        rng.uniform(-3.0, 3.0, 3),
        rng.uniform(-0.04, 0.04, 3),
        attitude(rng),
        rng.choice([-1.0, 1.0], 3) * rng.uniform(0.05, 0.12, 3),
        covariance(rng, [2e-3] * 3 + [1e-3] * 3 + [3e-3] * 3 + [2e-3] * 3),
        "tracking",
        2,
        (),
    )


def moving_odometry(rng: np.random.Generator, chaser: int, tick: int, time_ns: int) -> Odometry:
    """Return the state of a chaser that moves and turns."""
    return Odometry(
        tick=tick,
        sim_time_ns=time_ns,
        chaser=chaser,
        position_m=vector(rng.uniform(-3.0, 3.0, 3)),
        velocity_m_s=vector(rng.uniform(-0.1, 0.1, 3)),
        q_wxyz=vector(attitude(rng)),
        omega_rad_s=vector(rng.uniform(-0.2, 0.2, 3)),
    )


def relative_pose(rng: np.random.Generator) -> RelativePose:
    """Return a pose relative to the target with unequal standard deviations."""
    sigmas = [1e-3, 4e-3, 9e-3, 2e-3, 3e-3, 5e-3]
    return RelativePose(rng.uniform(-2.0, 2.0, 3), attitude(rng), covariance(rng, sigmas))


def rigid_motion(
    x: Array, mass_kg: float, inertia: Array, duration_s: float, force_w: Any, torque_b: Any
) -> Array:
    """Return position, velocity (WRF), rotation matrix and rate (18,) after ``duration_s`` under a
    force (WRF) and a torque (body axes), functions of the state; RK4 in steps of 10 ms.
    """
    count = max(1, round(abs(duration_s) / 1e-2))
    h, inverse = duration_s / count, np.linalg.inv(inertia)

    def slope(s: Array) -> Array:
        r, w = s[6:15].reshape(3, 3), s[15:]
        alpha = inverse @ (np.asarray(torque_b(s)) - np.cross(w, inertia @ w))
        return np.concatenate(
            [s[3:6], np.asarray(force_w(s)) / mass_kg, (r @ skew(w)).ravel(), alpha]
        )

    return rk4(slope, x, h, count)


def flown(x13: Array, mass_kg: float, inertia: Array, wrench: Array, duration_s: float) -> Array:
    """Return the state (18,), see ``rigid_motion``, of a chaser (13,) under a wrench (6,) that is
    constant in body axes.
    """
    x = np.concatenate([x13[:6], matrix(x13[6:10]).ravel(), x13[10:]])
    push: Callable[[Array], Array] = lambda s: s[6:15].reshape(3, 3) @ wrench[:3]  # noqa: E731
    return rigid_motion(x, mass_kg, inertia, duration_s, push, lambda _: wrench[3:])


class FreeTarget:
    """Free motion of ``BODY`` from a state on: its centre of mass moves uniformly."""

    def __init__(self, start: TargetState) -> None:
        r, c = matrix(start.q_wxyz), BODY.centre_trf_m
        centre = start.position_m + r @ c
        velocity = start.velocity_m_s + r @ np.cross(start.omega_rad_s, c)
        self._start = np.concatenate([centre, velocity, r.ravel(), start.omega_rad_s])

    def at(self, time_s: float) -> tuple[Array, Array, Array]:
        """Return position of TRF's origin (3,), rotation matrix (3, 3) and rate (3,) after
        ``time_s``.
        """
        still = np.zeros(3)
        inertia = BODY.inertia_kg_m2
        s = rigid_motion(self._start, 1.0, inertia, time_s, lambda _: still, lambda _: still)
        r = s[6:15].reshape(3, 3)
        return s[:3] - r @ BODY.centre_trf_m, r, s[15:]
