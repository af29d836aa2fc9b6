# SPDX-License-Identifier: Apache-2.0
"""Share sessions with ROS 2 among devices, and tell whether a topic is what a device needs.

Devices with the same endpoints and domain share one session and one node of ROS 2. What exists on
the network is known by liveliness tokens, which rmw_zenoh and PX4 declare.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
from chaserdock_protocol.transport.config import TransportError
from chaserdock_protocol.transport.network import Undo
from chaserdock_protocol.transport.zenoh_network import PlainSession

from chaserdock_agents.ros2.rmw_zenoh import (
    BEST_EFFORT_QOS,
    DEFAULT_QOS,
    RosNode,
    RosPublisher,
    dds_name,
    endpoint_tokens,
    type_of_token,
)
from chaserdock_agents.ros2.types import type_hash

from ..devices import DeviceError
from .sharing import Shared

NODE = "chaserdock_gateway"
_ANSWER_S = 2.0
"""Longest wait, s, for the network's answer on what exists: it comes in milliseconds; a router on a
slow radio link needs a fraction of a second.
"""


class RosOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of every device on ROS 2: endpoints of Zenoh to connect to, or to listen on as the
    router; domain (default: ``ROS_DOMAIN_ID``, or 0); and the quality of service to state.
    """

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    listen: tuple[str, ...] = ()
    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None
    qos: Literal["reliable", "best_effort"] = "reliable"

    def domain_id(self) -> int:
        """Return the domain. Raises DeviceError for a ROS_DOMAIN_ID that is no number."""
        text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
        if self.domain is not None:
            return self.domain
        if not text.isdecimal():
            raise DeviceError(f"ROS_DOMAIN_ID={text!r}: must be a number, or set option domain")
        return int(text)


def absolute_name(topic: str) -> str:
    """Return the address of a device as a topic of ROS 2. Raises DeviceError."""
    parts = topic.split("/")[1:]
    if not topic.startswith("/") or not all(p.replace("_", "a").isalnum() for p in parts):
        raise DeviceError(f"{topic!r} must be an absolute name of ROS 2, such as /robot0/odom")
    return topic


class RosNetwork:
    """One session and node, shared by all devices with equal endpoints and domain. Raises
    DeviceError if no endpoint is reached.
    """

    def __init__(self, connect: tuple[str, ...], listen: tuple[str, ...], domain: int) -> None:
        try:
            self._session = PlainSession(
                connect, listen, "router" if listen else "peer", must_connect=not listen
            )
        except TransportError as error:
            raise DeviceError(str(error)) from None
        self.domain, self.node = domain, RosNode(self._session, domain, NODE)

    def close(self) -> None:
        """Close node and session."""
        self.node.close()

    def watch(self, kind: Literal["MP", "MS"], topic: str, type_name: str) -> TopicWatch:
        """Return a watch over the publishers (``MP``) or subscriptions (``MS``) of a topic."""
        return TopicWatch(self._session, self.domain, kind, topic, type_name)


class TopicWatch:
    """Tells whether a topic has the type that a device needs, and whether its other side is gone.

    A side without tokens is believed to be right, as it cannot be seen.
    """

    def __init__(
        self,
        session: PlainSession,
        domain: int,
        kind: Literal["MP", "MS"],
        topic: str,
        type_name: str,
    ) -> None:
        self._who = "publishes" if kind == "MP" else "subscribes to"
        self._topic, self._type_name, self._own = topic, type_name, session.session_id
        self._lock = threading.Lock()
        self._types: dict[str, tuple[str, str]] = {}
        self._was_right = False
        expression = endpoint_tokens(domain, kind, topic)
        self.close: Undo = session.watch_tokens(expression, self._change)
        for token in session.tokens(expression, _ANSWER_S):
            self._change(token, True)

    def _change(self, token: str, alive: bool) -> None:
        if token.split("/")[2] == self._own:
            return
        with self._lock:
            if not alive:
                self._types.pop(token, None)
                return
            try:
                self._types[token] = type_of_token(token)
            except ValueError:
                return
            self._was_right |= self._is_right(token)

    def _is_right(self, token: str) -> bool:
        return self._types[token] == (self._type_name, type_hash(self._type_name))

    @property
    def exists(self) -> bool:
        """Whether the other side is there with the right type."""
        with self._lock:
            return any(map(self._is_right, self._types))

    def problem(self) -> str | None:
        """Return why nothing can pass: the type or the hash of the other side, or that it is gone;
        None if no reason is known.
        """
        with self._lock:
            if any(map(self._is_right, self._types)):
                return None
            if self._types:
                name, digest = next(iter(self._types.values()))
                text = f"somebody {self._who} {self._topic} with type {name}"
                if name != self._type_name:
                    return f"{text}, but option type is {self._type_name}"
                return (
                    f"{text} of hash {digest}, but {dds_name(name)} here has "
                    f"{type_hash(name)}: another version of the message"
                )
            return f"nobody {self._who} {self._topic} any more" if self._was_right else None


_NETWORKS: Shared[RosNetwork] = Shared()


class RosEndpoints:
    """Endpoints of one device on a network; ``close`` undoes them and leaves the network."""

    def __init__(self, options: RosOptions) -> None:
        # A router of its own has nobody to connect to.
        key = (() if options.listen else options.connect, options.listen, options.domain_id())
        self.network = _NETWORKS.acquire(key, lambda: RosNetwork(*key))
        self._qos = BEST_EFFORT_QOS if options.qos == "best_effort" else DEFAULT_QOS
        self._undo: list[Undo] = [lambda: _NETWORKS.release(key)]
        self._watches: list[TopicWatch] = []

    def subscribe(self, topic: str, type_name: str, arrived: Callable[[Any], None]) -> None:
        """Receive a topic, on Zenoh's thread. Raises DeviceError if it has another type."""
        self._watch("MP", topic, type_name)
        self._undo.append(self.network.node.subscribe(topic, type_name, arrived, self._qos))

    def publisher(self, topic: str, type_name: str) -> RosPublisher:
        """Return a publisher, which drops what a slow reader does not take. Raises DeviceError if
        somebody subscribes to the topic with another type.
        """
        self._watch("MS", topic, type_name)
        made = self.network.node.publisher(topic, type_name, blocking=False, qos=self._qos)
        self._undo.append(made.close)
        return made

    def _watch(self, kind: Literal["MP", "MS"], topic: str, type_name: str) -> None:
        watch = self.network.watch(kind, topic, type_name)
        self._undo.append(watch.close)
        self._watches.append(watch)
        self.check()

    @property
    def has_peer(self) -> bool:
        """Whether somebody is on the other side of any endpoint."""
        return any(watch.exists for watch in self._watches)

    def check(self) -> None:
        """Raise DeviceError if a topic has another type, or its other side is gone."""
        for watch in self._watches:
            problem = watch.problem()
            if problem is not None:
                raise DeviceError(problem)

    def close(self) -> None:
        """Undo the endpoints, the newest first."""
        while self._undo:
            self._undo.pop()()
