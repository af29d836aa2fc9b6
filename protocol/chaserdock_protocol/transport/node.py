# SPDX-License-Identifier: Apache-2.0
"""Zenoh sessions with safe defaults, and typed topics on them. No other module imports zenoh.

Defaults: no multicast, loopback only, one namespace per run, no shared memory. Callbacks run on Zenoh's threads
and only enqueue raw bytes, so that a slow reader of one topic does not delay another (head-of-line blocking).
The reader's thread decodes and validates.
"""

from __future__ import annotations

import json
import queue
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec
import zenoh

from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import Message, encoding_of
from chaserdock_protocol.topics import Role, Topic

from .bounded_queue import BoundedQueue
from .config import QUEUE_OPTIONS, Link, RawSample, ReceivedMessage, Tls, open_error

_PRIORITY = {
    "bulk": zenoh.Priority.DATA,
    "state": zenoh.Priority.DATA_HIGH,
    "command": zenoh.Priority.REAL_TIME,
    "event": zenoh.Priority.DATA_LOW,
}


class TransportError(ChaserdockError):
    """The network cannot be used as configured. The text is one line."""


def zenoh_config(link: Link) -> zenoh.Config:
    """Return the Zenoh configuration of a link. Raises TransportError for a bad file, namespace or endpoint."""
    if not link.namespace or any(c in link.namespace for c in "/*$?#@ "):
        raise TransportError(f"namespace {link.namespace!r}: must be one word without / * $ ? # @ or blanks")
    try:
        config = zenoh.Config.from_file(str(link.config)) if link.config else zenoh.Config()
    except zenoh.ZError as error:
        raise TransportError(f"Zenoh configuration {link.config}: {error}") from None
    values: dict[str, Any] = {
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    # Processes start in any order: retry the connection, unless the file configures it.
    retry = {
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
    }
    values |= {name: value for name, value in retry.items() if config.get_json(name) in ("null", None)}
    if link.config is None:
        values |= {
            "mode": link.mode,
            "listen/endpoints": list(link.listen) if link.mode != "client" else [],
            "connect/endpoints": list(link.connect),
            "transport/link/tx/lease": link.lease_ms,
            **QUEUE_OPTIONS,
        }
    if link.tls is not None:
        values |= _tls_values(link.tls)
    if link.access_control is not None:
        values["access_control"] = link.access_control
    try:
        config.insert_json5("namespace", json.dumps(link.namespace))
        for name, value in values.items():
            config.insert_json5(name, json.dumps(value))
    except zenoh.ZError as error:
        raise TransportError(f"Zenoh option: {error}") from None
    return config


def _tls_values(tls: Tls) -> dict[str, Any]:
    """Return the options that allow TLS only, with mission certificates on both sides."""
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(tls.ca),
            "enable_mtls": True,
            "listen_private_key": str(tls.key),
            "listen_certificate": str(tls.certificate),
            "connect_private_key": str(tls.key),
            "connect_certificate": str(tls.certificate),
        },
    }


def _raw_sample(sample: zenoh.Sample, key: str) -> RawSample:
    stamp = sample.timestamp
    sent_ns = stamp.get_time_as_ntp64().as_nanos() if stamp is not None else 0
    return RawSample(key, str(sample.encoding), sample.payload.to_bytes(), sent_ns)


@dataclass
class TrafficCounters:
    """Messages that a node rejected and lost, by topic, and the number of stale ones."""

    rejected: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    stale: int = 0


class MessageFilter(Protocol):
    """Replaces the messages that a node sends and receives. Fault injection implements it."""

    def outgoing(self, topic: Topic, place: int | str | None, message: Any) -> list[Any]:
        """Return the messages to publish instead of ``message``."""
        ...

    def incoming(self, topic: Topic, place: str | None, message: Any, payload: bytes) -> list[Any]:
        """Return the messages to deliver instead of ``message``, which was decoded from ``payload``."""
        ...


