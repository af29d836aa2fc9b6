"""Where the viewer's page is served, and who may come in. No browser here, and no viser: a launcher asks, too."""

from __future__ import annotations

import socket
from urllib.parse import urlsplit

from chaserdock_protocol.errors import ChaserdockError

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080
_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_TRIES = 20


class ViewError(ChaserdockError):
    """The page cannot be served; one clear line."""


def free_port(host: str, port: int | None) -> int:
    """``port``, or without one the first from 8080 on that nobody listens on. Raises ViewError."""
    first, reason = DEFAULT_PORT if port is None else port, ""
    for candidate in range(first, first + _TRIES if port is None else first + 1):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[
                0
            ]
            with socket.socket(family, kind, protocol) as probe:
                # As asyncio's servers do: a port whose last connections are just closing can be had.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                return int(probe.getsockname()[1])
        except OSError as error:
            reason = error.strerror or str(error)
            if isinstance(error, socket.gaierror) or "assign" in reason:
                raise ViewError(f"--host {host}: {reason}; give an address of this machine") from None
    which = f"port {first}" if port is not None else f"ports {first} to {first + _TRIES - 1}"
    raise ViewError(f"{which} of {host}: {reason}; choose another with --port")


def url_of(host: str, port: int) -> str:
    """Where a browser on this machine finds the page."""
    shown = DEFAULT_HOST if host in ("0.0.0.0", "::") else host
    return f"http://[{shown}]:{port}" if ":" in shown else f"http://{shown}:{port}"


def may_connect(origin: str | None, asked: str, host: str) -> bool:
    """Whether a web socket may be opened: from our own page (``Origin`` is the ``Host`` that was asked), or from a
    program (which sends no ``Origin``). On the loopback the host's name must be the loopback's, too: another name that
    leads here is somebody's trick (DNS rebinding)."""
    name = urlsplit(f"//{asked}").hostname
    if host in _LOOPBACK and name not in _LOOPBACK:
        return False
    return origin is None or urlsplit(origin).netloc == asked
