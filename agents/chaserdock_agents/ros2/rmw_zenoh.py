# SPDX-License-Identifier: Apache-2.0
"""Open a node of ROS 2 on Zenoh, as ``rmw_zenoh_cpp`` (Jazzy, Kilted) expects it.

After the design document and the sources of ros2/rmw_zenoh. Data of a topic travel on
``DOMAIN/TOPIC/TYPE/HASH`` as CDR. A liveliness token under
``@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/…`` states that a node, publisher, subscription or
service exists. Every message carries its number, time and publisher as an attachment.
"""

from __future__ import annotations

import hashlib
import re
import struct
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

from chaserdock_protocol.process import RosLink, print_status
from chaserdock_protocol.transport.network import Undo
from chaserdock_protocol.transport.zenoh_network import AttachedQuery, PlainSession

from .types import TYPES, type_hash

EndpointKind = Literal["NN", "MP", "MS", "SS"]
"""Node, publisher, subscription, service."""

DEFAULT_QOS = "::,10:,:,:,,"
"""Reliable, volatile, keep the last 10: reliability : durability : history,depth : deadline :
lifespan : liveliness. An empty field is the default of rmw_zenoh."""
BEST_EFFORT_QOS = "2" + DEFAULT_QOS
"""As `DEFAULT_QOS`, but best effort (rmw's number of it). Only stated: what is published arrives at
every subscription, whatever either states.
"""
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16
"""Bytes of the identity of a publisher (rmw.h, ``RMW_GID_STORAGE_SIZE``)."""
_WORKERS = 4
"""Service calls that are served at once. Each waits for a reply of the controller; further calls
wait for their turn.
"""


def dds_name(type_name: str) -> str:
    """Return the name of a type in keys: ``std_msgs::msg::dds_::String_`` for
    ``std_msgs/msg/String``.
    """
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def topic_key(domain: int, name: str, type_name: str) -> str:
    """Return the key of a topic or service with an absolute name."""
    return f"{domain}/{name.strip('/')}/{dds_name(type_name)}/{type_hash(type_name)}"


def _mangled(name: str) -> str:
    return name.replace("/", "%") if name not in ("", "/") else "%"


def node_token(domain: int, session: str, node: str) -> str:
    """Return the liveliness token of a node without a namespace."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{node}"


def endpoint_token(
    domain: int,
    session: str,
    node: str,
    number: int,
    kind: EndpointKind,
    name: str,
    type_name: str,
    qos: str = DEFAULT_QOS,
) -> str:
    """Return the liveliness token of the node's endpoint ``number``: publisher, subscription or
    service ``name``.
    """
    head = f"@ros2_lv/{domain}/{session}/0/{number}/{kind}/%/%/{node}"
    return f"{head}/{_mangled(name)}/{dds_name(type_name)}/{type_hash(type_name)}/{qos}"


def endpoint_tokens(domain: int, kind: EndpointKind, name: str) -> str:
    """Return the expression of the tokens of all nodes' endpoints of a kind at ``name``."""
    return f"@ros2_lv/{domain}/*/*/*/{kind}/*/*/*/{_mangled(name)}/**"


def type_of_token(token: str) -> tuple[str, str]:
    """Return name and hash of the type that an endpoint's token states. Raises ValueError for
    another text.
    """
    parts = token.split("/")
    if len(parts) < 12:
        raise ValueError(f"no token of an endpoint: {token!r}")
    return re.sub(r"_$", "", parts[10].replace("::dds_::", "::")).replace("::", "/"), parts[11]


@dataclass(frozen=True)
class Attachment:
    """Attachment of a message or request.

    ``number``: counts the messages of a publisher, or the requests of a client, from 1.
    ``time_ns``: wall clock. ``gid``: identity of the sender.
    """

    number: int
    time_ns: int
    gid: bytes

    def pack(self) -> bytes:
        """Return 33 bytes, little-endian."""
        return _ATTACHMENT.pack(self.number, self.time_ns, _GID_BYTES, self.gid)

    @classmethod
    def unpack(cls, data: bytes) -> Attachment:
        """Raise ValueError for bytes that are no attachment."""
        if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
            raise ValueError(
                f"no attachment of rmw_zenoh: {len(data)} bytes, expected {_ATTACHMENT.size}"
            )
        number, time_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(number, time_ns, gid)


def _gid_of(token: str) -> bytes:
    """Return an identity that no other endpoint has."""
    return hashlib.blake2b(token.encode(), digest_size=_GID_BYTES).digest()


