# SPDX-License-Identifier: Apache-2.0
"""Invariants of processes: none crashes or stalls, queues stay short, the log is complete."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from chaserdock_protocol import topics
from chaserdock_protocol.messages import Event
from chaserdock_protocol.mission.tick_barrier import RECORDER_WINDOW_TICKS
from chaserdock_protocol.recording.scan import LOG_NAME
from chaserdock_protocol.scenario.faults import FAULTY_TOPICS, role_of
from mcap.exceptions import McapError
from mcap.reader import make_reader

from ..mission import SimulatedFlight
from .causes import IN_LATE_NETWORK
from .check import Check
from .flight_view import lost_by
from .reader import reads

QUEUE_LIMIT = 400
"""Most messages that may wait for a reader that nothing delays: 7 ticks of four chasers with ports
and thrusters, which publish 54 messages a tick. Larger: growing queues are found later.
"""
RECORDER_TICKS = RECORDER_WINDOW_TICKS + 2
"""Ticks whose messages may wait for the recorder: those by which it may be behind, plus two, since
some ticks have more messages than the mean.
"""


@dataclass
class NoCrash(Check):
    """No process ends by an exception."""

    name = "no crash"

    def end(self, flight: SimulatedFlight) -> None:
        for name, trace in flight.crashes.items():
            self.violate(name, trace.strip().splitlines()[-1])


@dataclass
class MissionEnds(Check):
    """All processes end, and the mission after the scenario's duration."""

    name = "liveness"
    exceptions = ("its duration, where no command reaches any chaser",)

    def end(self, flight: SimulatedFlight) -> None:
        for name in flight.stalled:
            self.violate(name, "has not ended")
        s, end = self.scenario, self.view.mission_end
        if end is None:
            self.violate("world", "the mission has not ended")
            return
        chasers = {f"chaser/{i}" for i in range(len(s.chasers))}
        if not end.complete and not chasers <= self.view.unreachable:
            self.violate("world", f"the mission ended early: {end.reason}")
        if end.complete and end.tick != s.ticks:
            self.violate("world", f"complete after {end.tick} of {s.ticks} ticks")


@dataclass
class NoLossWithoutCause(Check):
    """The world loses no process and stops no actuators without a cause."""

    name = "no loss without a cause"
    exceptions = (
        "after the first fault of any process",
        f"{IN_LATE_NETWORK} (see [seeds flown](evidence/simulation.md#seeds-flown))",
        "in one with partitions or slow readers",
    )

    @reads(Event)
    def judge(self, event: Event) -> None:
        name = lost_by(event)
        if name is not None and not self.view.causes.loses(self.view.time_s):
            self.violate(name, event.what)


@dataclass
class NoRecordedDataLost(Check):
    """Every message that reached the recorder is in the log; in lock-step every message that was
    published."""

    name = "no recorded data lost"
    exceptions = (
        "if the recorder is killed, or has not ended",
        "what was published, if a process is killed or cut off",
    )

    def end(self, flight: SimulatedFlight) -> None:
        if "recorder" in flight.stalled or flight.statuses.get("recorder") is None:
            return
        try:
            with (flight.folder / LOG_NAME).open("rb") as file:
                index = make_reader(file).get_summary()
        except (OSError, McapError) as error:
            self.violate("recorder", f"the log cannot be read: {error}")
            return
        if index is None or index.statistics is None:
            self.violate("recorder", "the log has no index")
            return
        recorded: Counter[str] = Counter()
        for channel, number in index.statistics.channel_message_counts.items():
            recorded[index.channels[channel].topic] += number

        s, expected = self.scenario, Counter(flight.traffic.recorded)
        unreachable = s.simulation.partition or {"cut", "kill"} & {f.kind for f in s.fault}
        if s.simulation.mode == "lockstep" and not unreachable:
            expected |= self.view.published
        for key, number in expected.items():
            if recorded.get(key, 0) != number:
                self.violate(key, f"{recorded.get(key, 0)} of {number} messages are in the log")


@dataclass
class BoundedQueues(Check):
    """At most ``QUEUE_LIMIT`` messages wait for a reader; for the recorder, which may be some ticks
    behind, as many as are published in ``RECORDER_TICKS`` ticks, if that is more."""

    name = "bounded queues"
    exceptions = (
        "a reader that is itself slow, frozen, or cut off by a partition",
        "a reader of a flooded message",
        "in real time, the messages of the ticks that a process opens or replies to at once after "
        "it was frozen or slow",
    )

    def end(self, flight: SimulatedFlight) -> None:
        s = self.scenario
        behind_s = [f.duration_s or 0.0 for f in s.fault if f.kind == "freeze"]
        behind_s += [slow.duration_s for slow in s.simulation.slow]
        missed_ticks = sum(behind_s) * s.time.rate_hz if s.simulation.mode == "realtime" else 0.0
        published = self.view.published.total()
        for name, items in flight.traffic.queues.items():
            reader = name.split()[0]
            limit = queue_limit(reader, published, self.view.ticks, missed_ticks)
            if items.most > limit and not self._falls_behind(reader):
                self.violate(reader, f"{items.most} messages waited")

    def _falls_behind(self, reader: str) -> bool:
        """Return whether the network or a fault fills the queue of a process."""
        s = self.scenario
        return (
            any(w.process == reader for w in s.simulation.slow)
            or any(reader in p.processes for p in s.simulation.partition)
            or any(f.kind == "freeze" and f.process == reader for f in s.fault)
            or any(
                f.kind == "flood" and topics.may_read(role_of(reader), FAULTY_TOPICS[str(f.topic)])
                for f in s.fault
            )
        )


def queue_limit(reader: str, published: int, ticks: int, missed_ticks: float = 0.0) -> int:
    """Return how many messages may wait for a process in a flight with ``published`` messages and
    ``ticks`` ticks.

    ``missed_ticks``: most ticks that a process opens or answers at once after it was frozen or
    slow.
    """
    behind = missed_ticks + (RECORDER_TICKS if reader == "recorder" else 0)
    return max(QUEUE_LIMIT, math.ceil(behind * published / max(1, ticks)))
