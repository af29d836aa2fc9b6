# SPDX-License-Identifier: Apache-2.0
"""Detumbling control: motion of the stack from the estimates, thrusts that stop it, and reasons why
it cannot be stopped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from enum import Enum, auto
from functools import lru_cache, partial

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.mounting import plume_free_thrusters
from chaserdock_protocol.scenario.thrusters import thrusts_max

from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.composite_body import pose_in_target
from chaserdock_controller.interfaces import (
    DirectCommand,
    IdentifiedStack,
    Observation,
    TargetEstimation,
    TargetState,
)

from .allocation import feedback, minimum_time, spans_all_directions
from .planner import StackPlanner
from .planning import StackProblem
from .port_loads import LoadModel, load_model
from .sequencer import Sequencer
from .stack import StackMotion, thruster_wrenches

_DEADBAND_SHARE = 0.3
"""Share of the rest limits below which no thruster fires."""
_STOPPED_SHARE = 0.4
"""Share of the rest limits below which the stack counts as stopped. Less than ``_MOVING_SHARE``, so
that phases do not alternate.
"""
_MOVING_SHARE = 0.5
"""Share of the rest limits above which a stopped stack moves again.

Disturbances of 5 mN and 0.5 mN m on each of two chasers turn the stack faster by 0.01 degrees/s
every second. Until the thrusters act, the true rate rises by another quarter of the limit; they
fire down to ``_DEADBAND_SHARE``.
"""
_MEAN_S = 0.5
"""Time constant, s, of the mean motion. In a single tick the noise of `lab` odometry is half of the
limits.
"""
_SLEW_SHARE = 20.0
"""Share of the rest limits beyond which a stack that turns to its commanded attitude counts as
moving.
"""
_ATTITUDE_DEADBAND_RAD = math.radians(0.3)
_ATTITUDE_TIME_S = 5.0
"""Time constant, s, of the turn to a commanded attitude. Larger: slower near the end; smaller:
noise of the attitude demands larger rates, and so more thrust.
"""
_PULSE_PERIOD_NS, _PULSE_NS = 600_000_000, 300_000_000
"""Interval between identifying pulses, and their length, ns. Pulses last for half of the interval,
so that the rates before and after each are measured equally long.
"""


class StackTask(Enum):
    """Task of the stack's thrusters."""

    STOP = auto()
    HOLD = auto()
    IDENTIFY = auto()
    WAIT = auto()


