# SPDX-License-Identifier: Apache-2.0
"""Choose a port on a target of unknown shape by a click on a camera's image.

The browser reports a click by a request to the page's server, as viser has no event for it. Every
image that takes clicks has a key of its own beside the page's token, so that nothing but the page
that shows it can choose.
"""

from __future__ import annotations

import base64
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable
from html import escape
from http import HTTPStatus
from typing import Any, get_args
from urllib.parse import parse_qs

import cv2
import numpy as np
from chaserdock_protocol.messages import Image, PortKind, PortRequest
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import NDArray

from chaserdock.analysis.snapshot import annotated_image

NAME = "click"
"""Name of the address that takes clicks, below the token."""
_MOST = 32
"""Images that take clicks at a time. Smaller: with many tabs the first ones no longer do."""
_WIDTH_PX = 800
"""Width of the image in a dialog. Larger: a slower page; smaller: places are harder to hit."""
_STYLE = "width:100%;cursor:crosshair;display:block;margin-bottom:0.4em"
_MARK_RGB = (255, 176, 0)
"""Colour (0 to 255) of the mark: that of warnings, which stands out from grey images."""
_ASK = "Click the place where it is to dock, or let one be found."
_NO_IMAGE = "There is no image of this chaser yet."
SendPortRequest = Callable[[PortRequest, Callable[[str], None]], None]
"""Sends a request; its outcome is shown by the function."""


class ImageClicks:
    """Takes the clicks on images of the page: ``/TOKEN/click?image=KEY&x=SHARE&y=SHARE``.

    Called on the server's thread, which serves the page's web socket, too: functions that it calls
    must not wait.
    """

    def __init__(self, token: str) -> None:
        self._address = f"/{token}/{NAME}"
        self._lock = threading.Lock()
        self._taken: OrderedDict[str, Callable[[float, float], None]] = OrderedDict()

    def offer(self, clicked: Callable[[float, float], None]) -> str:
        """Return the key of an image; ``clicked`` gets the place as shares of width and height."""
        key = secrets.token_urlsafe(9)
        with self._lock:
            self._taken[key] = clicked
            while len(self._taken) > _MOST:
                self._taken.popitem(last=False)
        return key

    def withdraw(self, key: str) -> None:
        """Take no more clicks on an image."""
        with self._lock:
            self._taken.pop(key, None)

    def html_of(self, key: str, rgb: NDArray[np.uint8], alt: str) -> str:
        """Return HTML of an image that takes clicks."""
        _, data = cv2.imencode(".jpg", rgb[:, :, ::-1])
        script = (
            "const r=this.getBoundingClientRect();"
            f"fetch('{self._address}?image={key}"
            "&x='+(event.clientX-r.left)/r.width+'&y='+(event.clientY-r.top)/r.height)"
        )
        return (
            f'<img alt="{alt}" style="{_STYLE}" '
            f'src="data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}" '
            f'onclick="{script}">'
        )

    def __call__(self, query: str) -> tuple[HTTPStatus, str]:
        """Return status and HTML of a request."""
        given = parse_qs(query)
        try:
            (key,), (x,), (y,) = given["image"], given["x"], given["y"]
            place = float(x), float(y)
        except (KeyError, ValueError):
            return HTTPStatus.BAD_REQUEST, "<p>give image, x and y</p>"
        if not all(0.0 <= share <= 1.0 for share in place):
            return HTTPStatus.BAD_REQUEST, "<p>x and y are shares from 0 to 1</p>"
        with self._lock:
            clicked = self._taken.get(key)
        if clicked is None:
            return HTTPStatus.GONE, "<p>this image takes no clicks any more</p>"
        clicked(*place)
        return HTTPStatus.OK, "<p>taken</p>"


class PortDialogs:
    """Opens dialogs in which an operator chooses the port of a chaser."""

    def __init__(self, clicks: ImageClicks, send: SendPortRequest) -> None:
        self._clicks, self._send = clicks, send

    def open(
        self,
        gui: Any,
        scenario: FlightScenario,
        chaser: int,
        newest: Callable[[int], Image | None],
    ) -> None:
        """Open the dialog of a chaser. ``gui``: of the operator's tab. ``newest``: image of a
        chaser.
        """
        _PortDialog(gui, scenario, chaser, newest, self._clicks, self._send)


class _PortDialog:
    """One dialog. Its image stands still, so that it shows what was clicked."""

    def __init__(
        self,
        gui: Any,
        scenario: FlightScenario,
        chaser: int,
        newest: Callable[[int], Image | None],
        clicks: ImageClicks,
        send: SendPortRequest,
    ) -> None:
        self._scenario, self._chaser, self._newest = scenario, chaser, newest
        self._clicks, self._send = clicks, send
        self._key = ""
        names = tuple(f"chaser {i}" for i in range(len(scenario.chasers)))
        dialog = gui.add_modal(f"Port of chaser {chaser}")
        with dialog:
            self._reply = gui.add_markdown(_ASK)
            self._from = gui.add_dropdown("image of", names, initial_value=names[chaser])
            self._shown = gui.add_html("")
            find = gui.add_button_group("find", get_args(PortKind))
            again = gui.add_button("newest image")
            close = gui.add_button("close", color="gray")
        self._show()
        self._from.on_update(lambda _: self._show())
        again.on_click(lambda _: self._show())

        @find.on_click
        def _(event: Any) -> None:
            self._ask(PortRequest(chaser=chaser, find=event.target.value, operator="viewer"))

        @close.on_click
        def _(_: Any) -> None:
            self._clicks.withdraw(self._key)
            dialog.close()

    def _show(self) -> None:
        """Show the newest image of the chosen chaser."""
        self._clicks.withdraw(self._key)
        number = int(self._from.value.removeprefix("chaser "))
        image = self._newest(number)
        if image is None:
            self._shown.content = f"<p>{_NO_IMAGE}</p>"
            return
        try:
            drawn = annotated_image(self._scenario, image, None, _WIDTH_PX)
        except LogError as error:
            self._shown.content = f"<p>{escape(str(error))}</p>"
            return
        rgb = np.ascontiguousarray(drawn[:, :, ::-1])

        def clicked(x: float, y: float) -> None:
            """Ask for the port at a place; pixels count from the middle of the first one."""
            self._draw(rgb, number, (x, y))
            request = PortRequest(
                chaser=self._chaser,
                image=number,
                pixel=(
                    max(0.0, x * image.width_px - 0.5),
                    max(0.0, y * image.height_px - 0.5),
                ),
                exposed_ns=image.sim_time_ns,
                operator="viewer",
            )
            self._ask(request)

        self._key = self._clicks.offer(clicked)
        self._draw(rgb, number, None)

    def _draw(self, rgb: NDArray[np.uint8], number: int, at: tuple[float, float] | None) -> None:
        """Draw an image, with a mark at a place in shares of its size."""
        image = rgb.copy()
        if at is not None:
            place = round(at[0] * image.shape[1]), round(at[1] * image.shape[0])
            cv2.drawMarker(image, place, _MARK_RGB, cv2.MARKER_CROSS, 30, 2)
        self._shown.content = self._clicks.html_of(self._key, image, f"image of chaser {number}")

    def _ask(self, request: PortRequest) -> None:
        self._send(request, self._say)

    def _say(self, text: str) -> None:
        self._reply.content = text
