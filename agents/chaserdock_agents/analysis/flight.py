"""A recorded flight as arrays: time along the first axis, one row a tick."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from chaserdock_protocol import topics
from chaserdock_protocol.codec import without_wall_time
from chaserdock_protocol.log import Record, read_log, read_scenario
from chaserdock_protocol.messages import (
    BodyTruth,
    CommandReply,
    Event,
    Health,
    Reference,
    Sighting,
    SolverStatus,
    TargetEstimate,
    WorldTruth,
)
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Scenario, scenario_from_json

# Wall-clock matters: how often presence was told, who counted what, when the recorder confirmed.
_NOT_IN_DIGEST = (topics.PRESENCE, topics.HEALTH, topics.FAREWELL, topics.ACK)


@dataclass
class Track:
    """Motion of one body by tick: times (K,) s, positions and velocities (K, 3) WRF, attitudes (K, 4), rates (K, 3)."""

    time_s: Array
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array


@dataclass
class Flight:
    """What a log holds, without the pictures. Dictionaries by body name or chaser."""

    scenario: Scenario
    run: dict[str, str]
    truth: dict[str, Track]
    absolute_impulse_N_s: dict[str, float]
    jet_impulse_N_s: dict[str, float]
    propellant_kg: dict[str, float]
    estimate: Track
    estimate_covariance: Array
    estimate_status: list[str]
    references: dict[int, list[Reference]]
    sightings: dict[int, list[Sighting]]
    solver: list[SolverStatus]
    world: list[WorldTruth]
    events: list[Event]
    replies: list[CommandReply]
    counts: dict[str, int]
    lost: dict[str, int]
    rejected: dict[str, int]
    expected: dict[int, tuple[int, ...]]
    latency_s: Array
    wall_time_s: float
    digest: str


@dataclass
class _Collector:
    bodies: dict[str, list[BodyTruth]] = field(default_factory=lambda: defaultdict(list))
    targets: list[TargetEstimate] = field(default_factory=list)
    references: dict[int, list[Reference]] = field(default_factory=lambda: defaultdict(list))
    sightings: dict[int, list[Sighting]] = field(default_factory=lambda: defaultdict(list))
    solver: list[SolverStatus] = field(default_factory=list)
    world: list[WorldTruth] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    replies: list[CommandReply] = field(default_factory=list)
    health: dict[str, Health] = field(default_factory=dict)
    sent: dict[tuple[int, int], int] = field(default_factory=dict)
    latency: list[float] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    last_seq: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    hashes: dict[str, Any] = field(default_factory=dict)
    wall: list[int] = field(default_factory=list)
    expected: dict[int, tuple[int, ...]] = field(default_factory=dict)

    def take(self, record: Record) -> None:
        message = record.message
        self.counts[record.key] += 1
        last = self.last_seq.get(record.key, -1)
        self.lost[record.key] = self.lost.get(record.key, 0) + max(0, message.seq - last - 1)
        self.last_seq[record.key] = message.seq
        if record.topic not in _NOT_IN_DIGEST:
            content = msgspec.msgpack.encode(without_wall_time(message))
            self.hashes.setdefault(record.key, hashlib.sha256()).update(content)
        if record.topic is topics.TICK:
            self.expected[message.tick] = message.chasers
            self.wall.append(record.sent_ns)
        elif record.topic is topics.IMAGE:
            self.sent[message.chaser, message.tick] = record.sent_ns
        elif record.topic is topics.ACTUATORS:
            begun = self.sent.get((message.chaser, message.tick))
            if begun is not None:
                self.latency.append((record.sent_ns - begun) / 1e9)
        match message:
            case BodyTruth():
                self.bodies[message.body].append(message)
            case TargetEstimate():
                self.targets.append(message)
            case Reference():
                self.references[message.chaser].append(message)
            case Sighting():
                self.sightings[message.chaser].append(message)
            case SolverStatus():
                self.solver.append(message)
            case WorldTruth():
                self.world.append(message)
            case Event():
                self.events.append(message)
            case CommandReply():
                self.replies.append(message)
            case Health():
                self.health[message.process] = message


def _track(messages: list[Any]) -> Track:
    def column(name: str, width: int) -> Array:
        return np.array([getattr(m, name) for m in messages], dtype=float).reshape(-1, width)

    return Track(
        time_s=np.array([m.sim_time_ns for m in messages], dtype=float) / 1e9,
        position_m=column("position_m", 3),
        velocity_m_s=column("velocity_m_s", 3),
        q_wxyz=column("q_wxyz", 4),
        omega_rad_s=column("omega_rad_s", 3),
    )


def load_flight(log: Path) -> Flight:
    """The flight in a log; raises LogError when it cannot be read or was not recorded by chaserdock."""
    text, run = read_scenario(log)
    scenario = scenario_from_json(text, f"{log}: scenario")
    c = _Collector()
    for record in read_log(log):
        c.take(record)
    digest = hashlib.sha256()
    for key in sorted(c.hashes):
        digest.update(f"{key} {c.hashes[key].hexdigest()}\n".encode())
    rejected: dict[str, int] = defaultdict(int)
    for health in c.health.values():
        for reason, number in health.rejected.items():
            rejected[reason] += number
    return Flight(
        scenario=scenario,
        run=run,
        truth={name: _track(messages) for name, messages in c.bodies.items()},
        absolute_impulse_N_s={n: sum(m.absolute_impulse_N_s for m in ms) for n, ms in c.bodies.items()},
        jet_impulse_N_s={n: sum(sum(m.jet_impulse_N_s) for m in ms) for n, ms in c.bodies.items()},
        propellant_kg={n: sum(m.propellant_kg for m in ms) for n, ms in c.bodies.items()},
        estimate=_track(c.targets),
        estimate_covariance=np.array([m.covariance for m in c.targets], dtype=float).reshape(-1, 12, 12),
        estimate_status=[m.status for m in c.targets],
        references=dict(c.references),
        sightings=dict(c.sightings),
        solver=c.solver,
        world=c.world,
        events=c.events,
        replies=c.replies,
        counts=dict(sorted(c.counts.items())),
        lost=c.lost,
        rejected=dict(rejected),
        expected=c.expected,
        latency_s=np.array(c.latency),
        wall_time_s=(c.wall[-1] - c.wall[0]) / 1e9 if len(c.wall) > 1 else 0.0,
        digest=digest.hexdigest(),
    )
