"""The router process: what clients on several hosts, or in several containers, connect to.

It knows no mission: it forwards, and enforces who may do what (``rights``). Zenoh decides that once for a key and
a client, and then drops silently.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.rights import access_control
from chaserdock_protocol.runtime import ProcessOptions, Stop, say
from chaserdock_protocol.transport import Node

MOST_CHASERS = 256
AFTERWARDS_S = 5.0
"""Between the going of the process that it waits for and its own end: a cut link is not a farewell, and with Compose that
process' own status has to be there before this one's."""


def main(options: ProcessOptions) -> int:
    """Routes until stopped, or until ``options.until`` has come and gone; 0 then, 2 when it cannot listen."""
    link = replace(options.link, mode="router")
    if link.tls is not None:
        link = replace(link, access_control=access_control(link.namespace, MOST_CHASERS))
    try:
        node = Node("router", "operator", link)
    except ChaserdockError as error:
        say("router", str(error))
        return 2
    stop, last = Stop(options.watch_parent), _Guest(options.until or "")
    try:
        if options.until is not None:
            node.watch_liveliness(last.changed)
        how = "TLS, with access rules" if link.tls is not None else "without TLS and access rules"
        say("router", f"listens on {', '.join(link.listen)} {how}")
        while not (stop() or last.gone_for_s() > AFTERWARDS_S):
            time.sleep(0.2)
    finally:
        node.close()
    return 0


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
