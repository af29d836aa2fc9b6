"""Who takes part in a mission: joining, leaving, and who has heard whom."""

from __future__ import annotations

import threading
import time

import pytest
from chaserdock_protocol.messages import JoinRequest, Presence
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.session import Heartbeat
from chaserdock_world.lockstep.membership import Membership


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
        members.alive_changed(name, True)
    return members


def tell(members: Membership, name: str, *heard: str, instance: str | None = None) -> bool:
    message = Presence(process=name, instance=instance or f"{name}-1", heard=first(*heard))
    return members.presence_told(message)


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_who_may_join_is_told_the_mission(mode: str) -> None:
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
        ("world", "this mission has its world already"),
    ],
)
def test_who_may_not_join_is_told_why(name: str, reason: str) -> None:
    members = membership()
    reply = members.admit(JoinRequest(process=name, instance="i"))
    assert not reply.accepted
    assert reason in reply.reason
    assert reply.scenario_json == ""
    assert not tell(members, name, instance="i")


def test_nobody_joins_twice_at_a_time_and_anybody_comes_back() -> None:
    members = joined(membership(), "chaser/0")
    twin = JoinRequest(process="chaser/0", instance="another")
    assert members.admit(twin).reason == "chaser/0 is already running in this mission"
    assert members.admit(JoinRequest(process="chaser/0", instance="chaser/0-1")).accepted  # asked again
    members.alive_changed("chaser/0", False)
    assert members.who_left() == ["chaser/0"]
    assert members.who_left() == []
    assert members.admit(twin).accepted
    assert not tell(members, "chaser/0", "world")  # the old one has nothing to say any more
    assert tell(members, "chaser/0", "world", instance="another")


def test_leaving_without_having_come_is_nothing() -> None:
    members = membership()
    members.alive_changed("chaser/0", False)
    assert members.who_left() == []
    assert members.alive() == set()


def test_linked_are_those_who_have_heard_each_other_both_ways() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    assert members.linked({}) == set()
    everyone = first("chaser/0", "controller")
    tell(members, "chaser/0", "world", "controller")
    tell(members, "controller", "world", "chaser/0")
    assert members.linked(everyone) == {"chaser/0", "controller"}
    assert members.linked(first("controller")) == {"controller"}  # the world has not heard the chaser
    tell(members, "controller", "world")  # not any more
    assert members.linked(everyone) == set()
    tell(members, "controller", "chaser/0")  # has not heard the world
    assert members.linked(everyone) == {"chaser/0"}


def test_chasers_need_not_hear_each_other_and_the_recorder_must_hear_all() -> None:
    members = joined(membership(2), "chaser/0", "chaser/1", "controller", "recorder")
    tell(members, "chaser/0", "world", "controller")
    tell(members, "chaser/1", "world", "controller")
    tell(members, "controller", "world", "chaser/0", "chaser/1")
    tell(members, "recorder", "world", "chaser/0", "controller")
    everyone = first("chaser/0", "chaser/1", "controller", "recorder")
    assert members.linked(everyone) == {"chaser/0", "chaser/1", "controller"}


def test_who_is_gone_links_nobody_up_and_is_linked_no_more() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    tell(members, "chaser/0", "world", "controller")
    tell(members, "controller", "world", "chaser/0")
    everyone = first("chaser/0", "controller")
    members.alive_changed("controller", False)
    assert members.linked(everyone) == {"chaser/0"}
    assert members.alive() == {"chaser/0"}
    members.alive_changed("controller", True)
    assert members.linked(everyone) == {"chaser/0"}  # back, and not heard anew


def test_who_has_heard_an_earlier_start_has_not_heard_this_one() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    tell(members, "chaser/0", "world", "controller")
    tell(members, "controller", "world", "chaser/0")
    members.alive_changed("chaser/0", False)
    assert members.admit(JoinRequest(process="chaser/0", instance="chaser/0-2")).accepted
    members.alive_changed("chaser/0", True)
    tell(members, "chaser/0", "world", "controller", instance="chaser/0-2")
    again = {**first("controller"), "chaser/0": "chaser/0-2"}
    assert members.linked(again) == set()  # the controller still talks of the first one
    heard = {"world": "world-1", "chaser/0": "chaser/0-2"}
    assert members.presence_told(Presence(process="controller", instance="controller-1", heard=heard))
    assert members.linked(again) == {"chaser/0", "controller"}


