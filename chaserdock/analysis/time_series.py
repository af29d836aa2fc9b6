"""What figures need of a log beyond ``flight``: inputs, latencies and images over time."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.messages import BodyTruth
from chaserdock_protocol.recording.log import LogSource, Record, read_log
from numpy.typing import NDArray

from .columns import Columns

Look = Literal["used", "rejected", "nothing", "bad image", "unanswered"]
"""What became of an image: its sighting was used, or refused by the fusion; nothing was seen in it; it could not be
read; or no sighting of it is in the log."""
LOOKS: tuple[Look, ...] = get_args(Look)
_FATES: dict[str, Look] = {"seen": "used", "nothing": "nothing"}


@dataclass
class Looks:
    """A chaser's images by exposure: times (K,) s and places in ``LOOKS`` (K,)."""

    time_s: Array
    code: NDArray[np.intp]

    def stretches(self, gap_s: float = np.inf) -> Iterator[tuple[float, float, Look]]:
        """First and last exposure (s) of each run of images with the same fate; a gap of more than ``gap_s`` ends one."""
        if not len(self.code):
            return
        breaks = np.flatnonzero((np.diff(self.code) != 0) | (np.diff(self.time_s) > gap_s)) + 1
        edges = [0, *breaks.tolist(), len(self.code)]
        for first, end in pairwise(edges):
            yield float(self.time_s[first]), float(self.time_s[end - 1]), LOOKS[self.code[first]]


@dataclass
class Inputs:
    """What a chaser's actuators gave, intervals along the first axis, body axes.

    ``edges_s`` (K + 1,) bound the intervals over which ``force_N`` and ``torque_N_m`` (K, 3) are means;
    ``thruster_duty`` (K, J) is the share of it that each thruster was open, with J = 0 without thrusters.
    """

    edges_s: Array
    force_N: Array
    torque_N_m: Array
    thruster_duty: Array


@dataclass
class Traces:
    """Dictionaries by chaser. ``latency``: rows of exposure time (s) and wall-clock seconds to the actuator command."""

    inputs: dict[int, Inputs]
    latency: dict[int, Array]
    looks: dict[int, Looks]


@dataclass
class _Given:
    """Sums up what a chaser's actuators gave, over ``every`` ticks a row; the first tick has no interval before it."""

    every: int
    rows: Columns | None = None
    sums: Array = field(default_factory=lambda: np.zeros(0))
    ticks: int = 0

    def take(self, m: BodyTruth) -> None:
        given = np.array([*m.impulse_N_s, *m.angular_impulse_N_m_s, *m.thruster_open_s])
        if self.rows is None:
            self.rows = Columns(1 + len(given))
            self.rows.add((m.sim_time_ns / 1e9,), np.zeros(len(given)))
            self.sums = np.zeros(len(given))
            return
        self.sums += given
        self.ticks += 1
        if self.ticks % self.every == 0:
            self.rows.add((m.sim_time_ns / 1e9,), self.sums)
            self.sums = np.zeros(len(given))

    def finish(self) -> Inputs | None:
        table = np.zeros((0, 7)) if self.rows is None else self.rows.table()
        if len(table) < 2:
            return None
        edges_s = table[:, 0]
        means = table[1:, 1:] / np.diff(edges_s)[:, None]
        return Inputs(edges_s, means[:, :3], means[:, 3:6], means[:, 6:])


@dataclass
class _Collector:
    every: int
    given: dict[int, _Given] = field(default_factory=dict)
    sent: dict[tuple[int, int], int] = field(default_factory=dict)
    latency: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(2)))
    images: dict[int, array[int]] = field(default_factory=lambda: defaultdict(lambda: array("q")))
    sightings: dict[int, array[int]] = field(default_factory=lambda: defaultdict(lambda: array("q")))
    fates: dict[int, bytearray] = field(default_factory=lambda: defaultdict(bytearray))
    refused: dict[int, array[int]] = field(default_factory=lambda: defaultdict(lambda: array("q")))

    def take(self, record: Record) -> None:
        message = record.message
        if isinstance(message, BodyTruth):
            if message.body.startswith("chaser/"):
                i = int(message.body.partition("/")[2])
                self.given.setdefault(i, _Given(self.every)).take(message)
        elif record.topic is topics.IMAGE:
            self.sent[message.chaser, message.tick] = record.sent_ns
            self.images[message.chaser].append(message.sim_time_ns)
        elif record.topic is topics.ACTUATORS:
            begun = self.sent.pop((message.chaser, message.tick), None)
            if begun is not None:
                self.latency[message.chaser].add((message.sim_time_ns / 1e9, (record.sent_ns - begun) / 1e9))
        elif record.topic is topics.SIGHTING:
            self.sightings[message.chaser].append(message.sim_time_ns)
            self.fates[message.chaser].append(LOOKS.index(_FATES.get(message.status, "bad image")))
        elif record.topic is topics.TARGET:
            for chaser in message.rejected:
                self.refused[chaser].append(message.sim_time_ns)

    def looks(self, chaser: int) -> Looks:
        time_ns = np.unique(np.array(self.images[chaser], dtype=np.int64))
        code = np.full(len(time_ns), LOOKS.index("unanswered"), dtype=np.intp)
        seen_ns = np.array(self.sightings[chaser], dtype=np.int64)
        place = np.searchsorted(time_ns, seen_ns)
        inside = (place < len(time_ns)) & (time_ns[np.minimum(place, len(time_ns) - 1)] == seen_ns)
        code[place[inside]] = np.frombuffer(bytes(self.fates[chaser]), dtype=np.uint8)[inside]
        refused = np.isin(time_ns, np.array(self.refused[chaser], dtype=np.int64))
        code[refused & (code == LOOKS.index("used"))] = LOOKS.index("rejected")
        return Looks(time_ns / 1e9, code)


def load_traces(log: LogSource, chasers: Iterable[int], every: int = 1) -> Traces:
    """The traces of a log, inputs as means over ``every`` ticks; raises LogError where it cannot be read. Holds no image
    in memory."""
    numbers = list(chasers)
    keys = [topics.TARGET.key_of()]
    for i in numbers:
        keys += [t.key_of(i) for t in (topics.IMAGE, topics.SIGHTING, topics.ACTUATORS)]
        keys.append(topics.TRUTH_BODY.key_of(f"chaser/{i}"))
    c = _Collector(every)
    for record in read_log(log, keys):
        c.take(record)
    inputs = {i: given.finish() for i, given in sorted(c.given.items())}
    return Traces(
        inputs={i: given for i, given in inputs.items() if given is not None},
        latency={i: rows.table() for i, rows in sorted(c.latency.items())},
        looks={i: c.looks(i) for i in sorted(c.images)},
    )
