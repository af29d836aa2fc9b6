"""The page's web server: viser's, bound to one address, with no way to the internet and no other site's page let in."""

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
    """A page server on ``host``; without a ``port``, on the first free one from 8080 on. Raises ViewError."""
    server = _open(host, port)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):  # its farewell
            server.stop()


def _open(host: str, port: int | None) -> viser.ViserServer:
    chosen = free_port(host, port)
    # Whoever knocks with something else than a browser's request is no error of ours.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    # Its greeting on standard output is not ours.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=chosen, verbose=False)
    if server.get_port() != chosen:
        server.stop()
        raise ViewError(f"port {chosen} of {host} was taken just now; try again, or choose one with --port")
    _keep_in_house(server, host)
    return server


def _keep_in_house(server: viser.ViserServer, host: str) -> None:
    """No sharing over viser's public relay, and no page of another origin on the web socket.

    A browser lets any web site open a socket to this machine: without the second, one could press our buttons. viser
    has no public switch for either, so this reaches into version 1.1; tests/test_view_page.py holds it.
    """
    inner: Any = server._websock_server
    for message in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
        inner.unregister_handler(message)

    async def admit(client: Any) -> None:
        connection = inner._live_connections[client.client_id]
        headers = connection.request.headers
        if not may_connect(headers.get("Origin"), headers.get("Host", ""), host):
            logging.getLogger(__name__).warning("refused a page of %s", headers.get("Origin"))
            await connection.close(1008, "foreign page")

    inner.on_client_connect(admit)
