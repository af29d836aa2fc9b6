# SPDX-License-Identifier: Apache-2.0
"""Keeps messages of chasers until their tick begins. No I/O.

The world says which tick it is; a chaser only refers to it. The newest message of a chaser counts:
one that claims a later tick, by mistake or forged, would shut out all that are true until then.
"""

from __future__ import annotations

from collections import deque

from chaserdock_protocol.messages import Lease, Sighting, ThrusterReport, Tick
from chaserdock_protocol.transport import Node, ReceivedMessage

_AHEAD_TICKS = 8
"""Most ticks by which a chaser may know of a tick earlier than this process: half a second at 15
Hz, longer than any delay between two processes. Messages that claim more are dropped.
"""
_MOST_KEPT = 4096
"""Messages that are kept; bounds the memory. 16 chasers send 400 in that many ticks."""


class EarlyMessages:
    """Messages of ticks that have not begun, in the order of their arrival. ``node``: tells
    which are forged, as it knows once the tick has begun, and counts those that are dropped.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._tick = -1
        self._kept: deque[ReceivedMessage] = deque(maxlen=_MOST_KEPT)

    def in_turn(self, received: ReceivedMessage) -> list[ReceivedMessage]:
        """Return the messages to process now that one is received: none if it is early; after a
        tick also those that have waited for it.
        """
        message = received.message
        if isinstance(message, Tick):
            self._tick = max(self._tick, message.tick)
            waited, self._kept = self._kept, deque(maxlen=_MOST_KEPT)
            self._kept.extend(r for r in waited if r.message.tick > self._tick)
            due = (r for r in waited if r.message.tick <= self._tick)
            return [received, *(r for r in due if not self._node.is_forged(r))]
        if not isinstance(message, Lease | Sighting | ThrusterReport) or message.tick <= self._tick:
            return [received]
        if message.tick <= self._tick + _AHEAD_TICKS and len(self._kept) < _MOST_KEPT:
            self._kept.append(received)
        else:
            self._node.counts.rejected[f"{received.topic.key}:early tick"] += 1
        return []
