"""What a chaser's motion says that its thrusters have given, beside what they should have. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.odometry import OdometrySection


@dataclass(frozen=True)
class Noise:
    """One sigma of what makes a healthy chaser's motion differ from what is expected of its thrusters.

    ``velocity_m_s``, ``omega_rad_s``, ``attitude_rad``: of its odometry, each axis. ``scatter``: of a thruster's impulse, in
    parts of it.
    ``floor_*``: of the prediction itself (attitude within a tick, rounding), each axis; N s and N m s.
    """

    velocity_m_s: float = 0.0
    omega_rad_s: float = 0.0
    attitude_rad: float = 0.0
    scatter: float = 0.05
    floor_N_s: float = 1e-3
    floor_N_m_s: float = 2e-4


def noise_of(odometry: OdometrySection) -> Noise:
    """What is to be expected where a scenario says how good the chasers' odometry is."""
    return Noise(
        odometry.velocity_noise_m_s,
        math.radians(odometry.omega_noise_deg_s),
        math.radians(math.hypot(odometry.attitude_noise_deg, odometry.attitude_bias_deg)),
    )


def observed_impulse(before: Odometry, after: Odometry, body: Body) -> Array:
    """Impulse and angular impulse (6,), N s and N m s, body axes, that explain the motion between two odometries.

    Force turns with the body: its impulse is taken in the attitude half way. I omega' + omega x I omega = tau
    (Euler), with the middle rate.
    """
    inertia = np.asarray(body.inertia)
    turn = rotations.log(rotations.multiply(rotations.conjugate(before.q_wxyz), after.q_wxyz))
    middle = rotations.multiply(before.q_wxyz, rotations.exp(turn / 2.0))
    gained = np.subtract(after.velocity_m_s, before.velocity_m_s)
    first, last = np.asarray(before.omega_rad_s), np.asarray(after.omega_rad_s)
    omega = (first + last) / 2.0
    time_s = (after.sim_time_ns - before.sim_time_ns) * 1e-9
    torque = inertia * (last - first) + np.cross(omega, inertia * omega) * time_s
    return np.concatenate([body.mass_kg * rotations.rotate_inverse(middle, gained), torque])


def covariance(
    noise: Noise, body: Body, matrix: Array, thrusters_N_s: Array, before: Odometry, after: Odometry
) -> Array:
    """(6, 6): of observed less expected impulse, when thrusters (n,) were to give ``thrusters_N_s`` (``matrix``: (6, n)).

    The faster it turns, the less the attitude half way says: a quarter of the turn is counted as one sigma.
    """
    turned = float(np.linalg.norm(after.omega_rad_s)) * (after.sim_time_ns - before.sim_time_ns) * 1e-9
    relative = noise.scatter**2 + (turned / 4.0) ** 2 + noise.attitude_rad**2
    return np.diag(at_rest(noise, body)) + (matrix * (relative * thrusters_N_s**2)) @ matrix.T


def at_rest(noise: Noise, body: Body) -> Array:
    """Variances (6,) of the observed impulse of a body whose thrusters are quiet."""
    return np.concatenate(
        [
            np.full(3, noise.floor_N_s**2 + 2.0 * (body.mass_kg * noise.velocity_m_s) ** 2),
            noise.floor_N_m_s**2 + 2.0 * (np.asarray(body.inertia) * noise.omega_rad_s) ** 2,
        ]
    )
