# SPDX-License-Identifier: Apache-2.0
"""Shows overlays in a web browser: a page of this machine with a stream of JPEG images."""

from __future__ import annotations

import json
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chaserdock.viewer.address import (
    DEFAULT_HOST,
    free_port,
    page_token,
    path_below_token,
    url_of,
)

_PAGE = Path(__file__).with_name("live_page.html")
_BOUNDARY = "image"
_JPEG_QUALITY = 80
"""Quality of the streamed images: fine lines of the overlay stay clear."""
_WAIT_S = 1.0
"""Time after which a stream without a new image looks whether the page has closed."""


class LivePage:
    """A page with the newest overlay. ``url``: its address, which contains a secret token."""

    def __init__(self, port: int | None = None) -> None:
        self._token = page_token()
        self._changed = threading.Condition()
        self._image: NDArray[np.uint8] | None = None
        self._lines: list[str] = []
        self._number, self._closed = 0, False
        chosen = free_port(DEFAULT_HOST, port)
        self._server = ThreadingHTTPServer((DEFAULT_HOST, chosen), self._handler())
        self._server.daemon_threads = True
        self.url = url_of(DEFAULT_HOST, chosen, self._token)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def show(self, image: NDArray[np.uint8], lines: list[str]) -> None:
        """Replace the shown BGR image, and the lines of text below it."""
        with self._changed:
            self._image, self._lines = image, lines
            self._number += 1
            self._changed.notify_all()

    def close(self) -> None:
        """End the server and its streams."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def _next(self, after: int) -> tuple[int, NDArray[np.uint8] | None]:
        """Return number and image of the first one after a number, or None in its place."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > after or self._closed, _WAIT_S)
            return self._number, self._image if self._number > after else None

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:  # the name that the standard library calls
                path = path_below_token(self.path, page._token)
                if path == "/":
                    self._send("text/html; charset=utf-8", _PAGE.read_bytes())
                elif path == "/status":
                    self._send("application/json", json.dumps(page._lines).encode())
                elif path == "/stream":
                    self._stream()
                elif path is None:
                    text = (
                        "The address needs its token: open the one that chaserdock has printed.\n"
                    )
                    self._send("text/plain", text.encode(), HTTPStatus.FORBIDDEN)
                else:
                    self._send("text/plain", b"not found\n", HTTPStatus.NOT_FOUND)

            def _send(self, kind: str, body: bytes, status: HTTPStatus = HTTPStatus.OK) -> None:
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(body)

            def _stream(self) -> None:
                self.send_response(HTTPStatus.OK)
                self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                number = 0
                try:
                    while not page._closed:
                        number, image = page._next(number)
                        if image is not None:
                            self.wfile.write(_part(image))
                except OSError:
                    pass  # the browser has closed the page

            def log_message(self, format: str, *args: Any) -> None:
                """Print nothing: the terminal shows poses."""

        return Handler


def _part(image: NDArray[np.uint8]) -> bytes:
    """Return a part of the stream."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
    head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
    return head.encode() + data + b"\r\n"
