# SPDX-License-Identifier: Apache-2.0
"""Simulated network: carries the messages of all nodes in virtual time, with the faults of
``Conditions``.

Declarations and messages travel over the same links (`links.py`). Deliveries run within the
scheduler, so that publishing never waits.
"""

from __future__ import annotations

import random
import re
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

from chaserdock_protocol import codec, topics
from chaserdock_protocol.scenario.simulation import Partition, SimulationSection
from chaserdock_protocol.transport import RawSample
from chaserdock_protocol.transport.bounded_queue import BoundedQueue
from chaserdock_protocol.transport.network import Connection, Host, Query, Reply, T, Undo

from .links import Links, MessageLink, Traffic
from .scheduler import Killed, Scheduler, VirtualQueue

LEASE_S = 2.0
"""Time (s) after which a silent process counts as lost in real time, as under `chaserdock run`."""
EPOCH_NS = 1_800_000_000 * 10**9
"""Wall-clock time (ns) at the start of a simulation, in January 2027; fixed, so that flights are
repeatable.
"""


@lru_cache(maxsize=128)
def decode_once(kind: type[T], payload: bytes, encoding: str) -> T:
    """Decode as ``codec.decode``. The receivers of a message share the result, which is
    immutable.
    """
    return codec.decode(kind, payload, encoding)


@lru_cache(maxsize=4096)
def matches(expression: str, key: str) -> bool:
    """Return whether a key expression includes a key. ``*`` stands for one chunk, ``**`` for any
    number of chunks.
    """
    return expression == key or _pattern(expression).fullmatch(key) is not None


@lru_cache(maxsize=4096)
def _pattern(expression: str) -> re.Pattern[str]:
    pattern = re.escape(expression).replace(r"\*\*/", "(.*/)?").replace(r"\*\*", ".*")
    return re.compile(pattern.replace(r"\*", "[^/]*"))


@dataclass
class _Subscription:
    """The subscription ``number`` of a network. ``links``: from the publishers that know of it, by
    name.
    """

    number: int
    owner: SimulatedConnection
    expression: str
    arrived: Callable[[RawSample], None]
    links: dict[str, MessageLink] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.records_all = self.owner.name == "recorder" and self.expression == "**"


