"""A recorded flight as arrays: time along the first axis, one row a tick. Built while the log is read."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import without_wall_time
from chaserdock_protocol.messages import (
    BodyTruth,
    CommandReply,
    Event,
    Health,
    ProbeTouch,
    Reference,
    Sighting,
    SolverStatus,
    TargetEstimate,
    WorldTruth,
)
from chaserdock_protocol.recording.log import LogSource, Record, read_log, read_scenario
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from numpy.typing import NDArray

from .columns import Columns

# Wall-clock matters: how often presence was told, who counted what, when the recorder confirmed.
NOT_IN_DIGEST = (topics.PRESENCE, topics.HEALTH, topics.FAREWELL, topics.ACK, topics.STATE)
_POSE = (0, 1, 2, 6, 7, 8)
_UPPER = np.triu_indices(6)
_KEPT = np.array([12 * _POSE[i] + _POSE[j] for i, j in zip(*_UPPER, strict=True)])
_RATES = np.array([13 * k for k in (3, 4, 5, 9, 10, 11)])


@dataclass
class Track:
    """Motion of one body by tick: times (K,) s, positions and velocities (K, 3) WRF, attitudes (K, 4), rates (K, 3)."""

    time_s: Array
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array


class Tracks(Mapping[str, Track]):
    """Tracks by name. A long one is in memory only while it is held: ask again rather than keep it."""

    def __init__(self, motions: dict[str, Columns]) -> None:
        self._motions = motions

    def __getitem__(self, name: str) -> Track:
        t = self._motions[name].table()
        # Times by themselves: whoever keeps them for an axis must not keep all of the motion.
        return Track(t[:, 0].copy(), t[:, 1:4], t[:, 4:7], t[:, 7:11], t[:, 11:14])

    def __iter__(self) -> Iterator[str]:
        return iter(self._motions)

    def __len__(self) -> int:
        return len(self._motions)


@dataclass
class Told:
    """What a chaser was told to do: ``offset_m`` (K, 3), TRF, since ``time_s`` (K,), where it changed; and when (s) which
    phase began."""

    time_s: Array
    offset_m: Array
    phases: list[tuple[float, str]]


@dataclass
class Seen:
    """A chaser's sightings: exposure times (K,) s, whether anything was seen, and how many markers were used."""

    time_s: Array
    seen: NDArray[np.bool_]
    markers: NDArray[np.intp]


@dataclass
class Solves:
    """The solver's work where it had any: times (K,) s, wall-clock seconds (K,), whether any plan was less than solved."""

    name: str | None
    time_s: Array
    wall_s: Array
    imperfect: NDArray[np.bool_]
    statuses: Counter[str]


@dataclass
class World:
    """What the world tells of all bodies together. ``latched``: at the end; ``contacts``: how often two came to touch."""

    ticks: int = 0
    late_commands: int = 0
    contacts: int = 0
    touches: list[ProbeTouch] = field(default_factory=list)
    latched: tuple[int, ...] = ()
    _touching: set[Any] = field(default_factory=set)

    def take(self, message: WorldTruth) -> None:
        self.ticks += 1
        self.late_commands += message.late_commands
        touching = set(message.contacts)
        self.contacts += len(touching - self._touching)
        self._touching = touching
        self.touches += message.touches
        self.latched = message.latched


