"""The protocol's rules, held against all that one process says. No network here."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from chaserdock_agents.chaser.command_gate import refusal
from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import ActuatorCommand, Farewell, Message, Presence, WrenchCommand
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.topics import Role, Topic
from chaserdock_protocol.transport import RawSample

from .ticks import Turn, role_of

# Their time is that of the plan's first state, not of the tick.
_OWN_TIME = (topics.PLAN,)


@dataclass
class Finding:
    """One way in which the protocol is broken: where, what, at which tick first, how often."""

    where: str
    what: str
    detail: str
    tick: int
    times: int = 1

    def line(self) -> str:
        """For people."""
        when = f"at tick {self.tick}" if self.tick >= 0 else "before the first tick"
        often = f"{self.times} times, first " if self.times > 1 else ""
        return f"{self.where}: {self.what}{f': {self.detail}' if self.detail else ''} ({often}{when})"


def duties_of(role: Role, chaser: int | None, turn: Turn, thrusters: bool) -> dict[str, Topic]:
    """The answers that a tick must get from a process, by key: what world, controller and recorder wait for."""
    tick = turn.tick
    if role == "controller":
        wrenches = {topics.WRENCH.key_of(i): topics.WRENCH for i in tick.chasers}
        return {**wrenches, topics.TARGET.key_of(): topics.TARGET, topics.SOLVER.key_of(): topics.SOLVER}
    own = [
        topics.ACTUATORS,
        *([topics.SIGHTING] if tick.images else []),
        *([topics.THRUSTERS] if thrusters else []),
    ]
    return {topic.key_of(chaser): topic for topic in own}


@dataclass
class Ledger:
    """What the checked process has said so far, and what was wrong with it. ``instance``: as it joined."""

    process: str
    scenario: Scenario
    instance: str | None = None
    findings: dict[tuple[str, str], Finding] = field(default_factory=dict)
    heard: dict[str, str] = field(default_factory=dict)
    present: bool = False
    farewell: Farewell | None = None
    counts: Counter[str] = field(default_factory=Counter)
    _tick: int = -1
    _turn: Turn | None = None
    _duties: dict[str, Topic] = field(default_factory=dict)
    _came: set[str] = field(default_factory=set)
    _next: dict[str, int] = field(default_factory=dict)
    _unheard: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.role: Role
        self.role, self.chaser = role_of(self.process, len(self.scenario.chasers))

    @property
    def messages(self) -> int:
        """Messages that it has published."""
        return sum(self.counts.values())

    def find(self, where: str, what: str, detail: str = "") -> None:
        """Notes a breach; one of a kind is kept, and counted."""
        known = self.findings.get((where, what))
        if known is None:
            self.findings[where, what] = Finding(where, what, detail, self._tick)
        else:
            known.times += 1

    def open(self, turn: Turn) -> None:
        """A tick begins: its answers are due."""
        self._tick, self._turn = turn.tick.tick, turn
        self._duties = duties_of(self.role, self.chaser, turn, self.scenario.chaser.actuation == "thrusters")
        self._came = set()

    def due(self, *but: Topic) -> list[str]:
        """Keys that the open tick still needs an answer on, ``but`` those of some topics."""
        return [key for key, topic in self._duties.items() if key not in self._came and topic not in but]

    def take(self, raw: RawSample) -> None:
        """A message of the process, as it came."""
        self.counts[raw.key] += 1
        if self.instance is None:
            self.find(raw.key, "published before it joined")
        if self.farewell is not None:
            self.find(raw.key, "published after its farewell")
        topic = self._own_topic(raw.key)
        if topic is None:
            return
        # Even an answer that cannot be used is one: its sender has spoken, nothing more will come.
        if raw.key in self._came:
            self.find(raw.key, "a second answer to one tick")
        if raw.key in self._duties:
            self._came.add(raw.key)
        try:
            message: Any = codec.decode(topic.kind, raw.payload, raw.encoding)
        except Rejected as refused:
            self.find(raw.key, _WORDS.get(refused.reason, refused.reason), refused.detail)
            return
        self._number(raw.key, message, topic.rate in ("tick", "image"))
        match message:
            case Presence():
                self._presence(raw.key, message)
            case Farewell():
                self._farewell(raw.key, message)
            case _ if topic.rate in ("tick", "image"):
                self._answer(raw.key, topic, message)

    def _own_topic(self, key: str) -> Topic | None:
        found = topics.topic_of_key(key)
        if found is None:
            self.find(key, "a key that the protocol does not have")
            return None
        topic, place = found
        own = topics.may_write(self.role, topic)
        if "{process}" in topic.key:
            own = own and place == self.process
        elif place is not None:
            mine = range(len(self.scenario.chasers)) if self.chaser is None else (self.chaser,)
            own = own and int(place) in mine
        if not own:
            self.find(key, f"a key that {self.process} must not write")
            return None
        return topic

    def _number(self, key: str, message: Message, from_zero: bool) -> None:
        # What it tells before the declarations have reached it may go unheard: presence is there for that.
        if key not in self._next and not from_zero:
            self._unheard[key] = message.seq
        due = self._next.get(key, self._unheard.get(key, 0))
        if message.seq != due:
            self.find(key, "seq does not count from 0 without gaps", f"{message.seq} instead of {due}")
        self._next[key] = message.seq + 1

    def _presence(self, key: str, message: Presence) -> None:
        if message.process != self.process:
            self.find(key, "tells another process' presence", repr(message.process))
        if self.instance is not None and message.instance != self.instance:
            self.find(
                key, "another instance than it joined as", f"{message.instance!r}, not {self.instance!r}"
            )
        self.present, self.heard = True, dict(message.heard)

    def _farewell(self, key: str, message: Farewell) -> None:
        self.farewell = message
        if message.process != self.process:
            self.find(key, "another process' farewell", repr(message.process))

    def _answer(self, key: str, topic: Topic, message: Any) -> None:
        turn, timing = self._turn, self.scenario.timing
        if turn is None:
            self.find(key, "answered before the first tick", f"tick {message.tick}")
            return
        if message.tick != turn.tick.tick and (key in self._duties or message.tick > turn.tick.tick):
            self.find(key, "another tick than the open one", f"{message.tick}, not {turn.tick.tick}")
            return
        place = getattr(message, "chaser", None)
        if place is not None and topic.key_of(place) != key:
            self.find(key, "chaser is another one's than the key's", str(place))
        time_ns = timing.tick_time_ns(message.tick)
        if topic is topics.SIGHTING and turn.exposure_ns is not None:
            time_ns = turn.exposure_ns
        if topic not in _OWN_TIME and message.sim_time_ns != time_ns:
            self.find(key, "wrong sim_time_ns", f"{message.sim_time_ns}, not {time_ns}")
        if isinstance(message, WrenchCommand | ActuatorCommand):
            effective_ns = timing.effective_ns(message.tick)
            if message.effective_time_ns != effective_ns:
                self.find(key, "wrong effective_time_ns", f"{message.effective_time_ns}, not {effective_ns}")
        if isinstance(message, WrenchCommand):
            given, told = ((m.term, m.commander, m.instance) for m in (message, turn.tick))
            if given != told:
                self.find(key, "not the tick's term, commander and instance", f"{given}, not {told}")
            why = refusal(message, message.chaser, self.scenario.chaser, message.tick - 1, time_ns)
            if why is not None:
                self.find(key, "a command that the chaser refuses", why)

    def miss(self, patience_s: float) -> None:
        """The open tick's answers have not come in time."""
        for key in self.due():
            self.find(key, f"no answer within {patience_s:g} s")

    def finish(self) -> None:
        """It has ended: were its last words true?"""
        if self.farewell is None:
            self.find(topics.FAREWELL.key_of(self.process), "no farewell")
            return
        told = {key: n for key, n in self.farewell.published.items() if n}
        counted = self.counts + self._unheard
        own = topics.FAREWELL.key_of(self.process)
        told.pop(own, None)  # it may count itself, or not
        counted.pop(own, None)
        for key in sorted(told.keys() | counted.keys()):
            if told.get(key, 0) != counted.get(key, 0):
                detail = f"{key} {told.get(key, 0)}, but {counted.get(key, 0)} came"
                self.find(own, "published is not what was published", detail)


_WORDS = {
    "encoding": "wrong encoding",
    "size": "too long",
    "format": "not of the message's type",
    "not_finite": "a number that is not finite",
    "not_unit_quaternion": "a quaternion that is not of unit length",
}