class SimulatedNetwork:
    """The ``Network`` of one simulated mission. ``tap``: called with sender and sample of every
    message when it is published. ``lockstep``: see ``Links``.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        conditions: SimulationSection,
        seed: int,
        lockstep: bool,
        tap: Callable[[str, RawSample], None] | None = None,
    ) -> None:
        self.scheduler, self.conditions = scheduler, conditions
        self.lockstep, self.tap = lockstep, tap
        self.traffic = Traffic()
        self.links = Links(scheduler, conditions, seed, lockstep, self.traffic)
        self._seed = seed
        self._connections: dict[str, SimulatedConnection] = {}
        self._opened: Counter[str] = Counter()
        self._subscriptions: list[_Subscription] = []
        self._subscribed = 0
        self._routes: dict[str, list[_Subscription]] = {}
        self._of_keys: dict[str, list[_Subscription]] = {}
        self._of_patterns: list[_Subscription] = []

    def open(self, name: str) -> tuple[Connection, Host]:
        """Connect a process. One that is started again replaces its earlier connection."""
        host = SimulatedHost(name, self)
        self._opened[name] += 1
        number = self._opened[name]
        source = name if number == 1 else f"{name}#{number}"
        self._connections[name] = SimulatedConnection(self, name, host, source)
        for subscription in self._subscriptions:
            self._declare(subscription, name)
        return self._connections[name], host

    def seeded(self, *parts: object) -> random.Random:
        """Return a random stream that depends on this network's seed and ``parts``."""
        return random.Random(f"{self._seed} {parts}")

    # -- messages ----------------------------------------------------------------------------------

    def publish(
        self, sender: SimulatedConnection, raw: RawSample, qos: str, blocking: bool
    ) -> None:
        """Send a sample to all subscribers of its key that the sender knows of."""
        if sender.closed:
            return
        if raw.key == topics.TICK.key:
            self.scheduler.note_progress()
            if self.links.first_tick_s is None:
                self.links.first_tick_s = self.scheduler.now_s
                self._schedule_partitions()
        self.traffic.sent += 1
        if self.tap is not None:
            self.tap(sender.name, raw)
        for subscription in self._route(raw.key):
            if subscription.owner is sender:
                if subscription.records_all:
                    self.traffic.recorded[raw.key] += 1
                subscription.arrived(raw)
            elif (link := subscription.links.get(sender.name)) is not None:
                arguments = (link, subscription, raw)
                self.links.send(link, len(raw.payload), qos, blocking, self._arrive, arguments)

    def _route(self, key: str) -> list[_Subscription]:
        if key not in self._routes:
            if not self._routes:
                self._sort_subscriptions()
            found = list(self._of_keys.get(key, ()))
            found += [s for s in self._of_patterns if matches(s.expression, key)]
            self._routes[key] = sorted(found, key=lambda s: s.number)
        return self._routes[key]

    def _sort_subscriptions(self) -> None:
        """Separate the subscriptions of one key each, which most are, from those of patterns."""
        self._of_keys, self._of_patterns = defaultdict[str, list[_Subscription]](list), []
        for subscription in self._subscriptions:
            is_pattern = "*" in subscription.expression
            of = self._of_patterns if is_pattern else self._of_keys[subscription.expression]
            of.append(subscription)

    def _arrive(self, link: MessageLink, to: _Subscription, raw: RawSample) -> None:
        """Hand a sample that has crossed a link to its subscriber."""
        link.bytes -= len(raw.payload)
        if to.owner.closed:
            return
        if to.records_all:
            self.traffic.recorded[raw.key] += 1
        to.arrived(raw)

    # -- partitions and liveliness -----------------------------------------------------------------

    def _schedule_partitions(self) -> None:
        """Let processes lose sight of each other during partitions that outlast the lease."""
        if self.lockstep:
            return
        begin_s = self.links.first_tick_s or 0.0
        for partition in self.conditions.partition:
            if partition.duration_s > LEASE_S:
                for at_s in (
                    partition.at_s + LEASE_S,
                    partition.at_s + partition.duration_s + 1e-3,
                ):
                    self.scheduler.call_at(
                        begin_s + at_s, lambda p=partition: self._review_liveliness(p)
                    )

    def _review_liveliness(self, partition: Partition) -> None:
        for name in list(self._connections):
            for other in self._connections.values():
                if partition.separates(name, other.name):
                    other.review(name)

    def is_alive(self, name: str, seen_from: str) -> bool:
        """Return whether one process counts as alive for another."""
        connection, host = self._connections.get(name), self.host_of(name)
        if connection is None or connection.closed or not connection.token:
            return False
        if self.lockstep:
            return True
        silent_s = host.frozen_for_s if host is not None else 0.0
        if silent_s > LEASE_S:
            return False
        return not any(
            p.at_s + LEASE_S <= self.links.mission_s < p.at_s + p.duration_s
            for p in self.conditions.partition
            if p.separates(name, seen_from)
        )

    def host_of(self, name: str) -> SimulatedHost | None:
        """Return the host of a process."""
        connection = self._connections.get(name)
        return None if connection is None else connection.host

    def disconnect(self, name: str) -> None:
        """Close the connection of a process that has died."""
        self._connections[name].close()

    def announce(self, name: str) -> None:
        """Let all others check whether a process is alive, once the news has reached them."""
        for other in list(self._connections.values()):
            if other.name != name:
                self.links.deliver(name, other.name, lambda other=other: other.review(name))

    def tell_who_lives(self, watcher: SimulatedConnection) -> None:
        """Let a process check all that have appeared before, once the news has reached it."""
        for name, other in self._connections.items():
            if other.token and other is not watcher:
                review = partial(watcher.review, name)
                self.links.deliver(name, watcher.name, review)

    # -- declarations ------------------------------------------------------------------------------

    def subscribe(
        self, owner: SimulatedConnection, expression: str, arrived: Callable[[RawSample], None]
    ) -> None:
        """Add a subscription. Each publisher learns of it when the declaration arrives there."""
        added = _Subscription(self._subscribed, owner, expression, arrived)
        self._subscribed += 1
        for name in self._connections:
            if name != owner.name:
                self._declare(added, name)
        self._subscriptions.append(added)
        self._routes.clear()

    def _declare(self, subscription: _Subscription, publisher: str) -> None:
        """Make a subscription known to a publisher when the declaration arrives there."""
        owner = subscription.owner.name

        def arrive() -> None:
            subscription.links[publisher] = self.links.between(publisher, owner)

        self.links.deliver(owner, publisher, arrive)

    def ask(
        self,
        asker: SimulatedConnection,
        key: str,
        payload: bytes,
        encoding: str,
        replied: Callable[[Reply], None],
    ) -> None:
        """Carry a query to the process that serves its key, if any, and carry the reply back."""
        for server in list(self._connections.values()):
            handle = server.queryables.get(key)
            if handle is None or server.closed:
                continue

            def answer(reply: Reply, server: SimulatedConnection = server) -> None:
                self.links.deliver(server.name, asker.name, lambda: replied(reply), "event")

            query = _SimulatedQuery(payload, encoding, answer)
            self.links.deliver(
                asker.name, server.name, lambda s=server, q=query: s.serve(key, q), "event"
            )
            return

    def forget(self, connection: SimulatedConnection) -> None:
        """Remove the subscriptions of a connection that closes."""
        self._subscriptions = [s for s in self._subscriptions if s.owner is not connection]
        self._routes.clear()


