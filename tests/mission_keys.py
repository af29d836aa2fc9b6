"""A router with rights, and links to it, for tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from chaserdock_agents.keys import init_keys
from chaserdock_agents.launcher import free_port
from chaserdock_protocol.rights import access_control, common_name
from chaserdock_protocol.transport import Link, Node, Tls

NAMESPACE = "rights"
CHASERS = 3


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
    link = Link(NAMESPACE, (), (endpoint,), "router", tls=tls_of(keys, "router"), access_control=rules)
    node = Node("router", "operator", link)
    try:
        yield endpoint
    finally:
        node.close()
