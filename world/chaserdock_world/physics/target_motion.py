# SPDX-License-Identifier: Apache-2.0
"""Move a target as prescribed: at constant velocity and body rate, whatever touches it."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario

from .engine import PlacementPath

PLACEMENTS_HZ = 120
"""Rate, Hz, at which the engine's copy of a prescribed target is moved; only collisions need it. In
between, a target that turns at 10 degrees/s moves by 0.6 mm at 0.4 m from its centre. The stated
motion is exact at every step.
"""
_PLACEMENTS_AT_ONCE = 120
"""Placements that are computed together, a second: most of the time of a few is that of the calls.
"""


class PrescribedMotion:
    """Compute the exact motion of a prescribed target, and when the engine's copy is placed."""

    def __init__(self, scenario: Scenario) -> None:
        self._physics_hz = scenario.time.physics_hz
        self._every = max(1, self._physics_hz // PLACEMENTS_HZ)
        self._start = _start(scenario)
        self._moves = scenario.target.motion != "static"
        self._first, self._placed = 0, _moved(self._start, np.zeros((0, 1)))

    def at(self, step: int) -> BodyState:
        """Return the target's state at a physics step."""
        return _moved(self._start, step / self._physics_hz)

    def is_placed_at(self, step: int) -> bool:
        """Return whether the engine's copy is placed at a physics step."""
        return self._moves and step % self._every == 0

    def path(self, body: int, step: int, end: int) -> PlacementPath | None:
        """Return the placements of the engine's ``body`` after ``step`` up to ``end``; None without
        any.
        """
        first = step - step % self._every + self._every
        if not self._moves or first > end:
            return None
        return PlacementPath(body, first - step, self._every, self._placements(first, end))

    def _placements(self, first: int, end: int) -> BodyState:
        """Return the states of the engine's copy at its placements from step ``first`` to ``end``:
        positions (K, 3), attitudes (K, 4).
        """
        begin, count = (first - self._first) // self._every, (end - first) // self._every + 1
        if not 0 <= begin <= len(self._placed.position_m) - count:
            steps = first + self._every * np.arange(max(count, _PLACEMENTS_AT_ONCE))
            self._placed = _moved(self._start, steps[:, None] / self._physics_hz)
            self._first, begin = first, 0
        s, part = self._placed, slice(begin, begin + count)
        return BodyState(s.position_m[part], s.velocity_m_s, s.q_wxyz[part], s.omega_rad_s)


def prescribed_state(scenario: Scenario, time_s: float) -> BodyState:
    """Return the target's exact state at a simulated time under constant velocity and body rate."""
    return _moved(_start(scenario), time_s)


def _start(scenario: Scenario) -> BodyState:
    target = scenario.target
    still = target.motion == "static"
    velocity = np.zeros(3) if still else np.asarray(target.velocity_m_s)
    omega = np.zeros(3) if still else np.asarray(target.omega_rad_s)
    return BodyState(np.asarray(target.position_m), velocity, np.asarray(target.q_wxyz), omega)


def _moved(start: BodyState, time_s: float | Array) -> BodyState:
    """Return a state after a time, or after times (K, 1), at constant velocity and body rate."""
    velocity, omega = start.velocity_m_s, start.omega_rad_s
    position = start.position_m + velocity * time_s
    return BodyState(position, velocity, rotations.integrate(start.q_wxyz, omega, time_s), omega)
