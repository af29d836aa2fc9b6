# SPDX-License-Identifier: Apache-2.0
"""Test stand for one process: plays the world and its partners from a log over Zenoh."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import time
import uuid
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass

import msgspec
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import (
    JoinReply,
    JoinRequest,
    Message,
    MissionEnd,
    Presence,
    encoding_of,
)
from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.recording.log import LogSource
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import Node, RawSample
from chaserdock_protocol.transport import session as presence
from chaserdock_protocol.transport.bounded_queue import BoundedQueue
from chaserdock_protocol.transport.network import unique_id

from chaserdock.launch.launcher import open_hub

from .rules import Finding, Ledger
from .ticks import CheckError, RecordedTick, read_turns, with_instance

SILENT_TICKS = 3
"""Unanswered ticks after which the check stops."""
_LEASE_MS = 60_000
"""Time (ms) after which a silent process counts as lost. Long, so that a slow process does not; a
check of a dead one takes as long.
"""
_END_S = 5.0
"""Time (s) that the process has to end. Larger: a hanging process delays the check; smaller: a slow
one is reported.
"""


@dataclass(frozen=True)
class Checked:
    """Result of a check. ``findings``: empty if the process conforms. ``ticks``: ticks of the log
    that were played.
    """

    findings: list[Finding]
    ticks: int
    messages: int


def check(
    log: LogSource, process: str, command: list[str], ticks: int, start_s: float, patience_s: float
) -> Checked:
    """Run ``command`` as ``process`` against the first ``ticks`` of a log.

    ``{endpoint}`` and ``{namespace}`` in the command are replaced. Wall-clock timeouts: ``start_s``
    to join and discover the partners, ``patience_s`` per tick and to end. Raise LogError,
    ScenarioError, TransportError, or CheckError when the command or the log is unusable.
    """
    recorded = read_turns(log, process, ticks)
    with hub("world") as (node, filled):
        ledger = Ledger(process, recorded.scenario)
        stand = TestStand(node, ledger, recorded.scenario_json)
        with running(filled(command)) as child:
            played = stand.fly(child, recorded.turns, start_s, patience_s)
    return Checked(list(ledger.findings.values()), played, ledger.messages)


@contextmanager
def hub(name: str) -> Generator[tuple[Node, Callable[[list[str]], list[str]]]]:
    """Open the node of a test stand in a namespace of its own, to which the process under test
    connects; with what fills ``{endpoint}`` and ``{namespace}`` into its command. Raises
    TransportError.
    """
    namespace = f"check-{uuid.uuid4().hex[:12]}"
    node, endpoint = open_hub(namespace, _LEASE_MS, name, "analysis")

    def filled(command: list[str]) -> list[str]:
        return [
            word.replace("{endpoint}", endpoint).replace("{namespace}", namespace)
            for word in command
        ]

    try:
        yield node, filled
    finally:
        node.close()


@contextmanager
def running(command: list[str]) -> Generator[subprocess.Popen[bytes]]:
    """Run a command in a session of its own, and end its process group. Raises CheckError if it
    cannot be run.
    """
    child = _start(command)
    try:
        yield child
    finally:
        _end(child)


def _start(command: list[str]) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **SINGLE_THREADED},
            start_new_session=True,
        )
    except OSError as error:
        raise CheckError(f"{command[0]}: cannot be run: {error.strerror or error}") from None


def _end(child: subprocess.Popen[bytes]) -> None:
    """Terminate the process group, which is a session of its own."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if child.poll() is None:
            os.killpg(child.pid, number)
            try:
                child.wait(timeout=_END_S)
            except subprocess.TimeoutExpired:
                continue
    child.wait()


