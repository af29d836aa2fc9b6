"""How a process reaches the others, and what comes over the wire; ``transport`` makes sessions of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct

from chaserdock_protocol.topics import Topic

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
DEFAULT_NAMESPACE = "chaserdock"
_QUEUES = (
    "control", "real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background",
)  # fmt: skip
PATIENT_QUEUES: dict[str, Any] = {
    # Zenoh's largest: what is droppable is dropped for a reader only when 16 batches (1 MB) wait for it, not 2.
    "transport/link/tx/queue/size": dict.fromkeys(_QUEUES, 16),
    # Then the first message waits this long (us), and the others, until it reads again, not at all.
    "transport/link/tx/queue/congestion_control/drop": {
        "wait_before_drop": 2000,
        "max_wait_before_drop_fragments": 4000,
    },
}


@dataclass(frozen=True)
class Tls:
    """PEM files for mutual TLS: the mission's authority, this process' certificate, its private key."""

    ca: Path
    certificate: Path
    key: Path

    @classmethod
    def in_folder(cls, folder: Path) -> Tls:
        """Those of one process, as ``chaserdock keys init`` lays them down."""
        return cls(folder / "ca.pem", folder / "cert.pem", folder / "key.pem")


@dataclass(frozen=True)
class Link:
    """How a process reaches the others. ``lease_ms``: after that long a silent peer counts as lost.

    ``access_control`` is what a router enforces (see ``rights``).
    """

    namespace: str = DEFAULT_NAMESPACE
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    mode: Literal["peer", "client", "router"] = "peer"
    config: Path | None = None
    lease_ms: int = 60_000
    tls: Tls | None = None
    access_control: dict[str, Any] | None = None


class Received(Struct, frozen=True):
    """A message that passed all checks. ``sent_ns`` is the sender's wall clock (HLC), 0 if unstamped."""

    topic: Topic
    place: str | None
    message: Any
    sent_ns: int


class Raw(Struct, frozen=True):
    """What came over the wire, unopened."""

    key: str
    encoding: str
    payload: bytes
    sent_ns: int


def open_error(error: Exception, link: Link) -> str:
    """Why a session could not be opened, in one line."""
    text = " ".join(str(error).split())
    if link.config is not None:
        return f"cannot open the Zenoh session of {link.config}: {text}"
    listen, connect = ", ".join(link.listen) or "-", ", ".join(link.connect) or "-"
    if "in use" in text.lower():
        return (
            f"cannot listen on {listen}: the port is in use; stop its owner or choose another with --listen"
        )
    return f"cannot open the Zenoh session (listen {listen}, connect {connect}): {text}"
