# SPDX-License-Identifier: Apache-2.0
"""Web server of the page: viser's, bound to one address, without public sharing. It rejects pages
of other origins and programs without the page's token.
"""

from __future__ import annotations

import contextlib
import dataclasses
import http
import io
import logging
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import viser
import websockets.asyncio.server
from viser import _messages as viser_messages
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from .address import ViewError, free_port, is_own_origin, path_below_token

_RequestHandler = Callable[[ServerConnection, Request], Response | None]
Documents = Mapping[str, Callable[[str], tuple[http.HTTPStatus, str]]]
"""Pages beside viser's by name: functions that return status and HTML of a query at once."""


@contextlib.contextmanager
def page_server(
    host: str, port: int | None, token: str, documents: Documents | None = None
) -> Iterator[viser.ViserServer]:
    """Run a page server on ``host``, on ``port`` or the first free one from ``DEFAULT_PORT`` on.
    Raise ViewError.

    ``token``: first path segment of the page, of its web socket and of the ``documents``, which are
    rejected without it.
    """
    server = _open(host, port, token, documents or {})
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):  # suppress viser's message
            server.stop()


def _open(host: str, port: int | None, token: str, documents: Documents) -> viser.ViserServer:
    chosen = free_port(host, port)
    # Requests of other programs than a browser are not errors of this process.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    # Suppress viser's message on standard output.
    with contextlib.redirect_stdout(io.StringIO()), _checked_requests(host, token, documents):
        server = viser.ViserServer(host=host, port=chosen, verbose=False)
    if server.get_port() != chosen:
        server.stop()
        raise ViewError(
            f"port {chosen} of {host} has just been taken; try again or choose one with --port"
        )
    _disable_sharing(server)
    return server


def _disable_sharing(server: viser.ViserServer) -> None:
    """Disable sharing over viser's public relay. viser 1.1 has no public option for it."""
    inner: Any = server._websock_server
    for message in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
        inner.unregister_handler(message)


@contextlib.contextmanager
def _checked_requests(host: str, token: str, documents: Documents) -> Iterator[None]:
    """Make a viser server that starts meanwhile check every request before it accepts a web socket.

    A browser lets any web site open a socket to this machine, which could then send commands. viser
    has no option for this check; its callback for a new client comes after the handshake, when
    frames may already be buffered. This therefore replaces the function that starts its server;
    tests/chaserdock/test_viewer.py checks the effect.
    """

    def serve_checked(*args: Any, process_request: _RequestHandler, **options: Any) -> serve:
        check = request_check(process_request, host, token, documents)
        return serve(*args, process_request=check, **options)

    websockets.asyncio.server.serve = serve_checked
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve


def _html(status: http.HTTPStatus, text: str) -> Response:
    body = text.encode()
    headers = Headers()
    headers["Content-Type"] = "text/html; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Cache-Control"] = "no-store"
    return Response(status, status.phrase, headers, body)


def request_check(
    respond: _RequestHandler, host: str, token: str, documents: Documents
) -> _RequestHandler:
    """Return ``respond`` restricted to requests with the token and, for web sockets, of the page's
    own origin; with the token, the ``documents``, too.

    ``respond`` returns None to accept a web socket. The files of viser's client are public.
    """

    def check(connection: ServerConnection, request: Request) -> Response | None:
        path = path_below_token(request.path, token)
        response = respond(connection, dataclasses.replace(request, path=path or request.path))
        name, _, query = (path or "").removeprefix("/").partition("?")
        if response is not None and name in documents:
            return _html(*documents[name](query))
        if response is None:
            origins = request.headers.get_all("Origin")
            if not is_own_origin(origins, request.headers.get_all("Host"), host):
                logging.getLogger(__name__).warning(
                    "rejected a page of origin %s", ", ".join(origins)
                )
                return connection.respond(http.HTTPStatus.FORBIDDEN, "origin not allowed\n")
        if path is None and (response is None or request.path.partition("?")[0] == "/"):
            return connection.respond(
                http.HTTPStatus.FORBIDDEN,
                "The address needs its token: open the one that chaserdock has printed.\n",
            )
        return response

    return check
