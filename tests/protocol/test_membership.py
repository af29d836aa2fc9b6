# SPDX-License-Identifier: Apache-2.0
"""Membership of a mission: joining, departure and mutual discovery."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import msgspec
import pytest
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import JoinRequest, Presence, encoding_of
from chaserdock_protocol.mission.membership import Membership
from chaserdock_protocol.scenario.simulation import SimulationSection
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.network import RawSample
from chaserdock_protocol.transport.session import Heartbeat

from chaserdock.simulation.network import SimulatedNetwork
from chaserdock.simulation.scheduler import Scheduler


def membership(chasers: int = 2, mode: str = "lockstep") -> Membership:
    return Membership(
        chasers=chasers, run_id="run-1", mode=mode, scenario_json='{"a": 1}', instance="world-1"
    )


def first(*names: str) -> dict[str, str]:
    """The first instance of each process."""
    return {name: f"{name}-1" for name in names}


def joined(members: Membership, *names: str) -> Membership:
    for name in names:
        assert members.admit(JoinRequest(process=name, instance=f"{name}-1")).accepted
        members.set_alive(name, True)
    return members


def announce(members: Membership, name: str, *heard: str, instance: str | None = None) -> bool:
    message = Presence(process=name, instance=instance or f"{name}-1", heard=first(*heard))
    return members.update_presence(message)


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_admitted_process_receives_the_mission(mode: str) -> None:
    for name in ("chaser/0", "chaser/1", "controller", "recorder"):
        reply = membership(mode=mode).admit(JoinRequest(process=name, instance="i"))
        assert (reply.accepted, reply.reason) == (True, "")
        assert (reply.run_id, reply.mode, reply.scenario_json) == ("run-1", mode, '{"a": 1}')


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("chaser/2", "there is no chaser/2 in this mission; its chasers are 0 to 1"),
        ("chaser/99999999999999999999", "there is no chaser/99999999999999999999"),
        ("chaser/01", "'chaser/01' is no process of a mission"),
        ("chaser/-1", "is no process of a mission"),
        ("chaser", "is no process of a mission"),
        ("target", "'target' is no process of a mission"),
        ("", "'' is no process of a mission"),
        ("hacker", "is no process of a mission"),
        ("world", "this mission has a world already"),
    ],
)
def test_refused_process_receives_the_reason(name: str, reason: str) -> None:
    members = membership()
    reply = members.admit(JoinRequest(process=name, instance="i"))
    assert not reply.accepted
    assert reason in reply.reason
    assert reply.scenario_json == ""
    assert not announce(members, name, instance="i")


def test_running_process_blocks_a_second_instance_until_it_departs() -> None:
    members = joined(membership(), "chaser/0")
    twin = JoinRequest(process="chaser/0", instance="another")
    assert members.admit(twin).reason == "chaser/0 is already running in this mission"
    assert members.admit(
        JoinRequest(process="chaser/0", instance="chaser/0-1")
    ).accepted  # asked again
    members.set_alive("chaser/0", False)
    assert members.take_departed() == ["chaser/0"]
    assert members.take_departed() == []
    assert members.admit(twin).accepted
    assert not announce(members, "chaser/0", "world")  # the old instance is ignored
    assert announce(members, "chaser/0", "world", instance="another")


def test_departure_of_unknown_process_is_ignored() -> None:
    members = membership()
    members.set_alive("chaser/0", False)
    assert members.take_departed() == []
    assert members._alive == set()


def test_connection_requires_mutual_discovery() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    assert members.connected({}) == set()
    everyone = first("chaser/0", "controller")
    announce(members, "chaser/0", "world", "controller")
    announce(members, "controller", "world", "chaser/0")
    assert members.connected(everyone) == {"chaser/0", "controller"}
    assert members.connected(first("controller")) == {
        "controller"
    }  # the world has not heard the chaser
    announce(members, "controller", "world")  # no longer
    assert members.connected(everyone) == set()
    announce(members, "controller", "chaser/0")  # has not heard the world
    assert members.connected(everyone) == {"chaser/0"}


def test_chasers_need_not_discover_each_other_but_recorder_needs_all() -> None:
    members = joined(membership(2), "chaser/0", "chaser/1", "controller", "recorder")
    announce(members, "chaser/0", "world", "controller")
    announce(members, "chaser/1", "world", "controller")
    announce(members, "controller", "world", "chaser/0", "chaser/1")
    announce(members, "recorder", "world", "chaser/0", "controller")
    everyone = first("chaser/0", "chaser/1", "controller", "recorder")
    assert members.connected(everyone) == {"chaser/0", "chaser/1", "controller"}


def test_departed_process_is_disconnected() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    announce(members, "chaser/0", "world", "controller")
    announce(members, "controller", "world", "chaser/0")
    everyone = first("chaser/0", "controller")
    members.set_alive("controller", False)
    assert members.connected(everyone) == {"chaser/0"}
    assert members._alive == {"chaser/0"}
    members.set_alive("controller", True)
    assert members.connected(everyone) == {"chaser/0"}  # returned, but not discovered again


def test_discovery_of_an_earlier_instance_does_not_count() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    announce(members, "chaser/0", "world", "controller")
    announce(members, "controller", "world", "chaser/0")
    members.set_alive("chaser/0", False)
    assert members.admit(JoinRequest(process="chaser/0", instance="chaser/0-2")).accepted
    members.set_alive("chaser/0", True)
    announce(members, "chaser/0", "world", "controller", instance="chaser/0-2")
    again = {**first("controller"), "chaser/0": "chaser/0-2"}
    assert members.connected(again) == set()  # the controller still talks of the first one
    heard = {"world": "world-1", "chaser/0": "chaser/0-2"}
    assert members.update_presence(
        Presence(process="controller", instance="controller-1", heard=heard)
    )
    assert members.connected(again) == {"chaser/0", "controller"}


def flying(chasers: int = 2) -> tuple[Membership, dict[str, str]]:
    """A flight of so many chasers, and whom the world has heard."""
    ids = [f"chaser/{i}" for i in range(chasers)]
    members = joined(membership(chasers), *ids, "controller")
    for name in ids:
        announce(members, name, "world", "controller")
    announce(members, "controller", "world", *ids)
    heard = first(*ids, "controller")
    members.flying = True
    assert members.connected(heard) == set(heard)
    return members, heard


def again(members: Membership, name: str, *heard: str) -> None:
    """A process that crashed has started again, and announces whom it has received."""
    members.set_alive(name, False)
    assert members.admit(JoinRequest(process=name, instance=f"{name}-2")).accepted
    members.set_alive(name, True)
    assert announce(members, name, *heard, instance=f"{name}-2")


def test_joining_chaser_disconnects_no_other() -> None:
    members, heard = flying(2)
    again(members, "chaser/1", "world", "controller")
    heard["chaser/1"] = "chaser/1-2"
    for _ in range(3):  # the controller has not heard the second start yet
        assert members.connected(heard) == {"chaser/0", "controller"}
    with_it = {**first("chaser/0"), "world": "world-1", "chaser/1": "chaser/1-2"}
    assert members.update_presence(
        Presence(process="controller", instance="controller-1", heard=with_it)
    )
    assert members.connected(heard) == {"chaser/0", "chaser/1", "controller"}


def test_joining_controller_disconnects_no_other_and_waits_for_all() -> None:
    members, heard = flying(2)
    again(members, "controller", "world", "chaser/0")
    heard["controller"] = "controller-2"
    with_it = {"world": "world-1", "controller": "controller-2"}
    assert members.connected(heard) == {"chaser/0", "chaser/1"}
    for i in (0, 1):
        presence = Presence(process=f"chaser/{i}", instance=f"chaser/{i}-1", heard=with_it)
        assert members.update_presence(presence)
        assert members.connected(heard) == {"chaser/0", "chaser/1"}
    announce(members, "controller", "world", "chaser/0", "chaser/1", instance="controller-2")
    assert members.connected(heard) == {"chaser/0", "chaser/1", "controller"}


def test_flying_processes_must_stay_mutually_discovered() -> None:
    members, heard = flying(1)
    assert members.connected(first("controller")) == {
        "controller"
    }  # the world lost sight of the chaser
    members, heard = flying(1)
    announce(members, "controller", "world")
    assert members.connected(heard) == set()


def test_full_discovery_is_required_again_after_loss_of_all() -> None:
    members, heard = flying(1)
    for name in ("chaser/0", "controller"):
        again(members, name, "world")
        heard[name] = f"{name}-2"
    assert members.connected(heard) == set()
    for name, other in (("chaser/0", "controller"), ("controller", "chaser/0")):
        known = {"world": "world-1", other: f"{other}-2"}
        assert members.update_presence(Presence(process=name, instance=f"{name}-2", heard=known))
    assert members.connected(heard) == {"chaser/0", "controller"}


def test_second_of_two_simultaneous_joins_is_refused() -> None:
    now_s = [100.0]
    members = membership(1)
    members.now_s = lambda: now_s[0]
    assert members.admit(JoinRequest(process="chaser/0", instance="a")).accepted
    assert (
        "another chaser/0 is joining"
        in members.admit(JoinRequest(process="chaser/0", instance="b")).reason
    )
    now_s[0] += 6.0  # the first never came
    assert members.admit(JoinRequest(process="chaser/0", instance="b")).accepted


def test_heartbeat_ends_with_its_node() -> None:
    # A thread that is in Zenoh while the interpreter ends aborts the process: it has to end with
    # the node, farewell or not.
    node = Node("chaser/0", "chaser", Link("heartbeat", listen=("tcp/127.0.0.1:0",)))
    heartbeat = Heartbeat(node, "first")
    time.sleep(0.1)
    node.close()
    assert not [t for t in threading.enumerate() if t.name == "repeat"]
    heartbeat.stop()  # twice does no harm


@pytest.fixture
def node() -> Node:
    """That of a controller."""
    network = SimulatedNetwork(Scheduler(0), SimulationSection(), 0, True)
    return Node("controller", "controller", Link(network=network))


@pytest.fixture
def heartbeat(node: Node) -> Heartbeat:
    """That of a controller in the mission of the world whose session is ``w``."""
    node.expect_world("w", lambda key, source, newest: None)
    return Heartbeat(node, "controller-1")


def test_identity_forged_for_each_message_is_reported_a_few_times_only(
    node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    callbacks: list[Callable[[RawSample], None]] = []
    reported: list[str] = []
    monkeypatch.setattr(node._connection, "subscribe", lambda _, arrived: callbacks.append(arrived))
    node.expect_world("w", lambda key, source, newest: reported.append(source))
    node.subscribe(topics.TICK)
    for i in range(1000):
        callbacks[0](RawSample(topics.TICK.key, "", b"", 0, f"forged-{i}"))
        assert node.receive(0) is None
    assert reported == [f"forged-{i}" for i in range(16)]
    assert node.counts.rejected[f"{topics.TICK.key}:foreign publisher"] == 1000


def presence(instance: str, world: str = "w") -> Presence:
    return Presence(process="chaser/0", instance=instance, heard={}, world=world)


def test_presence_of_an_earlier_mission_is_ignored(heartbeat: Heartbeat) -> None:
    heartbeat.take(presence("chaser/0-1"))
    heartbeat.take(presence("chaser/0-0", world="earlier"))
    assert heartbeat.heard() == first("chaser/0")
    heartbeat.take(
        presence("chaser/0-2", world="")
    )  # of a process that does not know its world's session
    assert heartbeat.heard() == {"chaser/0": "chaser/0-2"}


def test_presence_of_a_replaced_process_that_goes_on_is_ignored(heartbeat: Heartbeat) -> None:
    heartbeat.take(presence("chaser/0-1"))
    heartbeat.forget("chaser/0")  # a lost process may return
    heartbeat.take(presence("chaser/0-1"))
    assert heartbeat.heard() == first("chaser/0")
    heartbeat.forget("chaser/0")
    heartbeat.take(presence("chaser/0-2"))
    heartbeat.take(presence("chaser/0-1"))
    assert heartbeat.heard() == {"chaser/0": "chaser/0-2"}


def test_a_forged_presence_shuts_no_process_out(heartbeat: Heartbeat) -> None:
    """Before the world lists the process, and after."""
    heartbeat.take(presence("chaser/0-1"))
    for k in range(1000):
        heartbeat.take(presence(f"forged-{k}"))
    heartbeat.take(presence("chaser/0-1"))
    listed = Presence(process="world", instance="world-1", heard=first("chaser/0"), world="w")
    heartbeat.take(listed)
    heartbeat.take(presence("chaser/0-1"))
    assert heartbeat.heard()["chaser/0"] == "chaser/0-1"
    heartbeat.take(presence("forged-again"))
    assert heartbeat.heard()["chaser/0"] == "chaser/0-1"
    assert len(heartbeat._replaced) < 1000
    heartbeat.forget("chaser/0")
    heartbeat.take(msgspec.structs.replace(listed, heard={}))  # the world has lost it
    heartbeat.take(presence("chaser/0-2"))
    assert heartbeat.heard()["chaser/0"] == "chaser/0-2"


def test_a_message_names_the_process_of_its_key(node: Node) -> None:
    key = topics.PRESENCE.key_of("chaser/0")
    for process, expected in (("chaser/0", True), ("world", False), ("controller", False)):
        message = Presence(process=process, instance="x", heard={})
        raw = RawSample(key, encoding_of(Presence), codec.encode(message), 0, "s")
        assert (node._decode(topics.PRESENCE, "chaser/0", raw) is not None) == expected


def test_a_process_is_replaced_when_the_world_lists_another_instance(
    heartbeat: Heartbeat, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not heartbeat.is_replaced("controller-1")
    assert not heartbeat.is_replaced(None)  # not listed, or by a world that lists none
    assert heartbeat.is_replaced("controller-2")
    assert "another controller has replaced this one" in capsys.readouterr().err
