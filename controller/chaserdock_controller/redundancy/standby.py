# SPDX-License-Identifier: Apache-2.0
"""Leader and hot standby of the controller: what to wait for, what to hold back, when to publish. No I/O.

In lock-step a standby processes a tick once it has the same inputs and the leader's operator commands of that tick, so that
both have the same state after each tick. In real time it does not wait. A standby that joins late or has missed ticks
restores the leader's state first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from chaserdock_protocol.messages import ControllerState, OperatorCommand, Tick
from chaserdock_protocol.topics import CONTROLLERS
from chaserdock_protocol.transport import ReceivedMessage

_MISSABLE_TICKS = 10
"""In real time a standby may miss this many ticks and keep its state."""
_MOST_HELD = 100_000


@dataclass
class HotStandby:
    """Role of this process. ``leads``: the newest tick names it as the leader; ``since``: from which tick on."""

    name: str
    realtime: bool = False
    replaying: bool = False
    instance: str = ""
    leads: bool = False
    since: int = -1
    newest: Tick | None = None
    leader_commands: dict[int, tuple[OperatorCommand, ...]] = field(default_factory=dict)
    _held: deque[ReceivedMessage] = field(default_factory=lambda: deque(maxlen=_MOST_HELD))
    _synced: bool = True
    _release_all: bool = False
    _state_sent_to: dict[str, str] = field(default_factory=dict)

    def _is_leader(self, tick: Tick) -> bool:
        if self.replaying:
            return True
        if tick.commander:
            return (tick.commander, tick.instance) == (self.name, self.instance)
        return tick.term == 0 and self.name == CONTROLLERS[0]

    def update(self, tick: Tick) -> bool:
        """Take the leader from a new tick, before held messages; return whether this process leads without any state."""
        before = self.newest
        if before is not None and (tick.tick, tick.revision) < (before.tick, before.revision):
            return False
        self.newest, led = tick, self.leads
        self.leads = self._is_leader(tick)
        if self.leads and not led:
            self.since = tick.tick
        missed = tick.tick - (before.tick if before is not None else -1) - 1
        if self.replaying or (led and self.leads):
            return False
        if missed > (_MISSABLE_TICKS if self.realtime else 0):
            self._synced = False
        if self._synced or not self.leads:
            return False
        # A controller without state is better than none.
        self._synced = self._release_all = True
        self._keep(lambda held_tick: held_tick >= tick.tick)
        return True

    def _keep(self, predicate: Callable[[int], bool]) -> None:
        kept = [r for r in self._held if predicate(r.message.tick)]
        self._held.clear()
        self._held.extend(kept)

    def leads_at(self, tick: int) -> bool:
        """Return whether this process publishes the outputs of a tick."""
        return self.leads and tick >= self.since

    def hold_back(self, received: ReceivedMessage, done_tick: int) -> bool:
        """Hold back a message of a tick after the next one to process; return whether it was held back."""
        if self.realtime or self.replaying or received.message.tick < 0:
            return False
        if self._synced and ((self.leads and not self._held) or received.message.tick <= done_tick + 1):
            return False
        self._held.append(received)
        return True

    def release(self, done_tick: int) -> ReceivedMessage | None:
        """Return the next held message that may be processed now."""
        if not self._synced:
            return None
        for k, held in enumerate(self._held):
            if self._release_all or held.message.tick <= done_tick + 1:
                del self._held[k]
                return held
        self._release_all &= bool(self._held)
        return None

    def may_process(self) -> bool:
        """Return whether the state is good enough to process ticks."""
        return self._synced or self.realtime

    def on_idle(self, open_tick: int) -> bool:
        """Return whether to process the open tick although no more messages arrive.

        The world has published a later tick. A standby has lost track then, and waits for the leader's state instead.
        """
        if self.newest is None or self.newest.tick <= open_tick:
            return False
        if not self.leads:
            self._synced = False
        return self.leads

    def add_leader_commands(self, state: ControllerState) -> None:
        """Add the operator commands that the leader has processed in a tick."""
        self.leader_commands[state.tick] = state.operated

    def has_leader_commands(self, tick: int) -> bool:
        """Return whether the operator commands of a tick are known, or need not be waited for."""
        if self.realtime or self.replaying or self.leads or self.newest is None:
            return True
        return tick in self.leader_commands or not self.newest.commander

    def take_leader_commands(self, tick: int) -> tuple[OperatorCommand, ...]:
        """Return the leader's operator commands of a tick; in real time, since the last call."""
        commands = [c for t, c in sorted(self.leader_commands.items()) if t == tick or self.realtime]
        self.leader_commands = {
            t: c for t, c in self.leader_commands.items() if t > tick and not self.realtime
        }
        return tuple(command for group in commands for command in group)

    def needs_state(self, tick: int, done_tick: int) -> bool:
        """Return whether to restore the leader's state after a tick."""
        return not self.leads and not self._synced and (self.realtime or tick >= done_tick)

    def state_restored(self, tick: int) -> None:
        """Note that the leader's state after a tick was restored."""
        self._synced = True
        self._keep(lambda held_tick: held_tick > tick)

    def should_send_state(self, periodic: bool) -> bool:
        """Return whether to send this leader's state: periodically, and to every new standby."""
        newest = self.newest
        if newest is None or not newest.standing_by or self.replaying:
            new, standing_by = False, False
        else:
            new, standing_by = newest.standing_by != self._state_sent_to, True
        if not standing_by or not (new or periodic):
            return False
        assert newest is not None
        self._state_sent_to = dict(newest.standing_by)
        return True
