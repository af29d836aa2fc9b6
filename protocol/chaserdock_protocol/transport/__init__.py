# SPDX-License-Identifier: Apache-2.0
"""Transport over Eclipse Zenoh: nodes, their configuration and access control."""

from .config import (
    DEFAULT_ENDPOINT,
    DEFAULT_NAMESPACE,
    Link,
    NoRouterError,
    ReceivedMessage,
    Tls,
    TransportError,
)
from .network import RawSample
from .node import MessageFilter, Node, TrafficCounters

__all__ = [
    "DEFAULT_ENDPOINT",
    "DEFAULT_NAMESPACE",
    "Link",
    "MessageFilter",
    "NoRouterError",
    "Node",
    "RawSample",
    "ReceivedMessage",
    "Tls",
    "TrafficCounters",
    "TransportError",
]
