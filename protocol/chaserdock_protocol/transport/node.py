# SPDX-License-Identifier: Apache-2.0
"""Typed topics on a network: publishers, subscribers and queries of one process.

Callbacks run on the network's threads and only enqueue raw bytes, so that a slow reader of one
topic does not delay another (head-of-line blocking). The reader's thread decodes and validates.
"""

from __future__ import annotations

import queue
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec

from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import Message, Presence, Tick, encoding_of
from chaserdock_protocol.topics import Role, Topic

from .bounded_queue import BoundedQueue
from .config import Link, ReceivedMessage, TransportError
from .foreign_publishers import ForeignPublishers
from .network import Network, Query, RawSample, T, Undo
from .process_sessions import ProcessSessions
from .zenoh_network import ZenohNetwork


@dataclass
class TrafficCounters:
    """Messages that a node rejected and lost, by topic, and the number of stale ones."""

    rejected: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    stale: int = 0


_Arrival = tuple[Topic, str | None, RawSample, float]
"""Topic, place and sample of a message, and the time (s) when it arrived."""


class MessageFilter(Protocol):
    """Replaces the messages that a node sends and receives. Fault injection implements it."""

    def outgoing(self, topic: Topic, place: int | str | None, message: Any) -> list[Any]:
        """Return the messages to publish instead of ``message``."""
        ...

    def incoming(self, topic: Topic, place: str | None, message: Any, payload: bytes) -> list[Any]:
        """Return the messages to deliver instead of ``message``, which was decoded from
        ``payload``.
        """
        ...