def flying(chasers: int = 2) -> tuple[Membership, dict[str, str]]:
    """A flight of so many chasers, and whom the world has heard."""
    ids = [f"chaser/{i}" for i in range(chasers)]
    members = joined(membership(chasers), *ids, "controller")
    for name in ids:
        tell(members, name, "world", "controller")
    tell(members, "controller", "world", *ids)
    heard = first(*ids, "controller")
    members.flying = True
    assert members.linked(heard) == set(heard)
    return members, heard


def again(members: Membership, name: str, *heard: str) -> None:
    """A process that crashed has started again, and tells whom it has heard."""
    members.alive_changed(name, False)
    assert members.admit(JoinRequest(process=name, instance=f"{name}-2")).accepted
    members.alive_changed(name, True)
    assert tell(members, name, *heard, instance=f"{name}-2")


def test_in_flight_a_chaser_that_joins_puts_nobody_out() -> None:
    members, heard = flying(2)
    again(members, "chaser/1", "world", "controller")
    heard["chaser/1"] = "chaser/1-2"
    for _ in range(3):  # the controller has not heard the second start yet
        assert members.linked(heard) == {"chaser/0", "controller"}
    with_it = {**first("chaser/0"), "world": "world-1", "chaser/1": "chaser/1-2"}
    assert members.presence_told(Presence(process="controller", instance="controller-1", heard=with_it))
    assert members.linked(heard) == {"chaser/0", "chaser/1", "controller"}


def test_in_flight_a_controller_that_joins_puts_nobody_out_and_waits_for_all() -> None:
    members, heard = flying(2)
    again(members, "controller", "world", "chaser/0")
    heard["controller"] = "controller-2"
    with_it = {"world": "world-1", "controller": "controller-2"}
    assert members.linked(heard) == {"chaser/0", "chaser/1"}
    for i in (0, 1):
        told = Presence(process=f"chaser/{i}", instance=f"chaser/{i}-1", heard=with_it)
        assert members.presence_told(told)
        assert members.linked(heard) == {"chaser/0", "chaser/1"}
    tell(members, "controller", "world", "chaser/0", "chaser/1", instance="controller-2")
    assert members.linked(heard) == {"chaser/0", "chaser/1", "controller"}


def test_in_flight_two_who_fly_must_still_hear_each_other_and_the_world_them() -> None:
    members, heard = flying(1)
    assert members.linked(first("controller")) == {"controller"}  # the world lost sight of the chaser
    members, heard = flying(1)
    tell(members, "controller", "world")
    assert members.linked(heard) == set()


def test_when_all_were_lost_the_barrier_is_for_all_again() -> None:
    members, heard = flying(1)
    for name in ("chaser/0", "controller"):
        again(members, name, "world")
        heard[name] = f"{name}-2"
    assert members.linked(heard) == set()
    for name, other in (("chaser/0", "controller"), ("controller", "chaser/0")):
        known = {"world": "world-1", other: f"{other}-2"}
        assert members.presence_told(Presence(process=name, instance=f"{name}-2", heard=known))
    assert members.linked(heard) == {"chaser/0", "controller"}


def test_of_two_that_join_at_once_the_second_is_refused() -> None:
    now_s = [100.0]
    members = membership(1)
    members.now_s = lambda: now_s[0]
    assert members.admit(JoinRequest(process="chaser/0", instance="a")).accepted
    assert (
        "another chaser/0 is just joining"
        in members.admit(JoinRequest(process="chaser/0", instance="b")).reason
    )
    now_s[0] += 6.0  # the first never came
    assert members.admit(JoinRequest(process="chaser/0", instance="b")).accepted


def test_nobody_tells_its_presence_on_a_closed_session() -> None:
    # A thread that is in Zenoh while the interpreter ends aborts the process: it has to end with the node, farewell or not.
    node = Node("chaser/0", "chaser", Link("told", listen=("tcp/127.0.0.1:0",)))
    heartbeat = Heartbeat(node, "first")
    time.sleep(0.1)
    node.close()
    assert not [t for t in threading.enumerate() if t.name == "presence"]
    heartbeat.stop()  # twice does no harm
