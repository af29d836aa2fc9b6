# SPDX-License-Identifier: Apache-2.0
"""``chaserdock track``: poses of a target in the images of a camera, a file or a recording."""

from __future__ import annotations

import sys
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chaserdock.exit_codes import BAD_INPUT, FAILED, STOPPED

from .options import fail

if TYPE_CHECKING:
    from chaserdock.tracking.run import Sink, TrackCounts, TrackStep
    from chaserdock.tracking.tracker import Tracker


def track(
    source: Annotated[
        str,
        typer.Argument(
            help="camera (0, /dev/video0), video file, address (rtsp://…, http://…), GStreamer "
            "pipeline, folder of images, recording (….mcap, folder of a run or of a ROS 2 bag)"
        ),
    ],
    camera: Annotated[
        Path, typer.Option(help="calibration file of OpenCV, ROS or Kalibr (see `calibrate`)")
    ],
    target: Annotated[
        str | None,
        typer.Option(help="target file (.toml) or name of a shipped target"),
    ] = None,
    mesh: Annotated[
        Path | None, typer.Option(help="mesh file of a target without markers (.stl, .glb, …)")
    ] = None,
    markers: Annotated[
        list[str] | None,
        typer.Option(
            "--marker", metavar="ID=SIZE_MM", help="single marker and its black side; repeatable"
        ),
    ] = None,
    dictionary: Annotated[
        str, typer.Option(help="--marker: ArUco dictionary, as OpenCV names it")
    ] = "DICT_4X4_50",
    margin_mm: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=1e4,
            help="--marker: white border, mm, where something darker follows; by default at least "
            "half a cell of the marker",
        ),
    ] = None,
    scale: Annotated[
        float,
        typer.Option(min=1e-9, max=1e9, help="--mesh: factor from its unit of length to m"),
    ] = 1.0,
    perception: Annotated[
        str | None,
        typer.Option(
            help="default (by markers), model (by the shape), or an installed one; by default by "
            "markers if the target has any"
        ),
    ] = None,
    topic: Annotated[str | None, typer.Option(help="image topic of a recording")] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            min=1e-3,
            max=1e4,
            help="images a second: set on a camera; of a folder whose names state no times",
        ),
    ] = None,
    out: Annotated[
        list[Path] | None,
        typer.Option(help="write the poses: .parquet, .csv or .tum; repeatable"),
    ] = None,
    video: Annotated[
        Path | None, typer.Option(help="write a video with axes, ids and figures: .mp4")
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="show the images in a web browser of this machine")
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(
            min=1, max=65535, help="--view: port; the first free one from 8080 by default"
        ),
    ] = None,
    show: Annotated[
        bool, typer.Option("--show", help="show the images in a window (needs OpenCV with windows)")
    ] = False,
    images: Annotated[int | None, typer.Option(min=1, help="stop after so many images")] = None,
    silent_s: Annotated[
        float,
        typer.Option(min=0.1, max=3600.0, help="seconds without an image after which to give up"),
    ] = 5.0,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="print the last line only, no poses")
    ] = False,
) -> None:
    """Track a target in the images of a camera, a video, a folder or a recording: poses with
    covariance. Status 1 if no image shows the target.

    Prints a pose a line, or on a terminal a line with the newest one. Ctrl-C ends it; what was
    written is complete.
    """
    from chaserdock_agents.gateway.cameras import OpeningOptions, open_camera

    from chaserdock.tracking.run import track_source
    from chaserdock.tracking.tracker import Tracker

    subject = _target(target, mesh, markers)
    # An option of what is not tracked would be lost in silence.
    if markers is None and (margin_mm is not None or dictionary != "DICT_4X4_50"):
        raise fail("--margin-mm, --dictionary: only with --marker; a target file states both")
    if mesh is None and scale != 1.0:
        raise fail("--scale: only with --mesh; a target file states mesh_scale")
    live = source.startswith("/dev/") or not Path(source).exists()
    tracker = Tracker(
        camera,
        subject,
        perception=perception,
        dictionary=dictionary,
        margin_m=None if margin_mm is None else 1e-3 * margin_mm,
        mesh_scale=scale,
        live=live,
    )
    sensor = tracker.camera
    options = OpeningOptions(sensor.width_px, sensor.height_px, fps, topic, silent_s)
    with ExitStack() as opened:
        sinks = list(_files(opened, tracker, out or [], video))
        if show:
            sinks.append(opened.enter_context(_window()))
        opened_source = open_camera(source, options)
        if view:
            sinks.append(opened.enter_context(_page(port)))
        sinks.append(opened.enter_context(_terminal(quiet)))
        counts = track_source(opened_source, tracker, sinks, images)
    written = [str(path) for path in (*(out or []), *([video] if video else []))]
    print(f"{counts.line()}{': ' if written else ''}{', '.join(written)}", file=sys.stderr)
    raise typer.Exit(_status(counts, live))


