# SPDX-License-Identifier: Apache-2.0
"""Connect nodes through Eclipse Zenoh, with safe defaults. No other module imports zenoh.

Defaults: no multicast, loopback only, one namespace per run, no shared memory.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal

import zenoh

from chaserdock_protocol import codec

from .config import (
    QUEUE_OPTIONS,
    Link,
    NoRouterError,
    Tls,
    TransportError,
    is_unreachable,
    open_error,
)
from .network import Connection, Host, Machine, Query, RawSample, Reply, T, Undo

_PRIORITY = {
    "bulk": zenoh.Priority.DATA,
    "state": zenoh.Priority.DATA_HIGH,
    "command": zenoh.Priority.REAL_TIME,
    "event": zenoh.Priority.DATA_LOW,
}

_LOG_FILTER = "error,zenoh::api::session=off"
"""Level of Zenoh's own log without ``RUST_LOG``. A session that joins a flight receives data before
the declarations of their keys, which Zenoh discards and reports as errors."""

_FIRST_ATTEMPT_S, _LONGEST_ATTEMPT_S = 1.0, 5.0
"""Wall time (s) of a client's first and longest attempts to connect. Shorter: Ctrl-C acts sooner;
longer: a slow TLS handshake succeeds.
"""


def zenoh_config(link: Link) -> zenoh.Config:
    """Return the Zenoh configuration of a link. Raises TransportError for a bad file, namespace or
    endpoint.
    """
    if not link.namespace or any(c in link.namespace for c in "/*$?#@ "):
        raise TransportError(
            f"namespace {link.namespace!r}: must be one word without / * $ ? # @ or blanks"
        )
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
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 1000,
            "period_increase_factor": 1.5,
        },
    }
    values |= {
        name: value for name, value in retry.items() if config.get_json(name) in ("null", None)
    }

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
    source = str(stamp.get_id()) if stamp is not None else ""
    return RawSample(key, str(sample.encoding), sample.payload.to_bytes(), sent_ns, source)


class ZenohNetwork:
    """Opens Zenoh sessions with the configuration of a link."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def open(self, name: str) -> tuple[Connection, Host]:
        """Open a session. Raises TransportError."""
        zenoh.init_log_from_env_or(_LOG_FILTER)
        config = zenoh_config(self._link)
        try:
            if (
                config.get_json("mode") == '"client"'
                and config.get_json("connect/timeout_ms") == "-1"
            ):
                return _ZenohConnection(self._open_client(config, name)), Machine()
            return _ZenohConnection(zenoh.open(config)), Machine()
        except zenoh.ZError as error:
            kind = NoRouterError if is_unreachable(error) else TransportError
            raise kind(open_error(error, self._link)) from None

    def _open_client(self, config: zenoh.Config, name: str) -> zenoh.Session:
        """Open a client session by attempts of limited duration. Raises ZError after the link's
        time.

        Zenoh waits in native code, and Python handles signals such as Ctrl-C only between the
        attempts. Each is longer than the one before, so that a slow TLS handshake succeeds, too.
        Prints once that it waits, unless that is soon over.
        """
        limit_s = self._link.connect_timeout_s
        end_s = math.inf if limit_s is None else time.monotonic() + limit_s
        attempt_s = _FIRST_ATTEMPT_S
        while True:
            left_s = end_s - time.monotonic()
            config.insert_json5(
                "connect/timeout_ms", str(max(1, round(1000 * min(attempt_s, left_s))))
            )
            try:
                return zenoh.open(config)
            except zenoh.ZError as error:
                if left_s <= attempt_s or not is_unreachable(error):
                    raise
                if attempt_s == _FIRST_ATTEMPT_S and (
                    limit_s is None or limit_s > _LONGEST_ATTEMPT_S
                ):
                    print(
                        f"{name}: {open_error(error, self._link)} Waiting for it.",
                        file=sys.stderr,
                        flush=True,
                    )
            attempt_s = min(2.0 * attempt_s, _LONGEST_ATTEMPT_S)


