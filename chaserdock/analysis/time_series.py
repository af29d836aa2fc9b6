# SPDX-License-Identifier: Apache-2.0
"""Time series of a log for figures: actuator forces, latencies and outcomes of images."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.messages import ActuatorCommand, BodyTruth
from chaserdock_protocol.recording.log import LogSource, Record, read_log
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.bodies import Body
from numpy.typing import NDArray

from .actuation import TickOutput, commanded_output, true_output
from .columns import Columns

ImageOutcome = Literal["used", "rejected", "not seen", "bad image", "not processed"]
"""Outcome of an image: its sighting was used or rejected by the filter; the target was not
detected; the image was unreadable; or the log holds no sighting of it."""
OUTCOMES: tuple[ImageOutcome, ...] = get_args(ImageOutcome)
_OUTCOME_OF_STATUS: dict[str, ImageOutcome] = {"seen": "used", "nothing": "not seen"}


@dataclass
class ImageOutcomes:
    """Outcomes of a chaser's images: exposure times (K,) s and indices into ``OUTCOMES`` (K,)."""

    time_s: Array
    code: NDArray[np.intp]

    def intervals(self, gap_s: float = np.inf) -> Iterator[tuple[float, float, ImageOutcome]]:
        """Yield first and last exposure (s) of consecutive images with equal outcome; a gap over
        ``gap_s`` splits them.
        """
        if not len(self.code):
            return
        breaks = np.flatnonzero((np.diff(self.code) != 0) | (np.diff(self.time_s) > gap_s)) + 1
        edges = [0, *breaks.tolist(), len(self.code)]
        for first, end in pairwise(edges):
            yield float(self.time_s[first]), float(self.time_s[end - 1]), OUTCOMES[self.code[first]]


@dataclass
class ActuatorHistory:
    """Applied (or commanded) force and torque of a chaser in body axes.

    ``force_N`` and ``torque_N_m`` (K, 3) are means over the intervals between ``edges_s`` (K + 1,).
    ``thruster_duty`` (K, J) is the share of an interval during which each thruster was open, with J
    = 0 without thrusters.
    """

    edges_s: Array
    force_N: Array
    torque_N_m: Array
    thruster_duty: Array


@dataclass
class Traces:
    """Time series of each chaser, by number. ``latency``: rows of exposure time (s) and wall-clock
    time from the exposure to the actuators' command (s).
    """

    inputs: dict[int, ActuatorHistory]
    latency: dict[int, Array]
    image_outcomes: dict[int, ImageOutcomes]


@dataclass
class _ActuatorCollector:
    """Averages actuator output over ``every`` ticks per row. The first tick has no interval before
    it.
    """

    every: int
    rows: Columns | None = None
    sums: Array = field(default_factory=lambda: np.zeros(0))
    ticks: int = 0

    def add(self, m: TickOutput) -> None:
        impulses = np.array([*m.impulse_N_s, *m.angular_impulse_N_m_s, *m.thruster_open_s])
        if self.rows is None:
            self.rows = Columns(1 + len(impulses))
            self.rows.add((m.time_s,), np.zeros(len(impulses)))
            self.sums = np.zeros(len(impulses))
            return
        self.sums += impulses
        self.ticks += 1
        if self.ticks % self.every == 0:
            self.rows.add((m.time_s,), self.sums)
            self.sums = np.zeros(len(impulses))

    def finish(self) -> ActuatorHistory | None:
        table = np.zeros((0, 7)) if self.rows is None else self.rows.table()
        if len(table) < 2:
            return None
        edges_s = table[:, 0]
        means = table[1:, 1:] / np.diff(edges_s)[:, None]
        return ActuatorHistory(edges_s, means[:, :3], means[:, 3:6], means[:, 6:])