class Node:
    """One process on the network: publishers, subscribers and queries, restricted by the topics
    table.

    Raises TransportError if the session cannot be opened, PermissionError for a topic that this
    role may not read or write.
    """

    def __init__(self, name: str, role: Role, link: Link) -> None:
        self.name = name
        self.role: Role = role
        self.counts = TrafficCounters()
        self.message_filter: MessageFilter | None = None
        self.blocking = True
        """Whether a slow reader blocks the publisher (lock-step) or misses messages. Set before
        publishing.
        """
        self._ready: deque[ReceivedMessage] = deque()
        self._latest: dict[str, _Arrival] = {}
        self._latest_lock = threading.Lock()
        self._publishers: dict[str, Callable[[bytes], None]] = {}
        self._next_seq: Counter[str] = Counter()
        self._published_before_restart: Counter[str] = Counter()
        self._last_seq: dict[tuple[str, str], int] = {}
        self._queryables: dict[str, Undo] = {}
        self._close_callbacks: list[Callable[[], None]] = []
        self.run_id = ""
        """Mission that the process has joined, empty before."""
        self._foreign = ForeignPublishers(self.counts.rejected)
        self._sessions = ProcessSessions()
        self._newest: Message | None = None
        network: Network = ZenohNetwork(link) if link.network is None else link.network
        self._connection, self.host = network.open(name)
        self._inbox: BoundedQueue[_Arrival | None] = self.host.new_queue()

    @property
    def source(self) -> str:
        """Identity of this node's session on the network."""
        return self._connection.source

    @property
    def world_source(self) -> str:
        """Identity of the session of the mission's world, empty if unknown."""
        return self.source if self.role == "world" else self._foreign.world_source

    def expect_world(
        self, source: str, on_foreign: Callable[[str, str, Message | None], None]
    ) -> None:
        """Ignore messages on the world's keys that another session than ``source`` publishes;
        empty: accept all.

        ``on_foreign(key, source, newest)`` runs on the reader's thread for the first of each
        session, up to a number of sessions; ``newest``: the last valid message.
        """
        self._foreign.expect(source, on_foreign)

    # -- publishing --------------------------------------------------------------------------------

    def advertise(self, topic: Topic, place: int | str | None = None) -> str:
        """Declare a publisher and return its key."""
        if not topics.may_write(self.role, topic):
            raise PermissionError(f"{self.role} may not write {topic.key}")
        key = topic.key_of(place)
        if key not in self._publishers:
            self._publishers[key] = self._connection.declare_publisher(
                key,
                encoding_of(topic.kind),
                topic.qos,
                express=topic in topics.EXPRESS,
                blocking=self.blocking or topic in topics.NEVER_DROPPED,
            )
        return key

    def publish(self, topic: Topic, message: Message, place: int | str | None = None) -> None:
        """Number, encode and send a message."""
        key = topic.key_of(place)
        send = self._publishers.get(key) or self._publishers[self.advertise(topic, place)]
        messages = [message]
        if self.message_filter is not None:
            messages = self.message_filter.outgoing(topic, place, message)
        for outgoing in messages:
            payload = codec.encode(msgspec.structs.replace(outgoing, seq=self._next_seq[key]))
            self._next_seq[key] += 1
            send(payload)

    def publish_raw(self, raw: RawSample) -> None:
        """Send a recorded message unchanged, with a new time stamp. Only for the role
        ``analysis``.
        """
        if self.role != "analysis":
            raise PermissionError(f"{self.role} may not write raw samples ({raw.key})")
        self._connection.put(raw)

    @property
    def published(self) -> dict[str, int]:
        """Return the number of messages published so far, by key."""
        return dict(self._next_seq + self._published_before_restart)

    def restart_numbering(self) -> None:
        """Restart ``seq`` at 0 on the keys of this role, on which another process may have
        published meanwhile.
        """
        for key in list(self._next_seq):
            found = topics.topic_of_key(key)
            if found is not None and found[0].writer == self.role:
                self._published_before_restart[key] += self._next_seq.pop(key)

    # -- receiving ---------------------------------------------------------------------------------

    def subscribe(
        self, topic: Topic, place: int | str | None = None, *, latest: bool = False
    ) -> None:
        """Subscribe to a topic, for all chasers or processes if ``place`` is None.

        ``latest`` keeps only the newest unread sample of each key (images in real time).
        """
        expression = self._key_expression(topic, place)

        def arrived(raw: RawSample) -> None:
            key = raw.key
            if self._foreign.sent(raw):
                return
            found = topics.topic_of_key(key)
            if found is None or found[0] is not topic:
                self.counts.rejected["key"] += 1
                return
            if latest:
                with self._latest_lock:
                    waiting = key in self._latest
                    self._latest[key] = (topic, found[1], raw, self.host.now_s())
                if not waiting:
                    self._inbox.put(None, 0)
            elif not self._inbox.put((topic, found[1], raw, self.host.now_s()), len(raw.payload)):
                self.counts.rejected["queue full"] += 1

        self._connection.subscribe(expression, arrived)

    def subscribe_newest(
        self, topic: Topic, depth: int, place: int | str | None = None
    ) -> Callable[[], list[ReceivedMessage]]:
        """Subscribe through a ring buffer of the newest ``depth`` samples, and return a function
        that drains it.

        The network drops older samples, so that a slow or stopped reader does not slow down the
        publishers.
        """
        take = self._connection.subscribe_ring(self._key_expression(topic, place), depth)

        def drain() -> list[ReceivedMessage]:
            out: list[ReceivedMessage] = []
            while (raw := take()) is not None and len(out) < depth:
                found = topics.topic_of_key(raw.key)
                received = (
                    self._decode(topic, found[1], raw) if found and found[0] is topic else None
                )
                if received is not None:
                    out.append(received)
            self._foreign.report_next(self._newest)
            return out

        return drain

    def _key_expression(self, topic: Topic, place: int | str | None) -> str:
        """Return the key expression of a topic. Raises PermissionError if this role may not read
        it.
        """
        if not topics.may_read(self.role, topic):
            raise PermissionError(f"{self.role} may not read {topic.key}")
        if place is None and "{" in topic.key:
            return topic.key.format(chaser="*", process="**")
        return topic.key_of(place)

    def subscribe_raw(self, expression: str, arrived: Callable[[RawSample], None]) -> None:
        """Pass every sample on a key expression to ``arrived`` on the network's thread. Only for
        recorder and analysis.
        """
        if self.role not in ("recorder", "analysis"):
            raise PermissionError(f"{self.role} may not read {expression}")

        def own_mission(raw: RawSample) -> None:
            if not self._foreign.sent(raw):
                arrived(raw)

        self._connection.subscribe(expression, own_mission)

    def receive(self, timeout_s: float | None) -> ReceivedMessage | None:
        """Return the next valid message, or None on timeout.

        Counts invalid messages in ``counts.rejected`` by topic and reason, and gaps in ``seq`` in
        ``counts.lost``.
        """
        self._foreign.report_next(self._newest)
        if self._ready:
            return self._ready.popleft()
        if timeout_s == 0 and self._inbox.empty():
            return None  # fast path for polling: no exception
        try:
            item = self._inbox.get(timeout_s)
        except queue.Empty:
            return None
        if item is None:
            with self._latest_lock:
                key = next(iter(self._latest))
                item = self._latest.pop(key)
        return self._filter(*item)

    def _filter(
        self, topic: Topic, place: str | None, raw: RawSample, arrived_s: float
    ) -> ReceivedMessage | None:
        received = self._decode(topic, place, raw, arrived_s)
        if received is None:
            return None
        publisher = (raw.key, raw.source)  # two controllers publish on the same keys
        seq, last = received.message.seq, self._last_seq.get(publisher)
        if last is not None and seq > last + 1:
            self.counts.lost[raw.key] += seq - last - 1
        self._last_seq[publisher] = seq
        if received.message.tick >= 0:
            self._newest = received.message
        if self.message_filter is None:
            return received
        delivered = self.message_filter.incoming(topic, place, received.message, raw.payload)
        self._ready.extend(
            received
            if m is received.message
            else ReceivedMessage(topic, place, m, raw.sent_ns, arrived_s)
            for m in delivered
        )
        return self._ready.popleft() if self._ready else None

    def decode(self, kind: type[T], raw: RawSample) -> T:
        """Decode and validate a sample; raises Rejected."""
        return self._connection.decode(kind, raw)

    def _decode(
        self, topic: Topic, place: str | None, raw: RawSample, arrived_s: float = 0.0
    ) -> ReceivedMessage | None:
        if self._foreign.sent(raw):  # arrived through a ring buffer, or before `expect_world`
            return None
        try:
            message: Any = self._connection.decode(topic.kind, raw)
            if place is not None and str(getattr(message, "chaser", place)) != place:
                raise Rejected("chaser", f"message of chaser {message.chaser} on {raw.key}")
            if place is not None and getattr(message, "process", place) != place:
                raise Rejected("process", f"message of {message.process} on {raw.key}")
        except Rejected as refusal:
            self.counts.rejected[f"{topic.key}:{refusal.reason}"] += 1
            return None
        received = ReceivedMessage(topic, place, message, raw.sent_ns, arrived_s, raw.source)
        match message:
            case Presence(process=process, instance=instance):
                self._sessions.note(process, instance, raw.source)
                self._sessions.list_instances(message.heard if process == "world" else {})
            case Tick():
                self._sessions.list_instances(message.chaser_instances)
                self._sessions.list_instances(message.controllers)
            case _ if self._is_forged(topic, raw.key, raw.source):
                return None
        return received

    def is_forged(self, received: ReceivedMessage) -> bool:
        """Return whether another session than its process' has sent a message, and count it.

        A message that was received earlier may turn out to be forged when its process is known.
        """
        topic = received.topic
        return self._is_forged(topic, topic.key_of(received.place), received.source)

    def _is_forged(self, topic: Topic, key: str, source: str) -> bool:
        forged = self._sessions.is_foreign(key, source)
        if forged:
            self.counts.rejected[f"{topic.key}:foreign publisher"] += 1
        return forged

    # -- queries and liveliness --------------------------------------------------------------------

    def declare_queryable(
        self,
        key: str,
        request: type[msgspec.Struct],
        handle: Callable[[Any, Callable[[msgspec.Struct], None]], None],
    ) -> None:
        """Serve queries on a key: the network's thread calls ``handle(message, reply)``, which must
        not block.

        ``reply`` may be called once, later and from any thread. A malformed query gets an error
        reply.
        """

        def arrived(query: Query) -> None:
            try:
                message = codec.decode(request, query.payload, query.encoding)
            except Rejected as refusal:
                self.counts.rejected[f"{key}:{refusal.reason}"] += 1
                query.refuse(str(refusal))
                return
            handle(
                message, lambda result: query.reply(codec.encode(result), encoding_of(type(result)))
            )

        self._queryables[key] = self._connection.declare_queryable(key, arrived)

    def undeclare_queryable(self, key: str) -> None:
        """Stop serving queries on a key."""
        if key in self._queryables:
            self._queryables.pop(key)()

    def query(
        self, key: str, request: msgspec.Struct, reply: type[msgspec.Struct], timeout_s: float
    ) -> Any:
        """Return the first reply to a query, or None without any. Raises TransportError for an
        error reply.
        """
        payload, encoding = codec.encode(request), encoding_of(type(request))
        for found in self._connection.query(key, payload, encoding, timeout_s):
            if found.error:
                raise TransportError(f"{key}: {found.error}")
            try:
                return codec.decode(reply, found.payload, found.encoding)
            except Rejected as refusal:
                raise TransportError(f"reply on {key}: {refusal}") from None
        return None

    def declare_liveliness(self, process: str = "") -> None:
        """Declare this process' liveliness token, or in a test stand that of another one."""
        self._connection.declare_liveliness(topics.LIVE_KEY.format(process=process or self.name))

    def watch_liveliness(self, changed: Callable[[str, bool], None]) -> None:
        """Call ``changed(process, alive)`` on the network's thread for every process that appears
        or disappears.
        """
        prefix = topics.LIVE_KEY.format(process="")

        self._connection.watch_liveliness(
            topics.LIVE_KEY.format(process="**"),
            lambda key, alive: changed(key.removeprefix(prefix), alive),
        )

    def on_close(self, stop: Callable[[], None]) -> None:
        """Register a callback to run before the connection closes: stops threads that publish on
        this node.
        """
        self._close_callbacks.append(stop)

    def close(self) -> None:
        """Run the callbacks of ``on_close``, then close the connection, which first sends all
        published messages.
        """
        for stop in self._close_callbacks:
            stop()
        self._connection.close()
