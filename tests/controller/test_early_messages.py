# SPDX-License-Identifier: Apache-2.0
"""What is forged before a tick begins does not shut out what is true in it."""

from __future__ import annotations

from typing import cast

import pytest
from chaserdock_controller.ingest.early_messages import EarlyMessages
from chaserdock_protocol import topics
from chaserdock_protocol.messages import Lease, Tick
from chaserdock_protocol.replay_node import ReplayNode
from chaserdock_protocol.transport import Node, ReceivedMessage
from chaserdock_protocol.transport.process_sessions import ProcessSessions


def lease(tick: int, source: str = "") -> ReceivedMessage:
    message = Lease(
        tick=tick,
        revision=0,
        chaser=0,
        holder="controller",
        instance="c",
        term=1,
        from_tick=0,
        until_tick=tick + 1,
    )
    return ReceivedMessage(topics.LEASE, "0", message, 0, 0.0, source)


def begin(tick: int) -> ReceivedMessage:
    return ReceivedMessage(topics.TICK, None, Tick(tick=tick, images=False, chasers=(0,)), 0)


@pytest.fixture
def node() -> ReplayNode:
    return ReplayNode("controller")


def test_messages_wait_for_their_tick(node: ReplayNode) -> None:
    early = EarlyMessages(cast(Node, node))
    first, second = lease(0), lease(1)
    assert early.in_turn(second) == early.in_turn(first) == []
    tick = begin(0)
    assert early.in_turn(tick) == [tick, first]
    assert early.in_turn(lease(0)) == [lease(0)]
    tick = begin(1)
    assert early.in_turn(tick) == [tick, second]
    assert not node.counts.rejected


def test_messages_of_ticks_far_ahead_are_dropped_and_counted(node: ReplayNode) -> None:
    early = EarlyMessages(cast(Node, node))
    for tick in (1_000, 2**40):
        assert early.in_turn(lease(tick)) == []
    assert sum(node.counts.rejected.values()) == 2
    assert early.in_turn(begin(5_000)) == [begin(5_000)]


def test_waiting_messages_of_another_session_are_dropped_when_the_tick_begins(
    node: ReplayNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node, "is_forged", lambda received: received.source == "intruder")
    early = EarlyMessages(cast(Node, node))
    for source in ("intruder", "own", "intruder"):
        early.in_turn(lease(0, source))
    assert early.in_turn(begin(0)) == [begin(0), lease(0, "own")]


@pytest.fixture
def sessions() -> ProcessSessions:
    """With a chaser and a controller that the world has listed."""
    found = ProcessSessions()
    found.note("chaser/0", "forged", "intruder")
    found.note("chaser/0", "a", "session-a")
    found.note("chaser/0", "a", "intruder")  # a copy of what it has seen
    found.note("controller", "c", "session-c")
    found.list_instances({"chaser/0": "a", "controller": "c"})
    return found


@pytest.mark.parametrize(
    ("key", "own"),
    [
        ("chaser/0/sighting", "session-a"),
        ("chaser/0/lease", "session-a"),
        ("controller/chaser/0/wrench", "session-c"),
        ("controller/target", "session-c"),
    ],
)
def test_only_the_session_of_the_listed_instance_publishes_as_a_process(
    sessions: ProcessSessions, key: str, own: str
) -> None:
    assert topics.topic_of_key(key) is not None
    assert not sessions.is_foreign(key, own)
    assert sessions.is_foreign(key, "intruder")
    assert not sessions.is_foreign(key, "")  # without a time stamp: unknown


def test_a_process_that_restarts_and_one_that_is_unknown_are_heard(
    sessions: ProcessSessions,
) -> None:
    assert not sessions.is_foreign("chaser/1/sighting", "any")
    assert not sessions.is_foreign("chaser/0/presence", "new session")
    sessions.list_instances({"chaser/0": "b"})  # before its presence arrives
    assert not sessions.is_foreign("chaser/0/sighting", "session-b")
    sessions.note("chaser/0", "b", "session-b")
    assert not sessions.is_foreign("chaser/0/sighting", "session-b")
    assert sessions.is_foreign("chaser/0/sighting", "session-a")


def test_a_standby_publishes_on_the_keys_of_the_controller(sessions: ProcessSessions) -> None:
    sessions.list_instances({"standby": "s"})
    assert not sessions.is_foreign("controller/target", "session-s")  # it has not been heard yet
    sessions.note("standby", "s", "session-s")
    assert not sessions.is_foreign("controller/target", "session-s")
    assert not sessions.is_foreign("controller/target", "session-c")
    assert sessions.is_foreign("controller/target", "intruder")


def test_a_flood_of_instances_takes_bounded_memory(sessions: ProcessSessions) -> None:
    for k in range(10_000):
        sessions.note("chaser/0", f"forged-{k}", "intruder")
        sessions.note(f"no/process/{k}", "x", "intruder")
    assert sum(map(len, sessions._stated.values())) < 100
    assert not sessions.is_foreign("chaser/0/lease", "session-a")
