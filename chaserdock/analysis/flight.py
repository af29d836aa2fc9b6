# SPDX-License-Identifier: Apache-2.0
"""A recorded flight as arrays, one row per tick, built while the log is read."""

from __future__ import annotations

import hashlib
import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import without_wall_time
from chaserdock_protocol.messages import (
    ActuatorCommand,
    AssuranceStatus,
    BodyReference,
    BodyTruth,
    CommandReply,
    DockingStatus,
    DrawnBody,
    DrawnTruth,
    Event,
    Health,
    LandmarkMap,
    MissionEnd,
    Odometry,
    PassiveSafety,
    PlumeLoad,
    PortLoad,
    ProbeTouch,
    Reference,
    Sighting,
    SolverStatus,
    StackEstimate,
    TargetEstimate,
    Tick,
    WorldTruth,
)
from chaserdock_protocol.recording.extent import late_begin_line, late_begin_s
from chaserdock_protocol.recording.gaps import SequenceGaps
from chaserdock_protocol.recording.log import (
    FLIGHT_SCENARIO,
    SCENARIO_KIND,
    LogSource,
    Record,
    logged_scenario,
    read_log,
)
from chaserdock_protocol.scenario import Scenario
from numpy.typing import NDArray

from .actuation import ImpulseTotals, OutputSource, commanded_output, true_output
from .columns import Columns
from .mapping import FittedFrame
from .mass_properties import values_of
from .motion import TARGET, KnownMotion, MotionCollector, Track, motion_columns
from .pose_errors import POSE

# Messages whose number or content depends on the wall clock: left out of the digest.
NOT_IN_DIGEST = (topics.PRESENCE, topics.HEALTH, topics.FAREWELL, topics.ACK, topics.STATE)
LOAD_QUANTITIES = (
    "peak_force_N",
    "peak_torque_N_m",
    "peak_axial_N",
    "peak_shear_N",
    "peak_bending_N_m",
    "closing_impulse_N_s",
)
_UPPER = np.triu_indices(6)
_KEPT = np.array([12 * POSE[i] + POSE[j] for i, j in zip(*_UPPER, strict=True)])
_UPPER_FLAT = np.ravel_multi_index(_UPPER, (6, 6))
_RATES = np.array([13 * k for k in (3, 4, 5, 9, 10, 11)])


@dataclass
class ReferenceHistory:
    """Reference of a chaser over time.

    ``offset_m`` (K, 3), TRF: commanded offsets, each valid from ``time_s`` (K,) on. ``phases``:
    start (s) and name of each. ``keep_out`` (L, 2): times (s), and the distance (m) from the
    target's centre that the plan keeps from then on; 0 while the chaser is latched.
    """

    time_s: Array
    offset_m: Array
    phases: list[tuple[float, str]]
    keep_out: Array


@dataclass
class SightingHistory:
    """Sightings of a chaser: exposure times (K,) s, whether the target was seen, number of markers
    used.
    """

    time_s: Array
    seen: NDArray[np.bool_]
    markers: NDArray[np.intp]


@dataclass
class SolverHistory:
    """Solves of the controller: times (K,) s, wall-clock durations (K,) s, and whether any status
    was not ``solved``.
    """

    name: str | None
    time_s: Array
    wall_s: Array
    imperfect: NDArray[np.bool_]
    statuses: Counter[str]


@dataclass
class WorldHistory:
    """Totals in the world's ground truth. ``latched``: at the end. ``latches``: time, s, of each
    change, and the chasers latched from then on. ``contacts``: number of times two bodies touched.
    """

    ticks: int = 0
    late_commands: int = 0
    contacts: int = 0
    touches: list[ProbeTouch] = field(default_factory=list)
    latched: tuple[int, ...] = ()
    latches: list[tuple[float, tuple[int, ...]]] = field(default_factory=list)
    _touching: set[Any] = field(default_factory=set)

    def add(self, message: WorldTruth) -> None:
        self.ticks += 1
        self.late_commands += message.late_commands
        touching = set(message.contacts)
        self.contacts += len(touching - self._touching)
        self._touching = touching
        self.touches += message.touches
        if message.latched != self.latched:
            self.latches.append((message.sim_time_ns / 1e9, message.latched))
        self.latched = message.latched


