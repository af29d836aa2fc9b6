# SPDX-License-Identifier: Apache-2.0
"""Transport over Eclipse Zenoh: nodes, their configuration and access control."""

from .config import DEFAULT_ENDPOINT, DEFAULT_NAMESPACE, Link, RawSample, ReceivedMessage, Tls
from .node import MessageFilter, Node, TrafficCounters, TransportError

__all__ = [
    "DEFAULT_ENDPOINT",
    "DEFAULT_NAMESPACE",
    "Link",
    "MessageFilter",
    "Node",
    "RawSample",
    "ReceivedMessage",
    "Tls",
    "TrafficCounters",
    "TransportError",
]
