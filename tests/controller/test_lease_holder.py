# SPDX-License-Identifier: Apache-2.0
"""Which tick a controller commands, by the leases that chasers state; and the model check of the
whole protocol.
"""

from __future__ import annotations

from typing import Any

import pytest
from chaserdock_agents.chaser import lease_grantor
from chaserdock_controller.redundancy.standby import HotStandby
from chaserdock_protocol.lease_holder import PATIENCE_TICKS, Commander, LeaseHolder
from chaserdock_protocol.messages import Lease, Tick, WrenchCommand
from lease_model import Chaser, Model, TwoCommanders, walk

BOTH = {"controller": "c", "standby": "s"}
ALONE = {"revision": 1, "controllers": {"standby": "s"}}


def tick(number: int, chasers: tuple[int, ...] = (0, 1, 2), **changes: Any) -> Tick:
    fields: dict[str, Any] = {"controllers": BOTH} | changes
    return Tick(tick=number, images=False, chasers=chasers, **fields)


def lease(chaser: int, number: int, holder: str = "standby", **changes: Any) -> Lease:
    fields: dict[str, Any] = {
        "instance": BOTH[holder],
        "term": 2,
        "from_tick": 0,
        "until_tick": number + 1,
    } | changes
    return Lease(tick=number, chaser=chaser, holder=holder, **fields)


def standby(*leases: Lease) -> LeaseHolder:
    made = LeaseHolder("standby", "s")
    for one in leases:
        made.add(one)
    return made


@pytest.mark.parametrize(
    ("leases", "number", "changes", "claimed"),
    [
        ([lease(1, 5), lease(2, 5)], 5, {}, True),
        ([lease(1, 5), lease(2, 5)], 7, {}, False),  # run out
        ([lease(2, 5)], 5, {}, False),
        ([lease(2, 5)], 5, {"chasers": (2,)}, True),  # the only one that takes part
        (
            [lease(1, 5), lease(2, 5)],
            5,
            {"controllers": {"controller": "c"}},
            False,
        ),  # taken for lost
        ([lease(1, 5), lease(2, 5)], 5, {"controllers": {"standby": "s2"}}, False),  # another start
        ([lease(1, 5), lease(2, 5, instance="s2")], 5, {}, False),
        ([lease(1, 5), lease(2, 5, from_tick=5)], 4, {}, False),  # another's tick
        (
            [lease(1, 5), lease(2, 5, from_tick=5, from_revision=1)],
            5,
            {},
            False,
        ),  # another's revision
        ([lease(1, 5), lease(2, 5, from_tick=5, from_revision=1)], 5, ALONE, True),
        ([lease(1, 5), lease(2, 5)], 6, {"since": {"chaser/2": 6}}, False),  # it may have forgotten
        ([lease(1, 5), lease(2, 5)], 6, {"since": {"standby": 6}}, False),
        (
            [lease(1, 5), lease(2, 5)],
            6,
            {"since": {"controller": 6, "standby": 5, "chaser/2": 5}},
            True,
        ),
    ],
)
def test_commander_of_a_tick(
    leases: list[Lease], number: int, changes: dict[str, Any], claimed: bool
) -> None:
    holder = standby(*leases)
    at = tick(number, **changes)
    assert holder.claim(at) is claimed
    assert holder.commander_of(at) == (Commander("standby", "s", 2) if claimed else None)


def test_chaser_that_is_lost_in_a_tick_still_counts_in_it_while_both_controllers_take_part() -> (
    None
):
    holder = standby(lease(1, 5))
    assert not holder.claim(tick(5, (0, 1), revision=1))
    holder.add_tick(tick(5, (0, 1)))
    assert not holder.claim(tick(5, (1,), revision=1))
    assert holder.claim(tick(5, (1,), **ALONE | {"revision": 2}))
    holder.add(lease(0, 5))
    assert holder.claim(tick(5, (1,), revision=1))
    assert holder.claim(tick(6, (1,)))


