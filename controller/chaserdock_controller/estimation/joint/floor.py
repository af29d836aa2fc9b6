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
from collections.abc import Iterable, Iterator

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.plane import UP, across
from msgspec.structs import replace

from .kernels import TARGET_MEAN
from .parameters import LevelFloor
from .running_update import StarUpdate
from .state import ATTITUDE, RATE, TARGET, VELOCITY, JointState, block, inject

_GATE_SIGMAS = 5.0
"""Residual, in sigmas, that counts at most against a hypothesis: more would come from errors of the
linearization, as the wrong pose of a single marker leans by tens of degrees.
"""
FloorRow = tuple[IntArray, Array, float, float]
"""Components of the error vector, derivatives of the measurement by them, residual, variance."""


def keep_on_floor(state: JointState, floor: LevelFloor) -> JointState:
    """Return the state updated by the knowledge that its bodies are on a floor."""
    if state.given_target is not None:
        return _keep_star_on_floor(state, floor)
    rows, likelihood = rows_of_bodies(state, floor), state.log_likelihood
    covariance, error, likelihood = _observed(state.covariance, rows, likelihood)
    return inject(replace(state, covariance=covariance, log_likelihood=likelihood), error)


def _keep_star_on_floor(state: JointState, floor: LevelFloor) -> JointState:
    """Do the same in star form, pair by pair."""
    update, likelihood = StarUpdate(state), state.log_likelihood
    bodies = [0] * state.target_known + [TARGET] * int(state.alive.sum())
    chasers = [0] * state.target_known + np.flatnonzero(state.alive).tolist()
    for first, chaser in zip(bodies, chasers, strict=True):
        update.place(chaser)
        body = update.mean[TARGET_MEAN if first else 0 :]
        up = UP if first else np.array(floor.up_trf)
        rows = _of_body(first, body[6:10], body[3:6], body[10:13], up, floor)
        covariance, error, likelihood = _observed(update.covariance, rows, likelihood)
        update.shift(error, covariance)
    return replace(update.finished(state.updates, state.markers), log_likelihood=likelihood)


def _observed(
    before: Array, rows: Iterable[FloorRow], likelihood: float
) -> tuple[Array, Array, float]:
    """Return covariance, error and log likelihood after measured rows."""
    covariance, error = before.copy(), np.zeros(len(before))
    for components, derivatives, residual, variance in rows:
        column = covariance[:, components] @ derivatives
        spread = float(derivatives @ column[components]) + variance
        off = residual - float(derivatives @ error[components])
        error += column * (off / spread)
        covariance -= np.outer(column, column / spread)
        likelihood -= 0.5 * (min(off * off / spread, _GATE_SIGMAS**2) + math.log(spread))
    return 0.5 * (covariance + covariance.T), error, likelihood


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
