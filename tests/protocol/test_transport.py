# SPDX-License-Identifier: Apache-2.0
"""Zenoh configuration of a link: safe defaults, and precedence of a user's file."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from chaserdock_protocol import topics
from chaserdock_protocol.transport import Link, Node, TransportError
from chaserdock_protocol.transport.zenoh_network import zenoh_config
from harness import finished
from mission_keys import client, make_keys, router_with_rights

from chaserdock.launch.launcher import free_port


def test_defaults_are_safe() -> None:
    config = zenoh_config(Link("run-1"))
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("transport/shared_memory/enabled")) is False
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/127.0.0.1:0"]
    assert json.loads(config.get_json("namespace")) == "run-1"
    assert json.loads(config.get_json("connect/timeout_ms")) == -1


@pytest.mark.parametrize("name", ["", "a/b", "a*", "@x", "a b", "$*"])
def test_namespace_is_one_word(name: str) -> None:
    with pytest.raises(TransportError, match="must be one word"):
        zenoh_config(Link(name))


def test_configuration_file_overrides_endpoints_and_timeouts(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(
        '{ mode: "client", connect: { endpoints: ["tcp/127.0.0.1:7"], timeout_ms: 1234 } }'
    )
    config = zenoh_config(Link("run-1", connect=("tcp/ignored:1",), config=file))
    assert json.loads(config.get_json("mode")) == "client"
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/127.0.0.1:7"]
    assert json.loads(config.get_json("connect/timeout_ms")) == 1234
    assert json.loads(config.get_json("connect/exit_on_failure")) is False
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False


def test_a_bad_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{ mode: ")
    with pytest.raises(TransportError, match=r"zenoh\.json5"):
        zenoh_config(Link("run-1", config=file))


def test_bad_endpoint_raises_an_error() -> None:
    with pytest.raises(TransportError):
        zenoh_config(Link("run-1", listen=("nonsense",)))


@pytest.mark.parametrize("refuses", [False, True])
def test_client_without_a_router_gives_up(tmp_path: Path, refuses: bool) -> None:
    if refuses:
        with router_with_rights(make_keys(tmp_path / "keys")) as endpoint:
            link = client(make_keys(tmp_path / "other-keys"), "operator", endpoint)
            words = (
                f"no router at {endpoint} accepts the connection; is it running, and are the keys "
                "valid"
            )
            with pytest.raises(TransportError, match=words):
                Node("operator", "operator", replace(link, connect_timeout_s=0.5))
        return
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    link = Link("run-1", (endpoint,), (), "client", connect_timeout_s=0.5)
    with pytest.raises(TransportError, match=f"no router at {endpoint} accepts the connection"):
        Node("operator", "operator", link)


def test_signals_interrupt_a_client_without_a_router() -> None:
    class InterruptedByTest(Exception):
        """Raised by the signal handler."""

    def interrupt(*_: object) -> None:
        raise InterruptedByTest

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(InterruptedByTest):
            Node(
                "operator",
                "operator",
                Link("run-1", (f"tcp/127.0.0.1:{free_port()}",), (), "client"),
            )
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_command_without_a_router_ends_with_status_2() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    status, said = finished(
        "chaser", "0", "-m", "client", "-e", endpoint, "--timeout", "0.5", timeout_s=120
    )
    assert status == 2, said
    assert said.splitlines() == [
        f"chaser/0: no router at {endpoint} accepts the connection; is it running?"
    ]


def congestion_of(node: Node, topic: topics.Topic, place: int | str | None = None) -> str:
    node.advertise(topic, place)
    connection: Any = node._connection
    return str(connection._declared[-1].congestion_control).rpartition(".")[2]


def test_slow_readers_block_only_in_lockstep() -> None:
    """In real time, only messages published once at the end block."""
    node = Node("world", "world", Link(namespace="waits"))
    try:
        assert congestion_of(node, topics.TICK) == "BLOCK"
        node.blocking = False
        for topic, place in ((topics.IMAGE, 0), (topics.ODOMETRY, 0), (topics.EVENT, "world")):
            assert congestion_of(node, topic, place) == "DROP"
        assert congestion_of(node, topics.END) == "BLOCK"
        assert congestion_of(node, topics.FAREWELL, "world") == "BLOCK"
    finally:
        node.close()


def test_transmit_queues_have_maximum_size() -> None:
    """Droppable messages are dropped for one reader only, after it has not read for long."""
    config = zenoh_config(Link())
    sizes = json.loads(config.get_json("transport/link/tx/queue/size"))
    assert set(sizes.values()) == {16}
    drop = json.loads(config.get_json("transport/link/tx/queue/congestion_control/drop"))
    assert drop == {"wait_before_drop": 2000, "max_wait_before_drop_fragments": 4000}