def test_older_statement_does_not_replace_a_newer_one() -> None:
    holder = standby(lease(0, 6), lease(1, 6), lease(1, 5, "controller"))
    assert holder.claim(tick(6))
    holder.add(lease(1, 7, "controller", term=3))
    assert not holder.claim(tick(7))


def test_commander_takes_the_highest_term_of_all() -> None:
    holder = standby(lease(0, 5), lease(1, 5), lease(2, 5, "controller", term=7))
    assert holder.claim(tick(5))
    assert holder.term == 8  # the next of its own
    holder.add(lease(2, 6, "controller", term=3))
    assert holder.claim(tick(6))
    assert holder.term == 8


def test_commander_keeps_its_term_while_the_other_has_only_a_minority_or_later_ticks() -> None:
    """A controller that was frozen finishes its tick after the other has read the leases of the
    next.
    """
    holder = standby(*(lease(i, 5) for i in (0, 1, 2)))
    assert holder.claim(tick(5))
    assert holder.term == 2
    holder.add(lease(0, 6, "controller", term=3))
    assert holder.claim(tick(6))
    assert holder.term == 2


def test_commander_that_returns_by_older_grants_takes_a_new_term() -> None:
    """Seed 4136 of `fault-drill`: of chasers 1 and 2, 1 granted term 3 to the controller; then 0,
    cut off until then, was back with its grant to the standby, and made a majority with 3."""
    holder = standby(*(lease(i, 5, until_tick=20) for i in (0, 1, 2, 3)))
    assert holder.claim(tick(5, (0, 1, 2, 3)))
    holder.add(lease(1, 6, "controller", term=3, until_tick=20))
    assert not holder.claim(tick(6, (1, 2)))
    assert holder.claim(tick(7, (0, 1, 2, 3)))
    assert holder.term == 4
    holder.add(lease(1, 8, "controller", term=5, until_tick=20))
    assert holder.claim(tick(8, (0, 1, 2, 3)))
    assert holder.term == 4


def test_new_commander_takes_no_account_of_leases_of_later_ticks() -> None:
    holder = standby(lease(0, 5), lease(1, 5), lease(2, 7, "controller", term=7))
    assert holder.claim(tick(5))
    assert holder.term == 2


def test_minority_waits_then_gives_its_lease_back_and_counts_it_no_more() -> None:
    holder = standby()
    for number in range(5, 5 + PATIENCE_TICKS):
        holder.add(lease(2, number, until_tick=20))
        assert holder.take_idle(tick(number)) == {2: (2, False)}
    last = 5 + PATIENCE_TICKS
    holder.add(lease(2, last, until_tick=20))
    assert holder.take_idle(tick(last)) == {2: (2, True)}
    holder.add(lease(1, last, until_tick=20))
    assert not holder.claim(tick(last + 1))
    holder.add(lease(2, last + 1, until_tick=20))  # granted again since
    assert holder.claim(tick(last + 1))


@pytest.mark.parametrize(
    ("renewed", "idle_ticks"),
    [((0, 1), 1), ((0,), PATIENCE_TICKS), ((), PATIENCE_TICKS)],
)
def test_minority_gives_its_lease_back_sooner_while_the_other_commands(
    renewed: tuple[int, ...], idle_ticks: int
) -> None:
    """A long lease alone does not show that its holder still commands: a majority must have
    executed a command meanwhile.
    """
    holder, mine = standby(*(lease(i, 4, "controller", term=1, until_tick=18) for i in (0, 1))), []
    for number in range(5, 6 + PATIENCE_TICKS):
        for i in (0, 1):
            until = 18 + number if i in renewed else 18
            holder.add(lease(i, number, "controller", term=1, until_tick=until))
        holder.add(lease(2, number, until_tick=20))
        mine.append(holder.take_idle(tick(number))[2][1])
    assert mine.index(True) == idle_ticks


