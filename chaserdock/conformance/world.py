# SPDX-License-Identifier: Apache-2.0
"""Test stand for a world: plays all chasers and the controller to it, and checks its messages."""

from __future__ import annotations

import queue
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec
from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Farewell,
    JoinReply,
    JoinRequest,
    Lease,
    Message,
    MissionEnd,
    Odometry,
    Presence,
    Tick,
    encoding_of,
)
from chaserdock_protocol.scenario import FlightScenario, ScenarioError, flight_scenario_from_json
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import Node, RawSample
from chaserdock_protocol.transport.bounded_queue import BoundedQueue
from chaserdock_protocol.transport.network import unique_id
from chaserdock_protocol.transport.session import EARLY_PERIOD_S

from .harness import SILENT_TICKS, Checked, hub, running
from .rules import WORDS, Finding

_WITHHELD_TICK, _WITHHELD_S = 3, 0.5
"""Tick in which one reply comes late, and by how much: a world in lock-step waits for it."""


def check_world(command: list[str], ticks: int, start_s: float, patience_s: float) -> Checked:
    """Run ``command`` as the world of a mission, for at most so many ticks.

    ``{endpoint}`` and ``{namespace}`` in the command are replaced. Wall-clock timeouts: ``start_s``
    to answer and to open the first tick, ``patience_s`` per tick. Raises TransportError and
    CheckError.
    """
    with hub("operator") as (node, filled):
        stand = WorldStand(node, patience_s)
        with running(filled(command)) as child:
            played = stand.fly(lambda: child.poll() is not None, ticks, start_s)
    return Checked(list(stand.findings.values()), played, sum(stand.counts.values()))


