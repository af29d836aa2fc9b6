# SPDX-License-Identifier: Apache-2.0
"""A port is chosen by a click on an image of the viewer's page, with the rights of the command."""

from __future__ import annotations

import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import chromium, open_page, why_no_browser
from chaserdock_protocol import topics
from chaserdock_protocol.messages import CommandReply, Image, OperatorCommand, PortRequest
from chaserdock_protocol.scenario import flight_scenario, parse_scenario
from chaserdock_protocol.transport import Node
from mission_keys import PATIENCE_S, client, make_keys, router_with_rights
from unknown_cases import UNKNOWN, foil, ring_image

from chaserdock.launch.reach import TO_CHOOSE_PORTS, TO_COMMAND
from chaserdock.viewer.address import DEFAULT_HOST
from chaserdock.viewer.history import History
from chaserdock.viewer.live import Order, outcome_of
from chaserdock.viewer.page import Page
from chaserdock.viewer.port_dialog import NAME, ImageClicks, PortDialogs
from chaserdock.viewer.server import page_server
from chaserdock.viewer.snapshot import MissionState

TOKEN = "0123456789abcdefghijkl"
SCENARIO = flight_scenario(parse_scenario(UNKNOWN, "unknown"))
EXPOSED_NS = 1_200_000_000
needs_browser = pytest.mark.skipif(bool(why_no_browser()), reason=why_no_browser())


# -- clicks ----------------------------------------------------------------------------------------


def status_of(url: str) -> int:
    try:
        with urllib.request.urlopen(url) as response:
            return int(response.status)
    except urllib.error.HTTPError as error:
        error.close()
        return error.code


def test_clicks_are_taken_for_the_image_that_is_open_and_below_the_token() -> None:
    taken: list[tuple[float, float]] = []
    clicks = ImageClicks(TOKEN)
    key = clicks.offer(lambda x, y: taken.append((x, y)))
    with page_server(DEFAULT_HOST, None, TOKEN, {NAME: clicks}) as server:
        base = f"http://127.0.0.1:{server.get_port()}"
        place = f"image={key}&x=0.25&y=1"
        assert status_of(f"{base}/{TOKEN}/{NAME}?{place}") == 200
        assert status_of(f"{base}/{NAME}?{place}") != 200
        assert status_of(f"{base}/{TOKEN[::-1]}/{NAME}?{place}") != 200
        for query in (f"image={key}&x=0.25", f"image={key}&x=a&y=1", f"{place}&x=0.5", ""):
            assert status_of(f"{base}/{TOKEN}/{NAME}?{query}") == 400, query
        for query in (f"image={key}&x=1.01&y=0", f"image={key}&x=nan&y=0"):
            assert status_of(f"{base}/{TOKEN}/{NAME}?{query}") == 400, query
        assert status_of(f"{base}/{TOKEN}/{NAME}?image=other&x=0&y=0") == 410
        clicks.withdraw(key)
        assert status_of(f"{base}/{TOKEN}/{NAME}?{place}") == 410
    assert taken == [(0.25, 1.0)]


def test_images_that_nobody_closes_are_bounded() -> None:
    clicks = ImageClicks(TOKEN)
    keys = [clicks.offer(lambda x, y: None) for _ in range(100)]
    assert len(set(keys)) == 100
    assert clicks(f"image={keys[0]}&x=0&y=0")[0] == 410
    assert clicks(f"image={keys[-1]}&x=0&y=0")[0] == 200


# -- the dialog ------------------------------------------------------------------------------------


