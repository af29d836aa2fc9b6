# SPDX-License-Identifier: Apache-2.0
"""Enforced passive safety: moves whose coasts stay clear of the target, and aborts onto a safe
coast.

An abort is a burn of a few seconds in one of several directions, followed by a coast. A coast is
the motion after a loss of all thrust (chaserdock_models/passive_safety.py). Collision avoidance
manoeuvres of this kind: Fehse, Automated Rendezvous and Docking of Spacecraft, section 4.5.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import STEP_S, DisturbedMotion
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import TargetState
from chaserdock_controller.nmpc.passive_safety import coast_duration_s, coast_model

from .trajectories import Escape, Motion

_COARSE_STEP_S = 60.0
"""Step of coasts in an orbit, s, when moves and aborts are selected. The monitor uses a shorter
one.
"""
_SPEED_SHARES = 0.7 ** np.arange(14)
_MOVE_SAMPLES, _TURN_SAMPLES = 33, 12
"""Number of states of a move, and of one turn of the target after it, from which coasts are
checked: every 3 % of the move, every 30 degrees.
"""
_LONGEST_TURN_S = 600.0
"""Longest wait at the goal of a move that is checked, s: as long as a coast counts."""
_DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1)[:, None]
_IMPULSE_SHARES = (0.5, 1.0, 2.0, 4.0)
"""Changes of velocity of an abort, as shares of the speed of an abort by a move."""
_FORCE_SHARE = 0.4
"""Share of the largest force per axis with which an abort burns; the rest is left for attitude
control and feedback.
"""
_BURN_ERROR = 0.03
"""Standard deviation of a burn's change of velocity, as a share of it."""
_SPARE = 1.5
"""A margin of this multiple of the required one is ample: of the burns that reach it the smallest
is taken.
"""


@dataclass(frozen=True)
class RelativeState:
    """Estimated state (6,) of a chaser relative to the target, WRF, and what else decides where it
    coasts, at one time.
    """

    state: Array
    disturbed: DisturbedMotion
    target: TargetState


class EscapePlanner:
    """Selects moves and aborts by the safety of their coasts."""

    def __init__(self, scenario: FlightScenario, abort_speed_m_s: float) -> None:
        orbit, limits, body = scenario.orbit, scenario.limits, scenario.chaser
        self._mean_motion_rad_s = 0.0 if orbit is None else orbit.elements.mean_motion_rad_s
        self.duration_s = coast_duration_s(scenario)
        self._coast = coast_model(scenario, STEP_S if orbit is None else _COARSE_STEP_S)
        self._keep_out_m, self._final_m = limits.min_distance_target_m, limits.final_corridor_m
        self.sigmas = limits.estimate_margin_sigmas
        pushes = body.wrench_max[:3] > 0.0
        # On a floor, body and WRF have the same vertical.
        self._directions = _DIRECTIONS[~_DIRECTIONS[:, ~pushes].any(axis=1)]
        largest_N = float(body.wrench_max[:3][pushes].min())
        self._acceleration_m_s2 = _FORCE_SHARE * largest_N / body.mass_kg
        self._speed_m_s = abort_speed_m_s

    # -- moves -------------------------------------------------------------------------------------

    def limited(
        self,
        known: RelativeState | None,
        move: Callable[[float], Motion],
        speed_m_s: float,
        now_s: float,
    ) -> Motion | None:
        """Return the fastest move, at a share of ``speed_m_s``, whose coasts are safe; None if none
        is.

        ``move``: maps a speed to the move, in TRF. Without a ``known`` state of the chaser the full
        speed is returned.
        """
        for share in _SPEED_SHARES:
            found = move(speed_m_s * float(share))
            if known is None or self.move_margin(known, found, now_s) >= self.sigmas:
                return found
        return None

    def move_margin(self, known: RelativeState, move: Motion, now_s: float) -> float:
        """Return the smallest margin (sigmas) of the coasts from a move outside the final corridor;
        infinity if it has no part there.
        """
        omega = np.asarray(known.target.omega_rad_s)
        rate = float(np.linalg.norm(omega))
        turn_s = min(2.0 * math.pi / rate, _LONGEST_TURN_S) if rate > 0.0 else 0.0
        end_s = move.start_s + move.duration_s
        times_s = np.concatenate(
            [
                np.linspace(now_s, end_s, _MOVE_SAMPLES),
                end_s + np.linspace(0.0, turn_s, _TURN_SAMPLES),
            ]
        )
        offsets, velocities, _ = move.at(times_s)
        outside = np.linalg.norm(offsets, axis=1) > self._final_m
        if not outside.any():
            return math.inf
        offsets, velocities, times_s = offsets[outside], velocities[outside], times_s[outside]
        turned = rotations.multiply(
            known.target.q_wxyz, rotations.exp((times_s - now_s)[:, None] * omega)
        )
        moving = velocities + np.cross(omega, offsets)
        states = np.concatenate(
            [rotations.rotate(turned, offsets), rotations.rotate(turned, moving)], axis=1
        )
        return self._margin(states, known.disturbed)

    # -- aborts ------------------------------------------------------------------------------------

    def escape(self, known: RelativeState, now_s: float) -> tuple[Escape, float]:
        """Return the best abort from the newest state of a chaser, and the margin of its coast.

        It is the smallest burn whose coast has ample margin, otherwise the one with the largest
        margin.
        """
        best = self._best_of(known, _IMPULSE_SHARES[0] * self._speed_m_s, now_s)
        for share in _IMPULSE_SHARES[1:]:
            if best[1] >= _SPARE * self.sigmas:
                break
            found = self._best_of(known, share * self._speed_m_s, now_s)
            if found[1] > best[1]:
                best = found
        return best

    def _best_of(
        self, known: RelativeState, impulse_m_s: float, now_s: float
    ) -> tuple[Escape, float]:
        """Return the abort with this change of velocity that has the largest margin over all
        directions.
        """
        burn_s = impulse_m_s / self._acceleration_m_s2
        escapes = [
            Escape(
                now_s,
                known.state,
                self._acceleration_m_s2 * direction,
                burn_s,
                self._mean_motion_rad_s,
                self.duration_s,
            )
            for direction in self._directions
        ]
        covariance = known.disturbed.covariance.copy()
        covariance[range(3, 6), range(3, 6)] += (_BURN_ERROR * impulse_m_s) ** 2
        ends = np.array([e.burnt_out() for e in escapes])
        motion = replace(known.disturbed, covariance=covariance)
        margins = self._coast.closest(ends, motion, self._keep_out_m).margin_sigmas
        times_s = now_s + np.linspace(0.0, burn_s, 9)
        nearest_m = np.array([np.linalg.norm(e.at(times_s)[0], axis=1).min() for e in escapes])
        # A burn through the keep-out is worse than any coast that stays outside.
        margins = np.where(nearest_m < self._keep_out_m, np.minimum(margins, -1.0), margins)
        best = int(np.argmax(margins))
        return escapes[best], float(margins[best])

    def _margin(self, states: Array, motion: DisturbedMotion) -> float:
        return float(self._coast.closest(states, motion, self._keep_out_m).margin_sigmas.min())
