# SPDX-License-Identifier: Apache-2.0
"""Replace a process' network node and heartbeat, to replay a log through today's code."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from .messages import Message
from .scenario import FlightScenario
from .topics import Topic
from .transport import ReceivedMessage, TrafficCounters
from .transport.network import Machine

Published = tuple[Topic, int | str | None, Message]
"""A published message: topic, place, message (``seq`` not set)."""


class ReplayNode:
    """Stand in for a ``Node``: deliver the messages that were put in, and collect published
    ones.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.counts = TrafficCounters()
        self.host = Machine()
        self._pending: deque[ReceivedMessage] = deque()
        self._published: list[Published] = []

    def put(self, received: ReceivedMessage) -> None:
        """Append a message to receive."""
        self._pending.append(received)

    def receive(self, timeout_s: float | None) -> ReceivedMessage | None:
        """Return the next message, as ``Node.receive`` does, without waiting."""
        return self._pending.popleft() if self._pending else None

    def is_forged(self, received: ReceivedMessage) -> bool:
        """Return False: what is put in is what the recorder took."""
        return False

    def publish(self, topic: Topic, message: Message, place: int | str | None = None) -> None:
        """Collect a message, as ``Node.publish`` sends it."""
        self._published.append((topic, place, message))

    def take_published(self) -> list[Published]:
        """Return the messages published since the last call."""
        published, self._published = self._published, []
        return published


class SilentHeartbeat:
    """Stand in for a ``Heartbeat``: publish and record nothing."""

    def __init__(self) -> None:
        self.in_flight = threading.Event()

    def take(self, message: Any) -> None:
        """Ignore a presence."""

    def is_replaced(self, listed: Any) -> bool:
        """Return False: a recorded process is the one that the world lists."""
        return False

    def report_waiting(self, received: Any, missing_keys: Any) -> None:
        """Ignore what the process waits for."""


@dataclass(frozen=True)
class Stage:
    """A part of the flight software that can be replayed on a log.

    ``play(scenario, recorded)`` yields the messages that today's code publishes for the recorded
    ``inputs``. It also gets the recorded ``outputs``, before the inputs of their tick, only to
    detect from their ``seq`` that a process was restarted. Within a tick, messages come in the
    order of ``inputs``.
    """

    process: str
    inputs: tuple[Topic, ...]
    outputs: tuple[Topic, ...]
    play: Callable[[FlightScenario, Iterable[ReceivedMessage]], Iterator[Published]]


# Upper bound on the delay of a lock-step message in a log, in ticks: the flight waits for the
# recorder.
_MAX_DELAY_TICKS = 64


def order_by_tick(stage: Stage, recorded: Iterable[ReceivedMessage]) -> Iterator[ReceivedMessage]:
    """Yield the messages of a lock-step flight by tick, and within a tick in the order of the
    stage's topics.

    A recorder receives messages of different processes in any order.
    """
    rank = {id(topic): k for k, topic in enumerate((*stage.outputs, *stage.inputs))}
    ticks: dict[int, list[ReceivedMessage]] = {}
    for received in recorded:
        tick = received.message.tick
        ticks.setdefault(tick, []).append(received)
        for complete in sorted(t for t in ticks if t < tick - _MAX_DELAY_TICKS):
            yield from sorted(ticks.pop(complete), key=lambda r: _order(r, rank))
    for complete in sorted(ticks):
        yield from sorted(ticks[complete], key=lambda r: _order(r, rank))


def _order(received: ReceivedMessage, rank: dict[int, int]) -> tuple[int, int]:
    # Processes received a revised tick after the other messages of the tick.
    revision = getattr(received.message, "revision", 0)
    return (len(rank) if revision else rank[id(received.topic)]), revision
