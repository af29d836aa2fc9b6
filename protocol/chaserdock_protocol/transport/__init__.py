"""Transport over Eclipse Zenoh: nodes, their configuration and access control."""

from .config import DEFAULT_ENDPOINT, DEFAULT_NAMESPACE, Link, Raw, Received, Tls
from .node import Counts, Node, TransportError

__all__ = [
    "DEFAULT_ENDPOINT",
    "DEFAULT_NAMESPACE",
    "Counts",
    "Link",
    "Node",
    "Raw",
    "Received",
    "Tls",
    "TransportError",
]
