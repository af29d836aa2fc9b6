# SPDX-License-Identifier: Apache-2.0
"""Leases that a chaser grants to controllers, and the commands that it refuses because of them."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from chaserdock_agents.chaser.lease_grantor import FIRST_COMMAND_S, LeaseGrantor
from chaserdock_protocol.leases import (
    LEASE_S,
    commander_of,
    defect_of,
    is_majority,
    lease_ticks,
    next_term,
)
from chaserdock_protocol.messages import Lease, Tick, WrenchCommand

RATE_HZ = 10
FIRST = round(FIRST_COMMAND_S * RATE_HZ)
BOTH = {"controller": "c1", "standby": "s1"}


def tick(number: int, controllers: dict[str, str] = BOTH, revision: int = 0) -> Tick:
    return Tick(tick=number, revision=revision, images=False, chasers=(0,), controllers=controllers)


def command(
    number: int, commander: str = "controller", instance: str = "c1", term: int = 1, **changes: Any
):
    return WrenchCommand(
        tick=number,
        chaser=0,
        effective_time_ns=0,
        expires_ns=10**12,
        mode=changes.get("mode", "nmpc"),
        force_N=(0.0, 0.0, 0.0),
        torque_N_m=(0.0, 0.0, 0.0),
        term=term,
        commander=commander,
        instance=instance,
    )


@pytest.fixture
def grantor() -> LeaseGrantor:
    made = LeaseGrantor(0, RATE_HZ)
    made.update(tick(0))
    return made


def stated(grantor: LeaseGrantor, tick: Tick) -> Lease:
    """Return what the chaser states in a tick."""
    lease = grantor.update(tick)
    assert lease is not None
    return lease


def fly(grantor: LeaseGrantor, first: int, last: int, **sender: Any) -> None:
    """Execute a command of the holder in each tick."""
    for number in range(first, last + 1):
        stated(grantor, tick(number))
        sent = command(number, **sender)
        assert grantor.refusal(sent) is None
        grantor.renew(sent)


def test_terms_of_controllers_differ_and_increase() -> None:
    assert [commander_of(term) for term in range(4)] == ["", "controller", "standby", "controller"]
    assert [next_term(term, "standby") for term in (0, 1, 2, 3)] == [2, 2, 4, 4]


@pytest.mark.parametrize(
    ("granted", "live", "expected"),
    [
        ((), (0, 1), False),
        ((0,), (0, 1), True),  # half, with the first
        ((1,), (0, 1), False),
        ((2,), (2,), True),
        ((2, 3), (1, 2, 3), True),
        ((1, 3), (0, 1, 2, 3), False),
        ((0, 3), (0, 1, 2, 3), True),
        ((), (), False),
    ],
)
def test_majority_of_live_chasers(
    granted: tuple[int, ...], live: tuple[int, ...], expected: bool
) -> None:
    assert is_majority(granted, live) is expected


def test_lease_covers_the_shortest_lease_and_two_ticks() -> None:
    assert lease_ticks(30.0) / 30.0 >= LEASE_S > (lease_ticks(30.0) - 1) / 30.0
    assert lease_ticks(2.0) == 2


def test_controller_precedes_standby_and_keeps_the_lease_while_it_commands(
    grantor: LeaseGrantor,
) -> None:
    assert (grantor.holder, grantor.instance, grantor.term, grantor.until_tick) == (
        "controller",
        "c1",
        1,
        FIRST - 1,
    )
    fly(grantor, 0, 50)
    assert (grantor.term, grantor.until_tick) == (1, 50 + lease_ticks(RATE_HZ) - 1)


def test_silent_holder_loses_the_lease_to_the_other_and_back(grantor: LeaseGrantor) -> None:
    fly(grantor, 0, 20)
    assert stated(grantor, tick(21)).holder == "controller"
    lease = stated(grantor, tick(22))
    assert (lease.holder, lease.term, lease.from_tick, lease.until_tick) == (
        "standby",
        2,
        22,
        22 + FIRST - 1,
    )
    assert "stale term" in str(grantor.refusal(command(22)))
    lease = stated(grantor, tick(22 + FIRST))
    assert (lease.holder, lease.term) == ("controller", 3)


def test_lost_holder_loses_the_lease_within_the_tick(grantor: LeaseGrantor) -> None:
    fly(grantor, 0, 5)
    lease = stated(grantor, tick(5, {"standby": "s1"}, revision=1))
    assert (lease.holder, lease.term, lease.from_tick, lease.from_revision) == ("standby", 2, 5, 1)
    lease = stated(grantor, tick(5, {}, revision=2))
    assert (lease.holder, lease.until_tick) == ("", 4)
    assert "no controller holds" in str(grantor.refusal(command(5, "standby", "s1", 2)))
    assert (
        stated(grantor, tick(6, {"controller": "c2"})).term == 3
    )  # started again: another instance


def test_only_controller_keeps_its_lease_without_a_command(grantor: LeaseGrantor) -> None:
    alone = {"controller": "c1"}
    for number in range(1, 40):
        lease = stated(grantor, tick(number, alone))
        assert (lease.holder, lease.term) == ("controller", 1)
        assert grantor.is_held_at(tick(number, alone))


def test_tick_without_this_chaser(grantor: LeaseGrantor) -> None:
    stated(grantor, tick(9))
    assert grantor.update(msgspec.structs.replace(tick(10, {}), chasers=(1,))) is None
    assert grantor.holder == "controller"


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        (command(1), None),
        (command(1, term=3), None),  # it has seen a higher number elsewhere
        (command(1, instance="c0"), "controller holds term 1"),
        (command(1, "standby", "s1", 2), "controller holds term 1"),
        (command(1, term=2), "the lease is of term 1"),  # a number of the other's
        (command(1, term=0), "the lease is of term 1"),
    ],
)
def test_commands_of_others_than_the_holder_are_refused(
    grantor: LeaseGrantor, sent: WrenchCommand, words: str | None
) -> None:
    reason = grantor.refusal(sent)
    assert (reason is None) == (words is None), reason
    assert words is None or (words in str(reason) and "stale term" in str(reason))


def test_executed_command_of_a_higher_term_raises_the_lease(grantor: LeaseGrantor) -> None:
    grantor.renew(command(1, term=5))
    assert grantor.term == 5
    assert "stale" in str(grantor.refusal(command(2, term=3)))


def test_lease_given_back_goes_to_the_other_unless_it_was_renewed_since(
    grantor: LeaseGrantor,
) -> None:
    fly(grantor, 0, 5)
    grantor.give_back(command(4, mode="yield"))  # late
    assert stated(grantor, tick(6)).holder == "controller"
    grantor.give_back(command(6, mode="yield"))
    assert grantor.is_held_at(tick(6))
    assert stated(grantor, tick(7)).holder == "standby"


def test_repeated_expiry_doubles_the_lease() -> None:
    def hand_overs(grantor: LeaseGrantor, start: int, stalls: list[int]) -> tuple[int, int]:
        """Command in ten ticks, then miss some, and again; return the number of changes, and the
        next tick.
        """
        number, changes = start, 0
        for missed in stalls:
            for _ in range(10):
                number += 1
                term = grantor.term
                changes += stated(grantor, tick(number)).term != term
                grantor.renew(command(number, grantor.holder, grantor.instance, grantor.term))
            number += missed
        return changes, number

    grantor = LeaseGrantor(0, RATE_HZ)
    stated(grantor, tick(0))
    changes, number = hand_overs(grantor, 0, [2] * 15)
    assert changes == 2  # the second has doubled the lease
    changes, number = hand_overs(grantor, number, [0] * 30)
    assert changes == 0
    changes, number = hand_overs(grantor, number, [2, 0])
    assert changes == 1  # calm since: the short lease again


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, None),
        ({"holder": "", "term": 0, "until_tick": 0}, None),  # granted to nobody
        ({"holder": "contRoller"}, "belongs to controller"),
        ({"term": 2}, "belongs to standby"),
        ({"term": 0}, "belongs to no controller"),
        ({"until_tick": 0}, "from tick 0 to 0, stated in tick 1"),
        ({"from_tick": 2}, "from tick 2"),
        ({"until_tick": 200}, "to 200"),
    ],
)
def test_lease_that_no_chaser_can_have_stated_is_recognized(
    grantor: LeaseGrantor, changes: dict[str, Any], words: str | None
) -> None:
    defect = defect_of(msgspec.structs.replace(stated(grantor, tick(1)), **changes), RATE_HZ)
    assert defect == "" if words is None else words in defect
