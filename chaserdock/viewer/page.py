# SPDX-License-Identifier: Apache-2.0
"""Panels of the page: state, commands, images, plots, events, and the timeline of a log."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import viser
from chaserdock_protocol.messages import Image
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import NDArray

from chaserdock.analysis.snapshot import annotated_image
from chaserdock.verdict import Verdict

from . import text
from .address import DEFAULT_HOST
from .history import History
from .plots import COLOURS, Plot, plots_of, points_of
from .port_dialog import PortDialogs
from .scene import VIEWS, SceneView
from .snapshot import OLD_S, MissionState

PERIOD_S = 0.1
"""Time (s) between two drawings: as long as a tick of 10 Hz."""
COMMANDS = ("approach", "hold", "retreat")
ABORT = "abort"
"""The command that must be confirmed."""
SendCommand = Callable[[str, int], None]

_IMAGE_PX = 400
"""Width (px) of each camera's image. Larger: more load of the browser."""
_ALL = "all cameras"
_ENLARGED_PX = 800
"""Width (px) when one camera is shown: that of two tiles."""
_SLOW_S = 0.5
"""Time (s) between two updates of text and plots. Smaller: they change too fast to be read."""
_IMAGES_S = 0.25
"""Time (s) between two updates of images. Smaller: smoother images, more load of the browser."""
_OLD_RGB = (255, 176, 0)
"""Colour of the age of an old image: that of warnings, on dark images."""
_LEFT_PX, _RIGHT_PX = 380, 370
"""Widths (px) of the panels. Larger: less of the scene on a screen of 1280 pixels."""
_STYLE = """<style>
.mantine-Paper-root td, .mantine-Paper-root th { padding: 0.1em 0.4em 0.1em 0; }
@media (max-width: 36em) {
  div:has(> .mantine-Paper-root[style*="max-height: 60%"]) { flex-direction: column; }
  div:has(> .mantine-Paper-root[style*="max-height: 60%"]) > div[style*="flex-grow: 1"] {
    height: auto !important; flex: 1 1 0; min-height: 0;
  }
  .mantine-Paper-root[style*="max-height: 60%"] {
    position: relative !important; width: 100% !important; max-height: 55% !important;
  }
  .mantine-Paper-root[style*="max-height: 60%"] div[style*="width: 20em"] {
    width: 100% !important;
  }
}
</style>"""
"""Space between the columns of tables. On a narrow screen: the panel of viser 1.1 below the scene,
not over its lower part. The width is that from which viser replaces its docks by one panel; a test
measures the places.
"""
_DECADES = [10.0**k for k in range(-3, 7)]
_GRID = {"stroke": "rgba(128,128,128,0.25)", "width": 1}


@dataclass(frozen=True)
class ViewOptions:
    """Address and content of the page. ``truth``: subscribe to ground truth and references if
    access rights allow it. ``folder``: where the running mission is recorded, if known.
    """

    host: str = DEFAULT_HOST
    port: int | None = None
    dark: bool = False
    truth: bool = True
    folder: Path | None = None


@dataclass
class Timeline:
    """Playback position of a log, written by the controls and read by the player."""

    end_s: float
    at_s: float = 0.0
    playing: bool = True
    speed: float = 1.0
    moved: bool = field(default=False, repr=False)
    """The user has moved the slider since the last step of the player."""


def _confirm_abort(gui: Any, chaser: int, command: SendCommand) -> None:
    """Ask for confirmation of an abort, then send the command."""
    dialog = gui.add_modal(f"Abort chaser {chaser}?")
    with dialog:
        gui.add_markdown(f"Chaser {chaser} leaves its task and flies away from the target.")
        confirm = gui.add_button(f"confirm: {ABORT} chaser {chaser}", color="red")
        cancel = gui.add_button("cancel", color="gray")

    @confirm.on_click
    def _(_: Any) -> None:
        dialog.close()
        command(ABORT, chaser)

    @cancel.on_click
    def _(_: Any) -> None:
        dialog.close()


