# SPDX-License-Identifier: Apache-2.0
"""The recorder process: writes every message of a run verbatim to MCAP.

In lock-step it acknowledges each tick that it has received completely, which bounds how far the
flight runs ahead. At the end it waits until it has received as many messages as the other processes
report to have published.
"""

from __future__ import annotations

import ctypes
import queue
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field

from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.fault_injection import FaultLayer, create_fault_layer
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Farewell,
    JoinReply,
    MissionEnd,
    Presence,
    RecorderAck,
    SolverStatus,
    Tick,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.recording.log import FLIGHT_SCENARIO, FULL_SCENARIO
from chaserdock_protocol.run_name import run_name
from chaserdock_protocol.scenario import flight_scenario_from_json
from chaserdock_protocol.scenario.faults import process_faults_from_json
from chaserdock_protocol.transport import Node, RawSample
from chaserdock_protocol.transport.bounded_queue import BoundedQueue
from chaserdock_protocol.transport.session import (
    Heartbeat,
    NoFullScenario,
    create_health,
    request_scenario,
    run_member,
)

from .foxglove_layer import SHOWN
from .rotation import Recording

_DRAIN_S = 10.0
"""Longest wall time (s) for which the recorder waits, after the mission's end, for messages that
publishers have counted. Those that are missing then are lost and reported. Longer: slow links
deliver more; shorter: a recorder whose network is cut ends sooner.
"""
_HEALTH_TICKS = 15
"""Ticks between two health messages: one second at the tick rate of most scenarios."""
_BATCH = 64
"""Most messages that are written before the recorder looks for a signal and the world."""
# glibc's malloc.h
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8
_MAPPED_FROM_BYTES = 1 << 18
"""Blocks of at least this size (256 KiB) go back to the system when they are freed: images and
chunks, but not messages.
"""


def main(options: ProcessOptions) -> int:
    """Record to ``options.out``; return 0 if complete, 1 if stopped early or messages are missing,
    2 on an error.
    """
    if options.link.network is None:  # a simulated process shares its heap with others
        _limit_heap()
    return run_member("recorder", "recorder", options, lambda *member: record(options, *member))


