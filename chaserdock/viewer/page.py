"""The page round the scene: state, commands, images, plots, what happened, and a time line on a log."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import viser
from chaserdock_protocol.messages import Image
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.scenario import Scenario

from chaserdock.analysis.snapshot import annotated_image

from . import text as words
from .history import History
from .plots import Plot, plots_of, points_of
from .scene import VIEWS, Stage
from .snapshot import Now

COMMANDS = ("approach", "hold", "retreat", "abort")
Command = Callable[[str, int], None]

_IMAGE_PX = 400
_SLOW_S = 0.5
_IMAGES_S = 0.25
_GRID = {"stroke": "rgba(128,128,128,0.25)", "width": 1}
_COLOURS = {"approach": "green", "hold": "blue", "retreat": "orange", "abort": "red"}


@dataclass
class TimeLine:
    """Where a log is looked at; the buttons write it, the player reads it."""

    end_s: float
    at_s: float = 0.0
    playing: bool = True
    speed: float = 1.0
    moved: bool = field(default=False, repr=False)
    """The slider was moved by a person since the player looked."""


SPEEDS = ("0.25", "0.5", "1", "2", "5", "10", "20")


class Page:
    """One mission's page on a server, for all tabs alike. ``command`` is called on viser's threads; None: no buttons."""

    def __init__(
        self,
        server: viser.ViserServer,
        scenario: Scenario,
        *,
        dark: bool,
        truth: bool,
        command: Command | None,
        timeline: TimeLine | None,
    ) -> None:
        self._server, self._scenario = server, scenario
        self._timeline = timeline
        self._slider: Any = None
        self._drawn_s = -math.inf
        self._plotted_s = -math.inf
        self._images_s = -math.inf
        self._image_waits = False
        self._shown_images: dict[int, tuple[int, bool]] = {}
        self._next_image = 0
        server.scene.reset()
        server.gui.reset()
        self._theme(dark)
        server.gui.set_panel_label(f"chaserdock · {scenario.name}")
        with server.atomic():
            self._stage = Stage(server, scenario)
            self._main_panel(dark, command)
            self._plots: list[tuple[Plot, Any]] = []
            self._left_panels(truth)
        server.flush()

    def _theme(self, dark: bool) -> None:
        self._server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, control_width="large"
        )

    # -- building -----------------------------------------------------------------------------------------

    def _main_panel(self, dark: bool, command: Command | None) -> None:
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(400)
        self._head = gui.add_markdown("waiting for the first tick")
        if self._timeline is not None:
            self._time_line(self._timeline)
        self._table = gui.add_markdown("")
        with gui.add_folder("Faults"):
            self._faults = gui.add_markdown("none")
        if command is not None:
            with gui.add_folder("Commands"):
                self._buttons(command)
        with gui.add_folder("What happened"):
            self._events = gui.add_markdown("")
        with gui.add_folder("View", expand_by_default=False):
            self._view_options(dark)

    def _buttons(self, command: Command) -> None:
        gui = self._server.gui
        self._answer = gui.add_markdown("")
        for i in range(len(self._scenario.chasers)):
            group = gui.add_button_group(f"chaser {i}", COMMANDS)

            @group.on_click
            def _(event: Any, chaser: int = i) -> None:
                command(event.target.value, chaser)

    def _time_line(self, line: TimeLine) -> None:
        gui = self._server.gui
        with gui.add_folder("Time line"):
            self._slider = gui.add_slider(
                "time, s", min=0.0, max=max(0.1, round(line.end_s, 1)), step=0.1, initial_value=0.0
            )
            play = gui.add_button_group("", ("play", "pause", "to start"))
            speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # a person, not the player
                line.at_s, line.moved = float(event.target.value), True

        @play.on_click
        def _(event: Any) -> None:
            if event.target.value == "to start":  # playing or not, as it was
                line.at_s, line.moved = 0.0, True
            else:
                line.playing = event.target.value == "play"

        @speed.on_update
        def _(event: Any) -> None:
            line.speed = float(event.target.value)

    def _view_options(self, dark: bool) -> None:
        gui, stage = self._server.gui, self._stage
        stands = gui.add_dropdown("stands still", VIEWS, initial_value=VIEWS[0])
        toggles: tuple[tuple[str, Callable[[bool], None]], ...] = (
            ("corridors", stage.show_corridors),
            ("keep-out", stage.show_keep_out),
            ("camera views", stage.show_views),
        )
        for name, show in toggles:
            box = gui.add_checkbox(name, True)

            @box.on_update
            def _(event: Any, show: Callable[[bool], None] = show) -> None:
                show(bool(event.target.value))

        darkness = gui.add_checkbox("dark", dark)

        @stands.on_update
        def _(event: Any) -> None:
            stage.view = event.target.value

        @darkness.on_update
        def _(event: Any) -> None:
            self._theme(bool(event.target.value))

    def _left_panels(self, truth: bool) -> None:
        gui, scenario = self._server.gui, self._scenario
        images, plots = gui.add_panel(), gui.add_panel()
        images.dock_left()
        images.set_width(360)
        number, camera = len(scenario.chasers), scenario.camera_model()
        self._columns = 1 if number == 1 else 2 if number <= 8 else 3
        self._tile = (round(_IMAGE_PX * camera.height_px / camera.width_px), _IMAGE_PX)
        rows = -(-number // self._columns)
        self._mosaic = np.full((rows * self._tile[0], self._columns * self._tile[1], 3), 60, np.uint8)
        with images.add_tab("Cameras"):
            self._images = gui.add_image(self._mosaic, format="jpeg", jpeg_quality=70)
        plots.dock_below(images)
        with plots.add_tab("Plots"):
            for plot in plots_of(len(scenario.chasers), truth):
                self._plots.append((plot, self._chart(plot)))

    def _chart(self, plot: Plot) -> Any:
        nothing = tuple(np.zeros(2) for _ in range(len(plot.curves) + 1))
        curves = [
            {"label": label, "stroke": colour, "width": 1.5, "points": {"show": False}}
            for label, colour, _, _ in plot.curves
        ]
        return self._server.gui.add_uplot(
            nothing,
            ({"label": "s"}, *curves),  # type: ignore[arg-type]
            title=plot.title,
            scales={"x": {"time": False}},
            axes=({"grid": _GRID}, {"grid": _GRID, "size": 55}),  # type: ignore[arg-type]
            height=130,
            padding=(8, 12, 0, 0),
        )

    # -- drawing ------------------------------------------------------------------------------------------

    @property
    def watched(self) -> bool:
        """Whether any browser looks."""
        return bool(self._server.get_clients())

    def answer(self, text: str) -> None:
        """What came of a command."""
        self._answer.content = text

    def draw(self, now: Now, history: History, mode: str, speed: float | None, lost: set[str]) -> None:
        """The present: the scene and one chaser's image each time, words and plots twice a second."""
        slow = time.monotonic() - self._drawn_s >= _SLOW_S
        with self._server.atomic():
            self._stage.draw(now, history, slow)
            if self._slider is not None:
                self._slider.value = round(now.time_s(), 1)
            if slow:
                self._drawn_s = time.monotonic()
                self._write(now, history, mode, speed, lost)
        self._draw_image(now)

    def _write(self, now: Now, history: History, mode: str, speed: float | None, lost: set[str]) -> None:
        for element, text in (
            (self._head, words.head(self._scenario, now, mode, speed)),
            (self._table, words.chasers(now, history)),
            (self._faults, words.faults(now, history, lost)),
            (self._events, words.happened(history.lines_until(now.time_s(), 12))),
        ):
            if element.content != text:
                element.content = text
        if now.time_s() != self._plotted_s:
            self._plotted_s = now.time_s()
            for plot, chart in self._plots:
                chart.data = points_of(plot, history, 0.0, now.time_s())

    def _draw_image(self, now: Now) -> None:
        for i in self._in_turn():
            image = now.chasers[i].image
            if image is None:
                continue
            sighting = now.chasers[i].sighting_in(image)
            version = (image.sim_time_ns, sighting is not None)
            if self._shown_images.get(i) != version:
                self._shown_images[i] = version
                row, column = (i // self._columns) * self._tile[0], (i % self._columns) * self._tile[1]
                place = np.s_[row : row + self._tile[0], column : column + self._tile[1]]
                self._mosaic[place] = self._image(image, sighting)
                self._image_waits = True
                break
        if self._image_waits and time.monotonic() - self._images_s >= _IMAGES_S:
            self._image_waits, self._images_s = False, time.monotonic()
            self._images.image = self._mosaic

    def _in_turn(self) -> Iterator[int]:
        number = len(self._scenario.chasers)
        first, self._next_image = self._next_image, (self._next_image + 1) % number
        yield from ((first + k) % number for k in range(number))

    def _image(self, image: Image, sighting: Any) -> Any:
        """RGB, the size of a tile; black for a damaged one, of which the table says "bad image"."""
        try:
            drawn = annotated_image(self._scenario, image, sighting, _IMAGE_PX)[:, :, ::-1]
        except LogError:
            drawn = np.zeros((*self._tile, 3), np.uint8)
        return drawn if drawn.shape[:2] == self._tile else cv2.resize(drawn, self._tile[::-1])
