# SPDX-License-Identifier: Apache-2.0
"""Reads from a log what identifies a robot: its motion, and the commands of its actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from chaserdock_agents.gateway.safety import limited_wrench
from chaserdock_models.arrays import Array, BoolArray, IntArray, limited
from chaserdock_models.thruster_model import Valves
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import ActuatorCommand, DockingStatus, Event, Odometry
from chaserdock_protocol.scenario import Scenario

from chaserdock.logs.reader import open_log

_MOST_GAP_NS = 500_000_000
"""Longest time, ns, between two odometries over which motion is predicted: seven ticks at 15 Hz.
Longer: the attitude within the gap is less certain; shorter: more dropouts split the run.
"""
_LEAST_S = 10.0
"""Shortest free motion, s, that is identified. Shorter: hardly more than one manoeuvre."""
_STARTS, _STOPS = ("arm accepted",), ("disarm accepted", "kill accepted", "disarmed")
"""Events of a gateway from which its robots act, and no longer act."""


class IdentificationError(ChaserdockError):
    """A run does not serve for an identification."""


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Odometry of one chaser, K times.

    ``states`` (K, 13): position and velocity (WRF), q_wxyz, rate (CRF). ``noise`` (12, 12): mean of
    the stated covariances of position, velocity, attitude and rate. ``free`` (K - 1,): intervals in
    which its actuators alone moved the chaser, and its odometry has no gap.
    """

    time_ns: IntArray
    states: Array
    noise: Array
    free: BoolArray


class ResponseDelay(NamedTuple):
    """Time from a command to the motion: a delay, and a first-order lag of this time constant."""

    delay_s: float
    lag_s: float = 0.0


class Pulses:
    """What on/off thrusters were told to give."""

    def __init__(self, scenario: Scenario, commands: Sequence[ActuatorCommand]) -> None:
        self._thrusters = scenario.chaser.thrusters
        self._valves = Valves(self._thrusters)
        self._pulses = sorted(
            (p.open_ns, p.close_ns, p.thruster) for c in commands for p in c.pulses
        )
        for open_ns, close_ns, thruster in self._pulses:
            self._valves.pulse(thruster, open_ns, close_ns)
        for command in commands:
            self._valves.set_shut(command.isolated, command.effective_time_ns)

    @property
    def acted(self) -> bool:
        """Whether anything was commanded."""
        return bool(self._pulses)

    def over(self, time_ns: IntArray, latencies: Sequence[ResponseDelay]) -> tuple[Array, Array]:
        """Return impulses and their first moments (see ``Valves``) between successive times (K,),
        each (latencies, K - 1, n), if they come later by each of the delays. The lag of valves is
        part of their model.
        """
        late_ns = [round(latency.delay_s * 1e9) for latency in latencies]
        found = [self._valves.impulses_and_moments(time_ns - late) for late in late_ns]
        return np.array([x for x, _ in found]), np.array([x for _, x in found])

    lags = False
    """Whether a lag beside the stated one of the valves is told."""

    def scattered(self, time_ns: IntArray, delay_s: float) -> Array:
        """Return the impulse (K - 1, n) by whose share each thruster scatters between successive
        times (K,): of whole pulses, when they end, as the width of a pulse scatters; several add as
        squares.
        """
        ends = np.array([(close_ns, close_ns - open_ns) for open_ns, close_ns, _ in self._pulses])
        numbers = np.array([k for *_, k in self._pulses])
        thrusts = np.array([t.thrust_N for t in self._thrusters])[numbers]
        rows = np.searchsorted(time_ns, ends[:, 0] + round(delay_s * 1e9)) - 1
        squares = np.zeros(
            (len(time_ns) + 1, len(self._thrusters))
        )  # the last row: before or after
        np.add.at(squares, (rows, numbers), (ends[:, 1] * 1e-9 * thrusts) ** 2)
        return np.sqrt(squares[: len(time_ns) - 1])


