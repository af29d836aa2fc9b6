# SPDX-License-Identifier: Apache-2.0
"""Track a setpoint by a second-order control law: the safe command without a plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array, limited
from .braking import ActuatedBody, MovingBody

# Second-order control laws: natural frequencies of position (a few cm/s) and attitude, and their
# damping ratio.
_POSITION_RAD_S, _ATTITUDE_RAD_S, _DAMPING = 0.3, 0.6, 0.9


class PlacedBody(MovingBody, Protocol):
    """A moving body and its position (3,) in WRF."""

    @property
    def position_m(self) -> ArrayLike: ...


@dataclass(frozen=True)
class Setpoint:
    """Reference of the control law.

    Position and velocity (3,) in WRF, attitude (4,) body to WRF, rate (3,) in body axes, and the
    feed-forward ``wrench`` (6,) in body axes.
    """

    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    wrench: Array


def track_setpoint(own: PlacedBody, body: ActuatedBody, setpoint: Setpoint) -> Array:
    """Return force and torque (6,), body axes, within the body's limits, that track a setpoint."""
    position_error = setpoint.position_m - np.asarray(own.position_m)
    velocity_error = setpoint.velocity_m_s - np.asarray(own.velocity_m_s)
    acceleration = (
        _POSITION_RAD_S**2 * position_error + 2 * _DAMPING * _POSITION_RAD_S * velocity_error
    )
    force = setpoint.wrench[:3] + body.mass_kg * rotations.rotate_inverse(own.q_wxyz, acceleration)
    attitude_error = rotations.log(
        rotations.multiply(rotations.conjugate(own.q_wxyz), setpoint.q_wxyz)
    )
    rate_error = setpoint.omega_rad_s - np.asarray(own.omega_rad_s)
    alpha = _ATTITUDE_RAD_S**2 * attitude_error + 2 * _DAMPING * _ATTITUDE_RAD_S * rate_error
    torque = setpoint.wrench[3:] + np.asarray(body.inertia) * alpha
    return limited(np.concatenate([force, torque]), body.wrench_max)
