# SPDX-License-Identifier: Apache-2.0
"""Rules of the protocol, checked on all messages of one process."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from chaserdock_agents.chaser.command_gate import refusal
from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.lease_holder import LeaseHolder
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Farewell,
    Lease,
    Message,
    Presence,
    WrenchCommand,
)
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.topics import Role, Topic
from chaserdock_protocol.transport import RawSample

from .ticks import RecordedTick, role_of

# Messages stamped with the time of the plan's first state instead of the tick's.
_OWN_TIME = (topics.PLAN,)


@dataclass
class Finding:
    """One kind of protocol violation: where, what, first tick, number of occurrences."""

    where: str
    what: str
    detail: str
    tick: int
    times: int = 1

    def line(self) -> str:
        """Format as one line."""
        when = f"at tick {self.tick}" if self.tick >= 0 else "before the first tick"
        often = f"{self.times} times, first " if self.times > 1 else ""
        return (
            f"{self.where}: {self.what}{f': {self.detail}' if self.detail else ''} ({often}{when})"
        )


def duties_of(
    role: Role, chaser: int | None, turn: RecordedTick, thrusters: bool
) -> dict[str, Topic]:
    """Return the answers that a process owes to a tick, by key."""
    tick = turn.tick
    if role == "controller":
        wrenches = {topics.WRENCH.key_of(i): topics.WRENCH for i in tick.chasers}
        return {
            **wrenches,
            topics.TARGET.key_of(): topics.TARGET,
            topics.SOLVER.key_of(): topics.SOLVER,
        }
    own = [
        topics.LEASE,
        topics.ACTUATORS,
        *([topics.SIGHTING] if tick.images else []),
        *([topics.THRUSTERS] if thrusters else []),
    ]
    return {topic.key_of(chaser): topic for topic in own}


@dataclass
class Ledger:
    """Records messages and violations of the process under test. ``instance``: as in its join
    request.
    """

    process: str
    scenario: Scenario
    instance: str | None = None
    findings: dict[tuple[str, str], Finding] = field(default_factory=dict)
    heard: dict[str, str] = field(default_factory=dict)
    present: bool = False
    farewell: Farewell | None = None
    counts: Counter[str] = field(default_factory=Counter)
    _tick: int = -1
    _turn: RecordedTick | None = None
    _duties: dict[str, Topic] = field(default_factory=dict)
    _came: set[str] = field(default_factory=set)
    _next: dict[str, int] = field(default_factory=dict)
    _unheard: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.role: Role
        self.role, self.chaser = role_of(self.process, len(self.scenario.chasers))

    @property
    def messages(self) -> int:
        """Number of published messages."""
        return sum(self.counts.values())

    def report(self, where: str, what: str, detail: str = "") -> None:
        """Record a violation; violations of one kind are counted."""
        known = self.findings.get((where, what))
        if known is None:
            self.findings[where, what] = Finding(where, what, detail, self._tick)
        else:
            known.times += 1

    def open(self, turn: RecordedTick) -> None:
        """Start a tick, whose answers become due."""
        self._tick, self._turn = turn.tick.tick, turn
        self._duties = duties_of(
            self.role, self.chaser, turn, self.scenario.chaser.actuation == "thrusters"
        )
        self._came = set()

    def due(self, *excluded: Topic) -> list[str]:
        """Return the keys without an answer to the present tick, except those of ``excluded``
        topics.
        """
        return [
            key
            for key, topic in self._duties.items()
            if key not in self._came and topic not in excluded
        ]

    def add(self, raw: RawSample) -> None:
        """Check a message of the process."""
        self.counts[raw.key] += 1
        if self.instance is None:
            self.report(raw.key, "published before it joined")
        if self.farewell is not None:
            self.report(raw.key, "published after its farewell")
        topic = self._own_topic(raw.key)
        if topic is None:
            return
        # An invalid answer counts as the answer, too: no other one will follow.
        if raw.key in self._came:
            self.report(raw.key, "a second answer to one tick")
        if raw.key in self._duties:
            self._came.add(raw.key)
        try:
            message: Any = codec.decode(topic.kind, raw.payload, raw.encoding)
        except Rejected as rejected:
            self.report(raw.key, WORDS.get(rejected.reason, rejected.reason), rejected.detail)
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
            self.report(key, "a key that is not part of the protocol")
            return None
        topic, place = found
        own = topics.may_write(self.role, topic)
        if "{process}" in topic.key:
            own = own and place == self.process
        elif place is not None:
            mine = range(len(self.scenario.chasers)) if self.chaser is None else (self.chaser,)
            own = own and int(place) in mine
        if not own:
            self.report(key, f"a key that {self.process} must not write")
            return None
        return topic

    def _number(self, key: str, message: Message, from_zero: bool) -> None:
        # Messages before discovery may be lost; presence is repeated for that reason.
        if key not in self._next and not from_zero:
            self._unheard[key] = message.seq
        due = self._next.get(key, self._unheard.get(key, 0))
        if message.seq != due:
            self.report(
                key, "seq does not count from 0 without gaps", f"{message.seq} instead of {due}"
            )
        self._next[key] = message.seq + 1

    def _presence(self, key: str, message: Presence) -> None:
        if message.process != self.process:
            self.report(key, "publishes another process' presence", repr(message.process))
        if self.instance is not None and message.instance != self.instance:
            self.report(
                key,
                "another instance than it joined as",
                f"{message.instance!r}, not {self.instance!r}",
            )
        self.present, self.heard = True, dict(message.heard)

    def _farewell(self, key: str, message: Farewell) -> None:
        self.farewell = message
        if message.process != self.process:
            self.report(key, "another process' farewell", repr(message.process))

    def _answer(self, key: str, topic: Topic, message: Any) -> None:
        turn, timing = self._turn, self.scenario.timing
        if turn is None:
            self.report(key, "answered before the first tick", f"tick {message.tick}")
            return
        if message.tick != turn.tick.tick and (
            key in self._duties or message.tick > turn.tick.tick
        ):
            self.report(
                key, "another tick than the open one", f"{message.tick}, not {turn.tick.tick}"
            )
            return
        place = getattr(message, "chaser", None)
        if place is not None and topic.key_of(place) != key:
            self.report(key, "chaser differs from the key's", str(place))
        time_ns = timing.tick_time_ns(message.tick)
        if topic is topics.SIGHTING and turn.exposure_ns is not None:
            time_ns = turn.exposure_ns
        if topic not in _OWN_TIME and message.sim_time_ns != time_ns:
            self.report(key, "wrong sim_time_ns", f"{message.sim_time_ns}, not {time_ns}")
        due_ns = timing.effective_ns(message.tick)
        if (
            isinstance(message, WrenchCommand | ActuatorCommand)
            and message.effective_time_ns != due_ns
        ):
            self.report(
                key, "wrong effective_time_ns", f"{message.effective_time_ns}, not {due_ns}"
            )
        if isinstance(message, WrenchCommand):
            self._check_authority(key, message, turn)
            body, before = self.scenario.chaser, message.tick - 1
            reason = refusal(message, message.chaser, body, before, time_ns, due_ns)
            if reason is not None:
                self.report(key, "a command that the chaser rejects", reason)

    def _check_authority(self, key: str, message: WrenchCommand, turn: RecordedTick) -> None:
        """Check that a command names its sender, and the term that the leases of the tick give."""
        leases = LeaseHolder(self.process, turn.tick.controllers.get(self.process, ""))
        for raw in turn.answers:
            found = topics.topic_of_key(raw.key)
            if found is not None and found[0] is topics.LEASE:
                leases.add(codec.decode(Lease, raw.payload))
        if not leases.claim(turn.tick):
            self.report(key, "commands a tick without a majority of leases")
        actual = (message.term, message.commander, message.instance)
        expected = (leases.term, leases.name, leases.instance)
        if actual != expected:
            detail = f"{actual}, not {expected}"
            self.report(key, "not the term of its leases, its name and its instance", detail)

    def miss(self, patience_s: float) -> None:
        """Report the answers that are missing in the present tick."""
        for key in self.due():
            self.report(key, f"no answer within {patience_s:g} s")

    def finish(self) -> None:
        """Check the farewell after the end of the process."""
        if self.farewell is None:
            self.report(topics.FAREWELL.key_of(self.process), "no farewell")
            return
        announced = {key: n for key, n in self.farewell.published.items() if n}
        counted = self.counts + self._unheard
        own = topics.FAREWELL.key_of(self.process)
        announced.pop(own, None)  # the farewell may or may not count itself
        counted.pop(own, None)
        for key in sorted(announced.keys() | counted.keys()):
            if announced.get(key, 0) != counted.get(key, 0):
                detail = f"{key} {announced.get(key, 0)}, but {counted.get(key, 0)} arrived"
                self.report(own, "wrong number of published messages", detail)


WORDS = {
    "encoding": "wrong encoding",
    "size": "too long",
    "format": "not of the message's type",
    "not_finite": "a number that is not finite",
    "not_unit_quaternion": "a quaternion that is not of unit length",
}
"""What is wrong with a message, by the reason for which it is rejected."""
