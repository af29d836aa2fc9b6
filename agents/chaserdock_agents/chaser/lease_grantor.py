# SPDX-License-Identifier: Apache-2.0
"""Grant a chaser's leases: to which controller, in which term, until which tick.

No I/O; ticks are the only clock. As in PaxosLease (M. Trencseni et al., 2012) the acceptors decide:
a chaser has promised each tick to at most one controller, and a controller commands a tick that a
majority has promised to it (``chaserdock_protocol.lease_holder``). Every executed command renews
the lease. When it has run out, or its holder is lost, the next controller gets it in a higher term.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from chaserdock_protocol.leases import commander_of, lease_ticks, longest_lease_ticks, next_term
from chaserdock_protocol.messages import Lease, Tick, WrenchCommand
from chaserdock_protocol.topics import CONTROLLERS

FIRST_COMMAND_S = 1.0
"""First lease of a new holder, s, which may need longer for its first command. Longer: a holder
that never commands keeps the chaser on its fallback for that time.
"""
BACKOFF_RESET_S = 20.0
"""A lease that runs out again within this time, s, is doubled, up to ``leases.LEASE_MAX_S``.
Repeated expiry means that the machine is overloaded, and a change of commander does not help.
"""


@dataclass
class LeaseGrantor:
    """Lease of chaser ``chaser``, granted to process ``holder`` and its ``instance`` until
    ``until_tick``.

    ``since``: tick and revision from which the holder has it.
    """

    chaser: int
    rate_hz: float
    holder: str = ""
    instance: str = ""
    term: int = 0
    until_tick: int = -1
    since: tuple[int, int] = (0, 0)
    _newest_tick: int = -1
    _length: int = 0
    _expired_tick: int | None = None
    _given_back: bool = False

    def __post_init__(self) -> None:
        self._length = lease_ticks(self.rate_hz)

    def update(self, tick: Tick) -> Lease | None:
        """Take the next tick: keep the lease or grant the next one.

        Return the lease to state; None if this chaser takes no part in the tick. A tick older than
        the last would give the lease to a controller that it lists; see
        ``ChaserInbox.is_outdated``.
        """
        if self.chaser not in tick.chasers:
            return None
        self._newest_tick = tick.tick
        listed = bool(self.holder) and tick.controllers.get(self.holder) == self.instance
        if not listed or self.until_tick < tick.tick:
            self._grant_next(tick, listed)
        return self.stated(tick)

    def _grant_next(self, tick: Tick, listed: bool) -> None:
        """Grant the lease to another controller; to the same again if there is no other."""
        others = [
            n for n in CONTROLLERS if n in tick.controllers and not (listed and n == self.holder)
        ]
        if others:
            if listed and not self._given_back:
                self._back_off(tick.tick)
            self.holder, self.instance = others[0], tick.controllers[others[0]]
            self.term = next_term(self.term, self.holder)
            self.since = (tick.tick, tick.revision)
            self.until_tick = (
                tick.tick + max(self._length, math.ceil(FIRST_COMMAND_S * self.rate_hz)) - 1
            )
        elif listed:
            self.until_tick = tick.tick + self._length - 1
        else:
            self.holder = self.instance = ""
            self.until_tick = tick.tick - 1
        self._given_back = False

    def _back_off(self, tick: int) -> None:
        before, self._expired_tick = self._expired_tick, tick
        shortest = lease_ticks(self.rate_hz)
        if before is not None and tick - before < BACKOFF_RESET_S * self.rate_hz:
            self._length = min(2 * self._length, longest_lease_ticks(self.rate_hz))
        else:
            self._length = shortest

    def stated(self, tick: Tick) -> Lease:
        """Return the lease as a message."""
        return Lease(
            tick=tick.tick,
            sim_time_ns=tick.sim_time_ns,
            revision=tick.revision,
            chaser=self.chaser,
            holder=self.holder,
            instance=self.instance,
            term=self.term,
            from_tick=self.since[0],
            from_revision=self.since[1],
            until_tick=self.until_tick,
        )

    def is_held_at(self, tick: Tick) -> bool:
        """Return whether a controller that takes part in a tick holds its lease."""
        return self.until_tick >= tick.tick and tick.controllers.get(self.holder) == self.instance

    def is_of_holder(self, command: WrenchCommand) -> bool:
        """Return whether the holder of the lease has sent a command."""
        return (command.commander, command.instance) == (self.holder, self.instance)

    def refusal(self, command: WrenchCommand) -> str | None:
        """Return why a command must not be executed because its sender does not hold the lease, or
        None.
        """
        if not self.is_of_holder(command):
            holder = self.holder or "no controller"
            return (
                f"stale term: {command.commander} {command.instance} sent it, {holder} holds term "
                f"{self.term}"
            )
        if command.term < self.term or commander_of(command.term) != self.holder:
            return f"stale term: sent in term {command.term}, the lease is of term {self.term}"
        return None

    def renew(self, command: WrenchCommand) -> None:
        """Renew the lease: its holder has commanded this chaser. See ``refusal`` first."""
        if (
            self._expired_tick is not None
            and command.tick - self._expired_tick > BACKOFF_RESET_S * self.rate_hz
        ):
            self._expired_tick, self._length = None, lease_ticks(self.rate_hz)
        self.term = command.term
        self.until_tick = max(self.until_tick, command.tick + self._length - 1)

    def give_back(self, command: WrenchCommand) -> None:
        """Take the lease back after a tick in which its holder yields it, for lack of a majority.

        See ``refusal`` first. The holder counts no lease stated up to that tick, but may count one
        that was stated after it.
        """
        if command.tick >= self._newest_tick:
            self.until_tick = min(self.until_tick, command.tick)
            self._given_back = True
