"""The safe command that everyone may fall back on: come to rest, within the actuators' limits."""

from __future__ import annotations

import numpy as np

from . import rotations
from .messages import Odometry
from .rotations import Array
from .scenario_bodies import Body

BRAKE_TIME_S = 3.0
"""Time constant with which velocity and rate decay while the limits allow."""


def brake_wrench(odometry: Odometry, body: Body) -> Array:
    """Force and torque (6,), body axes, that bring a chaser to rest in WRF."""
    velocity = rotations.rotate_inverse(odometry.q_wxyz, odometry.velocity_m_s)
    force = np.clip(-body.mass_kg / BRAKE_TIME_S * velocity, -body.force_max_N, body.force_max_N)
    torque = -np.asarray(body.inertia) / BRAKE_TIME_S * np.asarray(odometry.omega_rad_s)
    torque = np.clip(torque, -body.torque_max_N_m, body.torque_max_N_m)
    return np.concatenate([force, torque])