@dataclass
class SensedDocking:
    """What a chaser's docking sensor has measured. ``contacts``: number of touches of the probe.
    ``latched``: at the end; ``latch_time_s``: when the latch closed last, None if it was closed
    already when the log begins.
    """

    contacts: int = 0
    latched: bool = False
    latch_time_s: float | None = None
    _touching: bool = False
    _heard: bool = False

    def add(self, message: DockingStatus) -> None:
        self.contacts += message.contact and not self._touching
        if message.latched and not self.latched and self._heard:
            self.latch_time_s = message.sim_time_ns / 1e9
        self._touching, self.latched, self._heard = message.contact, message.latched, True


@dataclass
class SightingUse:
    """Number of a chaser's sightings that the estimator used, and that it rejected because their
    innovation does not fit its covariance.
    """

    used: int = 0
    rejected: int = 0


@dataclass
class InnovationHistory:
    """Innovations of a chaser's sightings: exposure times (K,) s, squares (K,) normalized by their
    covariances, degrees of freedom (K,), and whether the estimator used the sighting (K,).
    """

    time_s: Array
    squared: Array
    freedoms: Array
    used: NDArray[np.bool_]


@dataclass
class LoadHistory:
    """Loads at a port: times (K,) s, and values (K, 6) since the previous tick, in the order of
    ``LOAD_QUANTITIES``.
    """

    time_s: Array
    values: Array

    def of(self, quantity: str) -> Array:
        """Return the values (K,) of a quantity."""
        return self.values[:, LOAD_QUANTITIES.index(quantity)]

    def peaks(self) -> dict[str, float]:
        """Return the largest value of each quantity."""
        return dict(zip(LOAD_QUANTITIES, self.values.max(axis=0).tolist(), strict=True))


@dataclass
class IdentificationHistory:
    """Identified mass properties of the target: times (K,) s; values and standard deviations (K,
    10), SI units, in the order of ``mass_properties.NAMES``; the ``last`` message.
    """

    time_s: Array
    values: Array
    sigmas: Array
    last: StackEstimate


@dataclass
class SafetyHistory:
    """Passive safety of a chaser's plans: times (K,) s, margins (K,) in sigmas, distances (K,) m of
    closest approach, and whether the plan was safe (K,).
    """

    time_s: Array
    margin_sigmas: Array
    distance_m: Array
    safe: NDArray[np.bool_]


@dataclass
class AssuranceHistory:
    """What a chaser's assurance did: times (K,) s, room (K,) m (nan where none is known), whether a
    command was changed (K,), whether by the backup (K,), and the number of commands changed by
    hazard.
    """

    time_s: Array
    room_m: Array
    changed: NDArray[np.bool_]
    backup: NDArray[np.bool_]
    hazards: Counter[str]


@dataclass
class RelativeHistory:
    """Estimated poses of a chaser relative to the target.

    Times (K,) s; CRF's origin (K, 3) in TRF, m; attitudes (K, 4); covariances (K, 21): upper
    triangles over position (TRF axes) and attitude (CRF axes).
    """

    time_s: Array
    position_m: Array
    q_wxyz: Array
    upper: Array

    def covariance(self, rows: NDArray[np.intp]) -> Array:
        """Return the covariances (L, 6, 6) at these rows (L,)."""
        return _symmetric(self.upper[rows])


@dataclass
class PlumeTotals:
    """Impulses of plumes on a body: sums of their magnitudes per tick, N s and N m s, and the
    largest force, N.
    """

    impulse_N_s: float = 0.0
    angular_impulse_N_m_s: float = 0.0
    peak_force_N: float = 0.0

    def add(self, message: PlumeLoad) -> None:
        self.impulse_N_s += math.hypot(*message.impulse_N_s)
        self.angular_impulse_N_m_s += math.hypot(*message.angular_impulse_N_m_s)
        self.peak_force_N = max(self.peak_force_N, message.peak_force_N)