def _status(counts: TrackCounts, live: bool) -> int:
    """Return the exit status; Ctrl-C is how a camera's images end."""
    if counts.fault:
        print(f"chaserdock: {counts.fault}", file=sys.stderr)
        return BAD_INPUT
    if counts.stopped and not live:
        return STOPPED
    return 0 if counts.with_pose else FAILED


def _target(
    target: str | None, mesh: Path | None, markers: list[str] | None
) -> str | dict[int, float]:
    """Return what to track: name of a target or file, or sides of single markers, m, by id."""
    given = [value for value in (target, mesh, markers) if value is not None]
    if len(given) != 1:
        raise fail("give one of --target, --mesh and --marker")
    if markers is None:
        return str(given[0])
    sides_m: dict[int, float] = {}
    for text in markers:
        number, _, size_mm = text.partition("=")
        try:
            side_m = 1e-3 * float(size_mm)
            sides_m[int(number)] = side_m
        except ValueError:
            raise fail(f"--marker {text}: must be ID=SIZE_MM, such as 7=90") from None
    return sides_m


def _files(
    opened: ExitStack, tracker: Tracker, out: list[Path], video: Path | None
) -> Iterator[Sink]:
    from chaserdock.tracking.pose_files import pose_file

    for path in out:
        file = opened.enter_context(pose_file(path, len(tracker.names)))
        yield lambda step, file=file: file.write(step.image, step.tracked)
    if video is not None:
        from chaserdock.tracking.overlay_video import overlay_video

        film = opened.enter_context(overlay_video(video))
        yield lambda step: film.write(step.overlay, step.image.time_ns)


@contextmanager
def _page(port: int | None) -> Generator[Sink]:
    from chaserdock.tracking.live_page import LivePage

    page = LivePage(port)
    print(f"images: {page.url}", file=sys.stderr)
    try:
        yield lambda step: page.show(step.overlay, step.lines)
    finally:
        page.close()


@contextmanager
def _window() -> Generator[Sink]:
    import cv2

    if not cv2.currentUIFramework():
        raise fail(
            "--show: this OpenCV has no windows (opencv-python-headless, which chaserdock "
            "installs); use --view"
        )

    def show(step: TrackStep) -> None:
        cv2.imshow("chaserdock track", step.overlay)
        cv2.waitKey(1)

    try:
        yield show
    finally:
        cv2.destroyAllWindows()


@contextmanager
def _terminal(quiet: bool) -> Generator[Sink]:
    """Print poses: all, a line each; on a terminal the newest, in one line that is overwritten."""
    from chaserdock.tracking.run import HEADER, pose_lines

    if quiet:
        yield lambda step: None
    elif not sys.stdout.isatty():
        print(HEADER)
        yield lambda step: print("\n".join(pose_lines(step.tracked)), flush=True)
    else:
        width = _columns() - 1
        try:
            yield lambda step: print(
                f"\r\x1b[K{'   '.join(step.lines)[:width]}", end="", flush=True
            )
        finally:
            print()


def _columns() -> int:
    import shutil

    return shutil.get_terminal_size().columns
