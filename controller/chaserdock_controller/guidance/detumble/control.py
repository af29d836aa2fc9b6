# SPDX-License-Identifier: Apache-2.0
"""Detumbling control: the motion of the stack from the estimates, thrusts that stop it, and why it cannot be stopped.

The same inputs give the same thrusts: there is no state from tick to tick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.mounting import plume_free_thrusters
from chaserdock_protocol.scenario.thrusters import thrusts_max

from chaserdock_controller.estimation.composite_body import pose_in_target
from chaserdock_controller.estimation.target_body import TargetBody
from chaserdock_controller.estimation.types import TargetState
from chaserdock_controller.interfaces import DirectCommand, Observation, TargetEstimation

from .allocation import feedback, minimum_time, spans_all_directions
from .stack import StackMotion, thruster_wrenches

_DEADBAND_SHARE = 0.3
"""Share of the rest limits below which no thruster fires."""
_STOPPED_SHARE = 0.6
"""Share of the rest limits below which the stack counts as stopped; above the limits it moves again."""


@dataclass(frozen=True, eq=False)
class StackState:
    """The stack as estimated for the time at which the commands take effect; ``chasers``: those latched, by number."""

    body: TargetBody
    chasers: Mapping[int, MountedChaser]
    motion: StackMotion


class DetumbleControl:
    """Feedback on the momentum of the stack for a scenario; no thruster fires whose plume would hit something."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario, self._settings = scenario, scenario.detumble
        self._thrusters = scenario.chaser.thrusters
        self._full_N = thrusts_max(self._thrusters)
        self._own = wrench_matrix(self._thrusters)
        self._target = scenario.target_model()
        self._plume_free = lru_cache(maxsize=32)(partial(plume_free_thrusters, scenario))

    def state(self, observation: Observation, estimation: TargetEstimation) -> StackState | None:
        """Return the stack's state; None while the target is unknown or no latched chaser has odometry."""
        known = sorted(estimation.latched & estimation.own.keys())
        if estimation.at_effect is None or not known:
            return None
        chasers = {i: MountedChaser(*pose_in_target(estimation.target, estimation.own[i])) for i in known}
        ahead = np.zeros(6)
        for i, chaser in chasers.items():
            impulse = sum((duration_s * wrench for duration_s, wrench in observation.ahead[i]), np.zeros(6))
            ahead = ahead + chaser.wrench_to_stack(impulse, estimation.body.centre_trf_m)
        own = {i: estimation.own[i] for i in known}
        motion = observed_motion(estimation.body, estimation.target, own, self._variances(len(known)))
        turn = rotations.multiply(rotations.conjugate(estimation.at_effect.q_wxyz), estimation.target.q_wxyz)
        parts = [
            rotations.rotate(turn, part + ahead[k : k + 3])
            for k, part in ((0, motion.linear_N_s), (3, motion.angular_N_m_s))
        ]
        return StackState(estimation.body, chasers, StackMotion(*parts))

    def _variances(self, chasers: int) -> tuple[float, float]:
        """Return the variances per axis of velocity and rate of the stack by the odometry of so many chasers."""
        errors = self._scenario.navigation.errors()
        size_m = math.hypot(*self._target.size_m)
        velocity = errors.velocity_noise_m_s**2 + (errors.omega_noise_rad_s * size_m / 2.0) ** 2
        omega = errors.omega_noise_rad_s**2
        return velocity / chasers + 1e-12, omega / chasers + errors.gyro_bias_rad_s**2 + 1e-12

    def commands(
        self, state: StackState, chasers: Set[int], isolated: Mapping[int, tuple[int, ...]], hold: bool
    ) -> dict[int, DirectCommand]:
        """Return the commands of ``chasers`` that stop the stack; with ``hold`` none fires. ``isolated``: closed thrusters."""
        active = {i: state.chasers[i] for i in sorted(chasers & state.chasers.keys())}
        if not active:
            return {}
        limits = self._limits(active, frozenset(state.chasers), isolated)
        thrusts = np.zeros(len(limits))
        if not hold and self.share_of_limits(state) > _DEADBAND_SHARE:
            wrenches = thruster_wrenches(state.body, active, self._thrusters)
            thrusts = feedback(wrenches, state.motion.momentum, limits, self._settings.response_s).thrusts_N
        rows = dict(zip(active, thrusts.reshape(len(active), -1), strict=True))
        return {i: DirectCommand("detumble", self._own @ row, row) for i, row in rows.items()}

    def share_of_limits(self, state: StackState) -> float:
        """Return the larger of speed and angular rate of the stack, as share of the rest limits."""
        speed, rate = state.motion.rates(state.body)
        return max(speed / self._settings.speed_m_s, rate / math.radians(self._settings.rate_deg_s))

    def is_stopped(self, state: StackState) -> bool:
        """Return whether the stack has stopped."""
        return self.share_of_limits(state) < _STOPPED_SHARE

    def why_not(
        self, state: StackState | None, chasers: Set[int], isolated: Mapping[int, tuple[int, ...]]
    ) -> str:
        """Return why these chasers cannot stop the stack, or an empty string."""
        if not self._thrusters or self._scenario.chaser.actuation != "thrusters":
            return 'this mission\'s chasers fly without thrusters (chaser.actuation = "ideal")'
        if state is None:
            return "the motion of the target is not known"
        if missing := sorted(chasers - state.chasers.keys()):
            return f"chaser {missing[0]} is not latched, or its state is not known"
        active = {i: state.chasers[i] for i in sorted(chasers)}
        wrenches = thruster_wrenches(state.body, active, self._thrusters)
        limits = self._limits(active, frozenset(state.chasers), isolated)
        if not spans_all_directions(wrenches, limits):
            usable = ", ".join(
                f"{(row > 0.0).sum()} of {len(row)} of chaser {i}"
                for i, row in zip(active, limits.reshape(len(active), -1), strict=True)
            )
            return f"the thrusters whose plume is free ({usable}) cannot push and turn the stack in every direction"
        least = minimum_time(wrenches, state.motion.momentum, limits)
        if least is None or least.time_s > self._settings.timeout_s:
            time = "without end" if least is None else f"at least {least.time_s:.0f} s"
            return f"stopping the stack takes {time}; detumble.timeout_s is {self._settings.timeout_s:g} s"
        return ""

    def _limits(
        self,
        active: Mapping[int, MountedChaser],
        latched: frozenset[int],
        isolated: Mapping[int, tuple[int, ...]],
    ) -> Array:
        """Return the largest thrusts (N n,) of the active chasers: zero where a plume is not free or the thruster is closed."""
        rows = []
        for i in active:
            row = np.where(self._plume_free(latched)[i], self._full_N, 0.0)
            row[list(isolated.get(i, ()))] = 0.0
            rows.append(row)
        return np.concatenate(rows)


