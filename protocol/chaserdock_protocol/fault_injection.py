# SPDX-License-Identifier: Apache-2.0
"""Inject the scenario's faults into the messages of a process, by simulated time.

Network faults (loss, delay, corruption) apply at the *receiver*: the log holds the message as sent,
and receivers may lose different messages. Faults of a process (false odometry, clock jump, flood)
apply at the *publisher*, so that the log holds the faulty message. Random draws depend only on the
seed of the process' faults, the key and the tick.

In lock-step a tick waits for its messages. A lost, late or damaged message is therefore replaced by
a ``LostMessage``, on which the reader stops waiting. Real-time readers do not wait, and get none.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.clock import Timing

from chaserdock_protocol.scenario.faults import (
    FAULTY_TOPICS,
    ON_PUBLISHING,
    ON_RECEIPT,
    Fault,
    ProcessFaults,
)

from . import codec, topics
from .codec import Rejected
from .messages import Message, Odometry, PoseSolution, Sighting, WrenchCommand
from .topics import Topic
from .transport.network import Host

_CORRUPTED_BYTES = 4  # as a burst of noise; one byte is often within a number, and harmless
_SENDER_FIELDS = ("commander", "instance", "holder")
"""Fields that name a sender. In real time a reader must refuse a message that names another one;
see ``FaultLayer``.
"""


@dataclass(frozen=True)
class LostMessage:
    """Placeholder, in lock-step, for a message of this tick that the reader will not receive from
    ``sender``.
    """

    tick: int
    sim_time_ns: int
    sender: str = ""


def sender_of(topic: Topic, place: str | None, receiver: str, message: Any = None) -> str:
    """Return the sender of a topic from the view of a receiver.

    Sensor topics come from the world for the chaser itself, and from the chaser (telemetry) for
    other receivers. The sender of a command is the controller that ``message`` names.
    """
    if isinstance(message, WrenchCommand) and message.commander:
        return message.commander
    telemetry = topic in (topics.ODOMETRY, topics.DOCKING) and not receiver.startswith("chaser/")
    if topic.writer == "chaser" or telemetry:
        return f"chaser/{place}"
    return str(topic.writer)


@dataclass
class FaultLayer:
    """Faults of process ``name``. ``host`` kills and freezes the process."""

    faults: tuple[Fault, ...]
    name: str
    timing: Timing
    seed: int
    lockstep: bool
    host: Host
    count: dict[str, int] = field(default_factory=dict)
    _held: dict[str, list[tuple[int, bool, Any]]] = field(default_factory=dict)
    _first_tick: int | None = None
    _applied: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._own = [(k, f) for k, f in enumerate(self.faults) if f.process == self.name]
        self._receipt = [(k, f) for k, f in enumerate(self.faults) if f.kind in ON_RECEIPT]
        self._publishing = [(k, f) for k, f in enumerate(self.faults) if f.kind in ON_PUBLISHING]

    def active(self, fault: Fault, tick: int) -> bool:
        """Return whether a fault affects the messages of a tick."""
        begin, end = fault.ticks(self.timing.rate_hz)
        return begin <= tick < end

    def transitions_at(self, tick: int) -> list[tuple[str, str]]:
        """Return the faults that begin or end at a tick, as event texts: (what, detail)."""
        transitions = []
        for fault in self.faults:
            begin, end = fault.ticks(self.timing.rate_hz)
            if tick == begin:
                transitions.append(("fault begins", fault.text()))
            elif tick == end and fault.duration_s is not None:
                transitions.append(("fault ends", fault.text()))
        return transitions

    # -- faults of the process itself --------------------------------------------------------------

    def apply_process_faults(self, tick: int) -> None:
        """Kill or freeze this process if that is due. Call it before processing anything of the
        tick.

        A restarted process ignores faults that began before its first tick.
        """
        if self._first_tick is None:
            self._first_tick = tick
        for k, fault in self._own:
            if fault.kind not in ("kill", "freeze") or k in self._applied:
                continue
            begin, _ = fault.ticks(self.timing.rate_hz)
            if tick < begin:
                continue
            self._applied.add(k)
            if self._first_tick >= begin:
                continue
            if fault.kind == "kill":
                self.host.kill()
            else:
                self.host.freeze(fault.duration_s or 0.0)

    # -- published messages ------------------------------------------------------------------------

    def outgoing(self, topic: Topic, place: int | str | None, message: Any) -> list[Any]:
        """Return the messages to publish instead of ``message``: unchanged, modified, or several
        copies.
        """
        copies = 1
        for _, fault in self._publishing:
            if not self.active(fault, message.tick):
                continue
            if fault.kind == "odometry_lie":
                if topic is topics.ODOMETRY and fault.process == f"chaser/{place}":
                    message = self._count(fault, _falsify_odometry(message, fault))
            elif fault.process != self.name:
                continue
            elif fault.kind == "lying_sensor" and topic is topics.SIGHTING:
                message = self._count(fault, _falsify_sighting(message, fault))
            elif fault.kind == "clock_jump":
                message = self._count(fault, _shift_stamps(message, fault.offset_s or 0.0))
            elif fault.kind == "flood" and topic is FAULTY_TOPICS[str(fault.topic)]:
                copies += self._count(fault, fault.copies or 0)
        return [message] * copies

    def _count(self, fault: Fault, result: Any) -> Any:
        self.count[fault.kind] = self.count.get(fault.kind, 0) + 1
        return result

    # -- received messages -------------------------------------------------------------------------

    def incoming(self, topic: Topic, place: str | None, message: Any, payload: bytes) -> list[Any]:
        """Return the messages to deliver instead of ``message``, in order. See ``LostMessage`` for
        losses.
        """
        if message.tick >= 0:
            self.apply_process_faults(message.tick)

        key = topic.key_of(place)
        out = self._release_delayed(key, message.tick)

        for k, fault in self._receipt:
            if not self._affects(k, fault, topic, place, message):
                continue
            self._count(fault, None)
            sender = sender_of(topic, place, self.name, message)
            lost = [LostMessage(message.tick, message.sim_time_ns, sender)] if self.lockstep else []

            if fault.kind == "duplicate":
                return [*out, message, message, *self._release_overtaken(key)]
            if fault.kind == "delay":
                late = max(1, round((fault.delay_s or 0.0) * self.timing.rate_hz))
                self._held.setdefault(key, []).append((message.tick + late, False, message))
                return [*out, *lost]
            if fault.kind == "reorder":
                if overtaken := self._release_overtaken(key):
                    return [*out, message, *overtaken]
                self._held.setdefault(key, []).append((message.tick + 1, True, message))
                return [*out, *lost]
            if fault.kind == "corrupt":
                damaged = self._corrupt(topic, key, message, payload)
                return [
                    *out,
                    *(lost if damaged is None else [damaged]),
                    *self._release_overtaken(key),
                ]
            return [*out, *lost, *self._release_overtaken(key)]  # cut, drop, camera_off
        return [*out, message, *self._release_overtaken(key)]

    def _affects(self, k: int, fault: Fault, topic: Topic, place: str | None, message: Any) -> bool:
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
        return share >= 1.0 or self._random(k, topic.key_of(place), tick).random() < share

    def _random(self, k: int, key: str, tick: int) -> random.Random:
        return random.Random(f"{self.seed}/{k}/{key}/{tick}")

    def _release_delayed(self, key: str, tick: int) -> list[Any]:
        """Return the messages of a key whose delay has passed at ``tick``."""
        held = self._held.get(key)
        if not held:
            return []
        due = [m for release, after, m in held if release <= tick and not after]
        self._held[key] = [h for h in held if h[0] > tick or h[1]]
        return due

    def _release_overtaken(self, key: str) -> list[Any]:
        """Return the messages of a key that the present message overtakes (reordering)."""
        held = self._held.get(key)
        if not held:
            return []
        self._held[key] = [h for h in held if not h[1]]
        return [m for _, after, m in held if after]

    def _corrupt(self, topic: Topic, key: str, message: Message, payload: bytes) -> Any:
        """Return the message with some payload bits flipped, or None if validation rejects it."""
        draw, data = self._random(-1, key, message.tick), bytearray(payload)
        for _ in range(_CORRUPTED_BYTES):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        try:
            damaged: Any = codec.decode(topic.kind, bytes(data))
        except Rejected:
            return None
        # A message of another tick, chaser or sender does not count as this one. In lock-step the
        # reader would wait for this one without end, so that damage to these fields is a loss.
        # Not accepted for this one: in lock-step the reader would wait on.
        same = all(
            getattr(damaged, name, None) == getattr(message, name, None)
            for name in ("tick", "chaser", "revision", *(_SENDER_FIELDS if self.lockstep else ()))
        )
        return damaged if same else None


def create_fault_layer(
    faults: ProcessFaults, name: str, timing: Timing, lockstep: bool, host: Host
) -> FaultLayer | None:
    """Return the fault layer of process ``name``, which runs on ``host``, or None without
    faults.
    """
    return (
        FaultLayer(faults.faults, name, timing, faults.seed, lockstep, host)
        if faults.faults
        else None
    )


def _rotation(fault: Fault) -> Array:
    return rotations.exp(np.radians(fault.rotation_deg or (0.0, 0.0, 0.0)))


def _shift(position_m: Any, fault: Fault) -> Any:
    return codec.vector(np.asarray(position_m) + np.asarray(fault.offset_m or (0.0, 0.0, 0.0)))


def _falsify_odometry(odometry: Odometry, fault: Fault) -> Odometry:
    """Shift the position by ``offset_m`` (WRF) and rotate the attitude by ``rotation_deg``
    (rotation vector, CRF).
    """
    return msgspec.structs.replace(
        odometry,
        position_m=_shift(odometry.position_m, fault),
        q_wxyz=codec.vector(rotations.multiply(odometry.q_wxyz, _rotation(fault))),
    )


def _falsify_sighting(sighting: Sighting, fault: Fault) -> Sighting:
    """Shift every solution by ``offset_m`` and rotate it by ``rotation_deg`` (rotation vector),
    both in IRF.
    """

    def falsify(solution: PoseSolution) -> PoseSolution:
        return msgspec.structs.replace(
            solution,
            position_m=_shift(solution.position_m, fault),
            q_wxyz=codec.vector(rotations.multiply(_rotation(fault), solution.q_wxyz)),
        )

    return msgspec.structs.replace(
        sighting, solutions=tuple(falsify(s) for s in sighting.solutions)
    )


def _shift_stamps(message: Message, offset_s: float) -> Message:
    """Shift every simulated-time stamp by ``offset_s``, to 0 at least. The tick number does not
    depend on the clock.
    """
    shifted = {
        name: max(0, getattr(message, name) + round(offset_s * 1e9))
        for name in ("sim_time_ns", "effective_time_ns", "expires_ns")
        if name in message.__struct_fields__
    }
    return msgspec.structs.replace(message, **shifted)