SPEEDS = ("0.25", "0.5", "1", "2", "5", "10", "20")


class Page:
    """The page of one mission, shared by all tabs. ``command``: called on viser's threads; None for
    a page without buttons. ``ports``: dialogs to choose ports, of a target of unknown shape.
    ``report``: path of the report on the server, if there is one.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        scenario: FlightScenario,
        *,
        dark: bool,
        truth: bool,
        command: SendCommand | None,
        timeline: Timeline | None,
        report: str | None = None,
        ports: PortDialogs | None = None,
    ) -> None:
        self._server, self._scenario, self._report = server, scenario, report
        self._ports = ports if scenario.maps_target else None
        self._newest: tuple[Image | None, ...] = (None,) * len(scenario.chasers)
        self._timeline = timeline
        self._slider: Any = None
        self._drawn_s = -math.inf
        self._plotted_s = -math.inf
        self._images_s = -math.inf
        self._shown_images: dict[int, tuple[int, bool, int]] = {}
        server.scene.reset()
        server.gui.reset()
        self._theme(dark)
        server.gui.set_panel_label(f"chaserdock · {scenario.name}")
        with server.atomic():
            self._scene_view = SceneView(server, scenario)
            self._main_panel(dark, command)
            self._plots: list[tuple[Plot, Any]] = []
            self._left_panels(truth)
        server.flush()

    def _theme(self, dark: bool) -> None:
        self._server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, control_width="large"
        )

    # -- building ----------------------------------------------------------------------------------

    def _main_panel(self, dark: bool, command: SendCommand | None) -> None:
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_RIGHT_PX)
        gui.add_html(_STYLE)
        self._head = gui.add_markdown("waiting for the first tick")
        if self._timeline is not None:
            self._time_line(self._timeline)
        self._criteria = gui.add_markdown("")
        self._table = gui.add_markdown("")
        self._mass: Any = None
        if self._scenario.detumble.identification.enabled:
            with gui.add_folder("Mass properties"):
                self._mass = gui.add_markdown("")
        with gui.add_folder("Faults"):
            self._faults = gui.add_markdown("none")
        if command is not None:
            with gui.add_folder("Commands"):
                self._buttons(command)
        with gui.add_folder("Events"):
            self._events = gui.add_markdown("")
        with gui.add_folder("View", expand_by_default=False):
            self._view_options(dark)

    def _buttons(self, command: SendCommand) -> None:
        gui = self._server.gui
        self._reply = gui.add_markdown("")
        for i in range(len(self._scenario.chasers)):
            group = gui.add_button_group(f"chaser {i}", COMMANDS)

            @group.on_click
            def _(event: Any, chaser: int = i) -> None:
                command(event.target.value, chaser)

            if self._ports is not None:
                self._port_button(self._ports, i)
            stop = gui.add_button(f"{ABORT} chaser {i}", color="red")

            @stop.on_click
            def _(event: Any, chaser: int = i) -> None:
                # In the tab of the operator only.
                _confirm_abort((event.client or self._server).gui, chaser, command)

    def _port_button(self, ports: PortDialogs, chaser: int) -> None:
        button = self._server.gui.add_button(f"port chaser {chaser}")

        @button.on_click
        def _(event: Any) -> None:
            # In the tab of the operator only.
            gui = (event.client or self._server).gui
            ports.open(gui, self._scenario, chaser, lambda number: self._newest[number])

    def _time_line(self, line: Timeline) -> None:
        gui = self._server.gui
        with gui.add_folder("Time line"):
            self._slider = gui.add_slider(
                "time, s", min=0.0, max=max(0.1, round(line.end_s, 1)), step=0.1, initial_value=0.0
            )
            play = gui.add_button_group("", ("play", "pause", "to start"))
            speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # the user, not the player
                line.at_s, line.moved = float(event.target.value), True

        @play.on_click
        def _(event: Any) -> None:
            if event.target.value == "to start":  # keeps playing or pausing
                line.at_s, line.moved = 0.0, True
            else:
                line.playing = event.target.value == "play"

        @speed.on_update
        def _(event: Any) -> None:
            line.speed = float(event.target.value)

    def _view_options(self, dark: bool) -> None:
        gui, scene_view = self._server.gui, self._scene_view
        frame = gui.add_dropdown("fixed frame", VIEWS, initial_value=VIEWS[0])
        toggles: tuple[tuple[str, Callable[[bool], None], bool], ...] = (
            ("corridors", scene_view.show_corridors, True),
            ("keep-out", scene_view.show_keep_out, False),
            ("camera views", scene_view.show_views, True),
            ("scale", scene_view.show_scale, True),
        )
        for name, show, at_first in toggles:
            box = gui.add_checkbox(name, at_first)

            @box.on_update
            def _(event: Any, show: Callable[[bool], None] = show) -> None:
                show(bool(event.target.value))

        darkness = gui.add_checkbox("dark", dark)

        @frame.on_update
        def _(event: Any) -> None:
            scene_view.view = event.target.value

        @darkness.on_update
        def _(event: Any) -> None:
            self._theme(bool(event.target.value))

    def _left_panels(self, truth: bool) -> None:
        gui, scenario = self._server.gui, self._scenario
        images, plots = gui.add_panel(), gui.add_panel()
        images.dock_left()
        images.set_width(_LEFT_PX)
        number, camera = len(scenario.chasers), scenario.camera_model()
        self._columns = 1 if number == 1 else 2 if number <= 8 else 3
        self._tile = (round(_IMAGE_PX * camera.height_px / camera.width_px), _IMAGE_PX)
        rows = -(-number // self._columns)
        self._mosaic = np.full(
            (rows * self._tile[0], self._columns * self._tile[1], 3), 60, np.uint8
        )
        with images.add_tab("Cameras"):
            self._enlarged: int | None = None
            if number > 1:
                names = (_ALL, *(f"chaser {i}" for i in range(number)))
                shown = gui.add_dropdown("show", names, initial_value=_ALL)

                @shown.on_update
                def _(event: Any) -> None:
                    value = event.target.value
                    self._enlarged = None if value == _ALL else int(value.removeprefix("chaser "))
                    self._shown_images.clear()

            self._images = gui.add_image(self._mosaic, format="jpeg", jpeg_quality=70)
        plots.dock_below(images)
        with plots.add_tab("Plots"):
            ports = [i for i in range(number) if scenario.docking.port_of(i) is not None]
            identified = scenario.detumble.identification.enabled
            for plot in plots_of(number, truth, ports, identified):
                self._plots.append((plot, self._chart(plot)))

    def _chart(self, plot: Plot) -> Any:
        nothing = points_of(plot, History(0), 0.0, 0.0)
        scales: dict[str, Any] = {"x": {"time": False}}
        y_axis: dict[str, Any] = {"grid": _GRID, "size": 55}
        if plot.least is not None:
            scales["y"] = {"distr": 3}  # logarithmic, with a line at each power of ten
            y_axis |= {"splits": _DECADES, "space": 8, "ticks": {"show": False}}
        curves = [
            {
                "label": label,
                "stroke": colour,
                "width": 1.5,
                "points": {"show": False},
                "dash": [6, 4] if chaser is not None and chaser >= len(COLOURS) else [],
            }
            for label, colour, _, chaser in plot.curves
        ]
        return self._server.gui.add_uplot(
            nothing,
            ({"label": "time, s"}, *curves),  # type: ignore[arg-type]
            title=plot.title,
            legend={"show": True, "live": False},
            scales=scales,
            axes=({"grid": _GRID}, y_axis),  # type: ignore[arg-type]
            height=130,
            padding=(8, 12, 0, 0),
        )

    # -- drawing -----------------------------------------------------------------------------------

    @property
    def watched(self) -> bool:
        """Return whether a browser is connected."""
        return bool(self._server.get_clients())

    def show_reply(self, text: str) -> None:
        """Show the outcome of a command."""
        self._reply.content = text

    def draw(
        self,
        state: MissionState,
        history: History,
        mode: str,
        speed: float | None,
        lost: set[str],
        verdict: Verdict | None = None,
    ) -> None:
        """Draw the scene and the images; text and plots twice per second only. ``verdict``: of a
        log that has been judged.
        """
        slow = time.monotonic() - self._drawn_s >= _SLOW_S
        self._newest = tuple(chaser.image for chaser in state.chasers)
        with self._server.atomic():
            self._scene_view.draw(state, history, slow)
            if self._slider is not None:
                self._slider.value = round(state.time_s(), 1)
            if slow:
                self._drawn_s = time.monotonic()
                self._write(state, history, mode, speed, lost, verdict)
        self._draw_image(state)

    def _write(
        self,
        state: MissionState,
        history: History,
        mode: str,
        speed: float | None,
        lost: set[str],
        verdict: Verdict | None,
    ) -> None:
        mass = (
            ()
            if self._mass is None
            else ((self._mass, text.mass_properties(self._scenario, state)),)
        )
        for element, content in (
            *mass,
            (self._head, text.head(self._scenario, state, mode, speed, verdict, self._report)),
            (self._criteria, text.criteria(verdict)),
            (self._table, text.chasers(state, history)),
            (self._faults, text.faults(state, history, lost)),
            (
                self._events,
                text.events(history.lines_until(state.time_s(), 200), 12, history.begins_s),
            ),
        ):
            if element.content != content:
                element.content = content
        if state.time_s() != self._plotted_s:
            self._plotted_s = state.time_s()
            for plot, chart in self._plots:
                chart.data = points_of(plot, history, 0.0, state.time_s())

    def _draw_image(self, state: MissionState) -> None:
        """Draw the images that have changed, all at once, so that the tiles show the same
        moment.
        """
        if time.monotonic() - self._images_s < _IMAGES_S:
            return
        enlarged, changed = self._enlarged, False
        images = state.images_of_one_moment()
        for i in range(len(state.chasers)) if enlarged is None else (enlarged,):
            image = images[i]
            if image is None:
                continue
            sighting = state.chasers[i].sighting_in(image)
            age_s = state.time_s() - image.sim_time_ns / 1e9
            version = (image.sim_time_ns, sighting is not None, math.floor(max(0.0, age_s) / OLD_S))
            if self._shown_images.get(i) == version:
                continue
            self._shown_images[i], changed = version, True
            if enlarged is not None:
                self._images.image = self._image(image, sighting, _ENLARGED_PX, age_s)
                continue
            row, column = (i // self._columns) * self._tile[0], (i % self._columns) * self._tile[1]
            place = np.s_[row : row + self._tile[0], column : column + self._tile[1]]
            self._mosaic[place] = self._image(image, sighting, _IMAGE_PX, age_s)
        if changed:
            self._images_s = time.monotonic()
            if enlarged is None:
                self._images.image = self._mosaic

    def _image(self, image: Image, sighting: Any, width_px: int, age_s: float) -> Any:
        """Return an RGB image of this width, dimmed with its age if it is old; black for an
        unreadable image.
        """
        size_px = (width_px, round(width_px * self._tile[0] / self._tile[1]))
        try:
            drawn = annotated_image(self._scenario, image, sighting, width_px)[:, :, ::-1]
        except LogError:
            drawn = np.zeros((*size_px[::-1], 3), np.uint8)
        fitting = drawn if drawn.shape[1::-1] == size_px else cv2.resize(drawn, size_px)
        return with_age(np.asarray(fitting, np.uint8), age_s) if age_s > OLD_S else fitting


def with_age(image: NDArray[np.uint8], age_s: float) -> NDArray[np.uint8]:
    """Return an RGB image at half brightness, with its age across the bottom."""
    old: Any = image // 2
    text = f"{age_s:.0f} s old"
    place = (8, image.shape[0] - 10)
    cv2.putText(old, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, _OLD_RGB, 2, cv2.LINE_AA)
    return np.asarray(old, dtype=np.uint8)
