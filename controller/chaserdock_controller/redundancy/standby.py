# SPDX-License-Identifier: Apache-2.0
"""Leader and hot standby of the controller: what to wait for, what to hold back, when to publish.
No I/O.

In lock-step a standby processes a tick once it has the same inputs and the leader's operator
commands of that tick. Both then have the same state after each tick. In real time it does not wait.
A standby that joins late or has missed ticks first restores the leader's state.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from chaserdock_protocol.lease_holder import Commander, LeaseHolder
from chaserdock_protocol.messages import (
    CommandedWrench,
    ControllerState,
    OperatorCommand,
    Tick,
)
from chaserdock_protocol.transport import ReceivedMessage

_MISSABLE_TICKS = 10
"""In real time, number of ticks that a standby may miss and keep its state."""
_MOST_HELD = 100_000
"""Messages that are held until the process knows its role; bounds its memory. Older ones are
dropped.
"""


@dataclass
class HotStandby:
    """Role of this process.

    ``leads``: it commands the newest tick; ``since``: first such tick. ``leader``: who commands the
    newest tick, None if no controller does. ``replayed``: in a replay, where this process commands
    every tick, the commander in the log.
    """

    name: str
    realtime: bool = False
    replaying: bool = False
    instance: str = ""
    leads: bool = False
    since: int = -1
    newest: Tick | None = None
    leader: Commander | None = None
    replayed: Commander | None = None
    leader_commands: dict[int, tuple[OperatorCommand, ...]] = field(default_factory=dict)
    commanded: dict[int, tuple[CommandedWrench, ...]] = field(default_factory=dict)
    _held: deque[ReceivedMessage] = field(default_factory=lambda: deque(maxlen=_MOST_HELD))
    _synced: bool = True
    _missed: bool = False
    _release_all: bool = False
    _state_sent_to: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.leases = LeaseHolder(self.name)

    def join(self, instance: str) -> None:
        """Set the instance of this process."""
        self.instance = self.leases.instance = instance

    def update(self, tick: Tick) -> None:
        """Process a new tick, before held messages."""
        self.leases.add_tick(tick)
        before = self.newest
        if before is not None and (tick.tick, tick.revision) < (before.tick, before.revision):
            return
        self.newest = tick
        missed = tick.tick - (before.tick if before is not None else -1) - 1
        self._missed |= missed > (_MISSABLE_TICKS if self.realtime else 0)
        if self.replaying:
            self.leads, self.leader = True, self.replayed

    def is_decided(self, tick: Tick) -> bool:
        """Return whether it is known who commands a tick. In lock-step it is once each chaser has
        stated its lease.
        """
        newest = self.newest
        if self.realtime or self.replaying or newest is None or newest.tick > tick.tick:
            return True
        return self.leases.is_complete(newest)

    def decide(self, processed: Tick | None = None) -> bool:
        """Determine who commands the newest tick. Returns whether this process starts to command
        without any state.

        In real time the leases of a tick may still be on their way. A commander therefore continues
        until it processes a tick (``processed``) that it does not command, or until another one
        commands.
        """
        tick = processed or self.newest
        if tick is None or self.replaying or not self.is_decided(tick):
            return False
        self.leader = self.leases.commander_of(tick)
        leads = self.leases.claim(tick)
        if self.realtime and processed is None and self.leader is None:
            leads = self.leads
        led, self.leads = self.leads, leads
        if leads and not led:
            self.since = tick.tick
        if self._missed and not (led and leads):
            self._synced = False
        self._missed = False
        if self._synced or not leads:
            return False
        # A controller without state is better than none.
        self._synced = self._release_all = True
        self._keep(lambda held_tick: held_tick >= tick.tick)
        return True

    @property
    def authority(self) -> Commander:
        """Return name, instance and term that this process' commands carry."""
        return self.replayed or Commander(self.name, self.instance, self.leases.term)

    @property
    def others(self) -> dict[str, str]:
        """Return the other controllers that take part in the newest tick, with their instances."""
        controllers = {} if self.newest is None or self.replaying else self.newest.controllers
        return {n: i for n, i in controllers.items() if (n, i) != (self.name, self.instance)}

    def _keep(self, predicate: Callable[[int], bool]) -> None:
        kept = [r for r in self._held if predicate(r.message.tick)]
        self._held.clear()
        self._held.extend(kept)

    def leads_at(self, tick: int) -> bool:
        """Return whether this process publishes the outputs of a tick."""
        return self.leads and tick >= self.since

    def hold_back(self, received: ReceivedMessage, done_tick: int) -> bool:
        """Hold back a message of a tick after the next one to process. Returns whether it was
        held.
        """
        if self.realtime or self.replaying or received.message.tick < 0:
            return False
        if self._synced and (
            (self.leads and not self._held) or received.message.tick <= done_tick + 1
        ):
            return False
        self._held.append(received)
        return True

    def release(self, done_tick: int) -> ReceivedMessage | None:
        """Return the next held message that may be processed now, or None."""
        if not self._synced:
            return None
        for k, held in enumerate(self._held):
            if self._release_all or held.message.tick <= done_tick + 1:
                del self._held[k]
                return held
        self._release_all &= bool(self._held)
        return None

    def may_process(self) -> bool:
        """Return whether the state is complete enough to process ticks."""
        return self._synced or self.realtime

    def on_idle(self, open_tick: int) -> bool:
        """Return whether to process the open tick although no more messages arrive: the world has
        published a later one.

        A standby has then missed its messages and waits for the leader's state instead.
        """
        if self.newest is None or self.newest.tick <= open_tick:
            return False
        if not self.leads:
            self._synced = False
        return self.leads

    def is_deposed(self, state: ControllerState) -> bool:
        """Return whether the sender of a state message has lost the command without knowing it yet;
        only in real time.

        A term above all known ones belongs to a commander whose leases are still on their way. In
        lock-step a standby uses messages of its own tick only.
        """
        leader = self.leader
        if not self.realtime:
            return False
        if leader is not None and (leader.name, leader.instance) == (state.process, state.instance):
            return False
        return state.term <= max(self.leases.term, 0 if leader is None else leader.term)

    def add_leader_commands(self, state: ControllerState) -> None:
        """Store the operator commands that the leader has processed in a tick, and its wrenches."""
        self.leader_commands[state.tick] = state.operated
        if state.commanded:
            self.commanded[state.tick] = state.commanded

    def has_leader_commands(self, tick: int) -> bool:
        """Return whether the operator commands of a tick are known or need not be waited for."""
        if self.realtime or self.replaying or self.leads or self.newest is None:
            return True
        return tick in self.leader_commands or self.leader is None

    def take_leader_commands(self, tick: int) -> tuple[OperatorCommand, ...]:
        """Return the operator commands of a tick that another leader has accepted; in real time
        those since the last call.
        """
        commands = [
            c for t, c in sorted(self.leader_commands.items()) if t == tick or self.realtime
        ]
        self.leader_commands = {
            t: c for t, c in self.leader_commands.items() if t > tick and not self.realtime
        }
        return tuple(command for group in commands for command in group)

    def take_commanded(self, done_tick: int) -> dict[int, tuple[CommandedWrench, ...]]:
        """Return, by tick, the wrenches of another leader up to a tick that this process has
        processed, and forget them.
        """
        done = {t: wrenches for t, wrenches in sorted(self.commanded.items()) if t <= done_tick}
        for tick in done:
            del self.commanded[tick]
        return done

    def needs_state(self, tick: int, done_tick: int) -> bool:
        """Return whether to restore the leader's state after a tick."""
        return not self.leads and not self._synced and (self.realtime or tick >= done_tick)

    def state_restored(self, tick: int) -> None:
        """Record that the leader's state after a tick was restored."""
        self._synced = True
        self._keep(lambda held_tick: held_tick > tick)

    def should_send_state(self, periodic: bool) -> bool:
        """Return whether to send this leader's state: periodically, and to every new standby."""
        others = self.others
        if not others or not (periodic or others != self._state_sent_to):
            return False
        self._state_sent_to = others
        return True