@dataclass(frozen=True)
class _SimulatedQuery:
    payload: bytes
    encoding: str
    answer: Callable[[Reply], None]

    def reply(self, payload: bytes, encoding: str) -> None:
        self.answer(Reply(payload, encoding))

    def refuse(self, text: str) -> None:
        self.answer(Reply(b"", "", text))


class SimulatedConnection:
    """A ``Connection`` to a simulated network. ``source``: as a session has, one of its own for
    each process that is started again.
    """

    def __init__(
        self, network: SimulatedNetwork, name: str, host: SimulatedHost, source: str
    ) -> None:
        self.network, self.name, self.host = network, name, host
        self.source = source
        self.closed = False
        self.token = ""
        self.queryables: dict[str, Callable[[Query], None]] = {}
        self._watchers: list[tuple[str, Callable[[str, bool], None]]] = []
        self._known: dict[str, bool] = {}

    def declare_publisher(
        self, key: str, encoding: str, qos: str, *, express: bool, blocking: bool
    ) -> Callable[[bytes], None]:
        def send(payload: bytes) -> None:
            raw = RawSample(key, encoding, payload, self.host.wall_ns(), self.source)
            self.network.publish(self, raw, qos, blocking)

        return send

    def decode(self, kind: type[T], raw: RawSample) -> T:
        return decode_once(kind, raw.payload, raw.encoding)

    def put(self, raw: RawSample) -> None:
        sent = RawSample(raw.key, raw.encoding, raw.payload, self.host.wall_ns(), self.source)
        self.network.publish(self, sent, "state", blocking=True)

    def subscribe(self, expression: str, arrived: Callable[[RawSample], None]) -> None:
        self.network.subscribe(self, expression, arrived)

    def subscribe_ring(self, expression: str, depth: int) -> Callable[[], RawSample | None]:
        ring: deque[RawSample] = deque(maxlen=depth)
        self.network.subscribe(self, expression, ring.append)
        return lambda: ring.popleft() if ring else None

    def declare_queryable(self, key: str, arrived: Callable[[Query], None]) -> Undo:
        self.queryables[key] = arrived

        def undeclare() -> None:
            self.queryables.pop(key, None)

        return undeclare

    def serve(self, key: str, query: Query) -> None:
        """Hand an arrived query to the process if it still serves the key."""
        if not self.closed and key in self.queryables:
            self.queryables[key](query)

    def query(self, key: str, payload: bytes, encoding: str, timeout_s: float) -> Iterator[Reply]:
        scheduler, replies = self.network.scheduler, deque[Reply](maxlen=1)
        asking = scheduler.running

        def replied(reply: Reply) -> None:
            replies.append(reply)
            if asking is not None:
                scheduler.wake(asking)

        self.network.ask(self, key, payload, encoding, replied)
        self.host.pause(timeout_s, lambda: bool(replies))
        yield from replies

    def declare_liveliness(self, key: str) -> None:
        self.token = key
        self.network.announce(self.name)

    def watch_liveliness(self, expression: str, changed: Callable[[str, bool], None]) -> None:
        self._watchers.append((expression, changed))
        self.network.tell_who_lives(self)

    def review(self, name: str) -> None:
        """Tell the watchers if another process has appeared or disappeared."""
        if self.closed:
            return
        alive, key = self.network.is_alive(name, self.name), topics.LIVE_KEY.format(process=name)
        if self._known.get(name, False) == alive:
            return
        self._known[name] = alive
        for expression, changed in self._watchers:
            if matches(expression, key):
                changed(key, alive)

    def close(self) -> None:
        if not self.closed:
            self.network.announce(self.name)
            self.network.forget(self)
        self.closed = True