@dataclass
class Flight:
    """What a log holds, without the images. Mappings by body name or chaser.

    ``estimates`` has the fused estimate's motion as ``target``; ``estimate_known`` (K,): whether the target was known.
    ``expected_commands``: how many actuator commands all ticks together waited for.
    """

    scenario: Scenario
    run: dict[str, str]
    truth: Tracks
    absolute_impulse_N_s: dict[str, float]
    thruster_impulse_N_s: dict[str, float]
    propellant_kg: dict[str, float]
    estimates: Tracks
    estimate_known: NDArray[np.bool_]
    covariances: Columns
    told: dict[int, Told]
    sightings: dict[int, Seen]
    solves: Solves
    world: World
    events: list[Event]
    replies: list[CommandReply]
    counts: dict[str, int]
    lost: dict[str, int]
    rejected: dict[str, int]
    expected_commands: int
    latency_s: Array
    wall_time_s: float
    digest: str

    @property
    def estimate(self) -> Track:
        """Motion of the target as the fusion took it to be."""
        return self.estimates["target"]

    def pose_covariance(self, rows: NDArray[np.intp]) -> Array:
        """Covariances (K, 6, 6) of position (WRF) and attitude (TRF) at these rows (K,) of the estimate."""
        return _unpacked(self.covariances.table()[rows, :21])

    def variances(self, rows: NDArray[np.intp]) -> Array:
        """Variances (K, 12) of position and velocity (WRF), attitude and rate (TRF) at these rows of the estimate."""
        table = self.covariances.table()[rows]
        pose, rates = table[:, :21][:, [0, 6, 11, 15, 18, 20]], table[:, 21:]
        return np.concatenate([pose[:, :3], rates[:, :3], pose[:, 3:], rates[:, 3:]], axis=1)


def _unpacked(upper: Array) -> Array:
    """Symmetric matrices (K, 6, 6) from their upper triangles (K, 21)."""
    out = np.empty((len(upper), 6, 6))
    out[:, _UPPER[0], _UPPER[1]] = upper
    out[:, _UPPER[1], _UPPER[0]] = upper
    return out


@dataclass
class _Told:
    changes: Columns = field(default_factory=lambda: Columns(4))
    phases: list[tuple[float, str]] = field(default_factory=list)
    last: tuple[float, ...] | None = None

    def take(self, message: Reference) -> None:
        time_s = message.sim_time_ns / 1e9
        if message.offset_m != self.last:
            self.changes.add((time_s,), message.offset_m)
            self.last = message.offset_m
        if not self.phases or self.phases[-1][1] != message.phase:
            self.phases.append((time_s, message.phase))

    def finish(self) -> Told:
        table = self.changes.table()
        return Told(table[:, 0], table[:, 1:], self.phases)


def _motion() -> Columns:
    return Columns(14)


@dataclass
class _Collector:
    bodies: dict[str, Columns] = field(default_factory=lambda: defaultdict(_motion))
    impulse: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    thruster_impulse: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    propellant: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    target: Columns = field(default_factory=_motion)
    known: bytearray = field(default_factory=bytearray)
    covariance: Columns = field(default_factory=lambda: Columns(27))
    told: dict[int, _Told] = field(default_factory=lambda: defaultdict(_Told))
    sightings: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(3)))
    solves: Columns = field(default_factory=lambda: Columns(3))
    statuses: Counter[str] = field(default_factory=Counter)
    solver: str | None = None
    world: World = field(default_factory=World)
    events: list[Event] = field(default_factory=list)
    replies: list[CommandReply] = field(default_factory=list)
    health: dict[str, Health] = field(default_factory=dict)
    sent: dict[tuple[int, int], int] = field(default_factory=dict)
    latency: Columns = field(default_factory=lambda: Columns(1))
    counts: Counter[str] = field(default_factory=Counter)
    last_seq: dict[str, int] = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)
    hashes: dict[str, Any] = field(default_factory=dict)
    wall: list[int] = field(default_factory=list)
    expected: int = 0
    tick: int = -1
    tick_expected: int = 0

    def take(self, record: Record) -> None:
        message = record.message
        self.counts[record.key] += 1
        last = self.last_seq.get(record.key, -1)
        self.lost[record.key] += max(0, message.seq - last - 1)
        self.last_seq[record.key] = message.seq
        if record.topic not in NOT_IN_DIGEST:
            content = msgspec.msgpack.encode(without_wall_time(message))
            self.hashes.setdefault(record.key, hashlib.sha256()).update(content)
        if record.topic is topics.TICK:
            told_again = message.tick == self.tick
            self.expected += len(message.chasers) - (self.tick_expected if told_again else 0)
            self.tick, self.tick_expected = message.tick, len(message.chasers)
            self.wall = [*self.wall[:1], record.sent_ns]
        elif record.topic is topics.IMAGE:
            self.sent[message.chaser, message.tick] = record.sent_ns
        elif record.topic is topics.ACTUATORS:
            begun = self.sent.pop((message.chaser, message.tick), None)
            if begun is not None:
                self.latency.add(((record.sent_ns - begun) / 1e9,))
        match message:
            case BodyTruth():
                self._body(message)
            case TargetEstimate():
                _add_motion(self.target, message)
                self.known.append(message.status in ("tracking", "predicting"))
                covariance = np.asarray(message.covariance)
                self.covariance.add(covariance[_KEPT].tolist(), covariance[_RATES].tolist())
            case Reference():
                self.told[message.chaser].take(message)
            case Sighting():
                seen = (message.sim_time_ns / 1e9, message.status == "seen", len(message.marker_ids))
                self.sightings[message.chaser].add(seen)
            case SolverStatus():
                self.solver = self.solver or message.solver
                self.statuses.update(message.status)
                if message.chasers:
                    imperfect = any(s != "solved" for s in message.status)
                    self.solves.add((message.sim_time_ns / 1e9, message.wall_solve_s, imperfect))
            case WorldTruth():
                self.world.take(message)
            case Event():
                self.events.append(message)
            case CommandReply():
                self.replies.append(message)
            case Health():
                self.health[message.process] = message

    def _body(self, message: BodyTruth) -> None:
        _add_motion(self.bodies[message.body], message)
        self.impulse[message.body] += message.absolute_impulse_N_s
        self.thruster_impulse[message.body] += sum(message.thruster_impulse_N_s)
        self.propellant[message.body] += message.propellant_kg