def observed_motion(
    body: TargetBody, target: TargetState, own: Mapping[int, Odometry], variances: tuple[float, float]
) -> StackMotion:
    """Return the momentum of the stack, TRF axes, from the target's estimate and the states of latched chasers.

    The chasers measure the stack's rates without delay, the target's estimate smooths them while nothing fires; the two are
    weighted by their covariances. ``variances`` per axis: of the chasers' mean velocity (m²/s²) and rate (rad²/s²).
    """
    omega_world = np.mean([rotations.rotate(o.q_wxyz, o.omega_rad_s) for o in own.values()], axis=0)
    centre = target.position_m + rotations.rotate(target.q_wxyz, body.centre_trf_m)
    velocity_world = np.mean(
        [
            np.array(o.velocity_m_s) + rotations.cross(omega_world, centre - o.position_m)
            for o in own.values()
        ],
        axis=0,
    )
    measured = np.concatenate(
        [
            rotations.rotate_inverse(target.q_wxyz, velocity_world),
            rotations.rotate_inverse(target.q_wxyz, omega_world),
        ]
    )
    turn = rotations.to_matrix(target.q_wxyz).T
    lever = rotations.skew(body.centre_trf_m)
    estimated = np.concatenate([turn @ target.velocity_m_s - lever @ target.omega_rad_s, target.omega_rad_s])
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3], jacobian[:3, 3:], jacobian[3:, 3:] = turn, -lever, np.eye(3)
    rows = [3, 4, 5, 9, 10, 11]
    covariance = jacobian @ target.covariance[np.ix_(rows, rows)] @ jacobian.T
    noise = np.diag(np.repeat(variances, 3))
    rates = estimated + covariance @ np.linalg.solve(covariance + noise, measured - estimated)
    return StackMotion(body.mass_kg * rates[:3], body.inertia_kg_m2 @ rates[3:])
