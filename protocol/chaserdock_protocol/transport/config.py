# SPDX-License-Identifier: Apache-2.0
"""Link configuration, and the messages that a session delivers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.topics import Topic

from .network import Network

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
DEFAULT_NAMESPACE = "chaserdock"
_QUEUES = (
    "control",
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
)
QUEUE_OPTIONS: dict[str, Any] = {
    # Zenoh's maximum: droppable messages are dropped for a reader when 16 batches (1 MB) wait for
    # it, instead of 2.
    "transport/link/tx/queue/size": dict.fromkeys(_QUEUES, 16),
    # The first message then waits this long (us); later ones do not wait until the reader reads
    # again.
    "transport/link/tx/queue/congestion_control/drop": {
        "wait_before_drop": 2000,
        "max_wait_before_drop_fragments": 4000,
    },
}

_RUST_SOURCE = re.compile(r" at \S+\.rs:\d+\.?")
"""Source locations that Zenoh appends to its error messages."""


class TransportError(ChaserdockError):
    """The network cannot be used as configured. The text is one line."""


class NoRouterError(TransportError):
    """No router accepts a client's connection; one that starts later may."""


@dataclass(frozen=True)
class Tls:
    """PEM files for mutual TLS: certificate authority of the mission, certificate and private key
    of this process.
    """

    ca: Path
    certificate: Path
    key: Path

    @classmethod
    def in_folder(cls, folder: Path) -> Tls:
        """Return the files of one process in the layout that ``chaserdock deploy --keys``
        writes.
        """
        return cls(folder / "ca.pem", folder / "cert.pem", folder / "key.pem")


@dataclass(frozen=True)
class Link:
    """Endpoints and options of a Zenoh session. ``lease_ms``: time after which a silent peer counts
    as lost.

    ``connect_timeout_s``: wall time after which a client that no router accepts gives up; None: it
    never does. ``access_control``: rules that a router enforces (see ``access_control.py``).
    ``network``: carries the messages in place of Zenoh; the other fields have no effect then.
    """

    namespace: str = DEFAULT_NAMESPACE
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    mode: Literal["peer", "client", "router"] = "peer"
    config: Path | None = None
    lease_ms: int = 60_000
    tls: Tls | None = None
    access_control: dict[str, Any] | None = None
    connect_timeout_s: float | None = None
    network: Network | None = None


class ReceivedMessage(Struct, frozen=True):
    """A valid message. ``sent_ns`` is the sender's wall clock (HLC), 0 if unstamped; ``arrived_s``
    the clock of this host. ``source``: the sender's session, empty if unknown.
    """

    topic: Topic
    place: str | None
    message: Any
    sent_ns: int
    arrived_s: float = 0.0
    source: str = ""


def is_unreachable(error: Exception) -> bool:
    """Test whether a session could not be opened because no endpoint accepted the connection."""
    return "unable to connect" in str(error).lower()


def open_error(error: Exception, link: Link) -> str:
    """Return one line on why a session could not be opened."""
    text = _RUST_SOURCE.sub("", " ".join(str(error).split()))
    if link.config is not None:
        return f"cannot open the Zenoh session of {link.config}: {text}"
    listen, connect = ", ".join(link.listen) or "-", ", ".join(link.connect) or "-"
    if is_unreachable(error):
        keys = ", and are the keys valid and of its mission" if link.tls is not None else ""
        return f"no router at {connect} accepts the connection; is it running{keys}?"
    if "in use" in text.lower():
        return (
            f"cannot listen on {listen}: the port is in use; stop its owner or choose another "
            "with --listen"
        )
    return f"cannot open the Zenoh session (listen {listen}, connect {connect}): {text}"