class WorldStand:
    """Plays the members of a mission to a world. Single-threaded, except for callbacks."""

    def __init__(self, node: Node, patience_s: float) -> None:
        self._node, self._patience_s = node, patience_s
        self._inbox: BoundedQueue[RawSample] = BoundedQueue()
        self._alive: set[str] = set()
        self._instances: dict[str, str] = {}
        self._numbers: Counter[str] = Counter()
        self._next: Counter[str] = Counter()
        self._presence_sent_s = 0.0
        self._silent = 0
        self.scenario: FlightScenario | None = None
        self.mission: JoinReply | None = None
        self.findings: dict[tuple[str, str], Finding] = {}
        self.counts: Counter[str] = Counter()
        self.tick: Tick | None = None
        self.heard_world: Presence | None = None
        self.end: MissionEnd | None = None
        self.farewell: Farewell | None = None
        self._came: dict[str, int] = {}
        node.subscribe_raw("world/**", self._arrived)
        node.watch_liveliness(
            lambda name, alive: (self._alive.add if alive else self._alive.discard)(name)
        )

    def report(self, where: str, what: str, detail: str = "") -> None:
        """Record a violation; violations of one kind are counted."""
        known = self.findings.get((where, what))
        if known is None:
            at = -1 if self.tick is None else self.tick.tick
            self.findings[where, what] = Finding(where, what, detail, at)
        else:
            known.times += 1

    def fly(self, ended: Callable[[], bool], ticks: int, start_s: float) -> int:
        """Run the whole check; return the number of ticks played."""
        if not self._join(ended, start_s):
            return 0
        for name in self._instances:
            self._node.declare_liveliness(name)
        if not self._wait(lambda: self.tick is not None, ended, start_s):
            self._report_no_tick(start_s)
            return 0
        played = 0
        while played < ticks and self.end is None:
            if not self._fly_tick(ended):
                return played
            played += 1
        if self.end is not None:
            self._wait(lambda: self.farewell is not None, ended, self._patience_s)
            self._check_farewell()
        return played

    # -- joining -----------------------------------------------------------------------------------

    def _join(self, ended: Callable[[], bool], start_s: float) -> bool:
        """Join as every process; return whether the world admits them all with a scenario."""
        begun = time.monotonic()
        while self.mission is None and time.monotonic() - begun < start_s and not ended():
            self.mission = self._ask("controller")
        if self.mission is None:
            self.report(topics.JOIN_KEY, f"no reply within {start_s:g} s, or an invalid one")
            return False
        try:
            self.scenario = flight_scenario_from_json(self.mission.scenario_json, "scenario_json")
        except ScenarioError as error:
            self.report(topics.JOIN_KEY, "scenario_json is no flight scenario", str(error))
            return False
        if not self.mission.source:
            self.report(topics.JOIN_KEY, "names no source: any session passes for the world")
        for i in range(len(self.scenario.chasers)):
            if self._ask(f"chaser/{i}") is None:
                self.report(topics.JOIN_KEY, f"does not admit chaser/{i}")
        return True

    def _ask(self, name: str) -> JoinReply | None:
        instance = self._instances.setdefault(name, unique_id())
        request = JoinRequest(process=name, instance=instance)
        reply = self._node.query(topics.JOIN_KEY, request, JoinReply, 0.5)
        return reply if reply is not None and reply.accepted else None

    def _report_no_tick(self, start_s: float) -> None:
        self.report(topics.TICK.key_of(), f"no tick within {start_s:g} s of joining")
        if "world" not in self._alive:
            self.report(topics.LIVE_KEY.format(process="world"), "no liveliness token")
        if self.heard_world is None:
            self.report(topics.PRESENCE.key_of("world"), "no presence published")
        elif missing := sorted(set(self._instances) - set(self.heard_world.heard)):
            self.report(
                topics.PRESENCE.key_of("world"), "has not heard its members", ", ".join(missing)
            )

    # -- ticks -------------------------------------------------------------------------------------

    def _fly_tick(self, ended: Callable[[], bool]) -> bool:
        """Check and answer the open tick, and wait for the next one; return whether it came."""
        tick, scenario = self.tick, self.scenario
        assert tick is not None
        assert scenario is not None
        self._check_tick(tick, scenario)
        due = [topics.ODOMETRY.key_of(i) for i in tick.chasers]
        due += [topics.IMAGE.key_of(i) for i in tick.chasers if tick.images]
        due += [
            topics.DOCKING.key_of(i)
            for i in tick.chasers
            if scenario.docking.port_of(i) is not None
        ]
        lockstep = self.mission is not None and self.mission.mode == "lockstep"
        if lockstep:
            complete = self._wait(
                lambda: all(self._came.get(key, -1) >= tick.tick for key in due),
                ended,
                self._patience_s,
            )
            for key in due if not complete else ():
                if self._came.get(key, -1) < tick.tick:
                    self.report(key, f"not published within {self._patience_s:g} s of its tick")
            self._silent = 0 if complete else self._silent + 1
            if self._silent == SILENT_TICKS:
                self.report("world", f"stopped after {SILENT_TICKS} incomplete ticks")
                return False
        withheld = lockstep and tick.tick == _WITHHELD_TICK
        if withheld and self._wait(lambda: self.tick is not tick, ended, _WITHHELD_S):
            self.report(topics.TICK.key_of(), "does not wait for all replies in lock-step")
            return True
        for i in tick.chasers:
            self._reply(i, tick, scenario)
        patience_s = self._patience_s
        if self._wait(lambda: self.tick is not tick or self.end is not None, ended, patience_s):
            return True
        self.report(topics.TICK.key_of(), f"no next tick within {patience_s:g} s of all replies")
        return False

    def _check_tick(self, tick: Tick, scenario: FlightScenario) -> None:
        key = topics.TICK.key_of()
        due_ns = scenario.timing.tick_time_ns(tick.tick)
        if tick.sim_time_ns != due_ns:
            self.report(key, "wrong sim_time_ns", f"{tick.sim_time_ns}, not {due_ns}")
        for name in (f"chaser/{i}" for i in tick.chasers):
            if tick.chaser_instances.get(name) != self._instances.get(name):
                self.report(key, "another instance than joined", name)
        if tick.controllers.get("controller") != self._instances["controller"]:
            self.report(key, "does not list the controller with its instance")
        missing = set(range(len(scenario.chasers))) - set(tick.chasers)
        if missing:
            self.report(key, "does not list all chasers", ", ".join(map(str, sorted(missing))))

    def _reply(self, chaser: int, tick: Tick, scenario: FlightScenario) -> None:
        instance = self._instances.get(f"chaser/{chaser}", "")
        head: dict[str, Any] = {"tick": tick.tick, "sim_time_ns": tick.sim_time_ns}
        lease = Lease(
            **head, chaser=chaser, holder="controller", instance=self._instances["controller"],
            term=1, from_tick=tick.tick, until_tick=tick.tick + scenario.time.rate_hz,
        )  # fmt: skip
        zero = (0.0, 0.0, 0.0)
        command = ActuatorCommand(
            **head, chaser=chaser, effective_time_ns=scenario.timing.effective_ns(tick.tick),
            source="brake", force_N=zero, torque_N_m=zero, instance=instance,
        )  # fmt: skip
        self._publish(topics.LEASE, lease, chaser)
        self._publish(topics.ACTUATORS, command, chaser)

    def _check_farewell(self) -> None:
        key = topics.FAREWELL.key_of("world")
        if self.farewell is None:
            self.report(key, f"none within {self._patience_s:g} s of the mission's end")
            return
        # Presence begins before the stand listens, and truth is not for it.
        uncounted = (key, topics.PRESENCE.key_of("world"))
        for name, number in self.farewell.published.items():
            counted = name not in uncounted and not name.startswith("truth/")
            if counted and self.counts[name] != number:
                detail = f"{name}: states {number}, {self.counts[name]} arrived"
                self.report(key, "wrong number of published messages", detail)

    # -- the network -------------------------------------------------------------------------------

    def _publish(self, topic: Topic, message: Message, place: int | str) -> None:
        key = topic.key_of(place)
        numbered = codec.encode(msgspec.structs.replace(message, seq=self._numbers[key]))
        self._numbers[key] += 1
        self._node.publish_raw(RawSample(key, encoding_of(topic.kind), numbered, 0))

    def _publish_presence(self) -> None:
        heard = dict(self._instances)
        if self.heard_world is not None:
            heard["world"] = self.heard_world.instance
        source = "" if self.mission is None else self.mission.source
        for name, instance in self._instances.items():
            others = {n: i for n, i in heard.items() if n != name}
            presence = Presence(process=name, instance=instance, heard=others, world=source)
            self._publish(topics.PRESENCE, presence, name)

    def _wait(self, done: Callable[[], bool], ended: Callable[[], bool], seconds: float) -> bool:
        """Process messages and publish presence until ``done``; return False when time is up, or
        the world has ended.
        """
        deadline, over = time.monotonic() + seconds, False
        while not done():
            if over or time.monotonic() > deadline:
                return False
            if time.monotonic() - self._presence_sent_s >= EARLY_PERIOD_S:
                self._presence_sent_s = time.monotonic()
                self._publish_presence()
            over = ended()
            try:
                self._take(self._inbox.get(0.3 if over else 0.02))
            except queue.Empty:
                continue
        return True

    def _arrived(self, raw: RawSample) -> None:
        self._inbox.put(raw, len(raw.payload))

    def _take(self, raw: RawSample) -> None:
        """Check a message of the world, and note what it says."""
        self.counts[raw.key] += 1
        found = topics.topic_of_key(raw.key)
        if found is None or not topics.may_write("world", found[0]):
            self.report(raw.key, "a key that a world must not write")
            return
        topic, place = found
        try:
            message: Any = codec.decode(topic.kind, raw.payload, raw.encoding)
        except Rejected as rejected:
            self.report(raw.key, WORDS.get(rejected.reason, rejected.reason), rejected.detail)
            return
        self._check_sender(raw, topic, message)
        match message:
            case Tick():
                self._check_order(message)
                self.tick = message
            case Presence():
                self.heard_world = message
            case MissionEnd():
                self.end = message
            case Farewell():
                self.farewell = message
            case _ if topic.rate in ("tick", "image"):
                self._note(raw.key, place, message)

    def _check_sender(self, raw: RawSample, topic: Topic, message: Message) -> None:
        source = "" if self.mission is None else self.mission.source
        if source and raw.source != source:
            self.report(raw.key, "another session than the join reply names", raw.source)
        if topic is not topics.PRESENCE and message.seq != self._next[raw.key]:
            detail = f"{message.seq} instead of {self._next[raw.key]}"
            self.report(raw.key, "seq does not count from 0 without gaps", detail)
        self._next[raw.key] = message.seq + 1

    def _check_order(self, tick: Tick) -> None:
        if self.tick is not None and not 0 <= tick.tick - self.tick.tick <= 1:
            detail = f"{tick.tick} after {self.tick.tick}"
            self.report(topics.TICK.key_of(), "ticks do not count by one", detail)

    def _note(self, key: str, place: str | None, message: Message) -> None:
        """Note that a message of a tick has come."""
        if place is not None and str(getattr(message, "chaser", place)) != place:
            self.report(key, "chaser differs from the key's")
        if isinstance(message, Odometry) and message.tick != self._came.get(key, -1) + 1:
            self.report(key, "not one odometry for each tick", str(message.tick))
        self._came[key] = message.tick
