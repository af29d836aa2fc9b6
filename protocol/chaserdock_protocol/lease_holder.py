# SPDX-License-Identifier: Apache-2.0
"""Decide from the chasers' leases which controller commands a tick.

No I/O; ticks are the only clock. A controller commands a tick while a majority of the chasers that
take part in it have promised it to that controller. Any two majorities share a chaser, and a chaser
promises a tick to one controller only. A chaser that is lost in a tick still counts in it: a
majority of the others need not share a chaser with one that included it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec

from .leases import is_majority, next_term
from .messages import Lease, Tick

PATIENCE_TICKS = 3
"""Ticks without a majority after which a controller gives a lease back. One tick is enough while
the other controller commands.
"""
_MOST_KNOWN = 8
"""Ticks whose first message is kept: half a second at 15 Hz, longer than `PATIENCE_TICKS`."""


@dataclass(frozen=True)
class Commander:
    """The controller that commands a tick, and its term."""

    name: str
    instance: str
    term: int


@dataclass
class LeaseHolder:
    """Keep the newest lease that each chaser has stated.

    ``name``, ``instance`` and ``term``: of this controller. ``_renewed``: by chaser, the tick in
    which it last stated a longer lease of the same holder, and so has executed a command.
    ``_first``: the first revisions of the last ticks. ``_claimed``, ``_ceded``: newest ticks that
    this controller, and another one, was found to command.
    """

    name: str
    instance: str = ""
    term: int = 0
    leases: dict[int, Lease] = field(default_factory=dict)
    _renewed: dict[int, int] = field(default_factory=dict)
    _lost: dict[int, int] = field(default_factory=dict)
    _given_back: dict[int, int] = field(default_factory=dict)
    _idle_since: dict[int, int] = field(default_factory=dict)
    _claimed: int = -1
    _ceded: int = -1
    _first: deque[Tick] = field(default_factory=lambda: deque(maxlen=_MOST_KNOWN))

    def add_tick(self, tick: Tick) -> None:
        """Note which chasers a tick begins with."""
        if tick.revision == 0:
            self._first.append(tick)

    def add(self, lease: Lease) -> None:
        """Add a lease, unless a newer one of that chaser is known."""
        known = self.leases.get(lease.chaser)
        if known is not None and _age(lease) <= _age(known):
            return
        if (
            known is not None
            and lease.instance == known.instance
            and lease.until_tick > known.until_tick
        ):
            self._renewed[lease.chaser] = lease.tick
        self.leases[lease.chaser] = lease

    def add_lost(self, chaser: int, tick: int) -> None:
        """Note that the lease that a chaser states in a tick will not arrive."""
        self._lost[chaser] = max(tick, self._lost.get(chaser, -1))

    def missing(self, tick: Tick) -> list[int]:
        """Return the chasers whose lease of a tick has neither arrived nor is lost."""
        return list(self._missing(tick))

    def is_complete(self, tick: Tick) -> bool:
        """Test whether no lease of a tick is missing."""
        return next(self._missing(tick), None) is None

    def _missing(self, tick: Tick) -> Iterator[int]:
        leases, lost, newest = self.leases, self._lost, (tick.tick, tick.revision)
        return (
            i
            for i in tick.chasers
            if ((lease := leases.get(i)) is None or (lease.tick, lease.revision) < newest)
            and lost.get(i, -1) < tick.tick
        )

    def _granted(self, name: str, tick: Tick) -> list[Lease]:
        """Return the leases of a tick that a controller holds."""
        instance, begin = tick.controllers.get(name, ""), tick.since.get(name, 0)
        granted = []
        for i in tick.chasers:
            lease = self.leases.get(i)
            if lease is None or (lease.holder, lease.instance) != (name, instance):
                continue
            void = lease.tick < max(begin, tick.since.get(f"chaser/{i}", 0))
            if (name, instance) == (self.name, self.instance):
                void |= lease.tick <= self._given_back.get(i, -1)
            if not void and (lease.from_tick, lease.from_revision) <= (tick.tick, tick.revision):
                granted += [lease] if lease.until_tick >= tick.tick else []
        return granted

    def _with_lost_chasers(self, tick: Tick) -> Tick:
        """Return a tick with the chasers that it began with, which also count if they are lost.

        With one controller only, lost chasers do not count. If the tick's first revision is not
        known, it has no chasers, and so no majority.
        """
        if tick.revision == 0 or len(tick.controllers) < 2:
            return tick
        first = next((t for t in self._first if t.tick == tick.tick), None)
        changes: dict[str, Any] = (
            {"chasers": ()} if first is None else {"chasers": first.chasers, "since": first.since}
        )
        return msgspec.structs.replace(tick, **changes)

    def commander_of(self, tick: Tick) -> Commander | None:
        """Return who commands a tick by the leases known, None if no controller does."""
        tick = self._with_lost_chasers(tick)
        for name, instance in tick.controllers.items():
            granted = self._granted(name, tick)
            if is_majority({lease.chaser for lease in granted}, tick.chasers):
                return Commander(name, instance, max(lease.term for lease in granted))
        return None

    def claim(self, tick: Tick) -> bool:
        """Return whether this controller commands a tick, and update ``term``, the number to
        command with.

        After a new grant, and after the other controller has commanded, the term becomes no smaller
        than any that chasers have stated up to that tick: the newest commander has the highest.
        Otherwise it stays: the other controller may hold a higher term in a minority, or in later
        ticks, whose leases a controller that was frozen may have read before it finishes its own.
        """
        found = self.commander_of(tick)
        if found is None:
            return False
        if (found.name, found.instance) != (self.name, self.instance):
            self._ceded = max(self._ceded, tick.tick)
            return False
        # Chasers that were cut off may hold older grants than those with which the other has
        # commanded meanwhile.
        regained = self._claimed < self._ceded < tick.tick
        self._claimed = max(self._claimed, tick.tick)
        if found.term > self.term or regained:
            stated = [lease.term for lease in self.leases.values() if lease.tick <= tick.tick]
            self.term = next_term(max([self.term, found.term, *stated]) - 1, self.name)
        return True

    def _is_commanded_since(self, since: int, tick: Tick) -> bool:
        """Return whether another controller holds a majority at ``tick`` and commands those
        chasers.

        Each of them must have executed a command of it in tick ``since`` or later.
        """
        granted = [
            lease
            for name in tick.controllers
            if name != self.name
            for lease in self._granted(name, tick)
        ]
        return is_majority(
            {x.chaser for x in granted if self._renewed.get(x.chaser, -1) >= since}, tick.chasers
        )

    def take_idle(self, tick: Tick) -> dict[int, tuple[int, bool]]:
        """Return the chasers that may wait for this controller in a tick that it does not command.

        These are the chasers whose lease it holds, and those whose lease of this tick was lost. The
        value is the term, and whether the controller gives the lease back now.
        """
        held = {lease.chaser: lease.term for lease in self._granted(self.name, tick)}
        self._idle_since = {i: self._idle_since.get(i, tick.tick) for i in held}
        idle = {i: (self.term, False) for i in tick.chasers if self._lost.get(i) == tick.tick}
        for i, term in held.items():
            since = self._idle_since[i]
            gives_back = tick.tick - since >= PATIENCE_TICKS or (
                tick.tick > since and self._is_commanded_since(since, tick)
            )
            if gives_back:
                self._given_back[i] = tick.tick
            idle[i] = (term, gives_back)
        return idle


def _age(lease: Lease) -> tuple[int, int, int, int]:
    return lease.tick, lease.revision, lease.term, lease.until_tick