class Wrenches:
    """What actuators without thrusters were told to give: force and torque within their limits."""

    def __init__(
        self, scenario: Scenario, commands: Sequence[ActuatorCommand], simulated: bool
    ) -> None:
        safety = None if scenario.lab is None or simulated else scenario.lab.safety
        last = {c.effective_time_ns: c for c in commands}
        wrenches = []
        for c in last.values():
            force, torque = np.array(c.force_N), np.array(c.torque_N_m)
            if safety is not None:
                force, torque = limited_wrench(force, torque, safety)
            wrenches.append(limited(np.concatenate([force, torque]), scenario.chaser.wrench_max))
        self._from_s = np.array(list(last), dtype=float) * 1e-9
        self._wrenches = np.array(wrenches).reshape(-1, 6)
        steps = np.diff(self._from_s)[:, None]
        # Integrals of the wrench, and of its integral, at the beginning of each command.
        impulse = np.concatenate([np.zeros((1, 6)), np.cumsum(self._wrenches[:-1] * steps, axis=0)])
        grown = impulse[:-1] * steps + self._wrenches[:-1] * steps**2 / 2.0
        self._impulse, self._twice = (
            impulse,
            np.concatenate([np.zeros((1, 6)), np.cumsum(grown, 0)]),
        )

    @property
    def acted(self) -> bool:
        """Whether anything was commanded."""
        return bool(np.any(self._wrenches))

    def over(self, time_ns: IntArray, latencies: Sequence[ResponseDelay]) -> tuple[Array, Array]:
        """Return impulses and first moments of force and torque, each (latencies, K - 1, 6). See
        ``Pulses.over``.
        """
        found = [
            self._at(np.asarray(time_ns * 1e-9 - x.delay_s, dtype=float), x.lag_s)
            for x in latencies
        ]
        step_s = np.diff(time_ns)[:, None] * 1e-9
        impulses = [np.diff(once, axis=0) for once, _ in found]
        moments = [
            np.diff(twice, axis=0) - step_s / 2.0 * (once[1:] + once[:-1]) for once, twice in found
        ]
        return np.array(impulses), np.array(moments)

    lags = True
    """See ``Pulses.lags``."""

    def scattered(self, time_ns: IntArray, delay_s: float) -> Array:
        """Return the impulse (K - 1, 6) by whose share each component scatters between successive
        times (K,): of whole commands, when the next one acts. See ``Pulses.scattered``.
        """
        rows = np.searchsorted(time_ns * 1e-9, self._from_s[1:] + delay_s) - 1
        squares = np.zeros((len(time_ns) + 1, 6))  # the last row: before or after
        np.add.at(squares, rows, (np.diff(self._from_s)[:, None] * self._wrenches[:-1]) ** 2)
        return np.sqrt(squares[: len(time_ns) - 1])

    def _at(self, time_s: Array, lag_s: float) -> tuple[Array, Array]:
        """Return the integral of the wrench, and that of its integral, up to times (K,), each (K,
        6).
        """
        row = np.maximum(np.searchsorted(self._from_s, time_s, side="right") - 1, 0)
        since = np.maximum(time_s - self._from_s[row], 0.0)[:, None]
        once = self._impulse[row] + self._wrenches[row] * since
        twice = self._twice[row] + (self._impulse[row] + self._wrenches[row] * since / 2.0) * since
        if not lag_s:
            return once, twice
        # The lagging wrench y obeys lag y' = wrench - y, so its integral is short by lag y.
        lagging = np.zeros_like(self._wrenches)  # at the beginning of each command
        kept = np.exp(-np.diff(self._from_s) / lag_s)
        for k, share in enumerate(kept.tolist()):
            lagging[k + 1] = self._wrenches[k] + (lagging[k] - self._wrenches[k]) * share
        now = self._wrenches[row] + (lagging[row] - self._wrenches[row]) * np.exp(-since / lag_s)
        missing = lag_s * now
        return once - missing, twice - lag_s * (once - missing)