def _limit_heap() -> None:
    """Make glibc return large blocks (images, chunks, indices) to the system when they are freed.

    By default glibc keeps blocks up to the largest one freed so far, in one heap per thread, and a
    recorder grows for hours (``benchmarks/mission.py``). No effect with other C libraries.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAPPED_FROM_BYTES)
        mallopt(_M_ARENA_MAX, 2)


def record(
    options: ProcessOptions, node: Node, mission: JoinReply, instance: str, stop: StopSignal
) -> int:
    """Record until the mission has ended and all published messages are in the file; return the
    exit status.

    A world that gives no full scenario, such as one of a laboratory, is recorded with the flight
    scenario that it gives to every process.
    """
    scenario = flight_scenario_from_json(mission.scenario_json, "the world's scenario")
    faults = create_fault_layer(
        process_faults_from_json(mission.faults),
        node.name,
        scenario.timing,
        mission.mode == "lockstep",
        node.host,
    )
    node.message_filter = faults
    recorder = Recorder(node, faults)
    recorder.subscribe()  # such a world need not wait until the recorder is ready
    text, kind = mission.scenario_json, FLIGHT_SCENARIO
    try:
        full = request_scenario(node, mission, stop)
        if full is None:
            return 1
        text, kind = full, FULL_SCENARIO
    except NoFullScenario as reason:
        print_status("recorder", f"{reason} The log holds the flight scenario alone.")
    out = options.out / run_name(mission) if options.by_run else options.out
    recording = Recording(
        out,
        mission,
        text,
        kind,
        options.rotation,
        scenario if options.viewer_layer else None,
        node.host.now_s,
        options.compressed_log,
    )
    try:
        recorder.open(recording, instance, options.stall_s)
        if mission.mode == "realtime":
            # Flight processes have priority; received messages wait in the queue.
            node.host.lower_priority()
        while not recorder.finished() and not (stop() and recorder.idle()):
            recorder.write_waiting(0.1)
            if recorder.ended_s is None and recorder.heartbeat.world_is_gone():
                break
    finally:
        recording.close()
    if recorder.ended_s is None:
        print_status(
            "recorder",
            f"stopped before the mission's end; {recording.path} holds all messages up to then",
        )
        return 1
    missing = recorder.missing()
    for key, number in missing.items():
        print_status("recorder", f"{number} messages of {key} are missing")
    # In real time images may be dropped; every other message must have arrived.
    excused = {k for k in missing if mission.mode == "realtime" and k.endswith("/image")}
    return 1 if missing.keys() - excused else 0


@dataclass
class Recorder:
    """Record messages, and count those that the other processes report to have published."""

    node: Node
    faults: FaultLayer | None
    recording: Recording = field(init=False)
    ended_s: float | None = None
    _received: dict[str, int] = field(default_factory=dict)
    _published: dict[str, dict[str, int]] = field(default_factory=dict)
    _controllers: set[str] = field(default_factory=lambda: {"controller"})
    _mapper: set[str] = field(default_factory=set)
    _expected: set[str] = field(default_factory=set)
    _latest: dict[str, int] = field(default_factory=dict)
    _acked: int = -1
    _commanded: int = -1

    def __post_init__(self) -> None:
        self._queue: BoundedQueue[RawSample] = self.node.host.new_queue()
        self._decoded = _READ

    def subscribe(self) -> None:
        """Subscribe to all topics: messages wait until there is a recording."""
        self.node.advertise(topics.ACK)
        self.node.subscribe_raw("**", self._enqueue)

    def open(self, recording: Recording, instance: str, stall_s: float) -> None:
        """Start the heartbeat, and write to ``recording`` from now on."""
        self.recording = recording
        self._decoded = _READ | SHOWN if recording.shows else _READ
        self.heartbeat = Heartbeat(self.node, instance, stall_s)

    def _enqueue(self, raw: RawSample) -> None:
        if not self._queue.put(raw, len(raw.payload)):
            self.node.counts.rejected["queue full"] += 1

    def write_waiting(self, timeout_s: float) -> None:
        """Write at most ``_BATCH`` waiting messages; if there are none, wait for the next one."""
        while self.node.receive(0) is not None:
            # the raw subscription receives presence as well; the typed one only serves the join
            # barrier
            pass
        try:
            self._write(self._queue.get(timeout_s))
        except queue.Empty:
            self.recording.flush_if_due()
            self.heartbeat.waiting_for = self._missing_keys()
            return
        for _ in range(_BATCH - 1):
            if self._queue.empty():
                return
            self._write(self._queue.get(timeout_s))

    def _write(self, raw: RawSample) -> None:
        found, message = topics.topic_of_key(raw.key), None
        if found is not None and found[0] in self._decoded:
            with suppress(Rejected):
                message = self.node.decode(found[0].kind, raw)
        self.recording.write(raw, message)
        self._received[raw.key] = self._received.get(raw.key, 0) + 1
        self._process(raw.key, message)

    def _process(self, key: str, message: object) -> None:
        if key.startswith(topics.WORLD_BRANCHES):
            self.heartbeat.world_heard()
        if message is None:
            return
        match message:
            case Presence():
                self.heartbeat.take(message)
            case Tick() as tick:
                if self.faults is not None:
                    self.faults.apply_process_faults(tick.tick)
                self.heartbeat.in_flight.set()
                self._expected = {topics.ACTUATORS.key_of(i) for i in tick.chasers}
                if tick.revision or self._controllers != set(tick.controllers):
                    self._commanded = -1  # a controller that is lost may owe the end of a tick
                self._controllers = set(tick.controllers)
                self._mapper = {"mapper"} if tick.mapper else set[str]()
                self._latest[key] = tick.tick
                self._acknowledge()
            case ActuatorCommand() | SolverStatus():
                if isinstance(message, ActuatorCommand) and message.source == "command":
                    self._commanded = max(self._commanded, message.tick)
                self._latest[key] = message.tick
                self._acknowledge()
            case Farewell(process=process, published=published):
                self._published[process] = published
            case MissionEnd():
                self.ended_s = self.node.host.now_s()

    def _missing_keys(self) -> tuple[str, ...]:
        """Return the keys of the messages that the next acknowledgement waits for."""
        return tuple(
            sorted(key for key in self._awaited() if self._latest.get(key, -1) <= self._acked)
        )

    def _awaited(self) -> set[str]:
        awaited = self._expected | {topics.TICK.key_of()}
        solver = topics.SOLVER.key_of()
        return awaited | {solver} if self._latest.get(solver, -1) < self._commanded else awaited

    def _acknowledge(self) -> None:
        awaited, latest = self._awaited(), self._latest
        # Most messages leave others to wait for: find one of these before looking at all.
        if all(latest.get(key, -1) > self._acked for key in awaited):
            held = min(latest[key] for key in awaited)
            self._acked = held
            self.node.publish(topics.ACK, RecorderAck(tick=held))
            if held % _HEALTH_TICKS == 0:
                self.node.publish(topics.HEALTH, create_health(self.node, held, 0), "recorder")

    def missing(self) -> dict[str, int]:
        """Return the number of missing messages by key, according to the counts that publishers
        report.
        """
        # Several controllers publish on the same keys, one at a time.
        total: Counter[str] = Counter()
        for published in self._published.values():
            total.update(published)
        return {
            key: number - self._received.get(key, 0)
            for key, number in total.items()
            # Presence is published before the recorder has subscribed.
            if number > self._received.get(key, 0) and not key.endswith("/presence")
        }

    def idle(self) -> bool:
        """Return whether all received messages are written."""
        return self._queue.empty()

    def finished(self) -> bool:
        """Return whether the mission has ended and all published messages have arrived or timed
        out.
        """
        if self.ended_s is None:
            return False
        publishers = {
            "world",
            *self._controllers,
            *self._mapper,
            *(k.rpartition("/")[0] for k in self._expected if k.startswith("chaser")),
        }
        complete = publishers <= self._published.keys() and not self.missing() and self.idle()
        return complete or self.node.host.now_s() - self.ended_s > _DRAIN_S


_READ = frozenset(
    {topics.TICK, topics.ACTUATORS, topics.SOLVER, topics.PRESENCE, topics.FAREWELL, topics.END}
)
"""Topics whose messages ``_process`` reads; others are decoded for the viewer layer only."""
