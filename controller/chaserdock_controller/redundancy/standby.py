"""A controller in another's shadow: what it waits for, what it holds back, and when the command is its own. No I/O.

In lock-step it works a tick out once it has the same inputs and the commander's word on it, tick by tick, so that both
know the same after each. In real time it does not wait. Who joins late, or has missed ticks, does nothing in lock-step
until the commander's state has come.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from chaserdock_protocol.messages import OperatorCommand, Tick
from chaserdock_protocol.topics import CONTROLLERS
from chaserdock_protocol.transport import ReceivedMessage

_MISSABLE_TICKS = 10
"""In real time so many ticks may be missed without asking for the commander's state."""
_MOST_HELD = 100_000


@dataclass
class HotStandby:
    """``commands``: the newest tick gives the command to this process; ``since``: from which tick on."""

    name: str
    realtime: bool = False
    replaying: bool = False
    instance: str = ""
    commands: bool = False
    since: int = -1
    newest: Tick | None = None
    words: dict[int, tuple[OperatorCommand, ...]] = field(default_factory=dict)
    _held: deque[ReceivedMessage] = field(default_factory=lambda: deque(maxlen=_MOST_HELD))
    _synced: bool = True
    _free: bool = False

    def _is_mine(self, tick: Tick) -> bool:
        if self.replaying:
            return True
        if tick.commander:
            return (tick.commander, tick.instance) == (self.name, self.instance)
        return tick.term == 0 and self.name == CONTROLLERS[0]

    def note(self, tick: Tick) -> list[str]:
        """Takes a tick as soon as it comes, before all that is held back; what is to be told of it."""
        before = self.newest
        if before is not None and (tick.tick, tick.revision) < (before.tick, before.revision):
            return []
        self.newest, had_it = tick, self.commands
        self.commands = self._is_mine(tick)
        if self.commands and not had_it:
            self.since = tick.tick
        missed = tick.tick - (before.tick if before is not None else -1) - 1
        if self.replaying or (had_it and self.commands):
            return []
        if missed > (_MISSABLE_TICKS if self.realtime else 0):
            self._synced = False
        if self._synced or not self.commands:
            return []
        # Better a controller that begins anew than none.
        self._synced = self._free = True
        self._keep(lambda held_tick: held_tick >= tick.tick)
        return ["begins anew: it knows nothing of the flight so far"]

    def _keep(self, wanted: Callable[[int], bool]) -> None:
        kept = [r for r in self._held if wanted(r.message.tick)]
        self._held.clear()
        self._held.extend(kept)

    def commands_at(self, tick: int) -> bool:
        """Whether the answer to a tick is this one's to publish."""
        return self.commands and tick >= self.since

    def holds_back(self, received: ReceivedMessage, done_tick: int) -> bool:
        """Whether a message is to wait, which it then does: it belongs to a tick after the next one to be worked out."""
        if self.realtime or self.replaying or received.message.tick < 0:
            return False
        if self._synced and ((self.commands and not self._held) or received.message.tick <= done_tick + 1):
            return False
        self._held.append(received)
        return True

    def due(self, done_tick: int) -> ReceivedMessage | None:
        """A message that was held back and may be taken now."""
        if not self._synced:
            return None
        for k, held in enumerate(self._held):
            if self._free or held.message.tick <= done_tick + 1:
                del self._held[k]
                return held
        self._free &= bool(self._held)
        return None

    def follows(self) -> bool:
        """Whether it may work ticks out."""
        return self._synced or self.realtime

    def idle(self, open_tick: int) -> bool:
        """Nothing has come for a while: whether the open tick is to be worked out with what is here.

        The flight has gone on, so nothing more will come for it. Who only follows has lost track, and waits for the
        commander's state instead.
        """
        if self.newest is None or self.newest.tick <= open_tick:
            return False
        if not self.commands:
            self._synced = False
        return self.commands

    def has_word(self, tick: int) -> bool:
        """Whether nobody else's word on a tick is to be waited for."""
        if self.realtime or self.replaying or self.commands or self.newest is None:
            return True
        return tick in self.words or not self.newest.commander

    def operated(self, tick: int) -> tuple[OperatorCommand, ...]:
        """What operators asked of the commander in a tick; in real time, since the last call."""
        said = [w for t, w in sorted(self.words.items()) if t == tick or self.realtime]
        self.words = {t: w for t, w in self.words.items() if t > tick and not self.realtime}
        return tuple(command for word in said for command in word)

    def wants_state(self, tick: int, done_tick: int) -> bool:
        """Whether the commander's state after a tick is of use."""
        return not self.commands and not self._synced and (self.realtime or tick >= done_tick)

    def caught_up(self, tick: int) -> None:
        """The commander's state after a tick has been taken over."""
        self._synced = True
        self._keep(lambda held_tick: held_tick > tick)
