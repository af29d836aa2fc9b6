# SPDX-License-Identifier: Apache-2.0
"""Fly chasers whose commands mean harm, each with its assurance before the actuators.

The chasers are heavier or lighter than they believe, their thrust is wrong, their odometry and the
estimate of the target are noisy, and commands act late. Who commands knows the truth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from chaserdock_agents.chaser.assurance.assurance import Assurance
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    ActuatorCommand,
    AssuranceStatus,
    Odometry,
    RelativeEstimate,
    TargetEstimate,
)
from chaserdock_protocol.scenario import Scenario

Attack = Literal["ram", "chase", "random", "spin", "port"]
ATTACKS: tuple[Attack, ...] = ("ram", "chase", "random", "spin", "port")
"""Full force towards the target's centre; towards the nearest chaser; a new random wrench each
second; random force with a torque that speeds the rotation up; full force along a random direction
of the target from within the corridor."""


@dataclass(frozen=True)
class TruthErrors:
    """Errors of what a chaser believes: shares of mass and thrust (greatest), a force in N (along
    each axis), and standard deviations of measurements.
    """

    mass: float = 0.1
    thrust: float = 0.1
    force_N: float = 0.01
    position_m: float = 0.0005
    velocity_m_s: float = 0.001
    attitude_rad: float = 0.001
    target_m: float = 0.002


@dataclass(frozen=True)
class _Rigid:
    mass_kg: float
    inertia: tuple[float, float, float]


_TARGET = _Rigid(100.0, (6.0, 9.0, 11.0))
"""A target that tumbles freely, with three different moments of inertia (kg m²)."""


@dataclass
class AttackOutcome:
    """The worst of a flight, by the truth.

    ``*_room_m``: least distance beyond what must be kept from the target and between chasers, and
    from the corridor's cone within it. ``closing_m_s``: greatest closing speed in the corridor,
    ``touch_m_s`` at the port. A chaser that has touched its port is out of the flight.
    ``rate_rad_s``: greatest rate. ``states``: number of commands by what the assurance did.
    """

    target_room_m: float = math.inf
    chaser_room_m: float = math.inf
    corridor_room_m: float = math.inf
    closing_m_s: float = -math.inf
    touch_m_s: float = -math.inf
    gap_m: float = math.inf
    rate_rad_s: float = 0.0
    states: dict[str, int] = field(default_factory=dict)


class AssuredFlight:
    """Flies all chasers of a scenario under one attack; ``errors`` are drawn by ``seed``.

    ``assurances``: one of each chaser.
    """

    def __init__(
        self, scenario: Scenario, attack: Attack, seed: int, errors: TruthErrors | None = None
    ) -> None:
        self.scenario, self.attack = scenario, attack
        self.errors = errors or TruthErrors()
        self._rng = np.random.default_rng(seed)
        rng, e = self._rng, self.errors
        self._count = len(scenario.chasers)
        self._mass = 1.0 + e.mass * rng.uniform(-1.0, 1.0, self._count)
        self._thrust = 1.0 + e.thrust * rng.uniform(-1.0, 1.0, (self._count, 6))
        self._push_w = e.force_N * rng.uniform(-1.0, 1.0, (self._count, 3))
        self._target = np.concatenate(
            [
                rng.normal(size=3),
                0.02 * rng.normal(size=3),
                rotations.normalize(rng.normal(size=4)),
                rng.uniform(-0.05, 0.05, 3),
            ]
        )
        self._chasers = [self._start(i) for i in range(self._count)]
        self.assurances = [Assurance(scenario, i) for i in range(self._count)]
        self._asked = np.zeros((self._count, 6))
        self._direction = np.zeros((self._count, 3))
        self._touched: set[int] = set()

    def _start(self, i: int) -> Array:
        """Return the state (13,) of a chaser at rest relative to the target."""
        s, target = self.scenario, self._target
        offset, q_off = s.start_pose(i)[0], np.array([1.0, 0.0, 0.0, 0.0])
        port = s.docking.port_of(i)
        if self.attack == "port" and port is not None:
            offset = centre_offset(port, s.chaser.probe_reach_m, s.docking.entry_m)
            q_off = _facing(-np.asarray(port.axis))
        away = rotations.rotate(target[6:10], offset)
        spin = rotations.rotate(target[6:10], target[10:13])
        q = rotations.multiply(target[6:10], q_off)
        velocity = target[3:6] + np.cross(spin, away)
        omega = rotations.rotate_inverse(q, spin)
        return np.concatenate([target[:3] + away, velocity, q, omega])

    def fly(self, duration_s: float) -> AttackOutcome:
        """Return the outcome after ``duration_s``."""
        outcome, timing = AttackOutcome(), self.scenario.timing
        given = [np.zeros(6)] * self._count
        late_s = (timing.effective_ns(0)) / 1e9
        interval_s = 1.0 / self.scenario.time.rate_hz
        before: TargetEstimate | None = None
        for tick in range(round(duration_s / interval_s)):
            time_ns = round(tick * interval_s * 1e9)
            if tick % self.scenario.time.rate_hz == 0:
                self._redraw()
            statuses = []
            now = self._estimate(tick, time_ns)
            commands = [self._command(i, tick, time_ns) for i in range(self._count)]
            following = []
            for i, (assurance, command) in enumerate(zip(self.assurances, commands, strict=True)):
                assurance.add_estimate(before)
                assurance.add_odometry(self._odometry(i, tick, time_ns))
                assured = assurance.assure(command, None, latched=False)
                statuses.append(assured.status)
                following.append(np.array([*assured.command.force_N, *assured.command.torque_N_m]))
            self._move(given, late_s)
            given = following
            self._move(given, interval_s - late_s)
            before = now
            self._judge(outcome, statuses)
        return outcome

    def _redraw(self) -> None:
        """Draw a new random command of each chaser."""
        full = self.scenario.chaser.wrench_max
        self._asked = self._rng.choice([-1.0, 1.0], (self._count, 6)) * full
        self._direction = self._rng.normal(size=(self._count, 3))

    def _command(self, i: int, tick: int, time_ns: int) -> ActuatorCommand:
        """Return the harmful command of a chaser."""
        state, wrench = self._chasers[i], self._asked[i].copy()
        full = self.scenario.chaser.wrench_max
        towards: Array | None = None
        if self.attack == "ram":
            towards = self._target[:3] - state[:3]
        elif self.attack == "chase" and self._count > 1:
            others = [c[:3] - state[:3] for j, c in enumerate(self._chasers) if j != i]
            towards = min(others, key=lambda r: float(np.linalg.norm(r)))
        elif self.attack == "port":
            towards = rotations.rotate(self._target[6:10], self._direction[i])
            port = self.scenario.docking.port_of(i)
            if port is not None and self._rng.random() < 0.7:
                towards = rotations.rotate(self._target[6:10], -np.asarray(port.axis))
            wrench[3:] = self._attitude_hold(i)
        if towards is not None:
            body = rotations.rotate_inverse(state[6:10], towards)
            wrench[:3] = full[:3] * body / np.abs(body).max()
        if self.attack == "spin":
            wrench[3:] = full[3:] * np.where(state[10:13] >= 0.0, 1.0, -1.0)
        wrench = np.clip(wrench, -full, full)
        return ActuatorCommand(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=i,
            effective_time_ns=self.scenario.timing.effective_ns(tick),
            source="command",
            force_N=vector(wrench[:3]),
            torque_N_m=vector(wrench[3:]),
        )

    def _attitude_hold(self, i: int) -> Array:
        """Return the torque (3,) that keeps +X along the inward axis of the chaser's port."""
        state, target = self._chasers[i], self._target
        port = self.scenario.docking.port_of(i)
        inward = (1.0, 0.0, 0.0) if port is None else -np.asarray(port.axis)
        wanted = rotations.multiply(target[6:10], _facing(np.asarray(inward)))
        error = rotations.log(rotations.multiply(rotations.conjugate(state[6:10]), wanted))
        spin = rotations.rotate(target[6:10], target[10:13])
        rate = rotations.rotate_inverse(state[6:10], spin) - state[10:13]
        return np.array(self.scenario.chaser.inertia) * (0.5 * error + 1.2 * rate)

    def _move(self, wrenches: list[Array], duration_s: float) -> None:
        """Move all bodies under constant wrenches."""
        if duration_s <= 0.0:
            return
        body = self.scenario.chaser
        for i, wrench in enumerate(wrenches):
            state = self._chasers[i]
            true = wrench * self._thrust[i]
            true[:3] += rotations.rotate_inverse(state[6:10], self._push_w[i])
            true[:3] /= self._mass[i]
            self._chasers[i] = propagate(state, true, body, duration_s)
        self._target = propagate(self._target, np.zeros(6), _TARGET, duration_s)

    def _odometry(self, i: int, tick: int, time_ns: int) -> Odometry:
        state, e, rng = self._chasers[i], self.errors, self._rng
        turn = rotations.exp(e.attitude_rad * rng.normal(size=3))
        speed = e.velocity_m_s**2 * np.eye(3)
        return Odometry(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=i,
            position_m=vector(state[:3] + e.position_m * rng.normal(size=3)),
            velocity_m_s=vector(state[3:6] + e.velocity_m_s * rng.normal(size=3)),
            q_wxyz=vector(rotations.multiply(state[6:10], turn)),
            omega_rad_s=vector(state[10:13]),
            velocity_covariance_m2_s2=vector(speed.ravel()),
        )

    def _estimate(self, tick: int, time_ns: int) -> TargetEstimate:
        target, e, rng = self._target, self.errors, self._rng
        relative = []
        for i, state in enumerate(self._chasers):
            off = rotations.rotate_inverse(target[6:10], state[:3] - target[:3])
            q_off = rotations.multiply(rotations.conjugate(target[6:10]), state[6:10])
            covariance = np.diag([e.target_m**2] * 3 + [e.attitude_rad**2] * 3)
            relative.append(
                RelativeEstimate(
                    chaser=i,
                    position_m=vector(off + e.target_m * rng.normal(size=3)),
                    q_wxyz=vector(q_off),
                    covariance=vector(covariance.ravel()),
                    force_N=(0.0, 0.0, 0.0),
                    torque_N_m=(0.0, 0.0, 0.0),
                )
            )
        covariance = np.diag([e.target_m**2] * 3 + [1e-6] * 9)
        return TargetEstimate(
            tick=tick,
            sim_time_ns=time_ns,
            status="tracking",
            position_m=vector(target[:3]),
            velocity_m_s=vector(target[3:6] + 0.0005 * rng.normal(size=3)),
            q_wxyz=vector(target[6:10]),
            omega_rad_s=vector(target[10:13]),
            covariance=vector(covariance.ravel()),
            accepted=(),
            rejected=(),
            relative=tuple(relative),
        )

    def _judge(self, outcome: AttackOutcome, statuses: list[AssuranceStatus]) -> None:
        """Add the state of the truth, and what the assurances did, to the outcome."""
        limits, target = self.scenario.limits, self._target
        for i, state in enumerate(self._chasers):
            if i in self._touched:
                continue
            outcome.rate_rad_s = max(outcome.rate_rad_s, float(np.linalg.norm(state[10:13])))
            away = rotations.rotate_inverse(target[6:10], state[:3] - target[:3])
            inside = self._in_corridor(i, away, state, outcome)
            if not inside:
                room = float(np.linalg.norm(away)) - limits.min_distance_target_m
                outcome.target_room_m = min(outcome.target_room_m, room)
            for j in set(range(i)) - self._touched:
                apart = float(np.linalg.norm(state[:3] - self._chasers[j][:3]))
                outcome.chaser_room_m = min(
                    outcome.chaser_room_m, apart - limits.min_distance_chasers_m
                )
        for status in statuses:
            outcome.states[status.state] = outcome.states.get(status.state, 0) + 1

    def _in_corridor(self, i: int, away: Array, state: Array, outcome: AttackOutcome) -> bool:
        docking, target = self.scenario.docking, self._target
        port = docking.port_of(i)
        if port is None:
            return False
        axis = np.asarray(port.axis)
        off = away - np.asarray(port.position_m)
        gap = float(off @ axis) - self.scenario.chaser.probe_reach_m
        aside = float(np.linalg.norm(off - (off @ axis) * axis))
        slope = math.tan(math.radians(docking.corridor_angle_deg))
        room = 2.0 * docking.corridor.lateral_m + slope * gap - aside
        if room < 0.0:
            return False
        velocity = rotations.rotate_inverse(target[6:10], state[3:6] - target[3:6])
        velocity = velocity - np.cross(target[10:13], away)
        if gap < docking.entry_m:
            outcome.closing_m_s = max(outcome.closing_m_s, -float(velocity @ axis))
        outcome.corridor_room_m = min(outcome.corridor_room_m, room)
        outcome.gap_m = min(outcome.gap_m, gap)
        if gap <= 0.0:
            self._touched.add(i)
            outcome.touch_m_s = max(outcome.touch_m_s, -float(velocity @ axis))
        return True


def _facing(ahead: Array) -> Array:
    """Return an attitude (4,) whose +X points along ``ahead`` (3,)."""
    side = np.cross([0.0, 0.0, 1.0], ahead)
    if np.linalg.norm(side) < 1e-6:
        side = np.cross([0.0, 1.0, 0.0], ahead)
    side = side / np.linalg.norm(side)
    return rotations.from_matrix(np.column_stack([ahead, side, np.cross(ahead, side)]))


def worst(scenario: Scenario, attack: Attack, seeds: range, duration_s: float) -> AttackOutcome:
    """Return the worst of flights over seeds."""
    out = AttackOutcome()
    for seed in seeds:
        one = AssuredFlight(scenario, attack, seed).fly(duration_s)
        for name in ("target_room_m", "chaser_room_m", "corridor_room_m", "gap_m"):
            setattr(out, name, min(getattr(out, name), getattr(one, name)))
        for name in ("closing_m_s", "touch_m_s", "rate_rad_s"):
            setattr(out, name, max(getattr(out, name), getattr(one, name)))
        for state, count in one.states.items():
            out.states[state] = out.states.get(state, 0) + count
    return out