@dataclass
class RecordedFlight:
    """Content of a log without the images. Mappings are by body name or chaser.

    ``motion``: of the bodies, to judge against. ``impulses``: by chaser; ``impulses_are``: true, or
    as commanded. ``ticks``, ``flown_s``: number of ticks, and simulated time of the last one or of
    the end. ``innovations``: of the chasers for whose sightings the estimator states them.
    ``estimated``: motion of the target as estimated. ``estimated_errors`` (K, 3): time
    (s), distance (m) and angle (rad) of a chaser's odometry from its reference pose on the
    estimated target. ``estimate_known`` (K,): the target was tracked or predicted. ``relative``: of
    the chasers whose pose the estimator publishes, while the target is known. ``identified``: None
    without identification. ``maps``: of a target of unknown shape. ``end``: None in a log that ends
    before the mission does. ``begins_s``: time at which a log begins that lacks earlier messages,
    or None. ``expected_commands``: number of actuator commands that all ticks expected. ``blas``:
    linear algebra library of each process; empty if an older log does not state it.
    """

    scenario: Scenario
    run: dict[str, str]
    blas: dict[str, str]
    motion: KnownMotion
    ticks: int
    flown_s: float
    impulses: dict[int, ImpulseTotals]
    impulses_are: OutputSource
    estimated: Columns
    estimated_errors: dict[int, Array]
    sighting_use: dict[int, SightingUse]
    sensed_docking: dict[int, SensedDocking]
    estimate_known: NDArray[np.bool_]
    covariances: Columns
    relative: dict[int, RelativeHistory]
    references: dict[int, ReferenceHistory]
    sightings: dict[int, SightingHistory]
    innovations: dict[int, InnovationHistory]
    loads: dict[int, LoadHistory]
    identified: IdentificationHistory | None
    maps: list[LandmarkMap]
    safety: dict[int, SafetyHistory]
    assurance: dict[int, AssuranceHistory]
    plumes: dict[str, PlumeTotals]
    solves: SolverHistory
    world: WorldHistory
    drawn: tuple[DrawnBody, ...]
    events: list[Event]
    end: MissionEnd | None
    begins_s: float | None
    replies: list[CommandReply]
    counts: dict[str, int]
    lost: dict[str, int]
    rejected: dict[str, int]
    expected_commands: int
    latency_s: Array
    wall_time_s: float
    digest: str

    @property
    def chasers(self) -> list[int]:
        """Chasers that are in the log, by their motion or by what they have commanded."""
        numbers = {*self.motion.chasers, *self.impulses}
        return sorted(i for i in numbers if i < len(self.scenario.chasers))

    @property
    def shown(self) -> list[int]:
        """Chasers whose motion, and that of the target, is in the log."""
        return [i for i in self.chasers if self.motion.has_pair(i)]

    @property
    def latched(self) -> tuple[int, ...]:
        """Chasers that are latched at the end: by the ground truth, or by their docking sensors."""
        if self.world.ticks:
            return self.world.latched
        return tuple(i for i, sensed in sorted(self.sensed_docking.items()) if sensed.latched)

    def latched_during(self, chaser: int, time_s: Array) -> NDArray[np.bool_]:
        """Return whether a chaser is latched at times (K,) s."""
        if not self.world.ticks:
            sensed = self.sensed_docking.get(chaser, SensedDocking())
            return (time_s >= (sensed.latch_time_s or 0.0)) & sensed.latched
        found = np.zeros(len(time_s), dtype=np.bool_)
        for begin_s, latched in self.world.latches:
            found[time_s >= begin_s] = chaser in latched
        return found

    @property
    def states_criteria(self) -> bool:
        """Whether the log has the full scenario, and not only what flight software receives."""
        return self.run.get(SCENARIO_KIND) != FLIGHT_SCENARIO

    @property
    def missing(self) -> list[str]:
        """What the log lacks of its mission, a line each."""
        lines = [] if self.begins_s is None else [late_begin_line(self.begins_s)]
        if not self.states_criteria:
            lines.append("holds the flight scenario, without success criteria and ground truth")
        return lines

    @cached_property
    def map_fit(self) -> FittedFrame | None:
        """Frame of the map on the target; None unless the target is mapped and its motion known."""
        if not self.scenario.maps_target or TARGET not in self.motion:
            return None
        late = self.estimate.time_s >= self.scenario.settling_s
        known = np.flatnonzero(self.estimate_known & late)
        rows, true = self.motion.at(TARGET, self.estimate.time_s[known])
        return FittedFrame.of(self.estimate.rows(known[rows]), true) if len(rows) else None

    def estimated_frame(self, target: Track) -> Track:
        """Return the motion of the frame in which the flight software estimates the target: that
        of the map, as fitted to the flight; the target's own where its shape is known.
        """
        return target if self.map_fit is None else self.map_fit.frame_of(target)

    @property
    def estimate(self) -> Track:
        """Estimated motion of the target."""
        return Track.of(self.estimated)

    def pose_covariance(self, rows: NDArray[np.intp]) -> Array:
        """Return covariances (K, 6, 6) of position (WRF) and attitude (TRF) at these rows (K,) of
        the estimate.
        """
        return _symmetric(self.covariances.table()[rows, :21])

    def variances(self, rows: NDArray[np.intp]) -> Array:
        """Return variances (K, 12) of position and velocity (WRF), attitude and rate (TRF) at these
        rows of the estimate.
        """
        table = self.covariances.table()[rows]
        pose, rates = table[:, :21][:, [0, 6, 11, 15, 18, 20]], table[:, 21:]
        return np.concatenate([pose[:, :3], rates[:, :3], pose[:, 3:], rates[:, 3:]], axis=1)