@dataclass(frozen=True, eq=False)
class RecordedRobot:
    """What a log knows of one robot."""

    scenario: Scenario
    chaser: int
    motion: MeasuredMotion
    actuators: Pulses | Wrenches

    @property
    def free_s(self) -> float:
        """Time in which the actuators alone moved the robot, s."""
        return float(np.diff(self.motion.time_ns)[self.motion.free].sum()) * 1e-9


def recorded_robot(source: str | Path, chaser: int) -> RecordedRobot:
    """Read the motion and the commands of a chaser. Raises IdentificationError, LogError."""
    log = open_log(source)
    scenario = log.scenario
    if chaser >= len(scenario.chasers):
        known = len(scenario.chasers)
        raise IdentificationError(f"{source}: no chaser {chaser}; its {known} are 0 to {known - 1}")
    if scenario.orbit is not None:
        raise IdentificationError(
            f"{source}: flown in an orbit, whose forces hide the robot's; record a run without "
            "[orbit]"
        )
    odometry: dict[int, Odometry] = {}
    commands: list[ActuatorCommand] = []
    touched: list[int] = []
    simulated = any(key.startswith("truth/") for key in log.counts)
    acts = [(0, simulated)]
    keys = [t.key_of(chaser) for t in (topics.ODOMETRY, topics.ACTUATORS, topics.DOCKING)]
    for message in log.messages(*keys, topics.EVENT):
        match message:
            case Odometry():
                odometry[message.sim_time_ns] = message
            case ActuatorCommand():
                commands.append(message)
            case DockingStatus() if message.contact or message.latched:
                touched.append(message.sim_time_ns)
            case Event(what=what) if what in _STARTS + _STOPS:
                acts.append((message.sim_time_ns, what in _STARTS))
            case _:
                pass
    who = f"{source}: chaser {chaser}"
    if not odometry:
        raise IdentificationError(f"{who}: no odometry; the log must hold {keys[0]}")
    commands.sort(key=lambda c: (c.effective_time_ns, c.seq))
    actuators = (
        Pulses(scenario, commands)
        if scenario.chaser.actuation == "thrusters"
        else Wrenches(scenario, commands, simulated)
    )
    if not commands or not actuators.acted:
        raise IdentificationError(f"{who}: no thrust was commanded; the log must hold {keys[1]}")
    motion = _motion([odometry[k] for k in sorted(odometry)], touched, acts)
    found = RecordedRobot(scenario, chaser, motion, actuators)
    if found.free_s < _LEAST_S:
        raise IdentificationError(
            f"{who}: {found.free_s:.1f} s in which only its actuators moved it; at least "
            f"{_LEAST_S:g} s, armed and untouched"
        )
    return found


def _motion(
    odometry: list[Odometry], touched: list[int], acts: list[tuple[int, bool]]
) -> MeasuredMotion:
    time_ns = np.array([o.sim_time_ns for o in odometry], dtype=np.int64)
    states = np.array(
        [[*o.position_m, *o.velocity_m_s, *o.q_wxyz, *o.omega_rad_s] for o in odometry]
    )
    covariances = np.array(
        [
            [
                o.position_covariance_m2,
                o.velocity_covariance_m2_s2,
                o.attitude_covariance_rad2,
                o.omega_covariance_rad2_s2,
            ]
            for o in odometry
        ]
    ).mean(axis=0)
    noise = np.zeros((12, 12))
    for k, covariance in enumerate(covariances):
        noise[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = covariance.reshape(3, 3)
    free = np.diff(time_ns) <= _MOST_GAP_NS
    begin, end = time_ns[:-1], time_ns[1:]
    for at_ns in touched:  # the sensor reports contact since the tick before
        free &= ~((end >= at_ns) & (begin <= at_ns))
    state = np.searchsorted([t for t, _ in acts], begin, side="right") - 1
    free &= np.array([acting for _, acting in acts])[np.maximum(state, 0)]
    for at_ns, acting in acts[1:]:
        if not acting:
            free &= ~((begin <= at_ns) & (end > at_ns))
    return MeasuredMotion(time_ns, states, noise, free)
