# SPDX-License-Identifier: Apache-2.0
"""Use that bodies are on a floor: none moves up or down, leans, or turns about another axis than
the vertical. Pure functions.

The floor is one more sensor in every tick, of the target and of each chaser. In body axes, u is the
vertical by construction and e = R' z the estimated one. An error dtheta turns e by e x dtheta, so
that along both directions t across u: t . (u - e) = t . (e x dtheta), t . (-omega) = t . domega,
and -v_z = dv_z. These rows have independent errors and are used one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.plane import UP, across
from msgspec.structs import replace

from .parameters import LevelFloor
from .state import ATTITUDE, RATE, VELOCITY, JointState, block, inject

_GATE_SIGMAS = 5.0
"""Residual, in sigmas, that counts at most against a hypothesis: more would come from errors of the
linearization, as the wrong pose of a single marker leans by tens of degrees.
"""
FloorRow = tuple[IntArray, Array, float, float]
"""Components of the error vector, derivatives of the measurement by them, residual, variance."""


def keep_on_floor(state: JointState, floor: LevelFloor) -> JointState:
    """Return the state updated by the knowledge that its bodies are on a floor."""
    covariance, error = state.covariance.copy(), np.zeros(len(state.covariance))
    likelihood = state.log_likelihood
    for components, derivatives, residual, variance in rows_of_bodies(state, floor):
        column = covariance[:, components] @ derivatives
        spread = float(derivatives @ column[components]) + variance
        off = residual - float(derivatives @ error[components])
        error += column * (off / spread)
        covariance -= np.outer(column, column / spread)
        likelihood -= 0.5 * (min(off * off / spread, _GATE_SIGMAS**2) + math.log(spread))
    covariance = 0.5 * (covariance + covariance.T)
    return inject(replace(state, covariance=covariance, log_likelihood=likelihood), error)


def rows_of_bodies(state: JointState, floor: LevelFloor) -> Iterator[FloorRow]:
    """Yield the rows of the target, if it is known, and of the chasers that are."""
    if state.target_known:
        velocity, omega = state.velocity_m_s, state.omega_rad_s
        yield from _of_body(0, state.q_wxyz, velocity, omega, np.array(floor.up_trf), floor)
    for i in np.flatnonzero(state.alive).tolist():
        motion = state.attitudes_wxyz[i], state.velocities_m_s[i], state.omegas_rad_s[i]
        yield from _of_body(block(i).start, *motion, UP, floor)


def _of_body(
    start: int, q_wxyz: Array, velocity: Array, omega: Array, up: Array, floor: LevelFloor
) -> Iterator[FloorRow]:
    """Yield the rows of a body whose components begin at ``start``; ``up`` (3,) in its axes."""
    vertical = np.array([start + VELOCITY.stop - 1])
    yield vertical, np.ones(1), -float(velocity[2]), floor.vertical_m_s**2
    attitude = start + np.arange(ATTITUDE.start, ATTITUDE.stop)
    rate = start + np.arange(RATE.start, RATE.stop)
    leaning = so3.to_matrix(q_wxyz)[2]
    for side in across(up):
        turned = side @ so3.skew(leaning)
        yield attitude, turned, float(side @ (up - leaning)), floor.lean_rad**2
        yield rate, side, -float(side @ omega), floor.lean_rate_rad_s**2