def test_chaser_whose_lease_is_lost_need_not_wait_for_a_command() -> None:
    holder = standby(lease(0, 5, "controller"))
    holder.add_lost(1, 5)
    assert holder.missing(tick(5)) == [2]
    assert holder.take_idle(tick(5)) == {1: (0, False)}
    assert holder.missing(tick(6)) == [0, 1, 2]


def test_lockstep_decides_with_all_leases_and_real_time_as_they_come() -> None:
    for realtime in (False, True):
        role = HotStandby("standby", realtime)
        role.join("s")
        role.update(tick(3))
        for chaser in (0, 1):
            role.leases.add(lease(chaser, 3))
            role.decide()
        assert role.leads is realtime
        role.leases.add(lease(2, 3))
        role.decide()
        assert role.leads


def test_commander_goes_on_in_a_tick_in_which_a_chaser_is_lost() -> None:
    role = HotStandby("standby", realtime=False)
    role.join("s")
    role.update(tick(3, (0, 1)))
    role.leases.add(lease(0, 3))
    role.leases.add(lease(1, 3, revision=1))
    role.update(tick(3, (1,), revision=1))
    role.decide()
    assert role.leads


def test_real_time_commander_continues_until_a_tick_without_leases() -> None:
    role = HotStandby("standby", realtime=True)
    role.join("s")
    role.update(tick(3))
    for chaser in (0, 1, 2):
        role.leases.add(lease(chaser, 3))
    role.decide()
    role.update(tick(5))
    role.decide()
    assert role.leads  # the leases may be on their way
    role.decide(tick(4))
    assert role.leads
    role.decide(tick(5))
    assert not role.leads


def test_never_two_commanders_in_any_interleaving() -> None:
    """A short run of ``python tests/lease_model.py``."""
    steps = commanded = 0
    for seed in range(1000, 1030):
        model = walk(seed)
        steps, commanded = steps + model.steps, commanded + len(model.claims)
    assert steps > 90_000
    assert commanded > 2_000


class GrantsWhileALeaseRuns(lease_grantor.LeaseGrantor):
    def update(self, tick: Tick) -> Lease | None:
        self.until_tick -= 2
        return super().update(tick)


class IgnoresInstance(lease_grantor.LeaseGrantor):
    def is_of_holder(self, command: WrenchCommand) -> bool:
        return command.commander == self.holder


class IgnoresTerm(lease_grantor.LeaseGrantor):
    def refusal(self, command: WrenchCommand) -> str | None:
        return None if self.is_of_holder(command) else "another sender"


class IgnoresYield(lease_grantor.LeaseGrantor):
    def give_back(self, command: WrenchCommand) -> None:
        pass


@pytest.mark.parametrize(
    ("wrong", "seed", "words"),
    [
        (GrantsWhileALeaseRuns, 0, "command it"),
        (IgnoresInstance, 173, "command it"),
        (IgnoresTerm, 3, "states"),
        (IgnoresYield, 6, "after the last loss"),
    ],
)
def test_model_finds_errors_of_a_chaser(
    wrong: type, seed: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The seeds are the first that find them."""
    monkeypatch.setattr("lease_model.LeaseGrantor", wrong)
    with pytest.raises(TwoCommanders, match=words):
        walk(seed)


def test_model_finds_a_controller_that_does_not_count_lost_chasers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(LeaseHolder, "_with_lost_chasers", lambda _, tick: tick)
    with pytest.raises(TwoCommanders, match="command it"):
        walk(21)


def test_model_finds_a_chaser_that_does_not_ignore_older_ticks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def chaser_tick(model: Model, chaser: Chaser, tick: Tick) -> None:
        chaser.tick = None
        in_order(model, chaser, tick)

    in_order = Model._chaser_tick
    monkeypatch.setattr(Model, "_chaser_tick", chaser_tick)
    with pytest.raises(TwoCommanders, match="states"):
        walk(0)