class TestStand:
    """Plays the messages of a log to one process and records its messages. Single-threaded, except
    for the callbacks.
    """

    def __init__(self, node: Node, ledger: Ledger, scenario_json: str) -> None:
        self._node, self._ledger, self._scenario_json = node, ledger, scenario_json
        self._inbox: BoundedQueue[RawSample | JoinRequest | tuple[str, bool]] = BoundedQueue()
        # The stand also receives its own messages; all others come from the process under test.
        self._sent: Counter[tuple[str, str, bytes]] = Counter()
        self._numbers: Counter[str] = Counter()
        self._alive: set[str] = set()
        self._was_alive = False
        present = {
            "world",
            "controller",
            *(f"chaser/{i}" for i in range(len(ledger.scenario.chasers))),
        }
        self._partners = presence.required_peers(ledger.process, present) - {ledger.process}
        self._instances = {name: unique_id() for name in sorted(self._partners)}
        self._presence_sent_s = 0.0
        self._period_s = presence.EARLY_PERIOD_S
        node.subscribe_raw("**", self._arrived)
        node.watch_liveliness(self._alive_changed)
        node.declare_queryable(topics.JOIN_KEY, JoinRequest, self._joins)
        node.declare_liveliness()

    def fly(
        self,
        child: subprocess.Popen[bytes],
        turns: list[RecordedTick],
        start_s: float,
        patience_s: float,
    ) -> int:
        """Run the whole check; return the number of ticks played."""
        ledger = self._ledger
        if not self._wait(self._has_joined, child, start_s):
            self._report_failed_join(child, start_s)
            return 0
        self._period_s = presence.STEADY_PERIOD_S
        played = self._play(child, turns, patience_s)
        last = turns[played - 1].tick
        end = MissionEnd(
            tick=last.tick + 1,
            sim_time_ns=last.sim_time_ns,
            reason="end of the check",
            complete=True,
        )
        if child.poll() is None:
            self._publish(topics.END, end)
            ended = self._wait(lambda: False, child, patience_s) or child.poll() is not None
            # The liveliness token disappears with the session, after all messages have arrived.
            self._wait(lambda: ledger.process not in self._alive, None, min(patience_s, _END_S))
            if not ended:
                ledger.report(
                    ledger.process, f"does not end within {patience_s:g} s of the mission's end"
                )
            elif child.returncode != 0:
                ledger.report(ledger.process, f"ended with status {child.returncode}")
        ledger.finish()
        return played

    def _play(
        self, child: subprocess.Popen[bytes], turns: list[RecordedTick], patience_s: float
    ) -> int:
        ledger, silent = self._ledger, 0
        first = () if ledger.role == "controller" else (topics.ACTUATORS,)
        for k, recorded in enumerate(turns):
            turn = with_instance(recorded, ledger.process, ledger.instance or "")
            ledger.open(turn)
            for raw in turn.opening:
                self._send(raw)
            # A chaser publishes its sighting before the controller can answer.
            if first:
                self._wait(lambda: not ledger.due(*first), child, patience_s)
            for raw in turn.answers:
                self._send(raw)
            if not self._wait(lambda: not ledger.due(), child, patience_s):
                if child.poll() is not None:
                    ledger.report(
                        ledger.process,
                        f"ended before the mission's end, with status {child.returncode}",
                    )
                    return k + 1
                ledger.miss(patience_s)
                silent += 1
                if silent == SILENT_TICKS:
                    ledger.report(
                        ledger.process, f"stopped after {SILENT_TICKS} ticks without an answer"
                    )
                    return k + 1
        return len(turns)

    # -- joining up --------------------------------------------------------------------------------

    def _joins(self, request: JoinRequest, reply: Callable[[JoinReply], None]) -> None:
        """Answer a join request, on Zenoh's thread."""
        self._inbox.put(request, 0)
        right = request.process == self._ledger.process
        reply(
            JoinReply(accepted=True, reason="", run_id="check", scenario_json=self._scenario_json)
            if right
            else JoinReply(accepted=False, reason=f"this check is for {self._ledger.process}")
        )

    def _has_joined(self) -> bool:
        ledger = self._ledger
        return (
            ledger.instance is not None
            and ledger.process in self._alive
            and not self._undiscovered()
        )

    def _undiscovered(self) -> list[str]:
        heard = self._ledger.heard
        return [name for name, instance in self._instances.items() if heard.get(name) != instance]

    def _report_failed_join(self, child: subprocess.Popen[bytes], start_s: float) -> None:
        ledger, name = self._ledger, self._ledger.process
        ended = child.poll() is not None
        if ended:
            ledger.report(name, f"ended before the first tick, with status {child.returncode}")
        if ledger.instance is None:
            refused = self._node.counts.rejected
            detail = "; ".join(key for key in refused if key.startswith(topics.JOIN_KEY))
            ledger.report(
                topics.JOIN_KEY,
                f"{name} did not join{'' if ended else f' within {start_s:g} s'}",
                detail,
            )
            return
        if not self._was_alive:
            ledger.report(topics.LIVE_KEY.format(process=name), "no liveliness token")
        if not ledger.present:
            ledger.report(topics.PRESENCE.key_of(name), "no presence published")
        elif unheard := self._undiscovered():
            ledger.report(
                topics.PRESENCE.key_of(name), "has not discovered its partners", ", ".join(unheard)
            )

    # -- the network -------------------------------------------------------------------------------

    def _publish(self, topic: Topic, message: Message, place: str | None = None) -> None:
        key = topic.key_of(place)
        numbered = codec.encode(msgspec.structs.replace(message, seq=self._numbers[key]))
        self._numbers[key] += 1
        self._send(RawSample(key, encoding_of(topic.kind), numbered, 0))

    def _send(self, raw: RawSample) -> None:
        self._sent[raw.key, raw.encoding, raw.payload] += 1
        self._node.publish_raw(raw)

    def _wait(
        self, done: Callable[[], bool], child: subprocess.Popen[bytes] | None, seconds: float
    ) -> bool:
        """Process messages and publish the partners' presence until ``done``. Returns False if the
        child ends or time runs out.
        """
        deadline = time.monotonic() + seconds
        ended = False
        while not done():
            if ended or time.monotonic() > deadline:
                return False
            if time.monotonic() - self._presence_sent_s >= self._period_s:
                self._presence_sent_s = time.monotonic()
                self._publish_presence()
            # First process all messages that preceded its end.
            ended = child is not None and child.poll() is not None
            self._receive(0.3 if ended else 0.02)
        return True

    def _arrived(self, raw: RawSample) -> None:
        self._inbox.put(raw, len(raw.payload))

    def _alive_changed(self, name: str, alive: bool) -> None:
        self._inbox.put((name, alive), 0)

    def _receive(self, seconds: float) -> None:
        """Process one message and all queued ones."""
        try:
            self._process(self._inbox.get(seconds))
            while True:
                self._process(self._inbox.get(0))
        except queue.Empty:
            return

    def _process(self, item: RawSample | JoinRequest | tuple[str, bool]) -> None:
        ledger = self._ledger
        if isinstance(item, RawSample):
            sent = (item.key, item.encoding, item.payload)
            if self._sent[sent]:
                self._sent[sent] -= 1
                if not self._sent[sent]:
                    del self._sent[sent]
                return
            ledger.add(item)
        elif isinstance(item, JoinRequest):
            if item.process != ledger.process:
                ledger.report(topics.JOIN_KEY, "joins under another name", repr(item.process))
            else:
                ledger.instance = item.instance
        else:
            name, alive = item
            (self._alive.add if alive else self._alive.discard)(name)
            self._was_alive |= alive and name == ledger.process
            if alive and name not in (ledger.process, "world"):
                ledger.report(
                    topics.LIVE_KEY.format(process=name), "another process' liveliness token"
                )

    def _publish_presence(self) -> None:
        ledger = self._ledger
        others = dict(self._instances)
        if ledger.instance is not None and ledger.present:
            others[ledger.process] = ledger.instance
        for name, instance in self._instances.items():
            heard = {other: i for other, i in others.items() if other != name}
            self._publish(
                topics.PRESENCE, Presence(process=name, instance=instance, heard=heard), name
            )
