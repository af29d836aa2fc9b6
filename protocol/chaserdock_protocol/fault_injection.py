"""Faults as a mission's scenario asks for them, applied where a process meets the network. Simulated time decides.

What is lost or late on the way is so where it is *received*: the log holds what was sent, and each receiver may miss
something else. What a process says that is not so (a lie, a wrong clock, a flood) is so where it is *published*, and
lies in the log as it was told. Everything that is drawn comes from the scenario's seed, the key and the tick alone.

In lock-step a tick waits for its answers, so what is lost, late or damaged leaves a ``Lost`` in its place, by which its
reader knows that nothing will come. In real time nobody waits, and there is none.
"""

from __future__ import annotations

import math
import os
import random
import signal
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.clock import Timing

from chaserdock_protocol.scenario.faults import FAULTY_TOPICS, ON_PUBLISHING, ON_RECEIPT, Fault

from . import codec, topics
from .codec import Rejected
from .messages import Message, Odometry, PoseSolution, Sighting, WrenchCommand
from .scenario import Scenario
from .topics import Topic

_CORRUPTED_BYTES = 4


@dataclass(frozen=True)
class Lost:
    """In lock-step: the message of this tick, which has been lost on its way to this reader."""

    tick: int
    sim_time_ns: int


def sender_of(topic: Topic, place: str | None, receiver: str, message: Any = None) -> str:
    """Who a receiver hears a topic from. A chaser's own sensors are the world's; to others they are its telemetry.

    Of several controllers it is the one whose command the ``message`` is.
    """
    if isinstance(message, WrenchCommand) and message.commander:
        return message.commander
    telemetry = topic in (topics.ODOMETRY, topics.DOCKING) and not receiver.startswith("chaser/")
    if topic.writer == "chaser" or telemetry:
        return f"chaser/{place}"
    return str(topic.writer)


@dataclass
class FaultLayer:
    """The faults of one process, ``name``. ``end`` and ``stop`` are what a kill and a freeze (seconds) do to it."""

    faults: tuple[Fault, ...]
    name: str
    timing: Timing
    seed: int
    lockstep: bool
    end: Callable[[], None] = field(default_factory=lambda: _kill)
    stop: Callable[[float], None] = field(default_factory=lambda: _freeze)
    count: dict[str, int] = field(default_factory=dict)
    _held: dict[str, list[tuple[int, bool, Any]]] = field(default_factory=dict)
    _first_tick: int | None = None
    _struck: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._own = [(k, f) for k, f in enumerate(self.faults) if f.process == self.name]
        self._receipt = [(k, f) for k, f in enumerate(self.faults) if f.kind in ON_RECEIPT]
        self._publishing = [(k, f) for k, f in enumerate(self.faults) if f.kind in ON_PUBLISHING]

    def active(self, fault: Fault, tick: int) -> bool:
        """Whether a fault acts on what belongs to a tick."""
        begin, end = self._ticks(fault)
        return begin <= tick < end

    def _ticks(self, fault: Fault) -> tuple[int, int]:
        """The first tick of a fault, and the first one after it; at least one tick."""
        begin = max(1, math.ceil(fault.at_s * self.timing.rate_hz - 1e-9))
        return begin, begin + max(1, round((fault.duration_s or 0.0) * self.timing.rate_hz))

    def told_at(self, tick: int) -> list[tuple[str, str]]:
        """What begins and ends at a tick, for the log: (what, which)."""
        told = []
        for fault in self.faults:
            begin, end = self._ticks(fault)
            if tick == begin:
                told.append(("fault begins", fault.text()))
            elif tick == end and fault.duration_s is not None:
                told.append(("fault ends", fault.text()))
        return told

    # -- what happens to the process itself ---------------------------------------------------------------

    def strike(self, tick: int) -> None:
        """Kills or freezes this process if that is due at a tick; called before anything of it is worked on.

        A process that was started again does not die again of what is past.
        """
        if self._first_tick is None:
            self._first_tick = tick
        for k, fault in self._own:
            if fault.kind not in ("kill", "freeze") or k in self._struck:
                continue
            begin, _ = self._ticks(fault)
            if tick < begin:
                continue
            self._struck.add(k)
            if self._first_tick >= begin:
                continue
            if fault.kind == "kill":
                self.end()
            else:
                self.stop(fault.duration_s or 0.0)

    # -- what it publishes --------------------------------------------------------------------------------

    def outgoing(self, topic: Topic, place: int | str | None, message: Any) -> list[Any]:
        """What is really published in place of a message: itself, changed, or several times."""
        copies = 1
        for _, fault in self._publishing:
            if not self.active(fault, message.tick):
                continue
            if fault.kind == "odometry_lie":
                if topic is topics.ODOMETRY and fault.process == f"chaser/{place}":
                    message = self._note(fault, _lying_odometry(message, fault))
            elif fault.process != self.name:
                continue
            elif fault.kind == "lying_sensor" and topic is topics.SIGHTING:
                message = self._note(fault, _lying_sighting(message, fault))
            elif fault.kind == "clock_jump":
                message = self._note(fault, _stamped(message, fault.offset_s or 0.0))
            elif fault.kind == "flood" and topic is FAULTY_TOPICS[str(fault.topic)]:
                copies += self._note(fault, fault.copies or 0)
        return [message] * copies

    def _note(self, fault: Fault, result: Any) -> Any:
        self.count[fault.kind] = self.count.get(fault.kind, 0) + 1
        return result

    # -- what it receives ---------------------------------------------------------------------------------

    def incoming(self, topic: Topic, place: str | None, message: Any, payload: bytes) -> list[Any]:
        """What really reaches the process in place of a message, in this order; ``Lost`` where it knows of a loss."""
        if message.tick >= 0:
            self.strike(message.tick)
        key = topic.key_of(place)
        out = self._due(key, message.tick)
        for k, fault in self._receipt:
            if not self._hits(k, fault, topic, place, message):
                continue
            self._note(fault, None)
            lost = [Lost(message.tick, message.sim_time_ns)] if self.lockstep else []
            if fault.kind == "duplicate":
                return [*out, message, message, *self._after(key)]
            if fault.kind == "delay":
                late = max(1, round((fault.delay_s or 0.0) * self.timing.rate_hz))
                self._held.setdefault(key, []).append((message.tick + late, False, message))
                return [*out, *lost]
            if fault.kind == "reorder":
                self._held.setdefault(key, []).append((message.tick + 1, True, message))
                return [*out, *lost]
            if fault.kind == "corrupt":
                damaged = self._damaged(topic, key, message, payload)
                return [*out, *(lost if damaged is None else [damaged]), *self._after(key)]
            return [*out, *lost, *self._after(key)]  # cut, drop, camera_off
        return [*out, message, *self._after(key)]

    def _hits(self, k: int, fault: Fault, topic: Topic, place: str | None, message: Any) -> bool:
        tick = message.tick
        if not self.active(fault, tick) or topic not in FAULTY_TOPICS.values():
            return False
        sender = sender_of(topic, place, self.name, message)
        if fault.kind == "cut":
            ends = {sender, self.name}
            return fault.process in ends and (fault.peer is None or fault.peer in ends)
        if fault.process != self.name or (fault.peer is not None and fault.peer != sender):
            return False
        if fault.kind == "camera_off":
            return topic is topics.IMAGE
        if topic is not FAULTY_TOPICS[str(fault.topic)]:
            return False
        share = fault.share if fault.share is not None else 1.0
        return share >= 1.0 or self._drawn(k, topic.key_of(place), tick).random() < share

    def _drawn(self, k: int, key: str, tick: int) -> random.Random:
        return random.Random(f"{self.seed}/{k}/{key}/{tick}")

    def _due(self, key: str, tick: int) -> list[Any]:
        """Messages of a key whose delay is over when one of ``tick`` comes."""
        held = self._held.get(key)
        if not held:
            return []
        due = [m for release, after, m in held if release <= tick and not after]
        self._held[key] = [h for h in held if h[0] > tick or h[1]]
        return due

    def _after(self, key: str) -> list[Any]:
        """Messages of a key that a later one overtakes."""
        held = self._held.get(key)
        if not held:
            return []
        self._held[key] = [h for h in held if not h[1]]
        return [m for _, after, m in held if after]

    def _damaged(self, topic: Topic, key: str, message: Message, payload: bytes) -> Any:
        """The message after some of its bytes were changed; None when it is not accepted."""
        draw, data = self._drawn(-1, key, message.tick), bytearray(payload)
        for _ in range(_CORRUPTED_BYTES):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        try:
            damaged: Any = codec.decode(topic.kind, bytes(data))
        except Rejected:
            return None
        # What belongs to another tick or chaser is not taken for this one's.
        same = damaged.tick == message.tick and getattr(damaged, "chaser", None) == getattr(
            message, "chaser", None
        )
        return damaged if same else None