class _ZenohConnection:
    """Carry one node's messages over a Zenoh session; all declarations live as long as the
    session.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: list[Any] = []
        self.source = str(session.zid())

    def declare_publisher(
        self, key: str, encoding: str, qos: str, *, express: bool, blocking: bool
    ) -> Callable[[bytes], None]:
        control = zenoh.CongestionControl
        publisher = self._session.declare_publisher(
            key,
            encoding=encoding,
            priority=_PRIORITY[qos],
            express=express,
            reliability=zenoh.Reliability.RELIABLE,
            congestion_control=control.BLOCK if blocking else control.DROP,
        )
        self._declared.append(publisher)
        return lambda payload: publisher.put(payload, timestamp=self._session.new_timestamp())

    def put(self, raw: RawSample) -> None:
        self._session.put(
            raw.key,
            raw.payload,
            encoding=raw.encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timestamp=self._session.new_timestamp(),
        )

    def subscribe(self, expression: str, arrived: Callable[[RawSample], None]) -> None:
        def callback(sample: zenoh.Sample) -> None:
            arrived(_raw_sample(sample, str(sample.key_expr)))

        self._declared.append(self._session.declare_subscriber(expression, callback))

    def subscribe_ring(self, expression: str, depth: int) -> Callable[[], RawSample | None]:
        ring = self._session.declare_subscriber(expression, zenoh.handlers.RingChannel(depth))
        self._declared.append(ring)

        def take() -> RawSample | None:
            sample = ring.try_recv()
            return None if sample is None else _raw_sample(sample, str(sample.key_expr))

        return take

    def declare_queryable(self, key: str, arrived: Callable[[Query], None]) -> Undo:
        return self._session.declare_queryable(
            key, lambda query: arrived(_ZenohQuery(key, query))
        ).undeclare

    def query(self, key: str, payload: bytes, encoding: str, timeout_s: float) -> Iterator[Reply]:
        for reply in self._session.get(key, payload=payload, encoding=encoding, timeout=timeout_s):
            if reply.ok is not None:
                yield Reply(reply.ok.payload.to_bytes(), str(reply.ok.encoding))
            elif reply.err is not None and reply.err.payload.to_bytes() not in (b"Timeout", b""):
                yield Reply(b"", "", reply.err.payload.to_string())

    def decode(self, kind: type[T], raw: RawSample) -> T:
        return codec.decode(kind, raw.payload, raw.encoding)

    def declare_liveliness(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch_liveliness(self, expression: str, changed: Callable[[str, bool], None]) -> None:
        def callback(sample: zenoh.Sample) -> None:
            changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        subscriber = self._session.liveliness().declare_subscriber(
            expression, callback, history=True
        )
        self._declared.append(subscriber)

    def close(self) -> None:
        self._session.close()


class PlainSession:
    """A Zenoh session without a namespace and with attachments, for another protocol than that of a
    mission. What is declared lives until it is undone, or the session is closed.

    ``mode``: a ``peer``, or a ``router`` that other peers find each other by. ``must_connect``: not
    to go on without one of the endpoints. Raises TransportError if it cannot be opened.
    """

    def __init__(
        self,
        connect: tuple[str, ...],
        listen: tuple[str, ...],
        mode: Literal["peer", "router"],
        *,
        must_connect: bool = False,
    ) -> None:
        zenoh.init_log_from_env_or(_LOG_FILTER)
        config = zenoh.Config()
        values = {
            "mode": mode,
            "connect/endpoints": list(connect),
            "connect/timeout_ms": -1 if mode == "router" else 5000,
            "listen/endpoints": list(listen),
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
            **QUEUE_OPTIONS,
        }
        if must_connect:
            values["connect/exit_on_failure"] = True
        try:
            for name, value in values.items():
                config.insert_json5(name, json.dumps(value))
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise TransportError(
                open_error(error, Link(connect=connect, listen=listen, mode=mode))
            ) from None
        self._declared: set[Any] = set()
        self.session_id = str(self._session.zid())

    def declare_publisher(
        self, key: str, *, blocking: bool
    ) -> tuple[Callable[[bytes, bytes], None], Undo]:
        """Return a function that publishes a payload with an attachment, and its undoing.
        ``blocking``: it waits for slow readers.
        """
        control = zenoh.CongestionControl
        publisher = self._session.declare_publisher(
            key, congestion_control=control.BLOCK if blocking else control.DROP
        )

        def put(payload: bytes, attachment: bytes) -> None:
            publisher.put(payload, attachment=attachment)

        return put, self._keep(publisher)

    def subscribe(self, key: str, arrived: Callable[[bytes, bytes], None]) -> Undo:
        """Call ``arrived(payload, attachment)`` on Zenoh's thread for every sample on a key."""

        def callback(sample: zenoh.Sample) -> None:
            arrived(sample.payload.to_bytes(), _attachment(sample.attachment))

        return self._keep(self._session.declare_subscriber(key, callback))

    def declare_queryable(self, key: str, arrived: Callable[[AttachedQuery], None]) -> Undo:
        """Call ``arrived(query)`` on Zenoh's thread for every query on a key, which this session
        answers completely.
        """
        return self._keep(
            self._session.declare_queryable(
                key, lambda query: arrived(AttachedQuery(key, query)), complete=True
            )
        )

    def declare_token(self, key: str) -> Undo:
        """Declare a liveliness token."""
        return self._keep(self._session.liveliness().declare_token(key))

    def watch_tokens(self, expression: str, changed: Callable[[str, bool], None]) -> Undo:
        """Call ``changed(key, is alive)`` on Zenoh's thread for every liveliness token that exists
        or changes.
        """

        def callback(sample: zenoh.Sample) -> None:
            changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        return self._keep(
            self._session.liveliness().declare_subscriber(expression, callback, history=True)
        )

    def tokens(self, expression: str, timeout_s: float) -> list[str]:
        """Return the liveliness tokens that exist now."""
        replies = self._session.liveliness().get(expression, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def _keep(self, entity: Any) -> Undo:
        """Hold something declared, which ends with its last reference; return what ends it."""
        self._declared.add(entity)

        def undo() -> None:
            if entity in self._declared:
                self._declared.discard(entity)
                entity.undeclare()

        return undo

    def close(self) -> None:
        """Close the session, which ends everything declared."""
        self._declared.clear()
        self._session.close()


def _attachment(attachment: zenoh.ZBytes | None) -> bytes:
    return b"" if attachment is None else attachment.to_bytes()


class _ReceivedQuery:
    def __init__(self, key: str, query: zenoh.Query) -> None:
        self._key, self._query = key, query
        self.payload = query.payload.to_bytes() if query.payload is not None else b""

    def refuse(self, text: str) -> None:
        """Reply with an error and end the query."""
        self._query.reply_err(text)
        self._query.drop()


class AttachedQuery(_ReceivedQuery):
    """A query with an attachment, and its only reply."""

    def __init__(self, key: str, query: zenoh.Query) -> None:
        super().__init__(key, query)
        self.attachment = _attachment(query.attachment)

    def reply(self, payload: bytes, attachment: bytes) -> None:
        """Send the reply and end the query."""
        self._query.reply(self._key, payload, attachment=attachment)
        self._query.drop()


class _ZenohQuery(_ReceivedQuery):
    def __init__(self, key: str, query: zenoh.Query) -> None:
        super().__init__(key, query)
        self.encoding = str(query.encoding)

    def reply(self, payload: bytes, encoding: str) -> None:
        self._query.reply(self._key, payload, encoding=encoding)
        self._query.drop()
