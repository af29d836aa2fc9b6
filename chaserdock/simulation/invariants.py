# SPDX-License-Identifier: Apache-2.0
"""What must hold in every simulated flight, whatever fails: checked on all published messages, at
every tick.

The checks see messages only, and trust none of the processes: who commands follows from what the
chasers flew.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from chaserdock_controller.guidance.approach_cone import cone_of
from chaserdock_controller.guidance.trajectories import PEAK_SPEED
from chaserdock_controller.ingest.lost_chasers import MOST_M as LOST_MARGIN_M
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, length
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.relative_motion import relative_acceleration, relative_torque
from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.leases import commander_of
from chaserdock_protocol.messages import (
    ActuatorCommand,
    BodyTruth,
    DockingStatus,
    DrawnBody,
    DrawnTruth,
    Event,
    MissionEnd,
    Plan,
    Reference,
    RelativeEstimate,
    Sighting,
    TargetEstimate,
    ThrusterReport,
    Tick,
    WorldTruth,
    WrenchCommand,
)
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.faults import LATCH_FAULTS, Fault
from chaserdock_protocol.transport import RawSample
from chaserdock_world.orbit import TargetOrbit

from chaserdock.analysis.criteria import nearest_allowed_m
from chaserdock.analysis.pose_errors import (
    normalized_square,
    pose_covariance,
    pose_error,
    relative_pose,
)

from .message_checks import defects_of
from .network import EPOCH_NS, decode_once

SAFE_PHASES = frozenset(
    {"hold", "retreat", "abort", "wait", "searching", "acquire", "goto", "calibrate", "inspect"}
)
"""Phases in which a chaser keeps its distance, if their reason is in the log."""
KEEP_OUT_SLACK_M = 0.02
RETREAT_SLACK_M = 0.15
"""A reference that moves inwards at up to 8 cm/s turns within this distance."""
TURNING_S, HOMING_SLACK_M = 5.0, 0.03
"""Time (s) after which a retreat leads to the nominal place, and the noise of its reference."""
SETTLING_S, STOPPING_S = 15.0, 3.0
"""Time (s) after the last warning or command until a chaser has docked or is safe, at least the
time that an approach takes; and until a chaser that is in motion has stopped."""
BRAKING_S = 20.0
"""Longest time (s) in which a chaser without a controller brakes."""
DRIFT_ERROR_M = 0.1
"""Largest error (m) of the position to which a lost chaser is extrapolated."""
_NAMED_IN = ("hold", "retreat", "abort", "goto", "calibrate", "inspect")
ATTACHED = frozenset({"latched", "verified", "identify", "detumble", "stack_hold"})
DOCKED = ATTACHED | {"docked"}
DETUMBLING = frozenset({"identify", "detumble", "stack_hold"})
_TUMBLE_SHARE, _TUMBLE_FLOOR_N_M_S = 0.05, 0.02
"""By how much the angular momentum of a stack may rise above its least while it is stopped: share
of its first value, floor.
"""
_IMPULSE_SHARE, _IMPULSE_FLOOR_N_S = 0.02, 2e-5
_ANGULAR_FLOOR_N_M_S, _ARM_M = 2e-5, 0.1
_CONSERVED_SHARE = 2e-3
_SPUN_SHARE = 1e-5
"""Largest unexplained change of angular momentum in a tick in an orbit, as a share of it; the
turning frame gives 7e-5.
"""
_DISPLACEMENT_FLOOR_M = 2e-5
_ROUNDING = 1e-6
LATE_JITTERS = 6.0
"""Sum of the delays of three messages in mean jitters, which one in 16 exceeds."""
KNOWN_AFTER_S = 0.1
"""Time (s), in addition to the latency, after which a tick is known to a chaser that is not frozen.
"""
FOLLOWING_S = 3.0
"""Longest time (s) in which a chaser flies none of the commands that are published for it, unless a
fault lasts.
"""
_GAP_S = 1.1
"""Commands that pause for longer, at a hand-over, are published again."""
_HARMLESS = frozenset({"camera_off", "lying_sensor", "odometry_lie", "duplicate"})
"""Kinds of faults after which a chaser flies commands nevertheless."""
_LIES = frozenset({"odometry_lie", "clock_jump", "corrupt"})
_BESIDE_DAMAGE = frozenset({"corrupt", "flood", "duplicate"})
"""Kinds of faults beside which the controller still receives sightings, damaged or not."""
ACCURACY_M, SEEN_S = 0.01, 0.5
"""Largest error (m) of the target's position beside drift, while two honest chasers see it, or saw
it so long (s) ago.
"""
DAMAGED_SIGHTINGS = 100.0
"""Number of damaged sightings of which the controller names at least one as invalid; about one in
14 decodes and is.
"""
_THRUSTER_FLOOR_N_S, _THRUSTER_SHARE = 0.01, 0.15
_PLAN_SHARE = 1e-3


@dataclass(frozen=True)
class Violation:
    """An invariant that did not hold: its name, the mission time (s), and what was found."""

    invariant: str
    time_s: float
    text: str

    def __str__(self) -> str:
        return f"{self.invariant} at {self.time_s:.2f} s: {self.text}"


@dataclass
class Invariants:
    """Checks the messages of one flight as they are published; each violation is noted once per
    subject.

    ``reasons``: warnings and errors in the log. ``reason_s``: time of the last one that concerns a
    chaser. ``dead``: processes that were lost, and chasers that no command has reached, until these
    have flown commands for ``STOPPING_S``. ``nees``: normalized squared errors of the estimated
    pose of the target, one a second (6 on average if consistent).
    """

    scenario: Scenario
    violations: list[Violation] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    relative_nees: list[float] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    reason_s: dict[int, float] = field(default_factory=dict)
    end: MissionEnd | None = None
    phases: dict[int, str] = field(default_factory=dict)
    dead: set[str] = field(default_factory=set)
    _lost: set[str] = field(default_factory=set)
    _returned_s: dict[str, float] = field(default_factory=dict)
    _seen: set[tuple[str, str]] = field(default_factory=set)
    _tick: int = -1
    _opened: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=200))
    _state_tick: int = -1
    _bodies: list[BodyTruth] = field(default_factory=list)
    _states: dict[str, BodyTruth] = field(default_factory=dict)
    _drawn: dict[str, Any] = field(default_factory=dict)
    _flown: dict[int, ActuatorCommand] = field(default_factory=dict)
    _sources: dict[int, str] = field(default_factory=dict)
    _commanders: dict[int, str] = field(default_factory=dict)
    _controllers: dict[str, str] = field(default_factory=dict)
    _controller_lost: set[int] = field(default_factory=set)
    _term_ticks: dict[int, tuple[int, int]] = field(default_factory=dict)
    _touching: set[str] = field(default_factory=set)
    _begin: dict[str, float] = field(default_factory=dict)
    _commanded: dict[int, int] = field(default_factory=dict)
    _following: dict[int, int] = field(default_factory=dict)
    _latched: set[int] = field(default_factory=set)
    _probing: set[str] = field(default_factory=set)
    _retreats_from_m: dict[int, float] = field(default_factory=dict)
    _homing_m: dict[int, tuple[str, Array]] = field(default_factory=dict)
    _planned: dict[int, Plan] = field(default_factory=dict)
    _seen_s: dict[int, float] = field(default_factory=dict)
    _damaged: float = 0.0
    _sighted: dict[int, int] = field(default_factory=dict)
    _braking_s: dict[int, float] = field(default_factory=dict)
    _without_pulse_N_s: dict[int, tuple[int, Array]] = field(default_factory=dict)
    _unexplained: dict[int, Array] = field(default_factory=dict)
    _given_N_s: dict[int, float] = field(default_factory=dict)
    _tumble_N_m_s: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        self._lifetime_ticks = math.ceil(
            self.scenario.controller.command_lifetime_s * self.scenario.time.rate_hz
        )
        self._orbit = None if self.scenario.orbit is None else TargetOrbit(self.scenario.orbit)
        self._now_s, self._sender = 0.0, ""
        self._truth = self.scenario.truth.mismatch("chaser")
        self._nearest_m = {
            f"chaser/{i}": nearest_allowed_m(self.scenario, i)
            for i in range(len(self.scenario.chasers))
        }
        self._cones = {
            f"chaser/{p.chaser}": cone_of(self.scenario, p.chaser)
            for p in self.scenario.docking.ports
        }
        self._retreats_to_m = [
            _retreat_goals(self.scenario, i) for i in range(len(self.scenario.chasers))
        ]
        self._liars = {f.process for f in self.scenario.fault if f.kind == "lying_sensor"}
        self._handlers: dict[type, Callable[[Any], None]] = {
            Tick: self._on_tick,
            DockingStatus: self._on_docking,
            WorldTruth: self._on_world,
            DrawnTruth: self._on_drawn,
            BodyTruth: self._on_body,
            ActuatorCommand: self._on_command,
            WrenchCommand: self._on_wrench,
            TargetEstimate: self._on_estimate,
            Reference: self._on_reference,
            Sighting: self._on_sighting,
            Plan: self._on_plan,
            ThrusterReport: self._on_thrusters,
            Event: self._on_event,
            MissionEnd: self._on_end,
        }

    @property
    def time_s(self) -> float:
        """Mission time of the newest tick (s)."""
        return max(0, self._tick, self._state_tick) / self.scenario.time.rate_hz

    @property
    def ticks(self) -> int:
        """Number of ticks flown so far."""
        return 1 + max(self._tick, self._state_tick)

    @property
    def to_dock(self) -> list[int]:
        """Chasers that are to dock or to latch, and are commanded to approach before the end."""
        s, success = self.scenario, self.scenario.success
        rows = [e for e in s.timeline if e.command == "approach" and e.at_s < s.duration_s]
        return sorted({i for e in rows for i in e.chasers} & {*success.docked, *success.latched})

    def violate(self, invariant: str, subject: str, text: str) -> None:
        """Note a violation, unless one of the same invariant and subject is noted already."""
        if (invariant, subject) not in self._seen:
            self._seen.add((invariant, subject))
            self.violations.append(Violation(invariant, self.time_s, f"{subject}: {text}"))

    def observe(self, sender: str, raw: RawSample) -> None:
        """Check a message when it is published."""
        found = topics.topic_of_key(raw.key)
        try:
            if found is None:
                raise Rejected("key", f"unknown key {raw.key}")
            message = decode_once(found[0].kind, raw.payload, raw.encoding)
        except Rejected as refusal:
            self.violate("valid messages", sender, f"{raw.key}: {refusal}")
            return
        for text in defects_of(message, self.scenario):
            self.violate("valid messages", raw.key, text)
        self._now_s, self._sender = self._clock_s(sender, raw.sent_ns), sender
        handle = self._handlers.get(type(message))
        if handle is not None:
            handle(message)

    # -- bodies ------------------------------------------------------------------------------------

    def _on_tick(self, tick: Tick) -> None:
        if tick.tick == self._tick and len(tick.controllers) < len(self._controllers):
            self._controller_lost.add(tick.tick)
        self._lost.difference_update(f"chaser/{i}" for i in tick.chasers)
        if tick.tick > self._tick:
            self._controllers = tick.controllers
            self._opened.append((self._now_s, tick.tick))
            self._tick = tick.tick
            self._check_distances()

    def _on_world(self, world: WorldTruth) -> None:
        self._state_tick = world.tick
        for a, b in world.contacts:
            # A chaser that no command reaches drifts; its contacts are not counted.
            if not {a, b} & self.dead and not ("target" in (a, b) and self._is_misled()):
                self.violate("no contact", f"{a} and {b}", "bodies touch")
        for i in self._latched - set(world.latched):
            if self.phases.get(i) in ATTACHED and not self._latch_may_open(i):
                self.violate(
                    "latch holds", f"chaser/{i}", f"its latch opens in phase {self.phases[i]}"
                )
        held = self._latched | set(world.latched)  # also until a release within this tick
        self._latched = set(world.latched)
        self._touching = {n for pair in world.contacts for n in pair} | {
            f"chaser/{i}" for i in held
        }
        self._touching |= {f"chaser/{t.chaser}" for t in world.touches} | self._probing
        self._probing.clear()
        for body in self._bodies:
            self._check_body(body)
        self._bodies.clear()
        self._check_stack()

    def _on_docking(self, status: DockingStatus) -> None:
        """Note a probe in contact, also one whose latch has opened: the world publishes it before
        the bodies of the tick.
        """
        if status.contact:
            self._probing.add(f"chaser/{status.chaser}")

    def _on_drawn(self, drawn: DrawnTruth) -> None:
        self._drawn = {body.body: body for body in drawn.bodies}

    def _on_body(self, body: BodyTruth) -> None:
        self._bodies.append(body)

    def _check_body(self, body: BodyTruth) -> None:
        before = self._states.get(body.body)
        self._states[body.body] = body
        if body.body in self._touching or (body.body == "target" and self._touching):
            self._begin.clear()
            return
        if before is None:
            self._check_start(body)
        if before is None or body.tick != before.tick + 1:
            return
        self._check_displacement(before, body)
        if body.body == "target":
            self._check_target(before, body)
        else:
            self._check_momentum(before, body)

    def _check_start(self, body: BodyTruth) -> None:
        """Compare the first pose of a body with that of the scenario."""
        if body.tick != 0:
            return
        target = self.scenario.target
        position, q = np.array(target.position_m), np.array(target.q_wxyz)
        if body.body != "target":
            position, q = self.scenario.start_pose(int(body.body.partition("/")[2]))
        error_m = _distance(position, np.array(body.position_m))
        error_rad = float(rotations.angle_between(q, np.array(body.q_wxyz)))
        if max(error_m, error_rad) > _ROUNDING:
            text = f"begins {error_m:.2e} m and {error_rad:.2e} rad from its pose in the scenario"
            self.violate("initial state", body.body, text)

    def _check_displacement(self, before: BodyTruth, after: BodyTruth) -> None:
        """Compare the displacement of a body with its velocity: they differ by a changing force
        only.
        """
        dt_s = 1.0 / self.scenario.time.rate_hz
        mean = np.add(before.velocity_m_s, after.velocity_m_s) / 2.0
        error_m = _distance(np.array(after.position_m), np.array(before.position_m) + mean * dt_s)
        gained_m_s = _distance(np.array(before.velocity_m_s), np.array(after.velocity_m_s))
        drawn = self._drawn.get(after.body)
        pushed_m_s = after.absolute_impulse_N_s / drawn.mass_kg if drawn is not None else 0.0
        off_m = 0.0 if drawn is None else math.hypot(*drawn.centre_of_mass_m)
        turned_rad = (math.hypot(*after.omega_rad_s) + math.hypot(*before.omega_rad_s)) * dt_s
        allowed_m = _DISPLACEMENT_FLOOR_M + (gained_m_s + pushed_m_s) * dt_s + off_m * turned_rad
        if error_m > allowed_m:
            text = f"moved {error_m:.2e} m more than its velocity explains, {allowed_m:.2e} allowed"
            self.violate("displacement", after.body, text)

    def _check_momentum(self, before: BodyTruth, after: BodyTruth) -> None:
        """Compare the changes of a chaser's momentum and angular momentum with what its actuators
        and disturbances give.
        """
        drawn = self._drawn.get(after.body)
        if self.scenario.plume is not None and len(self.scenario.chasers) > 1:
            return  # plumes of the others push it
        if drawn is None or any(
            drawn.centre_of_mass_m
        ):  # the body's origin is not its centre of mass then
            return
        truth, dt_s = self._truth, 1.0 / self.scenario.time.rate_hz
        impulse = np.array(after.impulse_N_s) + np.array(drawn.force_N) * dt_s
        halfway = rotations.integrate(
            np.array(before.q_wxyz), np.array(before.omega_rad_s), 0.5 * dt_s
        )
        linear, turning = self._orbital_impulse(before, drawn)
        gained = (
            drawn.mass_kg * (np.array(after.velocity_m_s) - np.array(before.velocity_m_s)) - linear
        )
        error = length(gained - rotations.rotate(halfway, impulse))
        turned = math.hypot(*after.omega_rad_s) * dt_s
        allowed = _IMPULSE_FLOOR_N_S + (_IMPULSE_SHARE + turned) * (
            after.absolute_impulse_N_s + math.hypot(*drawn.force_N) * dt_s
        )
        if error > allowed + 5.0 * truth.force_noise_N * dt_s:
            self.violate(
                "momentum", after.body, f"{error:.2e} N s without a cause, {allowed:.2e} allowed"
            )
        inertia = np.array(drawn.inertia_kg_m2).reshape(3, 3)
        angular = np.array(after.angular_impulse_N_m_s) + np.array(drawn.torque_N_m) * dt_s
        spun = rotations.rotate(after.q_wxyz, inertia @ after.omega_rad_s)
        spun = spun - rotations.rotate(before.q_wxyz, inertia @ before.omega_rad_s) - turning
        error = length(spun - rotations.rotate(halfway, angular))
        allowed = _ANGULAR_FLOOR_N_M_S + (_IMPULSE_SHARE + turned) * (
            float(np.abs(angular).sum()) + _ARM_M * after.absolute_impulse_N_s
        )
        if error > allowed + 5.0 * truth.torque_noise_N_m * dt_s:
            text = f"{error:.2e} N m s without a cause, {allowed:.2e} allowed"
            self.violate("angular momentum", after.body, text)

    def _orbital_impulse(self, before: BodyTruth, drawn: DrawnBody) -> tuple[Array, Array]:
        """Return the changes (3,) of momentum and angular momentum, WRF, that the orbit gives a
        body in a tick; 0 in free space."""
        if self._orbit is None:
            return np.zeros(3), np.zeros(3)
        dt_s = 1.0 / self.scenario.time.rate_hz
        middle_s = (before.tick + 0.5) * dt_s
        frame = self._orbit.frame_at(middle_s)
        x, y, z = before.position_m
        acceleration = np.array(relative_acceleration(frame, (x, y, z), before.velocity_m_s))
        if before.body != "target":
            acceleration += self._orbit.differential_drag(middle_s)
        moments, axes = np.linalg.eigh(np.array(drawn.inertia_kg_m2).reshape(3, 3))
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        q = rotations.multiply(np.array(before.q_wxyz), rotations.from_matrix(axes))
        a, b, c = (np.array(before.omega_rad_s) @ axes).tolist()
        ia, ib, ic = moments.tolist()
        torque = relative_torque(frame, q.tolist(), (a, b, c), (ia, ib, ic))
        return drawn.mass_kg * acceleration * dt_s, rotations.rotate(q, torque) * dt_s

    def _check_target(self, before: BodyTruth, body: BodyTruth) -> None:
        """Compare the untouched target's motion with what its kind of motion conserves; in an
        orbit, with what that gives.
        """
        drawn = self._drawn.get("target")
        if drawn is None or self.scenario.plume is not None:
            return  # plumes push it
        if self._orbit is not None and self.scenario.target.motion == "torque_free":
            self._check_target_in_orbit(before, body, drawn)
            return
        omega, velocity = np.array(body.omega_rad_s), np.array(body.velocity_m_s)
        inertia = np.array(drawn.inertia_kg_m2).reshape(3, 3)
        conserved = {"rotational energy": 0.5 * float(omega @ inertia @ omega)}
        if not any(drawn.centre_of_mass_m):
            conserved["speed"] = length(velocity)
        if self.scenario.target.motion == "torque_free":
            momentum = rotations.rotate(np.array(body.q_wxyz), inertia @ omega)
            conserved |= {
                f"angular momentum {axis}": float(x)
                for axis, x in zip("xyz", momentum, strict=True)
            }
        scale = length(inertia @ omega)
        for name, value in conserved.items():
            begin = self._begin.setdefault(name, value)
            size = max(abs(begin), scale if name.startswith("angular") else abs(begin), 1e-9)
            if abs(value - begin) > _CONSERVED_SHARE * size:
                self.violate(
                    "energy and momentum", "target", f"{name} from {begin:.6g} to {value:.6g}"
                )

    def _check_stack(self) -> None:
        """Check that the angular momentum of target and latched chasers does not rise while they
        stop its tumble.
        """
        names = ["target", *(f"chaser/{i}" for i in sorted(self._latched))]
        stopping = any(self.phases.get(i) in DETUMBLING for i in self._latched)
        known = self._states.keys() & self._drawn.keys()
        if not stopping or not known.issuperset(names) or self._device_disturbed(self.time_s):
            self._tumble_N_m_s = None
            return
        now = float(
            np.linalg.norm(_angular_momentum([(self._states[n], self._drawn[n]) for n in names]))
        )
        first, least = self._tumble_N_m_s or (now, now)
        self._tumble_N_m_s = (first, min(least, now))
        if now > least + _TUMBLE_SHARE * first + _TUMBLE_FLOOR_N_M_S:
            text = f"the angular momentum of the stack rises from {least:.3g} to {now:.3g} N m s"
            self.violate("tumble falls", "target", text)

    def _device_disturbed(self, now_s: float) -> bool:
        """Return whether thrusters may give something else than commanded: failures, lost or late
        messages, recent faults.
        """
        s = self.scenario
        recent = any(f.at_s <= now_s <= f.at_s + (f.duration_s or 0.0) + 2.0 for f in s.fault)
        return bool(s.thruster_failure or recent or self._may_be_late())

    def _check_target_in_orbit(self, before: BodyTruth, body: BodyTruth, drawn: DrawnBody) -> None:
        """Compare the change of the free target's angular momentum in a tick with what the orbit
        gives.
        """
        inertia = np.array(drawn.inertia_kg_m2).reshape(3, 3)
        spun = [rotations.rotate(s.q_wxyz, inertia @ s.omega_rad_s) for s in (before, body)]
        _, given = self._orbital_impulse(before, drawn)
        error = length(spun[1] - spun[0] - given)
        allowed = _SPUN_SHARE * length(spun[1]) + 1e-12
        if error > allowed:
            text = f"target: {error:.2e} N m s without a cause, {allowed:.2e} allowed"
            self.violate("energy and momentum", "target", text)

    def _check_distances(self) -> None:
        states, target = self._states, self._states.get("target")
        chasers = {
            n: np.array(s.position_m)
            for n, s in states.items()
            if n != "target" and n not in self.dead
        }
        limit_m = self.scenario.limits.min_distance_chasers_m - KEEP_OUT_SLACK_M
        for (a, at), (b, bt) in itertools.combinations(chasers.items(), 2):
            if (distance_m := _distance(at, bt)) < limit_m:
                self.violate("keep-out zone", f"{a} and {b}", f"{distance_m:.3f} m apart")
        if target is None or self._is_misled():
            return
        for name, at in chasers.items():
            if name in self._touching:
                continue
            offset = rotations.rotate_inverse(target.q_wxyz, at - target.position_m)
            distance_m = length(offset)
            if distance_m < self._nearest_allowed_m(name, offset) - KEEP_OUT_SLACK_M:
                self.violate("keep-out zone", name, f"{distance_m:.3f} m from the target")

    def _is_misled(self) -> bool:
        """Return whether the sensors of half of the chasers lie, or lied until recently: who is
        honest cannot be known then.
        """
        lies = [f for f in self.scenario.fault if f.kind == "lying_sensor"]
        recent = [
            f.process
            for f in lies
            if f.at_s <= self.time_s <= f.at_s + (f.duration_s or 0.0) + SETTLING_S
        ]
        return 2 * len(set(recent)) >= len(self.scenario.chasers)

    def _nearest_allowed_m(self, name: str, offset_m: Array) -> float:
        """Return the smallest allowed distance from the target of a chaser at an offset (3,), TRF:
        smaller in its corridor, and for one that controls itself, which the corridor of a rotating
        target leaves behind."""
        cone = self._cones.get(name)
        in_corridor = cone is not None and cone.room_m(offset_m) > -KEEP_OUT_SLACK_M
        if in_corridor or (cone is not None and self._falls_back(int(name.partition("/")[2]))):
            return self._nearest_m[name]
        return self.scenario.limits.min_distance_target_m

    # -- commands ----------------------------------------------------------------------------------

    def _on_wrench(self, command: WrenchCommand) -> None:
        """Note since when a chaser is commanded without a break."""
        if command.mode in ("wait", "yield"):
            return  # of a controller that does not command
        i, gap = command.chaser, math.ceil(_GAP_S * self.scenario.time.rate_hz)
        if command.mode == "none" or command.tick - self._commanded.get(i, -gap) > gap:
            self._following[i] = command.tick
        self._commanded[i] = max(command.tick, self._commanded.get(i, -1))
        plan = self._planned.get(i)
        if command.mode == "nmpc" and plan is not None and plan.tick == command.tick:
            self._check_plan(plan, command)

    def _on_plan(self, plan: Plan) -> None:
        self._planned[plan.chaser] = plan

    def _check_plan(self, plan: Plan, command: WrenchCommand) -> None:
        """Check that a command is the input of its plan at the time from which it acts."""
        stage = int((command.effective_time_ns - plan.sim_time_ns) / 1e9 / plan.step_s + 1e-9)
        if not 0 <= stage < len(plan.inputs) // 6:
            return
        planned = plan.inputs[6 * stage : 6 * stage + 6]
        limits = self.scenario.chaser.wrench_max
        error = np.abs(np.array([*command.force_N, *command.torque_N_m]) - planned) / limits
        if float(error.max()) > _PLAN_SHARE:
            text = f"differs from its plan by {error.max():.2e} of the limits"
            self.violate("plan is flown", f"chaser/{command.chaser}", text)

    def _check_following(self, command: ActuatorCommand) -> None:
        """Check that a chaser without commands has a cause for it."""
        i, rate_hz = command.chaser, self.scenario.time.rate_hz
        since_s, now_s = self._following.get(i, self._tick) / rate_hz, self._tick / rate_hz
        since_s = max(since_s, self._disturbed_until_s(f"chaser/{i}", now_s))
        recent = self._commanded.get(i, -1) >= self._tick - math.ceil(_GAP_S * rate_hz)
        if recent and now_s - since_s > FOLLOWING_S:
            text = f"has flown no command for {now_s - since_s:.1f} s, but commands are published"
            self.violate("commands are flown", f"chaser/{i}", text)

    def _disturbed_until_s(self, name: str, now_s: float) -> float:
        """Return until when faults or the network have kept commands from a chaser, at most
        ``now_s``; 0 if never.
        """
        return self._lasted_until_s([f for f in self.scenario.fault if _concerns(f, name)], now_s)

    def _lasted_until_s(self, faults: Sequence[Fault], now_s: float) -> float:
        """Return until when one of the faults, a partition or a slow reader has lasted, at most
        ``now_s``; 0 if none.
        """
        s = self.scenario.simulation
        spans = [(f.at_s, f.at_s + (f.duration_s or 0.0)) for f in faults]
        spans += [(w.at_s, w.at_s + w.duration_s) for w in (*s.partition, *s.slow)]
        return max([0.0, *(min(end_s, now_s) for at_s, end_s in spans if at_s <= now_s)])

    def _note_return(self, command: ActuatorCommand) -> None:
        """Judge a chaser again that has flown commands for ``STOPPING_S``, while no fault kept them
        from its actuators.
        """
        name, now_s = f"chaser/{command.chaser}", self.time_s
        if command.source != "command" or name in self._lost:
            self._returned_s.pop(name, None)
            return
        since_s = max(
            self._returned_s.setdefault(name, now_s), self._disturbed_until_s(name, now_s)
        )
        if now_s - since_s > STOPPING_S:
            self.dead.remove(name)
            del self._returned_s[name]

    def _may_hand_over(self) -> bool:
        """Return whether the network, or a fault within the last `FOLLOWING_S`, explains that the
        other controller commands.
        """
        faults = [f for f in self.scenario.fault if f.kind not in _HARMLESS]
        until_s = self._lasted_until_s(faults, self.time_s)
        return self._may_be_late() or (until_s > 0.0 and self.time_s - until_s <= FOLLOWING_S)

    def _check_braking(self, command: ActuatorCommand) -> None:
        """Check that a chaser without a controller ends braking; a latched one, or one without
        odometry, pushes not at all.
        """
        i, name = command.chaser, f"chaser/{command.chaser}"
        pushes = any((*command.force_N, *command.torque_N_m)) and i not in self._latched
        if (
            command.source != "brake"
            or not pushes
            or name in self.dead
            or self.scenario.thruster_failure
        ):
            self._braking_s.pop(i, None)
        elif (lasting_s := self.time_s - self._braking_s.setdefault(i, self.time_s)) > BRAKING_S:
            self.violate("liveness", name, f"brakes for {lasting_s:.0f} s")

    def _check_pulses(self, command: ActuatorCommand) -> None:
        """Check that thrusters open before the force commanded since the last pulse gives more than
        all in one period.
        """
        body, i = self.scenario.chaser, command.chaser
        carried = body.actuation == "thrusters" and body.modulation.carry_over
        if command.pulses or command.isolated or not carried:
            self._without_pulse_N_s.pop(i, None)
            return
        counted, total_N_s = self._without_pulse_N_s.get(i, (-1, np.zeros(3)))
        if command.tick == counted:
            return  # a copy, or the second command of a tick
        total_N_s = total_N_s + np.array(command.force_N) / self.scenario.time.rate_hz
        self._without_pulse_N_s[i] = command.tick, total_N_s
        waiting_N_s = length(total_N_s)
        if waiting_N_s > sum(t.thrust_N for t in body.thrusters) / body.modulation.carrier_hz:
            text = f"opens no thruster, although {waiting_N_s:.2g} N s are commanded"
            self.violate("commands are flown", f"chaser/{i}", text)

    def _on_command(self, command: ActuatorCommand) -> None:
        self._sources[command.chaser] = command.source
        self._check_pulses(command)
        self._check_braking(command)
        if f"chaser/{command.chaser}" in self.dead:
            self._note_return(command)
        if command.source != "command":
            self._check_following(command)
            return
        self._following[command.chaser] = self._tick
        name, before = f"chaser/{command.chaser}", self._flown.get(command.chaser)
        self._flown[command.chaser] = command
        age = self._known_tick() - command.tick
        if age > self._lifetime_ticks:
            self.violate("no stale command", name, f"flies a command of {age} ticks ago")
        if before is not None and command.tick < before.tick:
            self.violate("no stale command", name, f"flies tick {command.tick} after {before.tick}")
        if before is not None and command.term < before.term:
            self.violate(
                "no superseded command", name, f"flies term {command.term} after {before.term}"
            )
        sender = commander_of(command.term)
        other = self._commanders.setdefault(command.tick, sender)
        # If the commander is lost in a tick, chasers may have executed its command before.
        if other != sender and command.tick not in self._controller_lost:
            text = f"flies a command of {sender} for tick {command.tick}, in which {other} commands"
            self.violate("one commander", name, text)
        self._check_hand_over(command)
        self._check_succession(command)

    def _check_succession(self, command: ActuatorCommand) -> None:
        """Check that no command of a lower term is flown for a later tick than one of a higher term
        of the other controller.

        A repeated tick may have both. A chaser that was lost may fly its commands late, but for
        their own ticks.
        """
        term, tick = command.term, command.tick
        first, last = self._term_ticks.get(term, (tick, tick))
        self._term_ticks[term] = min(first, tick), max(last, tick)
        for other, (from_tick, until_tick) in self._term_ticks.items():
            superseded = (other > term and from_tick < tick) or (other < term and tick < until_tick)
            if superseded and commander_of(other) != commander_of(term):
                text = f"flies term {term} for tick {tick}; term {other} is flown from tick {from_tick} to {until_tick}"
                self.violate("one commander", f"chaser/{command.chaser}", text)

    def _check_hand_over(self, command: ActuatorCommand) -> None:
        """Check that the network or a fault explains that a later tick is commanded by the other
        controller.
        """
        before = max(self._term_ticks, default=command.term)
        newer = command.term > before and command.tick > self._term_ticks[before][1]
        handed_over = newer and commander_of(command.term) != commander_of(before)
        if handed_over and not self._may_hand_over():
            text = f"flies term {command.term} after term {before}, but nothing disturbed its controller"
            self.violate("no hand-over without a cause", f"chaser/{command.chaser}", text)

    def _clock_s(self, process: str, sent_ns: int) -> float:
        """Return the virtual time (s) at which a process has stamped a message with its own clock."""
        clock = next((c for c in self.scenario.simulation.clock if c.process == process), None)
        wall_s = (sent_ns - EPOCH_NS) * 1e-9
        return wall_s if clock is None else (wall_s - clock.offset_s) / (1.0 + clock.drift)

    def _known_tick(self) -> int:
        """Return the newest tick that has reached the chasers by now: a world that was frozen opens
        many at once.
        """
        network = self.scenario.simulation
        if network.mode == "lockstep":
            return self._tick
        sent_s = self._now_s - network.latency_s - KNOWN_AFTER_S
        return next((tick for opened_s, tick in reversed(self._opened) if opened_s <= sent_s), -1)

    # -- the rest ----------------------------------------------------------------------------------

    def _on_sighting(self, sighting: Sighting) -> None:
        name = f"chaser/{sighting.chaser}"
        if sighting.status == "seen" and name not in self._liars:
            self._seen_s[sighting.chaser] = self.time_s
        commander = self._commanders.get(self._tick - 1)
        if sighting.status == "seen" and sighting.tick > self._sighted.get(sighting.chaser, -1):
            self._sighted[sighting.chaser] = sighting.tick
            self._damaged += self._damaged_share(name, commander) if commander else 0.0

    def _damaged_share(self, chaser: str, commander: str) -> float:
        """Return the share of a chaser's sightings that a fault damages now for the commander, and
        that it receives in time.
        """
        active = [
            f
            for f in self.scenario.fault
            if f.at_s <= self.time_s < f.at_s + (f.duration_s or math.inf)
        ]
        if self.scenario.simulation.partition or any(
            _concerns(f, chaser) for f in active if f.kind not in _BESIDE_DAMAGE
        ):
            return 0.0
        shares = (
            f.share or 1.0
            for f in active
            if _damages_sightings(f, commander) and f.peer in (None, chaser)
        )
        return max(shares, default=0.0)

    def _check_accuracy(self, estimate: TargetEstimate, truth: BodyTruth) -> None:
        """Check that one lying sensor does not mislead the estimate while two honest chasers see
        the target.
        """
        if len(self._liars) > 1 or any(f.kind in _LIES for f in self.scenario.fault):
            return
        if self.scenario.chaser.actuation == "thrusters" and self._may_be_late():
            return  # what late pulses lose is unknown to the chasers
        if self._is_pushed():
            return
        if sum(self.time_s - seen_s <= SEEN_S for seen_s in self._seen_s.values()) < 2:
            return
        error_m = _distance(np.array(estimate.position_m), np.array(truth.position_m))
        allowed_m = ACCURACY_M + 4.0 * self.scenario.navigation.errors().position_drift_m
        if error_m > allowed_m:
            text = f"estimated {error_m:.3f} m from its position, {allowed_m:g} allowed"
            self.violate("accurate estimate", "target", text)

    def _is_pushed(self) -> bool:
        """Return whether a thruster of a latched chaser may be stuck on without a report: detection
        pauses while latched.
        """
        return any(
            f.kind == "stuck_on"
            and not f.reported
            and f.at_s <= self.time_s
            and f.chaser in self._latched
            for f in self.scenario.thruster_failure
        )

    def _on_thrusters(self, report: ThrusterReport) -> None:
        """Compare the impulse that a chaser expects of its thrusters with the true one, summed
        since the last fault.
        """
        i, name = report.chaser, f"chaser/{report.chaser}"
        body, now_s = self._states.get(name), report.tick / self.scenario.time.rate_hz
        suspected = [j for j, state in enumerate(report.thrusters) if state != "healthy"]
        if suspected and not (self.scenario.thruster_failure or self._may_be_late()):
            self.violate(
                "thrusters as expected", name, f"takes {suspected} for failed, but none is"
            )
        if (
            body is None
            or body.tick != report.tick
            or name in self._touching
            or self._device_disturbed(now_s)
        ):
            self._unexplained.pop(i, None)
            return
        true = [*body.impulse_N_s, *np.divide(body.angular_impulse_N_m_s, _ARM_M)]
        expected = [
            *report.given_impulse_N_s,
            *np.divide(report.given_angular_impulse_N_m_s, _ARM_M),
        ]
        if i not in self._unexplained:
            self._unexplained[i], self._given_N_s[i] = np.zeros(6), 0.0
            return
        self._unexplained[i] = self._unexplained[i] + np.subtract(expected, true)
        self._given_N_s[i] += sum(body.thruster_impulse_N_s)
        error = float(np.linalg.norm(self._unexplained[i]))
        if error > self._thruster_error_N_s(name, self._given_N_s[i]):
            text = f"expects {error:.2e} N s more of its thrusters than they gave, of {self._given_N_s[i]:.2e}"
            self.violate("thrusters as expected", name, text)

    def _thruster_error_N_s(self, name: str, given_N_s: float) -> float:
        """Return by how much the impulse that thrusters have given may differ from the expected
        one.
        """
        truth, drawn = self._truth, self._drawn.get(name)
        late_s = truth.delay_s + 3.0 * truth.delay_jitter_s
        late_s += 0.0 if drawn is None else abs(drawn.clock_offset_s)
        # A thruster's force acts on position and, by its arm, on attitude.
        shifted_N_s = 2.0 * late_s * sum(t.thrust_N for t in self.scenario.chaser.thrusters)
        return (
            _THRUSTER_FLOOR_N_S
            + shifted_N_s
            + (_THRUSTER_SHARE + 3.0 * truth.thrust_share) * given_N_s
        )

    def _on_estimate(self, estimate: TargetEstimate) -> None:
        truth = self._states.get("target")
        if estimate.status not in ("tracking", "predicting"):
            return
        if truth is None or truth.sim_time_ns != estimate.sim_time_ns:
            return
        self._check_accuracy(estimate, truth)
        if estimate.tick % self.scenario.time.rate_hz:
            return
        true, known = ((np.array(x.position_m), np.array(x.q_wxyz)) for x in (truth, estimate))
        self.nees.append(
            float(
                normalized_square(pose_error(*true, *known), pose_covariance(estimate.covariance))
            )
        )
        for relative in estimate.relative:
            own = self._states.get(f"chaser/{relative.chaser}")
            if (
                own is not None
                and own.body not in self._touching
                and own.sim_time_ns == estimate.sim_time_ns
            ):
                self.relative_nees.append(_relative_nees(relative, own, truth))

    def _on_reference(self, reference: Reference) -> None:
        """Note the phase, and check that a retreat leads away from the target."""
        i, away_m = reference.chaser, math.hypot(*reference.offset_m)
        if self.phases.get(i) != reference.phase:
            nominal_m = self.scenario.chasers[i].position_m
            near_m = min(away_m, math.hypot(*nominal_m)) - RETREAT_SLACK_M
            # From the far side of the target the way back passes it.
            self._retreats_from_m[i] = (
                near_m if np.dot(reference.offset_m, nominal_m) > 0.0 else 0.0
            )
            self._homing_m.pop(i, None)
        self.phases[i] = reference.phase
        if reference.phase in ("retreat", "abort") and reference.phase_time_s > TURNING_S:
            self._check_homing(i, reference)
        if reference.phase in ("retreat", "abort") and away_m < self._retreats_from_m[i]:
            self.violate(
                "retreat leads away",
                f"chaser/{i}",
                f"its reference is {away_m:.2f} m from the target",
            )

    def _check_homing(self, i: int, reference: Reference) -> None:
        """Check that a retreat leads to the chaser's nominal place or, for another attempt, to the
        entry of its corridor.

        Controllers begin it by their own estimates: after a hand-over it may be less far.
        """
        left_m = np.linalg.norm(self._retreats_to_m[i] - reference.offset_m, axis=1)
        sender, least_m = self._homing_m.get(i, (self._sender, left_m))
        least_m = np.minimum(left_m, least_m) if sender == self._sender else left_m
        self._homing_m[i] = self._sender, least_m
        if np.all(left_m > least_m + HOMING_SLACK_M):
            text = f"its reference is {left_m[0]:.2f} m from its nominal place, after {least_m[0]:.2f} m"
            self.violate("retreat leads away", f"chaser/{i}", text)

    def _on_event(self, event: Event) -> None:
        # A phase that guidance chose names its reason: "chaser 0: hold (from approach: REASON)".
        chosen = "(from " in event.what and ": " in event.what.partition("(from ")[2]
        if (event.level != "info" and not event.what.startswith("fault ")) or chosen:
            self.reasons.append(f"{event.process}: {event.what} {event.detail}".strip())
            self.reason_s |= dict.fromkeys(self._concerned(event), self.time_s)
        if event.process == "world" and event.what in ("process lost", "actuators stopped"):
            lost = event.detail.partition(":")[0]
            self.dead.add(lost)
            self._returned_s.pop(lost, None)
            if event.what == "process lost":
                self._lost.add(lost)
            if not self._may_lose():
                self.violate("no loss without a cause", lost, event.what)

    def _concerned(self, event: Event) -> set[int]:
        """Return the chasers that an event may keep from docking: the one that publishes it, or
        those that world or controllers name; all if they name none."""
        if event.process.startswith("chaser/"):
            return {int(event.process.partition("/")[2])}
        named = {int(i) for i in re.findall(r"chaser[ /](\d+)", f"{event.what} {event.detail}")}
        if event.process == "recorder" or event.detail == "recorder":
            return set()
        return named or set(range(len(self.scenario.chasers)))

    def _latch_may_open(self, i: int) -> bool:
        """Return whether a fault or a limited strength explains that a closed latch opens."""
        faults = (
            f for f in self.scenario.fault if f.kind in LATCH_FAULTS and f.process == f"chaser/{i}"
        )
        lasting = any(f.at_s <= self.time_s <= f.at_s + (f.duration_s or 0.0) + 1.0 for f in faults)
        return lasting or "latch" in self.scenario.truth.model_fields_set

    def _may_lose(self) -> bool:
        """Return whether a fault or the network explains that a process is lost."""
        s = self.scenario.simulation
        begun = any(f.at_s <= self.time_s for f in self.scenario.fault)
        return bool(self._may_be_late() or s.slow or s.partition or begun)

    def _may_be_late(self) -> bool:
        """Return whether the network loses messages, or delays them so that leases may run out."""
        s = self.scenario.simulation
        # A tick's messages cross the network three times, which may take longer than half a tick.
        late_s = 3.0 * s.latency_s + LATE_JITTERS * s.jitter_s
        late = s.loss or s.reorder or late_s > 0.5 / self.scenario.time.rate_hz
        return s.mode == "realtime" and bool(late)

    def _on_end(self, end: MissionEnd) -> None:
        self.end = end

    def check_end(self, crashes: dict[str, str], stalled: tuple[str, ...]) -> None:
        """Check what must hold when a flight is over: it ended, all processes did, and each mission
        is docked or safe.
        """
        for name, trace in crashes.items():
            self.violate("no crash", name, trace.strip().splitlines()[-1])
        for name in stalled:
            self.violate("liveness", name, "has not ended")
        if self._damaged >= DAMAGED_SIGHTINGS and not any(
            "invalid sighting" in r for r in self.reasons
        ):
            self.violate(
                "damage is named",
                "controller",
                f"takes about {self._damaged:.0f} damaged sightings as valid",
            )
        if self.end is None:
            self.violate("liveness", "world", "the mission has not ended")
            return
        if not self.end.complete and not self.dead.issuperset(self._nearest_m):
            self.violate("liveness", "world", f"the mission ended early: {self.end.reason}")
        if self.end.complete and self.end.tick != self.scenario.ticks:
            text = f"complete after {self.end.tick} of {self.scenario.ticks} ticks"
            self.violate("liveness", "world", text)
        for chaser in self.to_dock:
            phase, name = self.phases.get(chaser, ""), f"chaser/{chaser}"
            if phase in ATTACHED and chaser not in self._latched and name not in self.dead:
                self.violate("liveness", name, f"is in phase {phase}, but its latch is open")
            error_m = self._docking_error_m(chaser)
            if (
                phase == "docked"
                and not self._falls_back(chaser)
                and error_m > self._docked_within_m()
            ):
                self.violate(
                    "liveness",
                    name,
                    f"is in phase docked, but {error_m:.3f} m from its docking place",
                )
            if phase not in DOCKED and not self._disturbed():
                self.violate(
                    "liveness",
                    name,
                    f"ends in phase {phase or 'none'}, although nothing disturbed it",
                )
            if not self.state_at_end(chaser):
                self.violate(
                    "liveness", name, f"ends in phase {phase or 'none'} without a named reason"
                )

    def state_at_end(self, chaser: int) -> str:
        """Return how a chaser that is to dock ends: ``docked``, ``safe``, ``unfinished``, or empty
        if it is none of these.

        Safe: no command reaches it, or it keeps its distance and a warning or command names why.
        Unfinished: the time after the last warning or command was too short for an approach, or a
        lost chaser is in the way.
        """
        phase = self.phases.get(chaser, "")
        commands = [e for e in self.scenario.timeline if chaser in e.chasers]
        named = chaser in self.reason_s or any(e.command in _NAMED_IN for e in commands)
        if phase in DOCKED and not self._falls_back(chaser):
            return "docked"
        if f"chaser/{chaser}" in self.dead or (
            named and (phase in SAFE_PHASES or self._falls_back(chaser))
        ):
            return "safe"
        last_s = max(self.reason_s.get(chaser, 0.0), *(e.at_s for e in commands), 0.0)
        in_time = self.time_s - last_s < settling_s(self.scenario, chaser)
        return (
            "unfinished"
            if (in_time or self._is_blocked(chaser)) and phase not in SAFE_PHASES
            else ""
        )

    def _falls_back(self, chaser: int) -> bool:
        """Return whether no command reaches a chaser: it is lost, stopped, or controls itself."""
        return f"chaser/{chaser}" in self.dead or self._sources.get(chaser, "command") != "command"

    def _docking_place(self, chaser: int) -> Array | None:
        """Return the true place (WRF, m) where a chaser without a port docks; None if the truth is
        not known.
        """
        target = self._states.get("target")
        if target is None:
            return None
        nominal_m = np.array(self.scenario.chasers[chaser].position_m)
        offset_m = nominal_m * (self.scenario.approach.dock_distance_m / math.hypot(*nominal_m))
        return target.position_m + rotations.rotate(np.array(target.q_wxyz), offset_m)

    def _docking_error_m(self, chaser: int) -> float:
        """Return the true distance of a chaser without a port from the place where it docks; 0 if
        the truth is not known.
        """
        place, own = self._docking_place(chaser), self._states.get(f"chaser/{chaser}")
        return 0.0 if place is None or own is None else math.dist(place, own.position_m)

    def _is_blocked(self, chaser: int) -> bool:
        """Return whether a lost chaser drifts so close to the docking place, or to a chaser with a
        port, that others avoid it.
        """
        own = self._states.get(f"chaser/{chaser}")
        port = self.scenario.docking.port_of(chaser)
        place = self._docking_place(chaser) if port is None or own is None else own.position_m
        near_m = self.scenario.limits.min_distance_chasers_m + LOST_MARGIN_M + DRIFT_ERROR_M
        lost = [state for name, state in self._states.items() if name in self._lost]
        return place is not None and any(
            math.dist(place, state.position_m) < near_m for state in lost
        )

    def _docked_within_m(self) -> float:
        """Return the largest true distance of a docked chaser from its place: that of the scenario
        and errors of the estimate.
        """
        drift_m = self.scenario.navigation.errors().position_drift_m
        return self.scenario.approach.docked_position_m + ACCURACY_M + 4.0 * drift_m

    def _disturbed(self) -> bool:
        """Return whether anything may keep the chasers from docking: faults, the network, commands,
        or another plant.
        """
        s = self.scenario
        network = s.simulation.model_dump(exclude={"mode", "latency_s", "jitter_s", "duplicate"})
        commands = {e.command for e in s.timeline} - {"approach"}
        plant = s.thruster_failure or "truth" in s.model_fields_set
        return bool(s.fault or commands or plant or any(network.values()))


def settling_s(s: Scenario, chaser: int) -> float:
    """Return how long a chaser may take after the last disturbance: for an approach from rest, or
    another attempt.
    """
    d, approach = s.docking, s.approach
    if d.port_of(chaser) is None:
        way_m = math.hypot(*s.chasers[chaser].position_m) - approach.dock_distance_m
        moving_s = PEAK_SPEED * max(0.0, way_m) / approach.max_speed_m_s
        return max(SETTLING_S, STOPPING_S + moving_s + approach.docked_time_s)
    out_s = d.entry_m / approach.max_speed_m_s
    in_s = (d.entry_m - d.final_m) / d.approach_speed_m_s + (
        d.final_m + d.overdrive_m
    ) / d.contact_speed_m_s
    return SETTLING_S + out_s + in_s + d.settle_s + 2.0 * d.pull_s


def _retreat_goals(s: Scenario, chaser: int) -> Array:
    """Return the places (1 or 2, 3), TRF, to which a retreat may lead: the nominal one, and the
    entry of the corridor to a port.
    """
    port, goals_m = s.docking.port_of(chaser), [np.array(s.chasers[chaser].position_m)]
    if port is not None:
        goals_m.append(centre_offset(port, s.chaser.probe_reach_m, s.docking.entry_m))
    return np.array(goals_m)


def _concerns(fault: Fault, name: str) -> bool:
    """Return whether a fault may keep commands from a chaser, or make it refuse them."""
    return fault.kind not in _HARMLESS and fault.process in (name, "world", "controller", "standby")


def _damages_sightings(fault: Fault, controller: str) -> bool:
    """Return whether a fault damages sightings that a controller receives."""
    return (fault.kind, fault.process, fault.topic) == ("corrupt", controller, "sighting")


def _relative_nees(estimate: RelativeEstimate, own: BodyTruth, target: BodyTruth) -> float:
    """Return the normalized squared error (6 on average if consistent) of the pose of a chaser
    relative to the target.
    """
    own_pose, target_pose = ((np.array(b.position_m), np.array(b.q_wxyz)) for b in (own, target))
    true = relative_pose(*own_pose, *target_pose)
    error = pose_error(*true, np.array(estimate.position_m), np.array(estimate.q_wxyz))
    return float(normalized_square(error, np.reshape(estimate.covariance, (6, 6))))


def _angular_momentum(bodies: Sequence[tuple[BodyTruth, DrawnBody]]) -> Array:
    """Return the angular momentum (3,), WRF, of bodies about their common centre of mass (N m s)."""
    mass = np.array([drawn.mass_kg for _, drawn in bodies])
    spin = np.zeros(3)
    at, velocity = np.zeros((len(bodies), 3)), np.zeros((len(bodies), 3))
    for k, (body, drawn) in enumerate(bodies):
        q, omega = np.array(body.q_wxyz), np.array(body.omega_rad_s)
        arm = rotations.rotate(q, np.array(drawn.centre_of_mass_m))
        at[k] = np.array(body.position_m) + arm
        velocity[k] = np.array(body.velocity_m_s) + np.cross(rotations.rotate(q, omega), arm)
        spin += rotations.rotate(q, np.reshape(drawn.inertia_kg_m2, (3, 3)) @ omega)
    about = at - mass @ at / mass.sum()
    return spin + (mass[:, None] * np.cross(about, velocity)).sum(axis=0)


def _distance(a: Array, b: Array) -> float:
    return math.dist(a.tolist(), b.tolist())
