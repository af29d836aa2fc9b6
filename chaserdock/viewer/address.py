# SPDX-License-Identifier: Apache-2.0
"""Address of the viewer's page, and admission of connections. Imports no viser, since the launcher
uses it.
"""

from __future__ import annotations

import os
import re
import secrets
import socket
from collections.abc import Sequence
from hmac import compare_digest
from urllib.parse import urlsplit

from chaserdock_protocol.errors import ChaserdockError

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080
"""First TCP port that is tried: the usual one of local pages."""
_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_TRIES = 20
"""Number of ports that are tried. Larger: more viewers can run at once."""
TOKEN_VARIABLE = "CHASERDOCK_VIEWER_TOKEN"
"""Environment variable with the token of the page. Other users cannot read it, unlike an
argument.
"""


class ViewError(ChaserdockError):
    """The page cannot be served."""


def free_port(host: str, port: int | None) -> int:
    """Return ``port``, or without one the first free port from 8080 on. Raise ViewError."""
    first, reason = DEFAULT_PORT if port is None else port, ""
    for candidate in range(first, first + _TRIES if port is None else first + 1):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, candidate, type=socket.SOCK_STREAM
            )[0]
            with socket.socket(family, kind, protocol) as probe:
                # As in asyncio servers: a port with connections in TIME_WAIT is available.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                return int(probe.getsockname()[1])
        except OSError as error:
            reason = error.strerror or str(error)
            if isinstance(error, socket.gaierror) or "assign" in reason:
                raise ViewError(
                    f"--host {host}: {reason}; give an address of this machine"
                ) from None
    which = f"port {first}" if port is not None else f"ports {first} to {first + _TRIES - 1}"
    raise ViewError(f"{which} of {host}: {reason}; choose another with --port")


def page_token() -> str:
    """Return the token of the page: that of the environment, or else a random one. Raise
    ViewError.
    """
    token = os.environ.get(TOKEN_VARIABLE) or secrets.token_urlsafe(16)
    if not re.fullmatch(r"[A-Za-z0-9_-]{16,}", token):
        raise ViewError(f"{TOKEN_VARIABLE}: give at least 16 letters, digits, - or _")
    return token


def url_of(host: str, port: int, token: str) -> str:
    """Return the URL of the page for a browser on this machine."""
    shown = DEFAULT_HOST if host in ("0.0.0.0", "::") else host
    return (
        f"http://[{shown}]:{port}/{token}/" if ":" in shown else f"http://{shown}:{port}/{token}/"
    )


def path_below_token(path: str, token: str) -> str | None:
    """Return path and query of a request without the token in front; None without a valid token."""
    found = re.fullmatch(r"/?([^/?]*)(.*)", path, re.DOTALL)
    assert found is not None  # all parts are optional
    first, rest = found.groups()
    if not compare_digest(first.encode(errors="replace"), token.encode()):
        return None
    return rest if rest.startswith("/") else f"/{rest}"


def is_own_origin(origins: Sequence[str], requested_hosts: Sequence[str], host: str) -> bool:
    """Return whether a web socket is opened by the viewer's page (``Origin`` equals ``Host``) or by
    a program (no ``Origin``).

    ``origins``, ``requested_hosts``: values of these headers; a valid request has at most one and
    exactly one. On a loopback address ``Host`` must be a loopback name, which prevents DNS
    rebinding.
    """
    if len(origins) > 1 or len(requested_hosts) != 1:
        return False
    try:
        name = urlsplit(f"//{requested_hosts[0]}").hostname
        own = all(urlsplit(origin).netloc == requested_hosts[0] for origin in origins)
    except ValueError:  # malformed
        return False
    return own and (host not in _LOOPBACK or name in _LOOPBACK)
