# SPDX-License-Identifier: Apache-2.0
"""Commands that look at a recorded flight: summary, report, figures, video, snapshot."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .options import JsonOpt, LogArg, fail, print_result


class FigureFormat(StrEnum):
    """File formats of figures."""

    svg = "svg"
    png = "png"
    pdf = "pdf"


def summary(log: LogArg, as_json: JsonOpt = False) -> None:
    """Judge a recorded flight again and print its summary. Status 0 only if the flight is a
    success.
    """
    from chaserdock.analysis.summary import summarize, text_of

    result = summarize(log)
    print_result(as_json, result, [text_of(result)])
    raise typer.Exit(0 if result["success"] else 1)


def report(
    log: LogArg,
    out: Annotated[
        Path | None, typer.Option(help="page to write; report.html beside the log by default")
    ] = None,
) -> None:
    """Write a self-contained page about a recorded flight: verdict, tables, 3-D replay, figures,
    events, scenario.
    """
    from chaserdock.analysis.report import write_report

    print(write_report(log, out))


def figures(
    log: LogArg,
    out: Annotated[Path, typer.Option(help="folder to write to")],
    format: Annotated[
        FigureFormat, typer.Option("--format", help="file format")
    ] = FigureFormat.svg,
) -> None:
    """Draw figures of a recorded flight, one file each: trajectories, errors, distances, inputs,
    estimate, cameras.
    """
    from chaserdock.analysis.figures import write_figures

    files, missing = write_figures(log, out, format.value)
    for file in files:
        print(file)
    for name, reason in missing.items():
        print(f"{name}: not drawn: {reason}")
    raise typer.Exit(0 if files else 1)


def video(
    log: LogArg,
    out: Annotated[Path, typer.Option(help="video to write: .mp4 (H.264), .webp or .gif")],
    speed: Annotated[
        float, typer.Option(min=0.01, max=1000.0, help="simulated seconds per second of video")
    ] = 1.0,
    fps: Annotated[int, typer.Option(min=1, max=60, help="frames per second of video")] = 15,
    width: Annotated[int, typer.Option(min=320, max=3840, help="pixels, even")] = 1280,
    height: Annotated[int, typer.Option(min=180, max=2160, help="pixels, even")] = 720,
    from_s: Annotated[
        float, typer.Option("--from", min=0.0, help="simulated time of the first frame, seconds")
    ] = 0.0,
    to_s: Annotated[
        float | None,
        typer.Option(
            "--to", min=0.0, help="simulated time of the last frame, seconds; the end by default"
        ),
    ] = None,
    quality: Annotated[int, typer.Option(min=0, max=100, help=".webp: image quality")] = 60,
) -> None:
    """Render a recorded flight as a video: an outside view beside the camera images with their
    detections.
    """
    from chaserdock.analysis.video import write_video

    window_s = (from_s, float("inf") if to_s is None else to_s)
    number = write_video(log, out, speed, fps, width, height, window_s, quality)
    print(f"{out}: {number} frames, {number / fps:.1f} s")


def snapshot(
    log: LogArg,
    at: Annotated[float, typer.Option(min=0.0, help="simulated time, seconds")],
    out: Annotated[Path, typer.Option(help="image to write: .png or .jpg")],
    width: Annotated[
        int, typer.Option(min=64, max=4096, help="width of each camera image, pixels")
    ] = 640,
) -> None:
    """Draw what every camera saw at one time of a recorded flight, with detections."""
    import cv2

    from chaserdock.analysis.snapshot import snapshot as draw

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise fail(f"--out {out}: must end in .png or .jpg")
    if not cv2.imwrite(str(out), draw(log, at, width)):
        raise fail(f"--out {out}: cannot be written")