@dataclass(frozen=True, eq=False)
class StackState:
    """State of the stack, predicted to the time at which the commands take effect.

    ``chasers``: the latched ones, by number. ``q_wxyz``: TRF to WRF. ``thrust_factors`` (n,):
    estimated over stated thrust, by chaser, where estimated. ``isolated``: thrusters that chasers
    report as closed; ``failed``: thrusters found stuck; both as (chaser, number). ``informative``:
    see ``IdentifiedStack``. ``measured_omega_rad_s`` (3,): angular rate, TRF axes, by the chasers'
    odometry alone: noisy, but without delay under disturbances.
    """

    body: TargetBody
    chasers: Mapping[int, MountedChaser]
    motion: StackMotion
    q_wxyz: Array
    thrust_factors: Mapping[int, Array] = field(default_factory=dict)
    isolated: frozenset[tuple[int, int]] = frozenset()
    failed: frozenset[tuple[int, int]] = frozenset()
    informative: Callable[[], tuple[tuple[int, int], ...]] = tuple
    measured_omega_rad_s: Array | None = None

    @property
    def omega_rad_s(self) -> Array:
        """Return the angular rate (3,), TRF axes."""
        omega = np.linalg.solve(self.body.inertia_kg_m2, self.motion.angular_N_m_s)
        return np.asarray(omega, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Thrusters:
    """Thrusters of the active ``chasers``. ``wrenches`` (6, n): per commanded 1 N. ``limits_N``
    (n,). ``groups`` (n,): index of the chaser.
    """

    chasers: tuple[int, ...]
    wrenches: Array
    limits_N: Array
    groups: IntArray


class DetumbleControl:
    """Controls the stack of a scenario. No thruster fires whose plume would hit a body.

    It flies a plan of least propellant if the scenario sets a time to stop in, else feedback on the
    momentum, which has no memory.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario, self._settings = scenario, scenario.detumble
        self._thrusters = scenario.chaser.thrusters
        self._full_N = thrusts_max(self._thrusters)
        self._own = wrench_matrix(self._thrusters)
        self._target = scenario.target_model()
        self._plume_free = lru_cache(maxsize=32)(partial(plume_free_thrusters, scenario))
        self.planner = StackPlanner(self._settings.plan_s, scenario.time.rate_hz)
        self.sequencer = Sequencer(scenario)
        self._pulse: tuple[int, int | None] = (-1, None)
        self._mean_share = 1.0 - math.exp(-1.0 / (scenario.time.rate_hz * _MEAN_S))
        self._mean_rates: Array | None = None

    def state(self, observation: Observation, estimation: TargetEstimation) -> StackState | None:
        """Return the stack's state; None while the target is unknown or no latched chaser has
        odometry.
        """
        latched = [c for c in estimation.chasers if c.latched]
        own = {c.chaser: c.own.state for c in latched if c.own is not None}
        if estimation.at_effect is None or not own:
            return None
        if estimation.stack is not None:
            return self._identified_state(observation, estimation.stack, own.keys())
        chasers = {
            i: MountedChaser(*pose_in_target(estimation.target, state)) for i, state in own.items()
        }
        ahead = _impulse_ahead(observation, chasers, estimation.body)
        states = tuple(own.values())
        motion = observed_motion(
            estimation.body, estimation.target, states, self._variances(len(states))
        )
        turn = rotations.multiply(
            rotations.conjugate(estimation.at_effect.q_wxyz), estimation.target.q_wxyz
        )
        parts = [
            rotations.rotate(turn, part + ahead[k : k + 3])
            for k, part in ((0, motion.linear_N_s), (3, motion.angular_N_m_s))
        ]
        return StackState(
            estimation.body,
            chasers,
            StackMotion(*parts),
            estimation.at_effect.q_wxyz,
            isolated=_isolated(observation),
            measured_omega_rad_s=_mean_omega(states, estimation.target.q_wxyz),
        )

    def _identified_state(
        self, observation: Observation, identified: IdentifiedStack, known: Set[int]
    ) -> StackState:
        """Return the state from identified mass properties and the motion estimated with them."""
        body, motion = identified.stack.body, identified.motion
        members = [c for c in identified.chasers if c.chaser in known]
        chasers = {c.chaser: c.mounting for c in sorted(members, key=lambda c: c.chaser)}
        ahead = _impulse_ahead(observation, chasers, body)
        linear = (
            body.mass_kg * rotations.rotate_inverse(motion.q_wxyz, motion.velocity_m_s) + ahead[:3]
        )
        angular = body.inertia_kg_m2 @ motion.omega_rad_s + ahead[3:]
        latency_s = (observation.effective_ns - observation.time_ns) / 1e9
        omega = np.linalg.solve(body.inertia_kg_m2, angular - ahead[3:] / 2.0)
        turn = rotations.exp(omega * latency_s)
        parts = StackMotion(
            rotations.rotate_inverse(turn, linear), rotations.rotate_inverse(turn, angular)
        )
        q = rotations.multiply(motion.q_wxyz, turn)
        odometry = [observation.chasers[i].odometry for i in chasers]
        return StackState(
            body,
            chasers,
            parts,
            q,
            thrust_factors={c.chaser: c.thrust_factors for c in members},
            isolated=_isolated(observation),
            failed=identified.failed,
            informative=identified.informative,
            measured_omega_rad_s=_mean_omega([o for o in odometry if o is not None], motion.q_wxyz),
        )

    def _variances(self, chasers: int) -> tuple[float, float]:
        """Return the variances per axis of the stack's velocity and rate, as measured by the
        odometry of so many chasers.
        """
        errors = self._scenario.navigation.errors()
        size_m = math.hypot(*self._target.size_m)
        velocity = errors.velocity_noise_m_s**2 + (errors.omega_noise_rad_s * size_m / 2.0) ** 2
        omega = errors.omega_noise_rad_s**2
        return velocity / chasers + 1e-12, omega / chasers + errors.gyro_bias_rad_s**2 + 1e-12

    def reset(self) -> None:
        """Discard plan, pending pulses and averaged motion. Call when no chaser is detumbling."""
        self.planner.reset()
        self.sequencer.reset()
        self._mean_rates = None

    def follow(self, state: StackState) -> None:
        """Add the motion of a tick to the mean that decides whether the stack is at rest."""
        measured = state.measured_omega_rad_s
        omega = state.omega_rad_s if measured is None else measured
        rates = np.concatenate([state.motion.linear_N_s / state.body.mass_kg, omega])
        if self._mean_rates is None:
            self._mean_rates = rates
        else:
            self._mean_rates = self._mean_rates + self._mean_share * (rates - self._mean_rates)

    def commands(
        self,
        state: StackState,
        chasers: Set[int],
        task: StackTask,
        observation: Observation,
    ) -> dict[int, DirectCommand]:
        """Return the commands of ``chasers`` for a task."""
        active = {i: state.chasers[i] for i in sorted(chasers & state.chasers.keys())}
        if not active:
            return {}
        thrusters = self._thrusters_of(state, active)
        match task:
            case StackTask.STOP:
                thrusts = self._stop(state, thrusters, observation.effective_ns)
            case StackTask.HOLD:
                thrusts = self._hold(state, thrusters)
            case StackTask.IDENTIFY:
                thrusts = self._informative(state, thrusters, observation.effective_ns)
            case StackTask.WAIT:
                self.reset()
                thrusts = np.zeros(len(thrusters.limits_N))
        if self.sequencer.limited:
            model = self._load_model(state, thrusters)
            thrusts = self.sequencer.in_turn(model, thrusts, thrusters.limits_N, observation.tick)
        rows = dict(zip(active, thrusts.reshape(len(active), -1), strict=True))
        return {i: DirectCommand("detumble", self._own @ row, row) for i, row in rows.items()}

    # -- tasks -------------------------------------------------------------------------------------

    def _stop(self, state: StackState, thrusters: _Thrusters, now_ns: int) -> Array:
        if min(self.share_of_limits(state), self._mean_share_of_limits(state)) <= _DEADBAND_SHARE:
            return np.zeros(len(thrusters.limits_N))
        if self.planner.enabled:
            planned = self.planner.thrusts(self._problem(state, thrusters), now_ns)
            if planned is not None:
                return planned
        return self._feedback(state.motion.momentum, thrusters)

    def _hold(self, state: StackState, thrusters: _Thrusters) -> Array:
        """Return thrusts that turn a stopped stack to the commanded attitude; zero without such an
        attitude, or close to it.
        """
        none = np.zeros(len(thrusters.limits_N))
        reference = self._slew_rate(state)
        if reference is None or self.share_of_limits(state, slewing=True) <= _DEADBAND_SHARE:
            return none
        if not spans_all_directions(thrusters.wrenches, thrusters.limits_N):
            return none
        wanted = np.concatenate([np.zeros(3), state.body.inertia_kg_m2 @ reference])
        return self._feedback(state.motion.momentum - wanted, thrusters)

    def _informative(self, state: StackState, thrusters: _Thrusters, now_ns: int) -> Array:
        """Return a pulse of the thruster that tells most about the mass properties, among those
        that damp the motion.
        """
        thrusts = np.zeros(len(thrusters.limits_N))
        number = now_ns // _PULSE_PERIOD_NS
        if now_ns % _PULSE_PERIOD_NS >= _PULSE_NS:
            return thrusts
        if self._pulse[0] != number:
            self._pulse = number, self._best_pulse(state, thrusters)
        k = self._pulse[1]
        if k is not None and k < len(thrusts):
            thrusts[k] = thrusters.limits_N[k]
        return thrusts

    def _best_pulse(self, state: StackState, thrusters: _Thrusters) -> int | None:
        velocity = state.motion.linear_N_s / state.body.mass_kg
        rates = np.concatenate([velocity, state.omega_rad_s])
        for chaser, thruster in state.informative():
            if chaser not in thrusters.chasers:
                continue
            k = thrusters.chasers.index(chaser) * len(self._full_N) + thruster
            if thrusters.limits_N[k] > 0.0 and float(thrusters.wrenches[:, k] @ rates) < 0.0:
                return k
        return None

    def _feedback(self, momentum: Array, thrusters: _Thrusters) -> Array:
        return feedback(
            thrusters.wrenches, momentum, thrusters.limits_N, self._settings.response_s
        ).thrusts_N

    def _slew_rate(self, state: StackState) -> Array | None:
        """Return the rate (3,), TRF axes, towards the commanded attitude; None if there is none."""
        wanted = self._settings.attitude_wxyz
        if wanted is None:
            return None
        turn = rotations.log(
            rotations.multiply(rotations.conjugate(state.q_wxyz), np.array(wanted))
        )
        angle = float(np.linalg.norm(turn))
        if angle < _ATTITUDE_DEADBAND_RAD:
            return np.zeros(3)
        return turn * min(1.0 / _ATTITUDE_TIME_S, math.radians(self._settings.slew_deg_s) / angle)

    # -- judgement ---------------------------------------------------------------------------------

    def share_of_limits(self, state: StackState, slewing: bool = False) -> float:
        """Return the larger of speed and angular rate of the stack, as shares of the rest limits.

        ``slewing``: measure the rate from the one that turns the stack to its commanded attitude.
        """
        velocity = state.motion.linear_N_s / state.body.mass_kg
        return self._share(state, np.concatenate([velocity, state.omega_rad_s]), slewing)

    def is_stopped(self, state: StackState) -> bool:
        """Return whether the stack has stopped, judged by its mean motion up to ``state``."""
        return self._mean_share_of_limits(state) < _STOPPED_SHARE

    def moves_again(self, state: StackState) -> bool:
        """Return whether a stack at rest has to be stopped again, judged by its mean motion up to
        ``state``. The turn to its commanded attitude does not count.
        """
        slews = self._slew_rate(state) is not None
        return self._mean_share_of_limits(state, slewing=True) > (
            _SLEW_SHARE if slews else _MOVING_SHARE
        )

    def _mean_share_of_limits(self, state: StackState, slewing: bool = False) -> float:
        if self._mean_rates is None:
            return self.share_of_limits(state, slewing)
        return self._share(state, self._mean_rates, slewing)

    def _share(self, state: StackState, rates: Array, slewing: bool) -> float:
        """Return velocity and angular rate ``rates`` (6,) as the larger share of the rest
        limits.
        """
        reference = self._slew_rate(state) if slewing else None
        omega = rates[3:] - (np.zeros(3) if reference is None else reference)
        speed, rate = float(np.linalg.norm(rates[:3])), float(np.linalg.norm(omega))
        return max(speed / self._settings.speed_m_s, rate / math.radians(self._settings.rate_deg_s))

    def why_not(self, state: StackState | None, chasers: Set[int]) -> str:
        """Return why these chasers cannot stop the stack; empty if they can."""
        if not self._thrusters or self._scenario.chaser.actuation != "thrusters":
            return 'this mission\'s chasers fly without thrusters (chaser.actuation = "ideal")'
        if state is None:
            return "the motion of the target is not known"
        if missing := sorted(chasers - state.chasers.keys()):
            return f"chaser {missing[0]} is not latched, or its state is not known"
        active = {i: state.chasers[i] for i in sorted(chasers)}
        thrusters = self._thrusters_of(state, active)
        limits = thrusters.limits_N
        if not spans_all_directions(thrusters.wrenches, limits):
            usable = ", ".join(
                f"{(row > 0.0).sum()} of {len(row)} of chaser {i}"
                for i, row in zip(active, limits.reshape(len(active), -1), strict=True)
            )
            return (
                f"the thrusters whose plume is free ({usable}) cannot push and turn the stack in "
                "every direction"
            )
        least = minimum_time(thrusters.wrenches, state.motion.momentum, limits)
        if least is None or least.time_s > self._settings.timeout_s:
            time = "without end" if least is None else f"at least {least.time_s:.0f} s"
            return (
                f"stopping the stack takes {time}; detumble.timeout_s is "
                f"{self._settings.timeout_s:g} s"
            )
        return ""

    # -- models ------------------------------------------------------------------------------------

    def problem(self, state: StackState, chasers: Set[int]) -> StackProblem:
        """Return the problem that a plan for these chasers has to solve."""
        active = {i: state.chasers[i] for i in sorted(chasers)}
        return self._problem(state, self._thrusters_of(state, active))

    def _problem(self, state: StackState, thrusters: _Thrusters) -> StackProblem:
        momentum = [
            rotations.rotate(state.q_wxyz, p)
            for p in (state.motion.linear_N_s, state.motion.angular_N_m_s)
        ]
        return StackProblem(
            np.concatenate(momentum),
            state.q_wxyz,
            state.body.inertia_kg_m2,
            thrusters.wrenches,
            thrusters.limits_N,
            thrusters.groups,
            1 if self.sequencer.limited else None,
        )

    def _thrusters_of(self, state: StackState, active: Mapping[int, MountedChaser]) -> _Thrusters:
        """Return the thrusters of the active chasers. The limit is zero if a plume is obstructed or
        the thruster is closed.
        """
        latched, rows = frozenset(state.chasers), []
        for i in active:
            row = np.where(self._plume_free(latched)[i], self._full_N, 0.0)
            row[[number for k, number in state.isolated | state.failed if k == i]] = 0.0
            rows.append(row)
        wrenches = thruster_wrenches(state.body, active, self._thrusters)
        if state.thrust_factors:
            wrenches = wrenches * np.concatenate([state.thrust_factors[i] for i in active])
        groups = np.repeat(np.arange(len(active)), len(self._full_N))
        return _Thrusters(tuple(active), wrenches, np.concatenate(rows), groups)

    def _load_model(self, state: StackState, thrusters: _Thrusters) -> LoadModel:
        count = len(self._full_N)
        own = {
            i: (slice(k * count, (k + 1) * count), self._own)
            for k, i in enumerate(thrusters.chasers)
        }
        return load_model(
            state.body,
            state.omega_rad_s,
            thrusters.wrenches,
            state.chasers,
            own,
            self._scenario.chaser,
            self.sequencer.tips_m,
            self.sequencer.limits,
        )


def _impulse_ahead(
    observation: Observation, chasers: Mapping[int, MountedChaser], body: TargetBody
) -> Array:
    """Return the impulse (6,), TRF axes, that acts on the stack until the commands take effect."""
    ahead = np.zeros(6)
    for i, chaser in chasers.items():
        impulse = sum(
            (duration_s * wrench for duration_s, wrench in observation.chasers[i].ahead),
            np.zeros(6),
        )
        ahead = ahead + chaser.wrench_to_stack(impulse, body.centre_trf_m)
    return ahead


def _isolated(observation: Observation) -> frozenset[tuple[int, int]]:
    """Return the thrusters that chasers report as closed, as (chaser, number)."""
    return frozenset((c.chaser, number) for c in observation.chasers for number in c.isolated)


def _mean_omega(own: Sequence[Odometry], q_wxyz: Array) -> Array:
    """Return the mean angular rate (3,) of chasers, in the axes of a body with attitude
    ``q_wxyz``.
    """
    omega_world = np.mean([rotations.rotate(o.q_wxyz, o.omega_rad_s) for o in own], axis=0)
    return rotations.rotate_inverse(q_wxyz, omega_world)


def observed_motion(
    body: TargetBody,
    target: TargetState,
    own: Sequence[Odometry],
    variances: tuple[float, float],
) -> StackMotion:
    """Return the momentum of the stack, TRF axes, from the target's estimate and the states of
    latched chasers.

    The chasers measure the stack's rates without delay; the target's estimate smooths them while
    nothing fires. Both are weighted by their covariances. ``variances`` per axis: of the chasers'
    mean velocity (m²/s²) and rate (rad²/s²).
    """
    omega = _mean_omega(own, target.q_wxyz)
    omega_world = rotations.rotate(target.q_wxyz, omega)
    centre = target.position_m + rotations.rotate(target.q_wxyz, body.centre_trf_m)
    velocity_world = np.mean(
        [
            np.array(o.velocity_m_s) + rotations.cross(omega_world, centre - o.position_m)
            for o in own
        ],
        axis=0,
    )
    measured = np.concatenate([rotations.rotate_inverse(target.q_wxyz, velocity_world), omega])
    turn = rotations.to_matrix(target.q_wxyz).T
    lever = rotations.skew(body.centre_trf_m)
    estimated = np.concatenate(
        [turn @ target.velocity_m_s - lever @ target.omega_rad_s, target.omega_rad_s]
    )
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3], jacobian[:3, 3:], jacobian[3:, 3:] = turn, -lever, np.eye(3)
    rows = [3, 4, 5, 9, 10, 11]
    covariance = jacobian @ target.covariance[np.ix_(rows, rows)] @ jacobian.T
    noise = np.diag(np.repeat(variances, 3))
    rates = estimated + covariance @ np.linalg.solve(covariance + noise, measured - estimated)
    return StackMotion(body.mass_kg * rates[:3], body.inertia_kg_m2 @ rates[3:])