class Node:
    """One process on the network: publishers, subscribers and queries, restricted by the topics table.

    Raises TransportError if the session cannot be opened, PermissionError for a topic that this role may
    not read or write.
    """

    def __init__(self, name: str, role: Role, link: Link) -> None:
        self.name = name
        self.role: Role = role
        self.counts = TrafficCounters()
        self.message_filter: MessageFilter | None = None
        self.blocking = True
        """True (lock-step): a slow reader blocks the publisher. False: it misses messages. Set before publishing."""
        self._inbox: BoundedQueue[tuple[Topic, str | None, RawSample] | None] = BoundedQueue()
        self._ready: deque[ReceivedMessage] = deque()
        self._latest: dict[str, tuple[Topic, str | None, RawSample]] = {}
        self._latest_lock = threading.Lock()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._next_seq: Counter[str] = Counter()
        self._published_before_restart: Counter[str] = Counter()
        self._last_seq: dict[str, int] = {}
        self._declared: list[Any] = []
        self._queryables: dict[str, Any] = {}
        self._close_callbacks: list[Callable[[], None]] = []
        zenoh.init_log_from_env_or("error")
        try:
            self._session = zenoh.open(zenoh_config(link))
        except zenoh.ZError as error:
            raise TransportError(open_error(error, link)) from None

    # -- publishing ---------------------------------------------------------------------------------------

    def advertise(self, topic: Topic, place: int | str | None = None) -> str:
        """Declare a publisher and return its key."""
        if not topics.may_write(self.role, topic):
            raise PermissionError(f"{self.role} may not write {topic.key}")
        key = topic.key_of(place)
        if key not in self._publishers:
            self._publishers[key] = self._session.declare_publisher(
                key,
                encoding=encoding_of(topic.kind),
                priority=_PRIORITY[topic.qos],
                express=topic in topics.EXPRESS,
                reliability=zenoh.Reliability.RELIABLE,
                congestion_control=zenoh.CongestionControl.BLOCK
                if self.blocking or topic in topics.NEVER_DROPPED
                else zenoh.CongestionControl.DROP,
            )
        return key

    def publish(self, topic: Topic, message: Message, place: int | str | None = None) -> None:
        """Number, encode and send a message."""
        key = topic.key_of(place)
        publisher = self._publishers.get(key) or self._publishers[self.advertise(topic, place)]
        messages = [message]
        if self.message_filter is not None:
            messages = self.message_filter.outgoing(topic, place, message)
        for outgoing in messages:
            payload = codec.encode(msgspec.structs.replace(outgoing, seq=self._next_seq[key]))
            self._next_seq[key] += 1
            publisher.put(payload, timestamp=self._session.new_timestamp())

    def publish_raw(self, raw: RawSample) -> None:
        """Send a recorded message unchanged, with a new time stamp. Only for the role ``analysis``."""
        if self.role != "analysis":
            raise PermissionError(f"{self.role} may not write raw samples ({raw.key})")
        self._session.put(
            raw.key,
            raw.payload,
            encoding=raw.encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timestamp=self._session.new_timestamp(),
        )

    @property
    def published(self) -> dict[str, int]:
        """Return the number of messages published so far, by key."""
        return dict(self._next_seq + self._published_before_restart)

    def restart_numbering(self) -> None:
        """Restart ``seq`` at 0 on the keys of this role, on which another process may have published meanwhile."""
        for key in list(self._next_seq):
            found = topics.topic_of_key(key)
            if found is not None and found[0].writer == self.role:
                self._published_before_restart[key] += self._next_seq.pop(key)

    # -- receiving ----------------------------------------------------------------------------------------

    def subscribe(self, topic: Topic, place: int | str | None = None, *, latest: bool = False) -> None:
        """Subscribe to a topic, for all chasers or processes if ``place`` is None.

        ``latest`` keeps only the newest unread sample of each key (images in real time).
        """
        expression = self._key_expression(topic, place)

        def arrived(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            found = topics.topic_of_key(key)
            if found is None or found[0] is not topic:
                self.counts.rejected["key"] += 1
                return
            raw = _raw_sample(sample, key)
            if latest:
                with self._latest_lock:
                    waiting = key in self._latest
                    self._latest[key] = (topic, found[1], raw)
                if not waiting:
                    self._inbox.put(None, 0)
            elif not self._inbox.put((topic, found[1], raw), len(raw.payload)):
                self.counts.rejected["queue full"] += 1

        self._declared.append(self._session.declare_subscriber(expression, arrived))

    def subscribe_newest(
        self, topic: Topic, depth: int, place: int | str | None = None
    ) -> Callable[[], list[ReceivedMessage]]:
        """Subscribe through a ring buffer of the newest ``depth`` samples, and return a function that drains it.

        Zenoh drops older samples, so that a slow or stopped reader does not slow down the publishers.
        """
        newest = zenoh.handlers.RingChannel(depth)
        ring = self._session.declare_subscriber(self._key_expression(topic, place), newest)
        self._declared.append(ring)

        def drain() -> list[ReceivedMessage]:
            out: list[ReceivedMessage] = []
            while (sample := ring.try_recv()) is not None and len(out) < depth:
                raw = _raw_sample(sample, str(sample.key_expr))
                found = topics.topic_of_key(raw.key)
                received = self._decode(topic, found[1], raw) if found and found[0] is topic else None
                if received is not None:
                    out.append(received)
            return out

        return drain

    def _key_expression(self, topic: Topic, place: int | str | None) -> str:
        """Return the key expression of a topic. Raises PermissionError if this role may not read it."""
        if not topics.may_read(self.role, topic):
            raise PermissionError(f"{self.role} may not read {topic.key}")
        if place is None and "{" in topic.key:
            return topic.key.format(chaser="*", process="**")
        return topic.key_of(place)

    def subscribe_raw(self, expression: str, arrived: Callable[[RawSample], None]) -> None:
        """Pass every sample on a key expression to ``arrived`` on Zenoh's thread. Only for recorder and analysis."""
        if self.role not in ("recorder", "analysis"):
            raise PermissionError(f"{self.role} may not read {expression}")

        def callback(sample: zenoh.Sample) -> None:
            arrived(_raw_sample(sample, str(sample.key_expr)))

        self._declared.append(self._session.declare_subscriber(expression, callback))

    def receive(self, timeout_s: float | None) -> ReceivedMessage | None:
        """Return the next valid message, or None on timeout.

        Counts invalid messages in ``counts.rejected`` by topic and reason, and gaps in ``seq`` in ``counts.lost``.
        """
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

    def _filter(self, topic: Topic, place: str | None, raw: RawSample) -> ReceivedMessage | None:
        received = self._decode(topic, place, raw)
        if received is None:
            return None
        seq, last = received.message.seq, self._last_seq.get(raw.key)
        if last is not None and seq > last + 1:
            self.counts.lost[raw.key] += seq - last - 1
        self._last_seq[raw.key] = seq
        if self.message_filter is None:
            return received
        delivered = self.message_filter.incoming(topic, place, received.message, raw.payload)
        self._ready.extend(ReceivedMessage(topic, place, m, raw.sent_ns) for m in delivered)
        return self._ready.popleft() if self._ready else None

    def _decode(self, topic: Topic, place: str | None, raw: RawSample) -> ReceivedMessage | None:
        try:
            message: Any = codec.decode(topic.kind, raw.payload, raw.encoding)
            if place is not None and str(getattr(message, "chaser", place)) != place:
                raise Rejected("chaser", f"message of chaser {message.chaser} on {raw.key}")
        except Rejected as refusal:
            self.counts.rejected[f"{topic.key}:{refusal.reason}"] += 1
            return None
        return ReceivedMessage(topic, place, message, raw.sent_ns)

    # -- queries and liveliness ----------------------------------------------------------------------------

    def declare_queryable(
        self,
        key: str,
        request: type[msgspec.Struct],
        handle: Callable[[Any, Callable[[msgspec.Struct], None]], None],
    ) -> None:
        """Serve queries on a key: Zenoh's thread calls ``handle(message, reply)``, which must not block.

        ``reply`` may be called once, later and from any thread. A malformed query gets an error reply.
        """

        def arrived(query: zenoh.Query) -> None:
            try:
                payload = query.payload.to_bytes() if query.payload is not None else b""
                message = codec.decode(request, payload, str(query.encoding))
            except Rejected as refusal:
                self.counts.rejected[f"{key}:{refusal.reason}"] += 1
                query.reply_err(str(refusal))
                query.drop()
                return

            def reply(result: msgspec.Struct) -> None:
                query.reply(key, codec.encode(result), encoding=encoding_of(type(result)))
                query.drop()

            handle(message, reply)

        self._queryables[key] = self._session.declare_queryable(key, arrived)

    def undeclare_queryable(self, key: str) -> None:
        """Stop serving queries on a key."""
        if key in self._queryables:
            self._queryables.pop(key).undeclare()

    def query(self, key: str, request: msgspec.Struct, reply: type[msgspec.Struct], timeout_s: float) -> Any:
        """Return the first reply to a query, or None without any. Raises TransportError for an error reply."""
        replies = self._session.get(
            key, payload=codec.encode(request), encoding=encoding_of(type(request)), timeout=timeout_s
        )
        for reply_sample in replies:
            if reply_sample.ok is not None:
                try:
                    return codec.decode(
                        reply, reply_sample.ok.payload.to_bytes(), str(reply_sample.ok.encoding)
                    )
                except Rejected as refusal:
                    raise TransportError(f"reply on {key}: {refusal}") from None
            if reply_sample.err is not None and reply_sample.err.payload.to_bytes() not in (b"Timeout", b""):
                raise TransportError(f"{key}: {reply_sample.err.payload.to_string()}")
        return None

    def declare_liveliness(self) -> None:
        """Declare this process' liveliness token."""
        token = self._session.liveliness().declare_token(topics.LIVE_KEY.format(process=self.name))
        self._declared.append(token)

    def watch_liveliness(self, changed: Callable[[str, bool], None]) -> None:
        """Call ``changed(process, alive)`` on Zenoh's thread for every process that appears or disappears."""
        prefix = topics.LIVE_KEY.format(process="")

        def callback(sample: zenoh.Sample) -> None:
            name = str(sample.key_expr).removeprefix(prefix)
            changed(name, sample.kind == zenoh.SampleKind.PUT)

        expression = topics.LIVE_KEY.format(process="**")
        self._declared.append(
            self._session.liveliness().declare_subscriber(expression, callback, history=True)
        )

    def on_close(self, stop: Callable[[], None]) -> None:
        """Register a callback to run before the session closes: stops threads that publish on this node."""
        self._close_callbacks.append(stop)

    def close(self) -> None:
        """Run the callbacks of ``on_close``, then close the session, which first sends all published messages."""
        for stop in self._close_callbacks:
            stop()
        self._session.close()