@contextmanager
def page_with_images(sent: list[PortRequest], reply: str) -> Iterator[str]:
    """The address of a page of two chasers whose cameras see a ring."""

    def send(request: PortRequest, show: Callable[[str], None]) -> None:
        sent.append(request)
        show(reply)

    clicks = ImageClicks(TOKEN)
    with page_server(DEFAULT_HOST, None, TOKEN, {NAME: clicks}) as server:
        page = Page(
            server,
            SCENARIO,
            dark=False,
            truth=False,
            command=lambda what, chaser: None,
            timeline=None,
            ports=PortDialogs(clicks, send),
        )
        state = MissionState.empty(2)
        data = cv2.imencode(".jpg", ring_image(foil()))[1].tobytes()
        for i in range(2):
            shown = Image(
                chaser=i,
                sim_time_ns=EXPOSED_NS + i,
                width_px=960,
                height_px=540,
                encoding="jpeg",
                data=data,
            )
            state.update(topics.IMAGE, shown)
        page.draw(state, History(2), "lockstep", None, set())
        yield f"http://127.0.0.1:{server.get_port()}/{TOKEN}"


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_a_click_on_an_image_asks_for_the_port_there(
    width: int, height: int, tmp_path: Path
) -> None:
    sent: list[PortRequest] = []
    reply = "✓ port chaser 1 (by viewer): accepted, flat"
    with page_with_images(sent, reply) as url, chromium() as browser:
        page = open_page(browser, url, width, height)
        page.get_by_role("button", name="port chaser 1").click()
        image = page.get_by_role("img", name="image of chaser 1")
        image.wait_for()
        box = image.bounding_box()
        assert box is not None
        assert box["x"] >= 0.0
        assert box["x"] + box["width"] <= width
        assert box["width"] > 0.6 * min(width, 480)
        assert box["width"] / box["height"] == pytest.approx(960 / 540, rel=0.02)
        image.click(position={"x": 0.25 * box["width"], "y": 0.75 * box["height"]})
        page.locator("text=/accepted, flat/").first.wait_for()
        page.screenshot(path=tmp_path / "dialog.png")
        (request,) = sent
        assert (request.chaser, request.image, request.operator) == (1, 1, "viewer")
        assert request.exposed_ns == EXPOSED_NS + 1
        assert request.pixel is not None
        pixel_px = 960.0 / box["width"]
        assert np.abs(np.subtract(request.pixel, (239.5, 404.5))).max() <= 1.1 * pixel_px
        page.get_by_role("button", name="ring").click()
        page.get_by_role("button", name="close").click()
        image.wait_for(state="detached")
    assert sent[1] == PortRequest(chaser=1, find="ring", operator="viewer")


@needs_browser
@pytest.mark.slow
def test_the_image_of_another_chaser_can_be_clicked() -> None:
    sent: list[PortRequest] = []
    reply = "⚠ port chaser 0 (by viewer): refused, not flat"
    with page_with_images(sent, reply) as url, chromium() as browser:
        page = open_page(browser, url)
        page.get_by_role("button", name="port chaser 0").click()
        page.get_by_role("img", name="image of chaser 0").wait_for()
        page.locator(".mantine-Modal-content input").first.click()
        page.get_by_role("option", name="chaser 1").click()
        page.get_by_role("img", name="image of chaser 1").click()
        page.locator("text=/refused, not flat/").first.wait_for()
    (request,) = sent
    assert (request.chaser, request.image, request.exposed_ns) == (0, 1, EXPOSED_NS + 1)


# -- rights ----------------------------------------------------------------------------------------


def test_a_port_needs_the_rights_of_the_command(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    request = PortRequest(chaser=0, find="flat", operator="viewer")
    order = Order("port", TO_CHOOSE_PORTS, "mapper", request, print)
    with router_with_rights(keys) as endpoint:
        mapper = Node("mapper", "mapper", client(keys, "mapper", endpoint))
        reply = CommandReply(
            command="port", chaser=0, accepted=True, reason="flat", operator="viewer"
        )
        mapper.declare_queryable(topics.PORT_KEY, PortRequest, lambda _, answer: answer(reply))
        link = client(keys, "viewer", endpoint)
        viewer = Node("viewer", "viewer", link)
        deadline = time.monotonic() + PATIENCE_S
        said = outcome_of(order, link, viewer)
        while "no reply" in said and time.monotonic() < deadline:  # not connected yet
            said = outcome_of(order, link, viewer)
        assert said == "✓ port chaser 0 (by viewer): accepted, flat"
        recorder = client(keys, "recorder", endpoint)
        for node in (viewer, mapper):
            node.close()
    denied = outcome_of(order, recorder, viewer)  # before anything is sent
    assert denied.startswith("⚠ port chaser 0: --keys")
    assert denied.endswith("the keys of recorder; port needs those of operator or viewer or bridge")
    hold = OperatorCommand(command="hold", chaser=0, operator="viewer")
    other = outcome_of(Order("hold", TO_COMMAND, "controller", hold, print), recorder, viewer)
    assert "hold needs those of operator or viewer or bridge" in other
