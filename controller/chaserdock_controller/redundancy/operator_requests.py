# SPDX-License-Identifier: Apache-2.0
"""Queue of operator commands for the next tick. Thread-safe; no I/O."""

from __future__ import annotations

import threading
from collections.abc import Callable

from chaserdock_protocol.messages import CommandReply, OperatorCommand, Tick

SendReply = Callable[[CommandReply], None]


class OperatorRequests:
    """Waiting requests with the functions that send their replies."""

    def __init__(self) -> None:
        self._requests: list[tuple[OperatorCommand, SendReply]] = []
        self._lock = threading.Lock()

    def add(self, command: OperatorCommand, reply: SendReply) -> None:
        """Add a request; may be called on any thread."""
        with self._lock:
            self._requests.append((command, reply))

    def take(self) -> list[tuple[OperatorCommand, SendReply]]:
        """Return and remove all requests."""
        with self._lock:
            requests, self._requests = self._requests, []
        return requests

    def refuse(self, tick: Tick, commander: str) -> None:
        """Refuse all requests because ``commander`` commands, or none if empty."""
        reason = f"{commander or 'no controller'} commands now: repeat the command"
        for command, reply in self.take():
            reply(
                CommandReply(
                    tick=tick.tick,
                    sim_time_ns=tick.sim_time_ns,
                    command=command.command,
                    chaser=command.chaser,
                    operator=command.operator,
                    accepted=False,
                    reason=reason,
                )
            )
