# SPDX-License-Identifier: Apache-2.0
"""The command ``demo``: a first flight to look at."""

from __future__ import annotations

import os
import sys

import typer

from chaserdock.terminal import labelled

from .options import OutOpt
from .run import choose_viewer_port, wait_for_viewer

FILM = "film.mp4"
"""Name of the film in the folder of the run."""

FILM_SIZE_PX = (960, 540)
"""Width and height of the film: a quarter of full HD, as most is drawn on small windows."""

FILM_FPS = 10
"""Frames a second of the film: motion is slow, and each frame takes 0.08 s of processor time."""

SEEN = """\
One chaser docks with a servicer that tumbles at 3 degrees/s. It sees the markers
on the servicer with its camera, flies to the port with twelve thrusters, is
latched on contact, and pulls to verify the latch.
"""

NEXT = """\
Try next:
  chaserdock view {folder}
  chaserdock run four-chaser-docking --view
  chaserdock scenario demo --show > mine.toml
"""


def demo(out: OutOpt = None) -> None:
    """Fly the last quarter of a metre of a docking, and write its report and film. Status 0 only if
    the chaser is latched.

    The viewer shows the flight; a browser opens it where there is a display.
    """
    from chaserdock.analysis.report import write_report
    from chaserdock.analysis.video import write_video
    from chaserdock.launch.launcher import Viewer, fly_mission, print_outcome
    from chaserdock.launch.progress import Show
    from chaserdock.launch.signals import stop_on_signals

    print(SEEN, flush=True)
    with stop_on_signals() as stop, Viewer(choose_viewer_port(has_display())) as viewer:
        outcome = fly_mission(
            "demo", out, show=Show.text, viewer=viewer, stop_requested=stop.is_set
        )
        print_outcome(outcome, Show.text)
        if outcome.summary is not None and not stop.is_set():
            page, film = write_report(outcome.folder), outcome.folder / FILM
            print(labelled("\nreport", page.absolute().as_uri()), flush=True)
            width_px, height_px = FILM_SIZE_PX
            write_video(outcome.folder, film, fps=FILM_FPS, width_px=width_px, height_px=height_px)
            print(labelled("film", film.absolute().as_uri()))
            print(f"\n{NEXT.format(folder=outcome.folder)}", end="", flush=True)
            wait_for_viewer(viewer, stop.is_set)
    raise typer.Exit(outcome.status)


def has_display() -> bool:
    """Return whether a browser can open a window here."""
    return sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