def _symmetric(upper: Array) -> Array:
    """Return symmetric matrices (K, 6, 6) with the given upper triangles (K, 21)."""
    out = np.empty((len(upper), 6, 6))
    out[:, _UPPER[0], _UPPER[1]] = upper
    out[:, _UPPER[1], _UPPER[0]] = upper
    return out


@dataclass
class _ReferenceCollector:
    changes: Columns = field(default_factory=lambda: Columns(4))
    phases: list[tuple[float, str]] = field(default_factory=list)
    last: tuple[float, ...] | None = None
    keep_out: Columns = field(default_factory=lambda: Columns(2))
    last_keep_out_m: float | None = None

    def add(self, message: Reference) -> None:
        time_s = message.sim_time_ns / 1e9
        if message.min_distance_target_m != self.last_keep_out_m:
            self.keep_out.add((time_s, message.min_distance_target_m))
            self.last_keep_out_m = message.min_distance_target_m
        if message.offset_m != self.last:
            self.changes.add((time_s,), message.offset_m)
            self.last = message.offset_m
        if not self.phases or self.phases[-1][1] != message.phase:
            self.phases.append((time_s, message.phase))

    def finish(self) -> ReferenceHistory:
        table = self.changes.table()
        return ReferenceHistory(table[:, 0], table[:, 1:], self.phases, self.keep_out.table())


def _impulses() -> dict[int, ImpulseTotals]:
    return defaultdict(ImpulseTotals)