def layer_of(scenario: Scenario, name: str, lockstep: bool) -> FaultLayer | None:
    """The faults that a process of a mission meets; None when there are none at all."""
    if not scenario.fault:
        return None
    return FaultLayer(scenario.fault, name, scenario.timing, scenario.seed, lockstep)


def _turned(fault: Fault) -> rotations.Array:
    return rotations.exp(np.radians(fault.rotation_deg or (0.0, 0.0, 0.0)))


def _moved(position_m: Any, fault: Fault) -> Any:
    return codec.vector(np.asarray(position_m) + np.asarray(fault.offset_m or (0.0, 0.0, 0.0)))


def _lying_odometry(odometry: Odometry, fault: Fault) -> Odometry:
    """Position off by ``offset_m`` (WRF), attitude turned by ``rotation_deg`` (rotation vector, CRF)."""
    return msgspec.structs.replace(
        odometry,
        position_m=_moved(odometry.position_m, fault),
        q_wxyz=codec.vector(rotations.multiply(odometry.q_wxyz, _turned(fault))),
    )


def _lying_sighting(sighting: Sighting, fault: Fault) -> Sighting:
    """Every solution off by ``offset_m`` and turned by ``rotation_deg`` (rotation vector), both in IRF."""

    def lying(solution: PoseSolution) -> PoseSolution:
        return msgspec.structs.replace(
            solution,
            position_m=_moved(solution.position_m, fault),
            q_wxyz=codec.vector(rotations.multiply(_turned(fault), solution.q_wxyz)),
        )

    return msgspec.structs.replace(sighting, solutions=tuple(lying(s) for s in sighting.solutions))


def _stamped(message: Message, offset_s: float) -> Message:
    """The message with every stamp of simulated time off by ``offset_s``, none before 0; its tick is not the clock's."""
    off = {
        name: max(0, getattr(message, name) + round(offset_s * 1e9))
        for name in ("sim_time_ns", "effective_time_ns", "expires_ns")
        if name in message.__struct_fields__
    }
    return msgspec.structs.replace(message, **off)


def _kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _freeze(seconds: float) -> None:
    """Stops this process for so long by the wall clock; a helper of its own lets it go on."""
    command = ["/bin/sh", "-c", f'sleep {seconds:.3f}; kill -CONT "$0"', str(os.getpid())]
    with open(os.devnull, "r+b") as nothing:
        subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True)
    os.kill(os.getpid(), signal.SIGSTOP)
