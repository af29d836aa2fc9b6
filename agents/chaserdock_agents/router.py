"""The router process: what clients on several hosts, or in several containers, connect to.

It knows no mission: it forwards, and enforces who may do what (``rights``). Zenoh decides that once for a key and
a client, and then drops silently.
"""

from __future__ import annotations

import threading
from dataclasses import replace

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.rights import access_control
from chaserdock_protocol.runtime import ProcessOptions, Stop, say
from chaserdock_protocol.transport import Node

MOST_CHASERS = 256


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
    stop, gone, seen = Stop(options.watch_parent), threading.Event(), threading.Event()

    def changed(process: str, alive: bool) -> None:
        if process == options.until:
            (seen if alive else gone).set()

    try:
        if options.until is not None:
            node.watch_liveliness(changed)
        how = "TLS, with access rules" if link.tls is not None else "without TLS and access rules"
        say("router", f"listens on {', '.join(link.listen)} {how}")
        while not (stop() or (seen.is_set() and gone.wait(0))):
            gone.wait(0.2)
    finally:
        node.close()
    return 0