@dataclass
class _Collector:
    scenario: Scenario
    motion: MotionCollector = field(default_factory=MotionCollector)
    ticks_s: Columns = field(default_factory=lambda: Columns(1))
    given: dict[int, ImpulseTotals] = field(default_factory=_impulses)
    commanded: dict[int, ImpulseTotals] = field(default_factory=_impulses)
    docking: dict[int, SensedDocking] = field(default_factory=lambda: defaultdict(SensedDocking))
    use: dict[int, SightingUse] = field(default_factory=lambda: defaultdict(SightingUse))
    odometry: dict[int, Odometry] = field(default_factory=dict)
    errors: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(3)))
    target: Columns = field(default_factory=motion_columns)
    known: bytearray = field(default_factory=bytearray)
    covariance: Columns = field(default_factory=lambda: Columns(27))
    relative: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(29)))
    references: dict[int, _ReferenceCollector] = field(
        default_factory=lambda: defaultdict(_ReferenceCollector)
    )
    sightings: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(3)))
    innovations: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(4)))
    loads: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(7)))
    identified: Columns = field(default_factory=lambda: Columns(21))
    stack: StackEstimate | None = None
    maps: list[LandmarkMap] = field(default_factory=list)
    safety: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(4)))
    assurance: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(4)))
    hazards: dict[int, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    plumes: dict[str, PlumeTotals] = field(default_factory=lambda: defaultdict(PlumeTotals))
    solves: Columns = field(default_factory=lambda: Columns(3))
    statuses: Counter[str] = field(default_factory=Counter)
    solver: str | None = None
    world: WorldHistory = field(default_factory=WorldHistory)
    drawn: tuple[DrawnBody, ...] = ()
    events: list[Event] = field(default_factory=list)
    end: MissionEnd | None = None
    replies: list[CommandReply] = field(default_factory=list)
    health: dict[str, Health] = field(default_factory=dict)
    sent: dict[tuple[int, int], int] = field(default_factory=dict)
    latency: Columns = field(default_factory=lambda: Columns(1))
    counts: Counter[str] = field(default_factory=Counter)
    gaps: SequenceGaps = field(default_factory=SequenceGaps)
    hashes: dict[str, int] = field(default_factory=dict)
    wall: list[int] = field(default_factory=list)
    expected: int = 0
    tick: int = -1
    tick_expected: int = 0

    def add(self, record: Record) -> None:
        """Add a message of the log."""
        message = record.message
        self._count(record)
        self._add_timed(record)
        match message:
            case BodyTruth():
                self._add_body(message)
            case BodyReference():
                self.motion.add(message)
            case TargetEstimate():
                self._add_estimate(message)
            case Reference():
                self._add_reference(message)
            case Odometry():
                self.odometry[message.chaser] = message
            case SolverStatus():
                self._add_solve(message)
            case WorldTruth():
                self.world.add(message)
            case Sighting() | PortLoad() | PassiveSafety() | DockingStatus() | ActuatorCommand():
                self._add_of_chaser(message)
            case AssuranceStatus():
                self._add_assurance(message)
            case (
                Event()
                | MissionEnd()
                | CommandReply()
                | Health()
                | DrawnTruth()
                | PlumeLoad()
                | StackEstimate()
                | LandmarkMap()
            ):
                self._add_report(message)

    def _add_assurance(self, message: AssuranceStatus) -> None:
        room_m = math.nan if message.room_m is None else message.room_m
        backup = message.state == "backup"
        changed = backup or message.state == "changed"
        row = (message.sim_time_ns / 1e9, room_m, changed, backup)
        self.assurance[message.chaser].add(row)
        self.hazards[message.chaser].update(message.hazards)

    def _add_timed(self, record: Record) -> None:
        """Add the time at which a message was sent."""
        message = record.message
        if record.topic is topics.TICK:
            self._add_tick(message, record.sent_ns)
        elif record.topic is topics.IMAGE:
            self.sent[message.chaser, message.tick] = record.sent_ns
        elif record.topic is topics.ACTUATORS:
            sent_ns = self.sent.pop((message.chaser, message.tick), None)
            if sent_ns is not None:
                self.latency.add(((record.sent_ns - sent_ns) / 1e9,))

    def _add_of_chaser(
        self, message: Sighting | PortLoad | PassiveSafety | DockingStatus | ActuatorCommand
    ) -> None:
        time_s = message.sim_time_ns / 1e9
        match message:
            case Sighting():
                seen = message.status == "seen"
                self.sightings[message.chaser].add((time_s, seen, len(message.marker_ids)))
            case PortLoad():
                values = (getattr(message, name) for name in LOAD_QUANTITIES)
                self.loads[message.chaser].add((time_s,), values)
            case PassiveSafety():
                self.safety[message.chaser].add(
                    (time_s, message.margin_sigmas, message.distance_m, message.safe)
                )
            case DockingStatus():
                self.docking[message.chaser].add(message)
            case ActuatorCommand():
                if not self.given:
                    s = self.scenario
                    output = commanded_output(message, s.chaser, 1.0 / s.time.rate_hz)
                    self.commanded[message.chaser].add(output)

    def _add_report(
        self,
        message: Event
        | MissionEnd
        | CommandReply
        | Health
        | DrawnTruth
        | PlumeLoad
        | StackEstimate
        | LandmarkMap,
    ) -> None:
        match message:
            case LandmarkMap():
                self.maps.append(message)
            case MissionEnd():
                self.end = message
            case StackEstimate():
                self.stack = message
                self.identified.add((message.sim_time_ns / 1e9,), *values_of(message.target))
            case PlumeLoad():
                self.plumes[message.body].add(message)
            case DrawnTruth():
                self.drawn = message.bodies
            case Event():
                self.events.append(message)
            case CommandReply():
                self.replies.append(message)
            case Health():
                self.health[message.process] = message

    def _count(self, record: Record) -> None:
        """Update counts, gaps in the sequence numbers, and the digest."""
        message = record.message
        self.counts[record.key] += 1
        self.gaps.update(record.key, message.seq)
        if record.topic not in NOT_IN_DIGEST:
            content = msgspec.msgpack.encode(without_wall_time(message))
            # A sum does not depend on the order: two controllers publish on the same keys, and
            # their messages arrive in any order.
            number = int.from_bytes(hashlib.sha256(content).digest(), "big")
            self.hashes[record.key] = (self.hashes.get(record.key, 0) + number) % 2**256

    def _add_tick(self, message: Tick, sent_ns: int) -> None:
        # A later revision of a tick replaces its number of expected commands.
        replaced = self.tick_expected if message.tick == self.tick else 0
        if message.tick != self.tick:
            self.ticks_s.add((message.sim_time_ns / 1e9,))
        self.expected += len(message.chasers) - replaced
        self.tick, self.tick_expected = message.tick, len(message.chasers)
        self.wall = [*self.wall[:1], sent_ns]

    def _add_body(self, message: BodyTruth) -> None:
        self.motion.add(message)
        if message.body.startswith("chaser/"):
            self.given[int(message.body.partition("/")[2])].add(true_output(message))

    def _add_reference(self, message: Reference) -> None:
        self.references[message.chaser].add(message)
        odometry = self.odometry.get(message.chaser)
        if odometry is not None and odometry.tick == message.tick:
            away_m = math.dist(odometry.position_m, message.position_m)
            angle = rotations.angle_between(message.q_wxyz, odometry.q_wxyz)
            self.errors[message.chaser].add((message.sim_time_ns / 1e9, away_m, float(angle)))

    def _add_estimate(self, message: TargetEstimate) -> None:
        m = message
        self.target.add(
            (m.sim_time_ns / 1e9,),
            m.position_m,
            m.velocity_m_s,
            m.q_wxyz,
            m.omega_rad_s,
            (0.0, 0.0),
        )
        for chaser in m.accepted:
            self.use[chaser].used += 1
        for chaser in m.rejected:
            self.use[chaser].rejected += 1
        for x in m.innovations or ():
            row = (x.sim_time_ns / 1e9, x.squared, x.freedoms, x.used)
            self.innovations[x.chaser].add(row)
        known = message.is_known
        self.known.append(known)
        covariance = np.asarray(message.covariance)
        self.covariance.add(covariance[_KEPT].tolist(), covariance[_RATES].tolist())
        for r in message.relative if known else ():
            upper = np.asarray(r.covariance)[_UPPER_FLAT].tolist()
            self.relative[r.chaser].add((message.sim_time_ns / 1e9,), r.position_m, r.q_wxyz, upper)

    def _add_solve(self, message: SolverStatus) -> None:
        self.solver = self.solver or message.solver
        self.statuses.update(message.status)
        if message.chasers:
            imperfect = any(s != "solved" for s in message.status)
            self.solves.add((message.sim_time_ns / 1e9, message.wall_solve_s, imperfect))


def _sighting_history(columns: Columns) -> SightingHistory:
    t = columns.table()
    return SightingHistory(t[:, 0].copy(), t[:, 1] > 0.0, t[:, 2].astype(np.intp))


def _innovation_history(columns: Columns) -> InnovationHistory:
    t = columns.table()
    return InnovationHistory(t[:, 0].copy(), t[:, 1].copy(), t[:, 2].copy(), t[:, 3] > 0.0)


def _load_history(columns: Columns) -> LoadHistory:
    t = columns.table()
    return LoadHistory(t[:, 0].copy(), t[:, 1:])


def _relative_history(columns: Columns) -> RelativeHistory:
    t = columns.table()
    return RelativeHistory(t[:, 0].copy(), t[:, 1:4], t[:, 4:8], t[:, 8:])


def _safety_history(columns: Columns) -> SafetyHistory:
    t = columns.table()
    return SafetyHistory(t[:, 0].copy(), t[:, 1].copy(), t[:, 2].copy(), t[:, 3] > 0.0)


def _assurance_history(columns: Columns, hazards: Counter[str]) -> AssuranceHistory:
    t = columns.table()
    return AssuranceHistory(t[:, 0].copy(), t[:, 1].copy(), t[:, 2] > 0.0, t[:, 3] > 0.0, hazards)


def _identification_history(c: _Collector) -> IdentificationHistory | None:
    if c.stack is None:
        return None
    t = c.identified.table()
    return IdentificationHistory(t[:, 0].copy(), t[:, 1:11].copy(), t[:, 11:].copy(), c.stack)


def load_flight(log: LogSource) -> RecordedFlight:
    """Read the flight in a log. Raise LogError for a log that is unreadable or not recorded by
    chaserdock.
    """
    scenario, run = logged_scenario(log)
    c = _Collector(scenario)
    for record in read_log(log):
        c.add(record)

    digest = hashlib.sha256()
    for key in sorted(c.hashes):
        digest.update(f"{key} {c.hashes[key]:064x}\n".encode())

    rejected: Counter[str] = Counter()
    for health in c.health.values():
        rejected.update(health.rejected)

    solves, ticks_s = c.solves.table(), c.ticks_s.table()[:, 0]
    motion = c.motion.finish(ticks_s)
    known_s = [0.0, *ticks_s[-1:].tolist(), *(motion[n].time_s[-1] for n in motion)]
    return RecordedFlight(
        scenario=scenario,
        run=run,
        blas={name: h.blas for name, h in c.health.items()} | {"recorder": run.get("blas", "")},
        motion=motion,
        ticks=len(ticks_s),
        flown_s=float(max(known_s if c.end is None else [*known_s, c.end.sim_time_ns / 1e9])),
        impulses=dict(c.given or c.commanded),
        impulses_are="true" if c.given else "commanded",
        estimated=c.target,
        estimated_errors={i: columns.table() for i, columns in sorted(c.errors.items())},
        sighting_use=dict(sorted(c.use.items())),
        sensed_docking=dict(c.docking),
        estimate_known=np.frombuffer(c.known, dtype=np.bool_),
        covariances=c.covariance,
        relative={i: _relative_history(columns) for i, columns in c.relative.items()},
        references={i: collector.finish() for i, collector in c.references.items()},
        sightings={i: _sighting_history(columns) for i, columns in c.sightings.items()},
        innovations={i: _innovation_history(c.innovations[i]) for i in sorted(c.innovations)},
        loads={i: _load_history(columns) for i, columns in c.loads.items()},
        identified=_identification_history(c),
        maps=c.maps,
        plumes=dict(c.plumes),
        safety={i: _safety_history(columns) for i, columns in c.safety.items()},
        assurance={i: _assurance_history(rows, c.hazards[i]) for i, rows in c.assurance.items()},
        solves=SolverHistory(
            c.solver, solves[:, 0].copy(), solves[:, 1].copy(), solves[:, 2] > 0.0, c.statuses
        ),
        world=c.world,
        drawn=c.drawn,
        events=c.events,
        end=c.end,
        begins_s=late_begin_s(log),
        replies=c.replies,
        counts=dict(sorted(c.counts.items())),
        lost=dict(c.gaps.lost),
        rejected=dict(rejected),
        expected_commands=c.expected,
        latency_s=c.latency.table()[:, 0],
        wall_time_s=(c.wall[-1] - c.wall[0]) / 1e9 if len(c.wall) > 1 else 0.0,
        digest=digest.hexdigest(),
    )