@dataclass
class _Collector:
    every: int
    body: Body
    tick_s: float
    given: dict[int, _ActuatorCollector] = field(default_factory=dict)
    commanded: dict[int, _ActuatorCollector] = field(default_factory=dict)
    sent: dict[tuple[int, int], int] = field(default_factory=dict)
    latency: dict[int, Columns] = field(default_factory=lambda: defaultdict(lambda: Columns(2)))
    images: dict[int, array[int]] = field(default_factory=lambda: defaultdict(lambda: array("q")))
    sightings: dict[int, array[int]] = field(
        default_factory=lambda: defaultdict(lambda: array("q"))
    )
    outcomes: dict[int, bytearray] = field(default_factory=lambda: defaultdict(bytearray))
    rejected: dict[int, array[int]] = field(default_factory=lambda: defaultdict(lambda: array("q")))

    def add(self, record: Record) -> None:
        message = record.message
        if isinstance(message, BodyTruth):
            if message.body.startswith("chaser/"):
                i = int(message.body.partition("/")[2])
                self.given.setdefault(i, _ActuatorCollector(self.every)).add(true_output(message))
        elif record.topic is topics.IMAGE:
            self.sent[message.chaser, message.tick] = record.sent_ns
            self.images[message.chaser].append(message.sim_time_ns)
        elif record.topic is topics.ACTUATORS:
            self._add_command(message)
            sent_ns = self.sent.pop((message.chaser, message.tick), None)
            if sent_ns is not None:
                latency_s = (record.sent_ns - sent_ns) / 1e9
                self.latency[message.chaser].add((message.sim_time_ns / 1e9, latency_s))
        elif record.topic is topics.SIGHTING:
            self.sightings[message.chaser].append(message.sim_time_ns)
            outcome = _OUTCOME_OF_STATUS.get(message.status, "bad image")
            self.outcomes[message.chaser].append(OUTCOMES.index(outcome))
        elif record.topic is topics.TARGET:
            for chaser in message.rejected:
                self.rejected[chaser].append(message.sim_time_ns)

    def _add_command(self, message: ActuatorCommand) -> None:
        if not self.given:
            collector = self.commanded.setdefault(message.chaser, _ActuatorCollector(self.every))
            collector.add(commanded_output(message, self.body, self.tick_s))

    def image_outcomes(self, chaser: int) -> ImageOutcomes:
        time_ns = np.unique(np.array(self.images[chaser], dtype=np.int64))
        code = np.full(len(time_ns), OUTCOMES.index("not processed"), dtype=np.intp)
        seen_ns = np.array(self.sightings[chaser], dtype=np.int64)
        row = np.searchsorted(time_ns, seen_ns)
        matched = (row < len(time_ns)) & (time_ns[np.minimum(row, len(time_ns) - 1)] == seen_ns)
        code[row[matched]] = np.frombuffer(bytes(self.outcomes[chaser]), dtype=np.uint8)[matched]
        rejected = np.isin(time_ns, np.array(self.rejected[chaser], dtype=np.int64))
        code[rejected & (code == OUTCOMES.index("used"))] = OUTCOMES.index("rejected")
        return ImageOutcomes(time_ns / 1e9, code)


def load_traces(log: LogSource, scenario: FlightScenario, every: int = 1) -> Traces:
    """Read the time series of a log, actuator values as means over ``every`` ticks. Raise LogError
    for an unreadable log.
    """
    numbers = range(len(scenario.chasers))
    keys = [topics.TARGET.key_of()]
    for i in numbers:
        keys += [t.key_of(i) for t in (topics.IMAGE, topics.SIGHTING, topics.ACTUATORS)]
        keys.append(topics.TRUTH_BODY.key_of(f"chaser/{i}"))
    c = _Collector(every, scenario.chaser, 1.0 / scenario.time.rate_hz)
    for record in read_log(log, keys):
        c.add(record)
    found = c.given or c.commanded
    inputs = {i: collector.finish() for i, collector in sorted(found.items())}
    return Traces(
        inputs={i: history for i, history in inputs.items() if history is not None},
        latency={i: rows.table() for i, rows in sorted(c.latency.items())},
        image_outcomes={i: c.image_outcomes(i) for i in sorted(c.images)},
    )