def _add_motion(table: Columns, message: BodyTruth | TargetEstimate) -> None:
    m = message
    table.add((m.sim_time_ns / 1e9,), m.position_m, m.velocity_m_s, m.q_wxyz, m.omega_rad_s)


def _seen(columns: Columns) -> Seen:
    t = columns.table()
    return Seen(t[:, 0].copy(), t[:, 1] > 0.0, t[:, 2].astype(np.intp))


def load_flight(log: LogSource) -> Flight:
    """The flight in a log; raises LogError when it cannot be read or was not recorded by chaserdock."""
    text, run = read_scenario(log)
    scenario = scenario_from_json(text, f"{log}: scenario")
    c = _Collector()
    for record in read_log(log):
        c.take(record)
    digest = hashlib.sha256()
    for key in sorted(c.hashes):
        digest.update(f"{key} {c.hashes[key].hexdigest()}\n".encode())
    rejected: Counter[str] = Counter()
    for health in c.health.values():
        rejected.update(health.rejected)
    solves = c.solves.table()
    return Flight(
        scenario=scenario,
        run=run,
        truth=Tracks(dict(c.bodies)),
        absolute_impulse_N_s=dict(c.impulse),
        thruster_impulse_N_s=dict(c.thruster_impulse),
        propellant_kg=dict(c.propellant),
        estimates=Tracks({"target": c.target}),
        estimate_known=np.frombuffer(c.known, dtype=np.bool_),
        covariances=c.covariance,
        told={i: told.finish() for i, told in c.told.items()},
        sightings={i: _seen(columns) for i, columns in c.sightings.items()},
        solves=Solves(c.solver, solves[:, 0].copy(), solves[:, 1].copy(), solves[:, 2] > 0.0, c.statuses),
        world=c.world,
        events=c.events,
        replies=c.replies,
        counts=dict(sorted(c.counts.items())),
        lost=dict(c.lost),
        rejected=dict(rejected),
        expected_commands=c.expected,
        latency_s=c.latency.table()[:, 0],
        wall_time_s=(c.wall[-1] - c.wall[0]) / 1e9 if len(c.wall) > 1 else 0.0,
        digest=digest.hexdigest(),
    )
