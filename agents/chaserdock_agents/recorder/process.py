"""The recorder process: every message of the run, verbatim, into one MCAP file.

In lock-step it confirms each tick that it holds completely, which bounds how far the flight runs ahead; at
the end it waits until it has all that the others say they published.
"""

from __future__ import annotations

import ctypes
import os
import queue
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field

from chaserdock_protocol import codec, topics
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
from chaserdock_protocol.run_name import run_name
from chaserdock_protocol.scenario import scenario_from_json
from chaserdock_protocol.transport import Node, RawSample
from chaserdock_protocol.transport.bounded_queue import BoundedQueue
from chaserdock_protocol.transport.session import Heartbeat, create_health, run_member

from .foxglove_layer import SHOWN
from .rotation import Recording

_DRAIN_S = 10.0
_HEALTH_TICKS = 15
_WRITING_NICE = 19
# glibc's malloc.h
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8
_MAPPED_FROM_BYTES = 1 << 18


def main(options: ProcessOptions) -> int:
    """Records into ``options.out``; 0 when complete, 1 when stopped early or messages are missing, 2 if it could not."""
    _give_memory_back()
    return run_member("recorder", "recorder", options, lambda *member: record(options, *member))


def _give_memory_back() -> None:
    """Large pieces (images, chunks, a part's index) go back to the system when they are done with, for days on end.

    Left to itself glibc keeps pieces as large as the largest one freed so far, in a heap for each thread, and a
    recorder grows for hours (``benchmarks/endurance.py``). Elsewhere there is nothing to set.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAPPED_FROM_BYTES)
        mallopt(_M_ARENA_MAX, 2)


def record(options: ProcessOptions, node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
    """Records until the mission is over and all that was published is in the file; the process' status."""
    source = "the world's scenario"
    scenario = scenario_from_json(mission.scenario_json, source) if options.viewer_layer else None
    out = options.out / run_name(mission) if options.by_run else options.out
    recording = Recording(out, mission, options.rotation, scenario)
    try:
        flown = scenario or scenario_from_json(mission.scenario_json, source)
        faults = create_fault_layer(flown, node.name, lockstep=mission.mode == "lockstep")
        node.message_filter = faults
        recorder = Recorder(node, recording, faults)
        recorder.open(instance)
        if mission.mode == "realtime":
            # Writing gives way to those who fly; what has been heard waits in the queue.
            os.nice(_WRITING_NICE)
        while not recorder.finished() and not (stop() and recorder.idle()):
            recorder.take_one(0.1)
    finally:
        recording.close()
    if recorder.ended_s is None:
        print_status(
            "recorder", f"stopped before the mission's end; {recording.path} holds what came until then"
        )
        return 1
    missing = recorder.missing()
    for key, number in missing.items():
        print_status("recorder", f"{number} messages of {key} never came")
    # In real time images are dropped rather than waited for; anything else must be here.
    excused = {k for k in missing if mission.mode == "realtime" and k.endswith("/image")}
    return 1 if missing.keys() - excused else 0


@dataclass
class Recorder:
    """What has been recorded, and what the ends of the others say there should be."""

    node: Node
    recording: Recording
    faults: FaultLayer | None
    ended_s: float | None = None
    _waiting: BoundedQueue[RawSample] = field(default_factory=BoundedQueue)
    _received: dict[str, int] = field(default_factory=dict)
    _promised: dict[str, dict[str, int]] = field(default_factory=dict)
    _controllers: set[str] = field(default_factory=lambda: {"controller"})
    _expected: set[str] = field(default_factory=set)
    _latest: dict[str, int] = field(default_factory=dict)
    _acked: int = -1

    def open(self, instance: str) -> None:
        """Subscribes everything, then tells its presence."""
        self.node.advertise(topics.ACK)
        self.node.subscribe_raw("**", self._arrived)
        self.heartbeat = Heartbeat(self.node, instance)

    def _arrived(self, raw: RawSample) -> None:
        if not self._waiting.put(raw, len(raw.payload)):
            self.node.counts.rejected["queue full"] += 1

    def take_one(self, timeout_s: float) -> None:
        """Writes one message, if one comes in time."""
        while self.node.receive(0) is not None:
            pass  # presence reaches the raw subscription, too; the typed one is only for the barrier
        try:
            raw = self._waiting.get(timeout_s)
        except queue.Empty:
            return
        found, message = topics.topic_of_key(raw.key), None
        if found is not None and found[0] in _OPENED:
            with suppress(Rejected):
                message = codec.decode(found[0].kind, raw.payload, raw.encoding)
        self.recording.write(raw, message)
        self._received[raw.key] = self._received.get(raw.key, 0) + 1
        self._note(raw.key, message)

    def _note(self, key: str, message: object) -> None:
        match message:
            case Presence():
                self.heartbeat.take(message)
            case Tick() as tick:
                if self.faults is not None:
                    self.faults.apply_process_faults(tick.tick)
                self.heartbeat.in_flight.set()
                self._expected = {topics.ACTUATORS.key_of(i) for i in tick.chasers}
                self._controllers = {tick.commander or "controller", *tick.standing_by}
                if tick.controller:
                    self._expected.add(topics.SOLVER.key_of())
                self._latest[key] = tick.tick
                self._confirm()
            case ActuatorCommand() | SolverStatus():
                self._latest[key] = message.tick
                self._confirm()
            case Farewell(process=process, published=published):
                self._promised[process] = published
            case MissionEnd():
                self.ended_s = time.monotonic()

    def _confirm(self) -> None:
        keys = self._expected | {topics.TICK.key_of()}
        held = min(self._latest.get(key, -1) for key in keys)
        if held > self._acked:
            self._acked = held
            self.node.publish(topics.ACK, RecorderAck(tick=held))
            if held % _HEALTH_TICKS == 0:
                self.node.publish(topics.HEALTH, create_health(self.node, held, 0), "recorder")

    def missing(self) -> dict[str, int]:
        """Messages that were published, by their publishers' own account, and never came."""
        # Several controllers publish on the same keys, one at a time.
        promised: Counter[str] = Counter()
        for published in self._promised.values():
            promised.update(published)
        return {
            key: number - self._received.get(key, 0)
            for key, number in promised.items()
            # Presence is told from before the recorder can hear it.
            if number > self._received.get(key, 0) and not key.endswith("/presence")
        }

    def idle(self) -> bool:
        """Whether nothing waits to be written."""
        return self._waiting.empty()

    def finished(self) -> bool:
        """Whether the mission is over and all that was published is here, or has had its time to come."""
        if self.ended_s is None:
            return False
        everyone = {
            "world",
            *self._controllers,
            *(k.rpartition("/")[0] for k in self._expected if k.startswith("chaser")),
        }
        complete = everyone <= self._promised.keys() and not self.missing() and self.idle()
        return complete or time.monotonic() - self.ended_s > _DRAIN_S


_OPENED = SHOWN | {
    topics.TICK, topics.ACTUATORS, topics.SOLVER, topics.PRESENCE, topics.FAREWELL, topics.END
}  # fmt: skip
"""Topics whose messages are opened: those shown, and those that ``_note`` reads."""
