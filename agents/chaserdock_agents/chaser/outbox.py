# SPDX-License-Identifier: Apache-2.0
"""Collect what a chaser publishes while it handles one message, in order."""

from __future__ import annotations

from dataclasses import dataclass, field

from chaserdock_protocol import topics
from chaserdock_protocol.messages import Event, Level, Message
from chaserdock_protocol.topics import Topic

Outgoing = tuple[Topic, int | str, Message]
"""A message to publish: topic, place in its key, message."""


@dataclass
class ChaserOutputs:
    """What follows from a received message.

    ``messages``: to be published in this order. ``stale``: whether the message came too late or
    twice. ``rejected``: why a command must not count or what went wrong in an image, as the
    traffic counters name it; empty for others.
    """

    messages: list[Outgoing] = field(default_factory=list)
    stale: bool = False
    rejected: str = ""

    def __bool__(self) -> bool:
        """Return whether anything follows."""
        return bool(self.messages or self.stale or self.rejected)

    def follow(self, later: ChaserOutputs) -> None:
        """Append what follows from another message."""
        self.messages += later.messages
        self.stale |= later.stale
        self.rejected = self.rejected or later.rejected


class Outbox:
    """Collects the outputs of chaser ``chaser`` from the parts of its core."""

    def __init__(self, chaser: int) -> None:
        self.chaser = chaser
        self._outputs = ChaserOutputs()

    def publish(self, topic: Topic, message: Message) -> None:
        """Append a message on a topic of this chaser."""
        self._outputs.messages.append((topic, self.chaser, message))

    def event(self, level: Level, what: str, detail: str, tick: int, time_ns: int) -> None:
        """Append an event."""
        name = f"chaser/{self.chaser}"
        event = Event(
            tick=tick, sim_time_ns=time_ns, process=name, level=level, what=what, detail=detail
        )
        self._outputs.messages.append((topics.EVENT, name, event))

    def warn(self, what: str, detail: str, tick: int, time_ns: int) -> None:
        """Append an event of level ``warning``."""
        self.event("warning", what, detail, tick, time_ns)

    def count_stale(self) -> None:
        """Count the received message as stale."""
        self._outputs.stale = True

    def count_rejected(self, reason: str) -> None:
        """Count the received message as rejected."""
        self._outputs.rejected = reason

    def take(self) -> ChaserOutputs:
        """Return the outputs since the last call."""
        outputs, self._outputs = self._outputs, ChaserOutputs()
        return outputs
