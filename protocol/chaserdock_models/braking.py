# SPDX-License-Identifier: Apache-2.0
"""Bring a body to rest within its actuator limits: the safe fallback command."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array, limited

BRAKE_TIME_S = 3.0
"""Time constant (s) with which velocity and angular rate decay while the limits allow it."""


class MovingBody(Protocol):
    """Describe a body's motion: velocity (3,) in WRF, attitude (4,) body to WRF, rate (3,) in body
    axes.
    """

    @property
    def velocity_m_s(self) -> ArrayLike: ...
    @property
    def q_wxyz(self) -> ArrayLike: ...
    @property
    def omega_rad_s(self) -> ArrayLike: ...


class ActuatedBody(Protocol):
    """Describe a body that can be actuated: mass, principal moments of inertia (3,), largest force
    and torque (6,) per body axis.
    """

    @property
    def mass_kg(self) -> float: ...
    @property
    def inertia(self) -> ArrayLike: ...
    @property
    def wrench_max(self) -> Array: ...


def brake_wrench(
    odometry: MovingBody, body: ActuatedBody, velocity_m_s: ArrayLike = (0.0, 0.0, 0.0)
) -> Array:
    """Return the wrench (6,), force and torque in body axes, that brings a chaser to rest.

    It stops the rotation, and the motion relative to ``velocity_m_s`` (3,), WRF.
    """
    relative = np.asarray(odometry.velocity_m_s) - np.asarray(velocity_m_s)
    velocity = rotations.rotate_inverse(odometry.q_wxyz, relative)
    force = -body.mass_kg / BRAKE_TIME_S * velocity
    torque = -np.asarray(body.inertia) / BRAKE_TIME_S * np.asarray(odometry.omega_rad_s)
    return limited(np.concatenate([force, torque]), body.wrench_max)
