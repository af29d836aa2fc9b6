# SPDX-License-Identifier: Apache-2.0
"""Route messages between clients on several hosts or in several containers.

Forwards messages, enforces access control (``access_control``) and reports denials on standard
error and as events.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import Event
from chaserdock_protocol.process import ProcessOptions, print_status
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.access_control import access_control

from .acl_audit import DenialCounter, ZenohLog

NAME = "router"
MAX_CHASERS = 256
"""Chasers for which access rules are made, as rules do not know the mission: more than any machine
flies.
"""
POLL_S = 0.2
"""Interval at which the router looks whether it was stopped or is alone, s."""
GRACE_S = 5.0
"""Time, s, between the departure of the process that the router waits for and the router's end. The
process may return after a cut link, and with Compose its exit status must be available before the
router's.
"""


def main(options: ProcessOptions) -> int:
    """Route until stopped, or until ``options.until`` has joined and departed; return 0, or 2 if it
    cannot listen.
    """
    link = replace(options.link, mode="router")
    log: ZenohLog | None = None
    if link.tls is not None:
        link = replace(link, access_control=access_control(link.namespace, MAX_CHASERS))
        log = ZenohLog(link.namespace)

    try:
        node = Node(NAME, "operator", link)
    except ChaserdockError as error:
        print_status(NAME, str(error))
        return 2

    stop, watched = options.stop_signal(), _WatchedProcess(options.until or "")
    auditor = _AuditLogger(node, log) if log is not None else None
    try:
        if options.until is not None:
            node.watch_liveliness(watched.set_alive)
        how = "TLS, with access rules" if link.tls is not None else "without TLS and access rules"
        print_status(NAME, f"listens on {', '.join(link.listen)} {how}")
        while not (stop() or watched.departed_for_s() > GRACE_S):
            time.sleep(POLL_S)
            if auditor is not None:
                auditor.publish_denials()
    finally:
        node.close()
        if auditor is not None:
            auditor.publish_total()
    print_status(NAME, "ended")
    return 1 if stop() else 0


class _AuditLogger:
    """Publishes denials with the tick and simulated time of the current mission."""

    def __init__(self, node: Node, log: ZenohLog) -> None:
        self._node, self._log = node, log
        self._denials = DenialCounter()
        self._ticks = node.subscribe_newest(topics.TICK, 1)
        self._tick, self._time_ns = 0, 0

    def publish_denials(self) -> None:
        """Publish new denials (see ``DenialCounter.add``) on standard error and as events."""
        for tick in self._ticks():
            self._tick, self._time_ns = tick.message.tick, tick.message.sim_time_ns
        for text in filter(None, map(self._denials.add, self._log.take_denials())):
            print_status(NAME, f"denied: {text}")
            event = Event(
                tick=self._tick,
                sim_time_ns=self._time_ns,
                process=NAME,
                level="warning",
                what="denied",
                detail=text,
            )
            self._node.publish(topics.EVENT, event, NAME)

    def publish_total(self) -> None:
        """Print the total number of denials after the last session has closed."""
        self._log.close()
        for denial in self._log.take_denials():
            self._denials.add(denial)
        if self._denials.total:
            print_status(NAME, f"denied {self._denials.total} messages and declarations in all")


@dataclass
class _WatchedProcess:
    """The process whose departure ends the router; updated on Zenoh's thread."""

    name: str
    left_s: float | None = None

    def set_alive(self, process: str, alive: bool) -> None:
        if process == self.name:
            self.left_s = None if alive else time.monotonic()

    def departed_for_s(self) -> float:
        return 0.0 if self.left_s is None else time.monotonic() - self.left_s
