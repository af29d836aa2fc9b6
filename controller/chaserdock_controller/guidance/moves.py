# SPDX-License-Identifier: Apache-2.0
"""Plans moves of the reference in TRF within speed limits; passively safe ones if enforced."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import FlightScenario

from .approach_line import why_not_past
from .chaser_machine import ChaserMachine
from .escape import EscapePlanner
from .parameters import GUIDANCE
from .phases import Phase
from .trajectories import Motion, move_to


class MovePlanner:
    """Plans moves at ``approach_m_s``, ``goto_m_s`` or ``abort_m_s``. ``escapes``: None unless
    passive safety is enforced.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.approach_m_s = scenario.approach.max_speed_m_s
        self.goto_m_s = self.approach_m_s * GUIDANCE.goto_speed_factor
        self.abort_m_s = self.approach_m_s * GUIDANCE.abort_speed_factor
        self.escapes: EscapePlanner | None = None
        if scenario.limits.passive_safety == "enforce":
            self.escapes = EscapePlanner(scenario, self.abort_m_s)

    def speed_m_s(self, phase: Phase) -> float:
        """Return the speed of the moves in a phase."""
        match phase:
            case Phase.ABORT:
                return self.abort_m_s
            case Phase.APPROACH | Phase.DOCKED | Phase.RETREAT:
                return self.approach_m_s
            case Phase.INSPECT:
                return self._scenario.inspection.speed_m_s
            case _:
                return self.goto_m_s

    def move(self, chaser: ChaserMachine, goal_m: Array, now_s: float, speed_m_s: float) -> Motion:
        """Return the move to a goal (3,), TRF, at most at ``speed_m_s``; slower where passive
        safety requires it.
        """
        return self._safe(chaser, goal_m, now_s, speed_m_s) or move_to(
            chaser.motion(now_s), goal_m, now_s, speed_m_s
        )

    def why_not_safe(self, chaser: ChaserMachine, goal_m: Array, now_s: float) -> str:
        """Return why no move to a goal (3,), TRF, is passively safe; empty if one is."""
        if self._safe(chaser, goal_m, now_s, self.goto_m_s) is not None:
            return ""
        return (
            "no speed makes the move passively safe: the coast after a loss of thrust comes within "
            f"{self._scenario.limits.min_distance_target_m:g} m of the target "
            "(limits.passive_safety, limits.passive_safety_force_N)"
        )

    def why_not_past(self, chaser: ChaserMachine, goal_m: Array, now_s: float) -> str:
        """Return why the straight way to a goal (3,), TRF, is too near to the target; empty if it
        is not.
        """
        here_m = chaser.motion(now_s).at(np.array([now_s]))[0][0]
        return why_not_past(self._scenario, here_m, goal_m)

    def _safe(
        self, chaser: ChaserMachine, goal_m: Array, now_s: float, speed_m_s: float
    ) -> Motion | None:
        start = chaser.motion(now_s)
        speed_m_s = self._closing_speed(start, goal_m, now_s, speed_m_s)
        if self.escapes is None:
            return move_to(start, goal_m, now_s, speed_m_s)
        return self.escapes.limited(
            chaser.relative, lambda speed: move_to(start, goal_m, now_s, speed), speed_m_s, now_s
        )

    def _closing_speed(self, start: Motion, goal_m: Array, now_s: float, speed_m_s: float) -> float:
        """Return the largest speed, at least ``speed_m_s``, at which a move keeps the speed limit
        by range along its whole way.
        """
        slope = self._scenario.approach.closing_per_s
        if not slope:
            return speed_m_s
        farthest = max(
            float(np.linalg.norm(goal_m)), float(np.linalg.norm(start.at(np.array([now_s]))[0][0]))
        )
        speed = speed_m_s + slope * farthest
        while speed > speed_m_s:
            move = move_to(start, goal_m, now_s, speed)
            positions, velocities, _ = move.at(np.linspace(now_s, now_s + move.duration_s, 65))
            limits = speed_m_s + slope * np.linalg.norm(positions, axis=1)
            if np.all(np.linalg.norm(velocities, axis=1) <= limits):
                return speed
            speed *= 0.97
        return speed_m_s
