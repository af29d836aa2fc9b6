# SPDX-License-Identifier: Apache-2.0
"""Check each command of a chaser against its safe set, and change it as little as possible.

No I/O. The last stage before actuators: it does not know who commands. It knows the chaser's own
odometry, the capability of its thrusters, and the newest estimate of the target and the chasers.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    ActuatorCommand,
    AssuranceState,
    AssuranceStatus,
    Hazard,
    Level,
    Odometry,
    TargetEstimate,
    ThrusterReport,
)
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.schema import MAX_ESTIMATE_MARGIN_M

from .barriers import Barrier, Margin, OffsetEstimate, PortCorridor, distance_barriers
from .nearest_input import Conditions, nearest_input

_OLDEST_NS = 30_000_000_000
"""Age of an estimate of the target beyond which the target counts as unknown, ns: with a velocity
known to 1 mm/s (three sigmas of the grade `lab`) it may be 3 cm away from where it is expected."""
_HISTORY_S = 0.4
"""Time over which the velocity of another chaser is measured from its estimated positions, s. They
are known to 1 mm, the velocity so to 4 mm/s, and it lags by 0.2 s."""
_MOST_MARGIN_M_S = 0.01
"""Largest margin for errors of velocities, m/s: half the speed of a touch (`docking.tolerances`).
An estimate states more in its first second only."""
_PAUSE_NS = 1_000_000_000
"""Time without a change after which the next one is reported as a new event, ns."""
_RATE_SHARE = 0.99
"""Share of the greatest torque that slows a rate beyond its limit: less than all of it, so that
rounding does not make the condition unsatisfiable."""


@dataclass(frozen=True, eq=False)
class AssuredCommand:
    """The command to give, the thrusts (n,) that replace its allocation, and what was done.

    ``event``: level, what and detail, where a series of changes begins, worsens or has ended.
    """

    command: ActuatorCommand
    thrusts_N: Array | None
    status: AssuranceStatus
    event: tuple[Level, str, str] | None = None


@dataclass(frozen=True, eq=False)
class _Known:
    """An estimate of the target as arrays, in WRF: covariance (3, 3) of its velocity; of the
    chasers, in the order of ``row``, positions (n, 3) relative to it and their covariances (n, 3,
    3).
    """

    estimate: TargetEstimate
    velocity_covariance: Array
    row: dict[int, int]
    offsets_m: Array
    covariances_m2: Array

    @classmethod
    def of(cls, estimate: TargetEstimate) -> _Known:
        turn, relative = rotations.to_matrix(estimate.q_wxyz), estimate.relative
        covariances = np.array([r.covariance for r in relative]).reshape(-1, 6, 6)[:, :3, :3]
        return cls(
            estimate,
            np.array(estimate.covariance).reshape(12, 12)[3:6, 3:6],
            {r.chaser: k for k, r in enumerate(relative)},
            np.array([r.position_m for r in relative]).reshape(-1, 3) @ turn.T,
            turn @ covariances @ turn.T,
        )


@dataclass(frozen=True)
class _Series:
    """Changes of commands without a pause: time of the last one, how many, whether any needed the
    backup.
    """

    last_ns: int
    count: int
    backup: bool


class Assurance:
    """Assures the commands of one chaser.

    Call ``add_estimate`` with the estimates of the target, ``limit_by`` with what the thrusters can
    give, ``add_odometry`` with the newest odometry, then ``assure`` with every command.
    """

    def __init__(self, scenario: FlightScenario, chaser: int) -> None:
        section = scenario.assurance
        assert section is not None
        body, limits, docking = scenario.chaser, scenario.limits, scenario.docking
        self._scenario, self._chaser, self._body = scenario, chaser, body
        self._interval_s = 1.0 / scenario.time.rate_hz
        self._share, self._rate_rad_s = section.braking_share, math.radians(section.max_rate_deg_s)
        self._margin = Margin(
            limits.estimate_margin_sigmas, MAX_ESTIMATE_MARGIN_M, _MOST_MARGIN_M_S
        )
        self._inertia, self._limits = np.array(body.inertia), body.wrench_max
        self._moves = self._limits[:3] > 0.0
        port = docking.port_of(chaser)
        self._corridor = None if port is None else PortCorridor(port, body.probe_reach_m, docking)
        self._wrenches = wrench_matrix(body.thrusters) if body.actuation == "thrusters" else None
        kept = max(2, math.ceil(_HISTORY_S * scenario.time.rate_hz))
        self._known: deque[_Known] = deque(maxlen=kept)
        self._own: deque[Odometry] = deque(maxlen=kept + 2)
        self._given = np.zeros(6)
        self._series: _Series | None = None

    def add_estimate(self, estimate: TargetEstimate | None) -> None:
        """Take the newest estimate of the target."""
        if estimate is None or not estimate.is_known:
            return
        if not self._known or estimate.tick > self._known[-1].estimate.tick:
            self._known.append(_Known.of(estimate))

    def add_odometry(self, odometry: Odometry) -> None:
        """Take the chaser's newest odometry."""
        if not self._own or odometry.tick > self._own[-1].tick:
            self._own.append(odometry)

    def limit_by(self, report: ThrusterReport) -> None:
        """Take the capability of the chaser's thrusters."""
        self._limits = np.array([*report.force_max_N, *report.torque_max_N_m])

    def assure(
        self, command: ActuatorCommand, thrusts_N: Array | None, latched: bool
    ) -> AssuredCommand:
        """Return the command to give in place of ``command``.

        ``thrusts_N`` (n,): thrusts that were commanded in place of force and torque.
        """
        wrench = np.array([*command.force_N, *command.torque_N_m])
        if thrusts_N is not None and self._wrenches is not None:
            wrench = self._wrenches @ thrusts_N
        if latched or not self._own:
            return AssuredCommand(command, thrusts_N, self._status(command, "off", wrench))
        q, omega = self._attitude_at(command.effective_time_ns)
        barriers = self._barriers(command.effective_time_ns, q)
        on_force, on_torque = self._on_force(barriers, q), self._on_torque(omega)
        missed = {barriers[k].hazard for k in on_force.missed(wrench[:3])}
        state: AssuranceState = "unchanged" if barriers else "blind"
        if len(on_torque.missed(wrench[3:])):
            missed.add("rate")
        given = wrench
        if missed:
            force, force_satisfied = nearest_input(wrench[:3], on_force)
            torque, torque_satisfied = nearest_input(wrench[3:], on_torque)
            state = "changed" if force_satisfied and torque_satisfied else "backup"
            given = np.concatenate([force, torque])
            command = msgspec.structs.replace(
                command, force_N=vector(force), torque_N_m=vector(torque)
            )
            thrusts_N = None
        self._given = given
        status = self._status(command, state, wrench, missed, barriers)
        return AssuredCommand(command, thrusts_N, status, self._event(status))

    def _event(self, status: AssuranceStatus) -> tuple[Level, str, str] | None:
        """Return what is to be reported of a command, if anything."""
        series, now_ns = self._series, status.sim_time_ns
        if status.state in ("changed", "backup"):
            begins = series is None or (status.state == "backup" and not series.backup)
            count = 1 if series is None else series.count + 1
            backup = status.state == "backup" or (series is not None and series.backup)
            self._series = _Series(now_ns, count, backup)
            if not begins:
                return None
            room = "" if status.room_m is None else f"; room {status.room_m * 1e3:.0f} mm"
            how = "backup command" if status.state == "backup" else "command changed"
            return "warning", f"assurance: {how}", ", ".join(status.hazards) + room
        if series is None or now_ns - series.last_ns < _PAUSE_NS:
            return None
        self._series = None
        return "info", "assurance: commands unchanged again", f"{series.count} were changed"

    # -- what is known -----------------------------------------------------------------------------

    def _attitude_at(self, time_ns: int) -> tuple[Array, Array]:
        """Return attitude (4,) and rate (3,) of the chaser when the command takes effect."""
        own = self._own[-1]
        ahead_s = (time_ns - own.sim_time_ns) / 1e9
        omega = np.array(own.omega_rad_s)
        turned = rotations.integrate(np.array(own.q_wxyz), omega, ahead_s)
        return turned, omega + ahead_s * self._angular_acceleration(omega, self._given[3:])

    def _angular_acceleration(self, omega: Array, torque: Array) -> Array:
        """Return J^-1 (torque - omega x J omega), body axes, rad/s²."""
        return (torque - rotations.cross(omega, self._inertia * omega)) / self._inertia

    def _barriers(self, time_ns: int, q: Array) -> list[Barrier]:
        """Return the conditions on the force at ``time_ns``; none while the target is unknown."""
        own = self._own[-1]
        if not self._known:
            return []
        known = self._known[-1]
        age_ns = own.sim_time_ns - known.estimate.sim_time_ns
        if self._chaser not in known.row or age_ns > _OLDEST_NS:
            return []
        target, offset = self._of_target(known, own, time_ns)
        offsets, limits = self._of_all(known, own, offset), self._scenario.limits
        least_m = [limits.min_distance_target_m] + [limits.min_distance_chasers_m] * len(known.row)
        distances = distance_barriers(offsets, least_m[: len(known.row)], self._margin)
        if self._corridor is None or not self._corridor.holds(offset, target):
            return distances
        corridor = self._corridor.barriers(
            offset, target, q, self._braking_m_s2(), self._interval_s, self._margin
        )
        return [*corridor, *distances[1:]]

    def _braking_m_s2(self) -> float:
        return self._share * float(self._limits[:3][self._moves].min()) / self._body.mass_kg

    def _of_target(
        self, known: _Known, own: Odometry, time_ns: int
    ) -> tuple[BodyState, OffsetEstimate]:
        """Return the target, and the chaser's offset from it, both at ``time_ns``.

        From the estimate to the chaser's newest odometry the chaser has moved as that says; from
        there on it moves under the command before.
        """
        estimate, row = known.estimate, known.row[self._chaser]
        velocity, omega = np.array(estimate.velocity_m_s), np.array(estimate.omega_rad_s)
        age_s = (own.sim_time_ns - estimate.sim_time_ns) / 1e9
        ahead_s = (time_ns - own.sim_time_ns) / 1e9
        then = next((o for o in self._own if o.tick == estimate.tick), None)
        if then is None:  # too long ago: odometry and estimate share WRF
            position = np.subtract(own.position_m, estimate.position_m)
        else:
            position = known.offsets_m[row] + np.subtract(own.position_m, then.position_m)
        drift = np.subtract(own.velocity_m_s, velocity)
        pushed = rotations.rotate(own.q_wxyz, self._given[:3]) / self._body.mass_kg
        position = position - velocity * age_s + drift * ahead_s + 0.5 * pushed * ahead_s**2
        q_target = rotations.integrate(np.array(estimate.q_wxyz), omega, age_s + ahead_s)
        speed_covariance = (
            np.array(own.velocity_covariance_m2_s2).reshape(3, 3) + known.velocity_covariance
        )
        target = BodyState(np.array(estimate.position_m), velocity, q_target, omega)
        return target, OffsetEstimate(
            position,
            drift + pushed * ahead_s,
            known.covariances_m2[row] + (age_s + ahead_s) ** 2 * speed_covariance,
            speed_covariance,
        )

    def _of_all(self, known: _Known, own: Odometry, offset: OffsetEstimate) -> OffsetEstimate:
        """Return the chaser's offsets from the target and from the others, which move on as they
        did relative to the target.
        """
        now_ns, others = known.estimate.sim_time_ns, [c for c in known.row if c != self._chaser]
        firsts = [next(k for k in self._known if c in k.row) for c in others]
        rows = [known.row[c] for c in others]
        before = [k.offsets_m[k.row[c]] for k, c in zip(firsts, others, strict=True)]
        elapsed_s = [(now_ns - k.estimate.sim_time_ns) / 1e9 for k in firsts]
        span_s = np.array([s or self._interval_s for s in elapsed_s])[:, None]
        # Row 0 is the target: no offset from itself.
        at, velocity = np.zeros((2, len(known.row), 3))
        at[1:], its = known.offsets_m[rows], np.zeros((len(known.row), 3, 3))
        velocity[1:] = (at[1:] - np.array(before).reshape(-1, 3)) / span_s
        its[1:] = known.covariances_m2[rows]
        at += velocity * ((own.sim_time_ns - now_ns) / 1e9)
        positions = offset.position_covariance + its
        its[1:] /= span_s[..., None] ** 2
        return OffsetEstimate(
            offset.position_m - at,
            offset.velocity_m_s - velocity,
            positions,
            offset.velocity_covariance + its,
        )

    # -- conditions --------------------------------------------------------------------------------

    def _on_force(self, barriers: list[Barrier], q: Array) -> Conditions:
        """Return the conditions on the force for an attitude (4,)."""
        normals = np.array([b.normal for b in barriers]).reshape(-1, 3)
        braking_m_s2 = self._braking_m_s2()
        least = [b.least_acceleration(braking_m_s2, self._interval_s) for b in barriers]
        rows = rotations.rotate_inverse(q, normals) / self._body.mass_kg
        return Conditions(rows, np.array(least), self._limits[:3])

    def _on_torque(self, omega: Array) -> Conditions:
        """Return the condition that the rate (3,) stays within its limit, along its direction."""
        speed, limits = math.hypot(*omega.tolist()), self._limits[3:]
        if speed == 0.0:
            return Conditions(np.zeros((0, 3)), np.zeros(0), limits)
        about = omega / speed
        row = -about / self._inertia
        free = float(about @ self._angular_acceleration(omega, np.zeros(3)))
        least = free - (self._rate_rad_s - speed) / self._interval_s
        # A rate beyond its limit falls as fast as it can.
        able = _RATE_SHARE * float(np.abs(row) @ limits)
        return Conditions(row[None], np.array([min(least, able)]), limits)

    def _status(
        self,
        command: ActuatorCommand,
        state: AssuranceState,
        asked: Array,
        missed: Iterable[Hazard] = (),
        barriers: Iterable[Barrier] = (),
    ) -> AssuranceStatus:
        surfaces = [b for b in barriers if math.isfinite(b.room_m)]
        nearest = min(surfaces, key=lambda b: b.room_m, default=None)
        return AssuranceStatus(
            tick=command.tick,
            sim_time_ns=command.sim_time_ns,
            chaser=self._chaser,
            state=state,
            hazards=tuple(sorted(missed)),
            asked_force_N=vector(asked[:3]),
            asked_torque_N_m=vector(asked[3:]),
            room_m=None if nearest is None else nearest.room_m,
            nearest=None if nearest is None else nearest.hazard,
        )
