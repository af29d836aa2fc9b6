"""The only module that imports zenoh: sessions with safe defaults, and typed topics on them.

Defaults: no multicast, loopback only, an own namespace for every run, no shared memory. Callbacks run on
Zenoh's threads and only put raw bytes into a queue, so that a slow reader of one topic never delays another
(head-of-line blocking); decoding and checking happen in the reader's own thread.
"""

from __future__ import annotations

import json
import queue
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import zenoh

from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.fault_injection import FaultLayer
from chaserdock_protocol.messages import Message, encoding_of
from chaserdock_protocol.topics import Role, Topic

from .bounded_queue import Inbox
from .config import PATIENT_QUEUES, Link, Raw, Received, Tls, open_error

_PRIORITY = {
    "bulk": zenoh.Priority.DATA,
    "state": zenoh.Priority.DATA_HIGH,
    "command": zenoh.Priority.REAL_TIME,
    "event": zenoh.Priority.DATA_LOW,
}


class TransportError(ChaserdockError):
    """The network could not be had as asked; the text is one clear line."""


def zenoh_config(link: Link) -> zenoh.Config:
    """Zenoh configuration of a link; raises TransportError for a bad file, namespace or endpoint."""
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
    # Processes start in any order: keep trying to connect, unless the file says otherwise.
    patient = {
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
    }
    values |= {name: value for name, value in patient.items() if config.get_json(name) in ("null", None)}
    if link.config is None:
        values |= {
            "mode": link.mode,
            "listen/endpoints": list(link.listen) if link.mode != "client" else [],
            "connect/endpoints": list(link.connect),
            "transport/link/tx/lease": link.lease_ms,
            **PATIENT_QUEUES,
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
    """Nothing but TLS, both sides with a certificate of the mission."""
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


def _raw(sample: zenoh.Sample, key: str) -> Raw:
    stamp = sample.timestamp
    sent_ns = stamp.get_time_as_ntp64().as_nanos() if stamp is not None else 0
    return Raw(key, str(sample.encoding), sample.payload.to_bytes(), sent_ns)


@dataclass
class Counts:
    """What a node has refused and missed, by topic."""

    rejected: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    stale: int = 0


class Node:
    """One process on the network: publishes, subscribes and answers by the topics table.

    Raises TransportError if the session cannot be opened, PermissionError for a topic that this role may
    not read or write.
    """

    def __init__(self, name: str, role: Role, link: Link) -> None:
        self.name = name
        self.role: Role = role
        self.counts = Counts()
        self.faults: FaultLayer | None = None
        """What the mission's scenario does to this process' messages."""
        self.waits = True
        """Whether a slow reader holds up who publishes (lock-step) or misses what it cannot take. Set before publishing."""
        self._inbox: Inbox[tuple[Topic, str | None, Raw] | None] = Inbox()
        self._ready: deque[Received] = deque()
        self._latest: dict[str, tuple[Topic, str | None, Raw]] = {}
        self._latest_lock = threading.Lock()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._numbers: Counter[str] = Counter()
        self._before_anew: Counter[str] = Counter()
        self._last_seq: dict[str, int] = {}
        self._declared: list[Any] = []
        self._answering: dict[str, Any] = {}
        self._before_close: list[Callable[[], None]] = []
        zenoh.init_log_from_env_or("error")
        try:
            self._session = zenoh.open(zenoh_config(link))
        except zenoh.ZError as error:
            raise TransportError(open_error(error, link)) from None

    # -- publishing ---------------------------------------------------------------------------------------

    def advertise(self, topic: Topic, place: int | str | None = None) -> str:
        """Declares a publisher."""
        if not topics.may_write(self.role, topic):
            raise PermissionError(f"{self.role} may not write {topic.key}")
        key = topic.key_of(place)
        if key not in self._publishers:
            self._publishers[key] = self._session.declare_publisher(
                key,
                encoding=encoding_of(topic.kind),
                priority=_PRIORITY[topic.qos],
                express=topic in topics.AT_ONCE,
                reliability=zenoh.Reliability.RELIABLE,
                congestion_control=zenoh.CongestionControl.BLOCK
                if self.waits or topic in topics.NEVER_DROPPED
                else zenoh.CongestionControl.DROP,
            )
        return key

    def publish(self, topic: Topic, message: Message, place: int | str | None = None) -> None:
        """Numbers, encodes and sends a message."""
        key = topic.key_of(place)
        publisher = self._publishers.get(key) or self._publishers[self.advertise(topic, place)]
        for said in (message,) if self.faults is None else self.faults.outgoing(topic, place, message):
            payload = codec.encode(msgspec.structs.replace(said, seq=self._numbers[key]))
            self._numbers[key] += 1
            publisher.put(payload, timestamp=self._session.new_timestamp())

    def publish_raw(self, raw: Raw) -> None:
        """Sends a recorded message as it was, with a new time stamp: for analysis alone."""
        if self.role != "analysis":
            raise PermissionError(f"{self.role} may not write {raw.key} unopened")
        self._session.put(
            raw.key,
            raw.payload,
            encoding=raw.encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timestamp=self._session.new_timestamp(),
        )

    @property
    def published(self) -> dict[str, int]:
        """Messages published so far, by key."""
        return dict(self._numbers + self._before_anew)

    def number_anew(self) -> None:
        """Numbers from 0 again on the keys of its role, on which another process may have published since."""
        for key in list(self._numbers):
            found = topics.topic_of_key(key)
            if found is not None and found[0].writer == self.role:
                self._before_anew[key] += self._numbers.pop(key)

    # -- receiving ----------------------------------------------------------------------------------------

    def subscribe(self, topic: Topic, place: int | str | None = None, *, latest: bool = False) -> None:
        """Subscribes a topic, of all chasers or processes when ``place`` is None.

        ``latest`` keeps only the newest sample of a key that waits to be read (images in real time).
        """
        expression = self._readable(topic, place)

        def arrived(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            found = topics.topic_of_key(key)
            if found is None or found[0] is not topic:
                self.counts.rejected["key"] += 1
                return
            raw = _raw(sample, key)
            if latest:
                with self._latest_lock:
                    waiting = key in self._latest
                    self._latest[key] = (topic, found[1], raw)
                if not waiting:
                    self._inbox.put(None, 0)
            elif not self._inbox.put((topic, found[1], raw), len(raw.payload)):
                self.counts.rejected["queue full"] += 1

        self._declared.append(self._session.declare_subscriber(expression, arrived))

    def follow(
        self, topic: Topic, depth: int, place: int | str | None = None
    ) -> Callable[[], list[Received]]:
        """Subscribes a topic for a reader who looks on; each call of what is returned gives what came since the last.

        Of all that comes only the newest ``depth`` are kept. Zenoh itself drops the others, so that a reader who is
        slow or stands still costs the publishers nothing.
        """
        newest = zenoh.handlers.RingChannel(depth)
        ring = self._session.declare_subscriber(self._readable(topic, place), newest)
        self._declared.append(ring)

        def take() -> list[Received]:
            out: list[Received] = []
            while (sample := ring.try_recv()) is not None and len(out) < depth:
                raw = _raw(sample, str(sample.key_expr))
                found = topics.topic_of_key(raw.key)
                received = self._checked(topic, found[1], raw) if found and found[0] is topic else None
                if received is not None:
                    out.append(received)
            return out

        return take

    def _readable(self, topic: Topic, place: int | str | None) -> str:
        """The key expression of a topic that this role may read; raises PermissionError."""
        if not topics.may_read(self.role, topic):
            raise PermissionError(f"{self.role} may not read {topic.key}")
        if place is None and "{" in topic.key:
            return topic.key.format(chaser="*", process="**")
        return topic.key_of(place)

    def subscribe_raw(self, expression: str, arrived: Callable[[Raw], None]) -> None:
        """Everything on a key expression, unopened, on Zenoh's thread: for recorder and analysis alone."""
        if self.role not in ("recorder", "analysis"):
            raise PermissionError(f"{self.role} may not read {expression}")

        def callback(sample: zenoh.Sample) -> None:
            arrived(_raw(sample, str(sample.key_expr)))

        self._declared.append(self._session.declare_subscriber(expression, callback))

    def receive(self, timeout_s: float | None) -> Received | None:
        """The next message that passes all checks, or None when none came in time.

        Messages that do not pass are counted in ``counts.rejected`` by topic and reason; gaps in ``seq``
        in ``counts.lost``.
        """
        if self._ready:
            return self._ready.popleft()
        if timeout_s == 0 and self._inbox.empty():
            return None  # without an exception, for who looks often
        try:
            item = self._inbox.get(timeout_s)
        except queue.Empty:
            return None
        if item is None:
            with self._latest_lock:
                key = next(iter(self._latest))
                item = self._latest.pop(key)
        return self._open(*item)

    def _open(self, topic: Topic, place: str | None, raw: Raw) -> Received | None:
        received = self._checked(topic, place, raw)
        if received is None:
            return None
        seq, last = received.message.seq, self._last_seq.get(raw.key)
        if last is not None and seq > last + 1:
            self.counts.lost[raw.key] += seq - last - 1
        self._last_seq[raw.key] = seq
        if self.faults is None:
            return received
        came = self.faults.incoming(topic, place, received.message, raw.payload)
        self._ready.extend(Received(topic, place, m, raw.sent_ns) for m in came)
        return self._ready.popleft() if self._ready else None

    def _checked(self, topic: Topic, place: str | None, raw: Raw) -> Received | None:
        try:
            message: Any = codec.decode(topic.kind, raw.payload, raw.encoding)
            if place is not None and str(getattr(message, "chaser", place)) != place:
                raise Rejected("chaser", f"message of chaser {message.chaser} on {raw.key}")
        except Rejected as refusal:
            self.counts.rejected[f"{topic.key}:{refusal.reason}"] += 1
            return None
        return Received(topic, place, message, raw.sent_ns)

    # -- questions and presence ---------------------------------------------------------------------------

    def answer(
        self,
        key: str,
        request: type[msgspec.Struct],
        handle: Callable[[Any, Callable[[msgspec.Struct], None]], None],
    ) -> None:
        """Answers queries on a key: ``handle(message, reply)`` is called on Zenoh's thread and must not block.

        ``reply`` may be called later and from any thread, once. A malformed query gets an error reply.
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

        self._answering[key] = self._session.declare_queryable(key, arrived)

    def answer_no_more(self, key: str) -> None:
        """Leaves the queries on a key to others."""
        if key in self._answering:
            self._answering.pop(key).undeclare()

    def ask(self, key: str, request: msgspec.Struct, reply: type[msgspec.Struct], timeout_s: float) -> Any:
        """The first answer to a query, or None when nobody answers. Raises TransportError for an error reply."""
        replies = self._session.get(
            key, payload=codec.encode(request), encoding=encoding_of(type(request)), timeout=timeout_s
        )
        for answer in replies:
            if answer.ok is not None:
                try:
                    return codec.decode(reply, answer.ok.payload.to_bytes(), str(answer.ok.encoding))
                except Rejected as refusal:
                    raise TransportError(f"answer on {key}: {refusal}") from None
            if answer.err is not None and answer.err.payload.to_bytes() not in (b"Timeout", b""):
                raise TransportError(f"{key}: {answer.err.payload.to_string()}")
        return None

    def announce(self) -> None:
        """Declares this process' liveliness token."""
        token = self._session.liveliness().declare_token(topics.LIVE_KEY.format(process=self.name))
        self._declared.append(token)

    def watch_liveliness(self, changed: Callable[[str, bool], None]) -> None:
        """Calls ``changed(process, alive)`` on Zenoh's thread for every process that comes or goes."""
        prefix = topics.LIVE_KEY.format(process="")

        def callback(sample: zenoh.Sample) -> None:
            name = str(sample.key_expr).removeprefix(prefix)
            changed(name, sample.kind == zenoh.SampleKind.PUT)

        expression = topics.LIVE_KEY.format(process="**")
        self._declared.append(
            self._session.liveliness().declare_subscriber(expression, callback, history=True)
        )

    def before_close(self, stop: Callable[[], None]) -> None:
        """Has ``stop`` called before the session closes: for threads that publish on this node."""
        self._before_close.append(stop)

    def close(self) -> None:
        """Stops the threads that publish, then closes the session; what was published is sent first."""
        for stop in self._before_close:
            stop()
        self._session.close()
