"""What figures and video need of a log beyond ``flight``: inputs, latencies, pictures and phases over time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.log import Record, read_log
from chaserdock_protocol.log_scan import LOG_NAME
from chaserdock_protocol.messages import BodyTruth, Reference
from chaserdock_protocol.rotations import Array

Look = Literal["used", "rejected", "nothing", "bad picture", "unanswered"]
"""What became of a picture: its sighting was used, or refused by the fusion; nothing was seen in it; it could not be
read; or no sighting of it is in the log."""


@dataclass
class Inputs:
    """What a chaser's actuators gave, ticks along the first axis, body axes.

    ``edges_s`` (K + 1,) bound the intervals over which ``force_N`` and ``torque_N_m`` (K, 3) are means;
    ``jet_duty`` (K, J) is the share of it that each jet was open, with J = 0 without thrusters.
    """

    edges_s: Array
    force_N: Array
    torque_N_m: Array
    jet_duty: Array


@dataclass
class Traces:
    """Dictionaries by chaser. ``latency``: rows of exposure time (s) and wall-clock seconds to the actuator command."""

    inputs: dict[int, Inputs]
    latency: dict[int, Array]
    looks: dict[int, list[tuple[float, Look]]]


@dataclass
class _Collector:
    bodies: dict[int, list[tuple[Any, ...]]] = field(default_factory=lambda: defaultdict(list))
    sent: dict[tuple[int, int], int] = field(default_factory=dict)
    latency: dict[int, list[tuple[float, float]]] = field(default_factory=lambda: defaultdict(list))
    pictures: dict[int, dict[int, float]] = field(default_factory=lambda: defaultdict(dict))
    sightings: dict[tuple[int, int], str] = field(default_factory=dict)
    refused: set[tuple[int, int]] = field(default_factory=set)

    def take(self, record: Record) -> None:
        message = record.message
        time_s = message.sim_time_ns / 1e9
        if isinstance(message, BodyTruth):
            if message.body.startswith("chaser/"):
                row = (time_s, message.impulse_N_s, message.angular_impulse_N_m_s, message.jet_open_s)
                self.bodies[int(message.body.partition("/")[2])].append(row)
        elif record.topic is topics.IMAGE:
            self.sent[message.chaser, message.tick] = record.sent_ns
            self.pictures[message.chaser][message.sim_time_ns] = time_s
        elif record.topic is topics.ACTUATORS:
            begun = self.sent.pop((message.chaser, message.tick), None)
            if begun is not None:
                self.latency[message.chaser].append((time_s, (record.sent_ns - begun) / 1e9))
        elif record.topic is topics.SIGHTING:
            self.sightings[message.chaser, message.sim_time_ns] = message.status
        elif record.topic is topics.TARGET:
            self.refused.update((chaser, message.sim_time_ns) for chaser in message.rejected)


def _inputs(rows: list[tuple[Any, ...]]) -> Inputs:
    time_s = np.array([row[0] for row in rows])
    # The first tick has no interval before it, and nothing was given yet.
    step = np.diff(time_s)[:, None]
    jets = max((len(row[3]) for row in rows), default=0)
    open_s = np.array([row[3] if len(row[3]) == jets else (0.0,) * jets for row in rows])
    return Inputs(
        edges_s=time_s,
        force_N=np.array([row[1] for row in rows])[1:] / step,
        torque_N_m=np.array([row[2] for row in rows])[1:] / step,
        jet_duty=open_s.reshape(len(rows), jets)[1:] / step,
    )


def _looks(c: _Collector, chaser: int) -> list[tuple[float, Look]]:
    out: list[tuple[float, Look]] = []
    for time_ns, time_s in sorted(c.pictures[chaser].items()):
        status = c.sightings.get((chaser, time_ns))
        look: Look = "unanswered"
        if status == "seen":
            look = "rejected" if (chaser, time_ns) in c.refused else "used"
        elif status is not None:
            look = "nothing" if status == "nothing" else "bad picture"
        out.append((time_s, look))
    return out


def load_traces(log: Path, chasers: Iterable[int]) -> Traces:
    """The traces of a log; raises LogError where it cannot be read. Holds no picture in memory."""
    numbers = list(chasers)
    keys = [topics.TARGET.key_of()]
    for i in numbers:
        keys += [t.key_of(i) for t in (topics.IMAGE, topics.SIGHTING, topics.ACTUATORS)]
        keys.append(topics.TRUTH_BODY.key_of(f"chaser/{i}"))
    c = _Collector()
    for record in read_log(log, keys):
        c.take(record)
    return Traces(
        inputs={i: _inputs(rows) for i, rows in sorted(c.bodies.items()) if len(rows) > 1},
        latency={i: np.array(rows) for i, rows in sorted(c.latency.items())},
        looks={i: _looks(c, i) for i in sorted(c.pictures)},
    )


def phases(references: list[Reference]) -> list[tuple[float, str]]:
    """When (s) a chaser's phases began, and their names."""
    out: list[tuple[float, str]] = []
    for m in references:
        if not out or out[-1][1] != m.phase:
            out.append((m.sim_time_ns / 1e9, m.phase))
    return out


def log_of(path: Path) -> Path:
    """The log that is meant by a log file or a run's folder; raises ChaserdockError when there is none."""
    if path.is_dir():
        if (path / LOG_NAME).is_file():
            return path / LOG_NAME
        raise ChaserdockError(f"{path}: holds no {LOG_NAME}; name a run's folder or a log file")
    if not path.exists():
        raise ChaserdockError(f"{path}: no such file or folder")
    return path
