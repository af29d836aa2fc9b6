"""A process without a network: recorded messages in, what it publishes out. What replaying a log stands on."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from .messages import Message
from .scenario import Scenario
from .topics import Topic
from .transport import Counts, Received

Said = tuple[Topic, int | str | None, Message]
"""What a process publishes: topic, place, message (not numbered)."""


class ReplayNode:
    """Stands in for a process' ``Node``: it hears what is put in, and what it says is kept."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.counts = Counts()
        self._heard: deque[Received] = deque()
        self._said: list[Said] = []

    def put(self, received: Received) -> None:
        """What the process receives next."""
        self._heard.append(received)

    def receive(self, timeout_s: float | None) -> Received | None:
        """As ``Node.receive``, without waiting."""
        return self._heard.popleft() if self._heard else None

    def publish(self, topic: Topic, message: Message, place: int | str | None = None) -> None:
        """As ``Node.publish``."""
        self._said.append((topic, place, message))

    def said(self) -> list[Said]:
        """What was published since the last call."""
        said, self._said = self._said, []
        return said


class SilentHeartbeat:
    """Stands in for a process' ``Heartbeat``: nobody needs to be told."""

    def __init__(self) -> None:
        self.settled = threading.Event()

    def take(self, message: Any) -> None:
        """Nobody needs to be heard."""


@dataclass(frozen=True)
class Stage:
    """A part of the flying software that can be run again on a log.

    ``play(scenario, recorded)`` yields what today's code says to the ``inputs`` among the recorded messages. It gets
    the recorded ``answers``, too, before the inputs of their tick, to learn from their numbering when a process was
    started again, and for nothing else. Within a tick inputs come in the order of ``inputs``.
    """

    process: str
    inputs: tuple[Topic, ...]
    answers: tuple[Topic, ...]
    play: Callable[[Scenario, Iterable[Received]], Iterator[Said]]


# Ticks that the messages of a tick may come late to a recorder in lock-step, by far: the flight waits for it.
_LATE_TICKS = 64


def by_tick(stage: Stage, recorded: Iterable[Received]) -> Iterator[Received]:
    """The messages of a lock-step flight in the order of their ticks, and of the stage's within one.

    A recorder hears different processes in any order; what belongs to a tick is what they agree on.
    """
    rank = {id(topic): k for k, topic in enumerate((*stage.answers, *stage.inputs))}
    ticks: dict[int, list[Received]] = {}
    for received in recorded:
        tick = received.message.tick
        ticks.setdefault(tick, []).append(received)
        for done in sorted(t for t in ticks if t < tick - _LATE_TICKS):
            yield from sorted(ticks.pop(done), key=lambda r: _order(r, rank))
    for done in sorted(ticks):
        yield from sorted(ticks[done], key=lambda r: _order(r, rank))


def _order(received: Received, rank: dict[int, int]) -> tuple[int, int]:
    # A tick that was revised: its processes knew of the revision last.
    revision = getattr(received.message, "revision", 0)
    return (len(rank) if revision else rank[id(received.topic)]), revision
