# SPDX-License-Identifier: Apache-2.0
"""Leader election between controllers, and rejection of commands of stale terms by chasers."""

from __future__ import annotations

import random

import msgspec
import pytest
from chaserdock_agents.chaser.command_gate import stale_term
from chaserdock_protocol.messages import Tick, WrenchCommand
from chaserdock_world.lockstep.leader_election import (
    FIRST_COMMAND_S,
    LEASE_S,
    LeaderElection,
    Term,
    lease_s,
    next_term,
)

BOTH = {"controller": "c1", "standby": "s1"}
FIRST = Term(1, "controller", "c1")
NOBODY: frozenset[str] = frozenset()


def test_the_first_term_is_the_controllers_and_lasts() -> None:
    assert next_term(Term(), BOTH, NOBODY) == FIRST
    assert next_term(FIRST, BOTH, NOBODY) is FIRST
    assert next_term(FIRST, {"controller": "c1"}, NOBODY) is FIRST


@pytest.mark.parametrize(
    ("here", "silent", "after"),
    [
        ({"standby": "s1"}, [], Term(2, "standby", "s1")),
        ({}, [], Term(1)),
        ({"controller": "c2"}, [], Term(2, "controller", "c2")),  # started again: another one
        ({"controller": "c2", "standby": "s1"}, [], Term(2, "controller", "c2")),
        (BOTH, ["c1"], Term(2, "standby", "s1")),
        (BOTH, ["c1", "s1"], FIRST),  # both silent: no change for the better
        ({"controller": "c1"}, ["c1"], FIRST),
    ],
)
def test_who_follows(here: dict[str, str], silent: list[str], after: Term) -> None:
    assert next_term(FIRST, here, frozenset(silent)) == after


def test_a_number_is_never_given_twice() -> None:
    draw, term, seen = random.Random(1), Term(), {}
    for _ in range(2000):
        here = {name: draw.choice("abc") + name[0] for name in BOTH if draw.random() < 0.7}
        after = next_term(
            term, here, frozenset(draw.sample(sorted(here.values()), draw.randint(0, len(here))))
        )
        assert after.number >= term.number
        if after.commander:
            assert here[after.commander] == after.instance
            assert seen.setdefault(after.number, (after.commander, after.instance)) == (
                after.commander,
                after.instance,
            )
        else:
            assert not here
        term = after


def test_silence_ends_a_term_only_where_another_can_have_it() -> None:
    election = LeaderElection(LEASE_S)
    assert election.update(BOTH, 10.0)
    election.renew_lease(1, 10.0)
    assert not election.update(BOTH, 10.0 + LEASE_S)
    assert not election.update({"controller": "c1"}, 15.0)
    assert (
        election.update(BOTH, 15.0) == "term 2: standby leads: no command of controller executed for 5.00 s"
    )
    election.renew_lease(1, 15.0)  # of the term before: says nothing about this one
    assert not election.update(BOTH, 15.0 + 0.9 * FIRST_COMMAND_S)
    assert election.expired_for_s(15.0 + 1.1 * FIRST_COMMAND_S) > 0.0
    # Nobody gets the command back who has not been heard since.
    assert not election.update(BOTH, 15.0 + 1.1 * FIRST_COMMAND_S)
    election.mark_responsive("c1")
    assert election.update(BOTH, 15.0 + 1.1 * FIRST_COMMAND_S).startswith("term 3: controller leads")


def test_a_commander_that_is_gone_loses_the_command_at_once() -> None:
    election = LeaderElection(LEASE_S)
    election.update(BOTH, 0.0)
    assert election.update({"standby": "s1"}, 0.0) == "term 2: standby leads: controller lost"
    assert election.update({}, 0.0) == "no leader: standby lost"
    assert election.update({"controller": "c2"}, 1.0) == "term 3: controller leads: no leader before"
    assert not election.update({"controller": "c2", "standby": "s2"}, 1.0)  # keeps it until it is lost itself


def test_a_lease_is_some_ticks_at_least() -> None:
    assert lease_s(30.0) == LEASE_S
    assert lease_s(2.0) == 0.75


# -- the chaser ---------------------------------------------------------------------------------------------

COMMAND = WrenchCommand(
    tick=9,
    chaser=0,
    effective_time_ns=0,
    expires_ns=10**12,
    mode="nmpc",
    force_N=(0.0, 0.0, 0.0),
    torque_N_m=(0.0, 0.0, 0.0),
    term=2,
    commander="standby",
    instance="s1",
)
TICK = Tick(tick=9, images=False, chasers=(0,), controller=True, term=2, commander="standby", instance="s1")


@pytest.mark.parametrize(
    ("changes", "tick", "last", "words"),
    [
        ({}, TICK, 2, None),
        ({}, TICK, 0, None),
        (
            {"term": 1, "commander": "controller", "instance": "c1"},
            TICK,
            1,
            "sent in term 1, current term is 2",
        ),
        ({"instance": "s0"}, TICK, 1, "standby s0 does not lead term 2"),
        ({"commander": "controller"}, TICK, 1, "controller s1 does not lead term 2"),
        ({"term": 3, "commander": "controller"}, TICK, 2, None),  # its tick is on its way
        ({"term": 2}, TICK, 3, "sent in term 2, current term is 3"),
        ({"term": 0, "commander": "", "instance": ""}, TICK, 0, "sent in term 0"),
        ({"term": 0, "commander": "", "instance": ""}, None, 0, None),
    ],
)
def test_which_commands_are_stale(
    changes: dict[str, object], tick: Tick | None, last: int, words: str | None
) -> None:
    why = stale_term(msgspec.structs.replace(COMMAND, **changes), tick, last)
    assert (why is None) == (words is None), why
    assert words is None or (words in str(why) and "stale term" in str(why))


def test_without_terms_everybody_is_heard_as_before() -> None:
    old = Tick(tick=9, images=False, chasers=(0,), controller=True)
    assert stale_term(msgspec.structs.replace(COMMAND, term=0, commander="", instance=""), old, 0) is None


def test_where_nobody_commands_who_did_last_is_refused() -> None:
    nobody = msgspec.structs.replace(TICK, term=2, commander="", instance="", controller=False)
    assert "stale term" in str(stale_term(COMMAND, nobody, 2))


def test_a_machine_that_stalls_again_and_again_does_not_change_commanders_each_time() -> None:
    election, now_s = LeaderElection(LEASE_S), 0.0
    election.update(BOTH, now_s)

    def hand_overs(*stalls: float) -> int:
        """How often the command changes hands where commands come every 0.1 s, but each second stop for so long."""
        nonlocal now_s
        changes = 0
        for stall_s in stalls:
            for _ in range(10):
                now_s += 0.1
                election.renew_lease(election.term.number, now_s)
            for instance in BOTH.values():
                election.mark_responsive(instance)
            now_s += stall_s
            changes += bool(election.update(BOTH, now_s))
        return changes

    assert hand_overs(*[0.25] * 15) == 2  # the second has doubled the lease
    assert hand_overs(*[0.0] * 30) == 0
    assert hand_overs(0.25) == 1  # calm since: the short lease again
    assert hand_overs(1.0) == 1
