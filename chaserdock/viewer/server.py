# SPDX-License-Identifier: Apache-2.0
"""Web server of the page: viser's, bound to one address, without public sharing, closed to pages of other origins."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator
from typing import Any

import viser
from viser import _messages as viser_messages

from .address import ViewError, free_port, may_connect


@contextlib.contextmanager
def page_server(host: str, port: int | None) -> Iterator[viser.ViserServer]:
    """Run a page server on ``host``; without a ``port``, on the first free one from 8080 on. Raise ViewError."""
    server = _open(host, port)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):  # suppress viser's message
            server.stop()


def _open(host: str, port: int | None) -> viser.ViserServer:
    chosen = free_port(host, port)
    # Requests other than a browser's are not errors of this process.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    # Suppress viser's message on standard output.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=chosen, verbose=False)
    if server.get_port() != chosen:
        server.stop()
        raise ViewError(f"port {chosen} of {host} has just been taken; try again or choose one with --port")
    _restrict_access(server, host)
    return server


def _restrict_access(server: viser.ViserServer, host: str) -> None:
    """Disable sharing over viser's public relay, and reject web sockets of pages of other origins.

    A browser lets any web site open a socket to this machine, which could then send commands. viser has no public
    option for either, so this uses internals of version 1.1; tests/chaserdock/test_viewer_page.py checks the effect.
    """
    inner: Any = server._websock_server
    for message in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
        inner.unregister_handler(message)

    async def admit(client: Any) -> None:
        connection = inner._live_connections[client.client_id]
        headers = connection.request.headers
        if not may_connect(headers.get("Origin"), headers.get("Host", ""), host):
            logging.getLogger(__name__).warning("rejected a page of origin %s", headers.get("Origin"))
            await connection.close(1008, "origin not allowed")

    inner.on_client_connect(admit)
