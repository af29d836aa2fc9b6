# SPDX-License-Identifier: Apache-2.0
"""Coasts in free space by definition: straight lines bent by a constant acceleration, searched on a
fine grid.
"""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import CoastNoise, DisturbedMotion
from general_position import covariance


def disturbed_in_general(
    rng: np.random.Generator, position_m: float, velocity_m_s: float, push_m_s2: float
) -> DisturbedMotion:
    """Return a motion with an acceleration along no axis, and correlated errors of about these
    standard deviations.
    """
    sigmas = np.repeat([position_m, velocity_m_s, push_m_s2], 3)
    return DisturbedMotion(rng.normal(0.0, 3.0 * push_m_s2, 3), covariance(rng, sigmas))


def coast_of(state: Array, motion: DisturbedMotion, times_s: Array) -> tuple[Array, Array]:
    """Return the positions (T, 3) of a coast and its rows (T, 3, 9): what they change by errors of
    position, velocity and acceleration.
    """
    t = times_s[:, None]
    positions = state[:3] + t * state[3:6] + 0.5 * t * t * motion.acceleration_m_s2
    one, t3 = np.eye(3), times_s[:, None, None]
    return positions, np.concatenate(
        [np.broadcast_to(one, (len(t), 3, 3)), t3 * one, 0.5 * t3 * t3 * one], axis=2
    )


def margins_of(
    state: Array, motion: DisturbedMotion, noise: CoastNoise, keep_out_m: float, times_s: Array
) -> tuple[Array, Array]:
    """Return the margins (T,) in standard deviations along a coast and its distances (T,), m.

    White acceleration alone is the noise: a variance of density t^3 / 3.
    """
    positions, rows = coast_of(state, motion, times_s)
    away = np.linalg.norm(positions, axis=1)
    slopes = np.einsum("ti,tij->tj", positions / away[:, None], rows)
    variance = np.einsum("ti,ij,tj->t", slopes, motion.covariance, slopes)
    variance += noise.white_m_s2_sqrt_s**2 * times_s**3 / 3.0
    return (away - keep_out_m) / np.sqrt(variance), away