class SimulatedHost:
    """The ``Host`` of a process in virtual time. Its clock has an offset and a drift from the
    scheduler's.
    """

    def __init__(self, name: str, network: SimulatedNetwork) -> None:
        self.name = name
        self.frozen_until_s = 0.0
        self._network, self._scheduler = network, network.scheduler
        self._ids = network.seeded(
            "ids", name, len(network.scheduler.tasks), network.scheduler.now_s
        )
        clock = next((c for c in network.conditions.clock if c.process == name), None)
        self._offset_s, self._rate = (
            (0.0, 1.0) if clock is None else (clock.offset_s, 1.0 + clock.drift)
        )
        self._slow = [s for s in network.conditions.slow if s.process == name]
        self._dead = False

    # -- time --------------------------------------------------------------------------------------

    def now_s(self) -> float:
        return self._offset_s + self._rate * self._scheduler.now_s

    def wall_ns(self) -> int:
        """Return the wall clock (ns), which message time stamps use."""
        return EPOCH_NS + round(self.now_s() * 1e9)

    def pause(self, timeout_s: float | None, over: Callable[[], bool] = lambda: False) -> None:
        """Wait for a time of the host's clock or until ``over``, which is tested whenever the task
        is woken.
        """
        end_s = None if timeout_s is None else self._scheduler.now_s + timeout_s / self._rate
        while not over() and (end_s is None or self._scheduler.now_s < end_s):
            self._scheduler.pause(None if end_s is None else end_s - self._scheduler.now_s)

    def sleep(self, duration_s: float) -> None:
        self.pause(duration_s)

    def new_queue(self) -> BoundedQueue[Any]:
        queue = VirtualQueue(self._scheduler, self._read_slowly if self._slow else None, self._rate)
        self._network.traffic.queues[f"{self.name} {len(self._network.traffic.queues)}"] = queue
        return queue

    def _read_slowly(self) -> None:
        """Pause before reading a message for as long as a slow reader does."""
        now_s = self._network.links.mission_s
        for slow in self._slow:
            if slow.at_s <= now_s < slow.at_s + slow.duration_s:
                self.sleep(slow.each_s)

    def unique_id(self) -> str:
        return f"{self._ids.getrandbits(48):012x}"

    def repeat(self, call: Callable[[], float]) -> Undo:
        """Call ``call`` repeatedly within the scheduler, unless the host is frozen or dead."""
        ended = False

        def run() -> None:
            if ended or self._dead:
                return
            if self._scheduler.now_s < self.frozen_until_s:
                self._scheduler.call_at(self.frozen_until_s, run)
                return
            self._scheduler.call_at(self._scheduler.now_s + call() / self._rate, run)

        def end() -> None:
            nonlocal ended
            ended = True

        run()
        return end

    def worker(self, call: Callable[[Any], None]) -> tuple[Callable[[Any], None], Undo]:
        """Handle each item at once, as virtual time has no background."""
        return call, lambda: None

    # -- the process -------------------------------------------------------------------------------

    def finish_startup(self) -> None:
        """Do nothing: many missions share the interpreter."""

    def lower_priority(self) -> None:
        """Do nothing: tasks have no priority."""

    def kill(self) -> None:
        """End the process' task. Nothing that it does while unwinding reaches the network."""
        self._dead = True
        self._network.disconnect(self.name)
        raise Killed

    @property
    def frozen_for_s(self) -> float:
        """Return for how long the process has been frozen (s)."""
        now_s = self._scheduler.now_s
        return now_s - self._frozen_since_s if now_s < self.frozen_until_s else 0.0

    _frozen_since_s = 0.0

    def freeze(self, duration_s: float) -> None:
        self._frozen_since_s = self._scheduler.now_s
        self.frozen_until_s = self._frozen_since_s + duration_s
        for at_s in (self._frozen_since_s + LEASE_S + 1e-3, self.frozen_until_s + 1e-3):
            if duration_s > LEASE_S:
                self._scheduler.call_at(at_s, lambda: self._network.announce(self.name))
        self.sleep(duration_s * self._rate)
