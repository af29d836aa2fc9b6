# SPDX-License-Identifier: Apache-2.0
"""Compute the observed impulse of a chaser, and the covariance of its residual to the expected one.

Pure functions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.navigation import NavigationErrors


@dataclass(frozen=True)
class ImpulseNoise:
    """Standard deviations of observed minus expected motion of a healthy chaser.

    ``velocity_m_s``, ``omega_rad_s``, ``attitude_rad``: of the odometry, per axis. ``scatter``: of
    a thruster's impulse, relative. ``floor_*``: of the prediction (attitude within a tick,
    rounding), per axis; N s and N m s.
    """

    velocity_m_s: float = 0.0
    omega_rad_s: float = 0.0
    attitude_rad: float = 0.0
    scatter: float = 0.05
    floor_N_s: float = 1e-3
    floor_N_m_s: float = 2e-4


@dataclass(frozen=True)
class PlantMismatch:
    """Standard deviations of the constant differences between a chaser and its model.

    They cause residuals of a healthy chaser. ``mass``, ``inertia`` (per principal moment) and
    ``thrust`` (per thruster): relative. ``centre_of_mass_m`` per axis; it also covers thrusters
    that are turned by a degree. ``force_N``, ``torque_N_m``: external, per body axis.
    """

    mass: float = 0.1
    inertia: float = 0.15
    thrust: float = 0.05
    centre_of_mass_m: float = 0.006
    force_N: float = 0.005
    torque_N_m: float = 0.0005


def noise_of(errors: NavigationErrors) -> ImpulseNoise:
    """Return the noise for the errors of the odometry."""
    return ImpulseNoise(
        errors.velocity_noise_m_s,
        errors.omega_noise_rad_s,
        math.hypot(
            max(errors.attitude_noise_rad, errors.attitude_roll_noise_rad),
            errors.attitude_drift_rad,
            errors.attitude_bias_rad,
        ),
    )


def observed_impulse(before: Odometry, after: Odometry, body: Body) -> Array:
    """Return impulse and angular impulse (6,), N s and N m s, body axes, from the motion between
    two odometries.

    The impulse is expressed in the mean attitude, as force rotates with the body. Torque by Euler's
    equation I omega' + omega x I omega = tau with the mean rate.
    """
    inertia = np.asarray(body.inertia)
    turn = rotations.log(rotations.multiply(rotations.conjugate(before.q_wxyz), after.q_wxyz))
    middle = rotations.multiply(before.q_wxyz, rotations.exp(turn / 2.0))
    gained = np.subtract(after.velocity_m_s, before.velocity_m_s)
    first, last = np.asarray(before.omega_rad_s), np.asarray(after.omega_rad_s)
    omega = (first + last) / 2.0
    time_s = (after.sim_time_ns - before.sim_time_ns) * 1e-9
    torque = inertia * (last - first) + rotations.cross(omega, inertia * omega) * time_s
    return np.concatenate([body.mass_kg * rotations.rotate_inverse(middle, gained), torque])


def covariance(
    noise: ImpulseNoise,
    body: Body,
    matrix: Array,
    thrusters_N_s: Array,
    before: Odometry,
    after: Odometry,
) -> Array:
    """Return the covariance (6, 6) of observed minus expected impulse.

    ``thrusters_N_s`` (n,): expected impulses; ``matrix`` (6, n): wrench of unit thrusts. The mean
    attitude is less accurate at higher rates: a quarter of the rotation is counted as one sigma.
    """
    turned = (
        float(np.linalg.norm(after.omega_rad_s)) * (after.sim_time_ns - before.sim_time_ns) * 1e-9
    )
    relative = noise.scatter**2 + (turned / 4.0) ** 2 + noise.attitude_rad**2
    return (
        np.diag(quiescent_variance(noise, body))
        + (matrix * (relative * thrusters_N_s**2)) @ matrix.T
    )


def mismatch_signatures(
    mismatch: PlantMismatch,
    body: Body,
    matrix: Array,
    thrusters_N_s: Array,
    before: Odometry,
    after: Odometry,
) -> Array:
    """Return the residuals (6, 13 + n) for one standard deviation of each part of ``mismatch``.

    Parts: mass, three moments of inertia, centre of mass, force, torque, thrust of every thruster.
    To first order, with motion and forces at the origin of CRF and the centre of mass c: m (a +
    omega' x c + omega x (omega x c)) = F and I omega' + omega x I omega = tau - c x F.
    """
    time_s = (after.sim_time_ns - before.sim_time_ns) * 1e-9
    inertia, force = np.asarray(body.inertia), observed_impulse(before, after, body)[:3]
    first, last = np.asarray(before.omega_rad_s), np.asarray(after.omega_rad_s)
    omega, turned = (first + last) / 2.0, rotations.skew(last - first)
    turning = rotations.skew(omega)
    signatures = np.zeros((6, 13 + len(thrusters_N_s)))
    signatures[:3, 0] = -mismatch.mass * force
    signatures[3:, 1:4] = -mismatch.inertia * (
        np.diag(inertia * (last - first)) + turning @ np.diag(inertia * omega) * time_s
    )
    signatures[:3, 4:7] = (
        -mismatch.centre_of_mass_m * body.mass_kg * (turned + turning @ turning * time_s)
    )
    signatures[3:, 4:7] = mismatch.centre_of_mass_m * rotations.skew(force)
    signatures[:3, 7:10] = mismatch.force_N * time_s * np.eye(3)
    signatures[3:, 10:13] = mismatch.torque_N_m * time_s * np.eye(3)
    signatures[:, 13:] = mismatch.thrust * matrix * thrusters_N_s
    return signatures


def quiescent_variance(noise: ImpulseNoise, body: Body) -> Array:
    """Return the variances (6,) of the observed impulse of a body whose thrusters are closed."""
    return np.concatenate(
        [
            np.full(3, noise.floor_N_s**2 + 2.0 * (body.mass_kg * noise.velocity_m_s) ** 2),
            noise.floor_N_m_s**2 + 2.0 * (np.asarray(body.inertia) * noise.omega_rad_s) ** 2,
        ]
    )
