# SPDX-License-Identifier: Apache-2.0
"""A router with rights, and links to it, for tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from chaserdock_protocol.topics import TOPICS
from chaserdock_protocol.transport import Link, Node, Tls
from chaserdock_protocol.transport.access_control import (
    OBSERVERS,
    access_control,
    common_name,
    identities,
)

from chaserdock.launch.keys import init_keys
from chaserdock.launch.launcher import free_port

NAMESPACE = "rights"
CHASERS = 3
EVERYONE = identities(CHASERS)
PUBLISHERS = {w.process: w for w in EVERYONE if w.role not in OBSERVERS}
PATIENCE_S = 60.0
_OWN = tuple(f"controller/{what}" for what in ("event", "health", "presence", "farewell"))


def make_keys(folder: Path) -> Path:
    init_keys(folder, CHASERS, ("localhost", "127.0.0.1"), 1, datetime.now(UTC))
    return folder


def tls_of(keys: Path, process: str) -> Tls:
    return Tls.in_folder(keys / common_name(process))


def client(keys: Path, process: str, endpoint: str) -> Link:
    return Link(NAMESPACE, (endpoint,), (), "client", tls=tls_of(keys, process))


@contextmanager
def router_with_rights(keys: Path) -> Iterator[str]:
    """The endpoint of a router that enforces the rights."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    rules = access_control(NAMESPACE, CHASERS)
    link = Link(
        NAMESPACE, (), (endpoint,), "router", tls=tls_of(keys, "router"), access_control=rules
    )
    node = Node("router", "operator", link)
    try:
        yield endpoint
    finally:
        node.close()


def keys_with_owners() -> list[tuple[str, str]]:
    """Every concrete key of the topics table and who may publish on it: one process, of controllers
    each.
    """
    out = []
    for topic in TOPICS:
        if "{chaser}" in topic.key:
            for i in range(CHASERS):
                owner = f"chaser/{i}" if topic.writer == "chaser" else topic.writer
                out.append((topic.key_of(i), owner))
        elif topic.writer == "any":
            out += [(topic.key_of(name), name) for name in PUBLISHERS]
        elif "{process}" in topic.key:
            bodies = ("target", *(f"chaser/{i}" for i in range(CHASERS)))
            out += [(topic.key_of(body), topic.writer) for body in bodies]
        else:
            out.append((topic.key, topic.writer))
    # What is one controller's to say is the other's, too: the world says which of them is obeyed.
    return out + [
        (key, "standby") for key, owner in out if owner == "controller" and not key.startswith(_OWN)
    ]