class RosPublisher:
    """Publishes messages of one type on one topic, until ``close``; safe to call from several
    threads.
    """

    def __init__(
        self, type_name: str, gid: bytes, put: Callable[[bytes, bytes], None], close: Undo
    ) -> None:
        self._type_name, self._gid, self._put, self.close = type_name, gid, put, close
        self._number = 0
        self._lock = threading.Lock()

    def publish(self, message: Any) -> None:
        """Serialize and send a message."""
        self.send(bytes(TYPES.serialize_cdr(message, self._type_name)))

    def send(self, cdr: bytes) -> None:
        """Send a serialized message."""
        with self._lock:
            self._number += 1
            self._put(cdr, Attachment(self._number, time.time_ns(), self._gid).pack())


class RosNode:
    """A node of ROS 2 with its endpoints, on a session of its own."""

    def __init__(self, session: PlainSession, domain: int, name: str) -> None:
        self._session, self._domain, self._name = session, domain, name
        self._endpoints, self._numbering = 0, threading.Lock()
        self._workers = ThreadPoolExecutor(_WORKERS, "service")
        session.declare_token(node_token(domain, session.session_id, name))

    def publisher(
        self, topic: str, type_name: str, *, blocking: bool, qos: str = DEFAULT_QOS
    ) -> RosPublisher:
        """Declare a publisher. ``blocking``: it waits for slow readers, else they miss messages."""
        put, undo = self._session.declare_publisher(
            topic_key(self._domain, topic, type_name), blocking=blocking
        )
        gid, withdraw = self._declare("MP", topic, type_name, qos)
        return RosPublisher(type_name, gid, put, _both(withdraw, undo))

    def subscribe(
        self, topic: str, type_name: str, arrived: Callable[[Any], None], qos: str = DEFAULT_QOS
    ) -> Undo:
        """Call ``arrived(message)`` on Zenoh's thread for every message of a topic; those that are
        no CDR are ignored.
        """

        def decode(payload: bytes, _: bytes) -> None:
            message = _decoded(payload, type_name)
            if message is not None:
                arrived(message)

        undo = self._session.subscribe(topic_key(self._domain, topic, type_name), decode)
        _, withdraw = self._declare("MS", topic, type_name, qos)
        return _both(withdraw, undo)

    def serve(self, name: str, type_name: str, handle: Callable[[Any], Any]) -> None:
        """Serve requests with ``handle(request) -> response``, on threads of this node. Malformed
        requests get an error.
        """

        def arrived(query: AttachedQuery) -> None:
            request = _decoded(query.payload, f"{type_name}_Request")
            try:
                asked = Attachment.unpack(query.attachment)
            except ValueError as error:
                query.refuse(str(error))
                return
            if request is None:
                query.refuse(f"no CDR of {type_name}_Request")
                return
            self._workers.submit(answer, query, asked, request)

        def answer(query: AttachedQuery, asked: Attachment, request: Any) -> None:
            response = TYPES.serialize_cdr(handle(request), f"{type_name}_Response")
            query.reply(bytes(response), Attachment(asked.number, time.time_ns(), asked.gid).pack())

        self._session.declare_queryable(topic_key(self._domain, name, type_name), arrived)
        self._declare("SS", name, type_name)

    def _declare(
        self, kind: EndpointKind, name: str, type_name: str, qos: str = DEFAULT_QOS
    ) -> tuple[bytes, Undo]:
        """Declare an endpoint's token, after the endpoint. Return its identity and what withdraws
        the token.
        """
        with self._numbering:
            self._endpoints += 1
            number = self._endpoints
        token = endpoint_token(
            self._domain, self._session.session_id, self._name, number, kind, name, type_name, qos
        )
        return _gid_of(token), self._session.declare_token(token)

    def close(self) -> None:
        """Answer the requests that have arrived, then close the session, which ends the node."""
        self._workers.shutdown()
        self._session.close()


def _both(first: Undo, second: Undo) -> Undo:
    def undo() -> None:
        first()
        second()

    return undo


def open_ros(link: RosLink, name: str) -> RosNode:
    """Open a session with ROS 2 and a node on it. Raises TransportError."""
    session = PlainSession(link.connect, link.listen, "router" if link.listen else "peer")
    print_status(name, f"ROS 2, domain {link.domain}: {', '.join((*link.listen, *link.connect))}")
    return RosNode(session, link.domain, name)


def _decoded(payload: bytes, type_name: str) -> Any:
    """Return a message, or None for bytes that are no CDR of its type."""
    try:
        return TYPES.deserialize_cdr(payload, type_name)
    except Exception:  # rosbags documents no errors: struct, index, Unicode and its own
        return None
