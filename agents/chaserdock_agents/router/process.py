"""The router process: what clients on several hosts, or in several containers, connect to.

It forwards, enforces who may do what (``rights``), and tells what it denied: on standard error and as ``Event`` for
the log.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import Event
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.access_control import access_control

from .acl_audit import Account, ZenohLog

NAME = "router"
MOST_CHASERS = 256
LOOK_S = 0.2
AFTERWARDS_S = 5.0
"""Between the going of the process that it waits for and its own end: a cut link is not a farewell, and with Compose that
process' own status has to be there before this one's."""


def main(options: ProcessOptions) -> int:
    """Routes until stopped, or until ``options.until`` has come and gone; 0 then, 2 when it cannot listen."""
    link = replace(options.link, mode="router")
    log: ZenohLog | None = None
    if link.tls is not None:
        link = replace(link, access_control=access_control(link.namespace, MOST_CHASERS))
        log = ZenohLog(link.namespace)
    try:
        node = Node(NAME, "operator", link)
    except ChaserdockError as error:
        print_status(NAME, str(error))
        return 2
    stop, last = StopSignal(options.watch_parent), _Guest(options.until or "")
    clerk = _Clerk(node, log) if log is not None else None
    try:
        if options.until is not None:
            node.watch_liveliness(last.changed)
        how = "TLS, with access rules" if link.tls is not None else "without TLS and access rules"
        print_status(NAME, f"listens on {', '.join(link.listen)} {how}")
        while not (stop() or last.gone_for_s() > AFTERWARDS_S):
            time.sleep(LOOK_S)
            if clerk is not None:
                clerk.note()
    finally:
        node.close()
        if clerk is not None:
            clerk.sum_up()
    return 0


class _Clerk:
    """Tells denials, with the tick and simulated time of the mission under way, as far as the router hears of one."""

    def __init__(self, node: Node, log: ZenohLog) -> None:
        self._node, self._log = node, log
        self._account = Account()
        self._ticks = node.subscribe_newest(topics.TICK, 1)
        self._tick, self._time_ns = 0, 0

    def note(self) -> None:
        """Tells what is told (``Account``): on standard error, and to the recorder."""
        for tick in self._ticks():
            self._tick, self._time_ns = tick.message.tick, tick.message.sim_time_ns
        for text in filter(None, map(self._account.add, self._log.take())):
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

    def sum_up(self) -> None:
        """After the last session: how many there were."""
        self._log.close()
        for denial in self._log.take():
            self._account.add(denial)
        if self._account.total:
            print_status(NAME, f"denied {self._account.total} messages and declarations in all")


@dataclass
class _Guest:
    """A process whose coming and going ends the router; told on Zenoh's thread."""

    name: str
    left_s: float | None = None

    def changed(self, process: str, alive: bool) -> None:
        if process == self.name:
            self.left_s = None if alive else time.monotonic()

    def gone_for_s(self) -> float:
        return 0.0 if self.left_s is None else time.monotonic() - self.left_s
