"""Verbs that make something to show of a recorded flight: figures, a page, a film."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

LogArg = Annotated[Path, typer.Argument(help="a run's folder, or its mission.mcap")]


class Format(StrEnum):
    """What a figure is written as."""

    svg = "svg"
    png = "png"
    pdf = "pdf"


def figures(
    log: LogArg,
    out: Annotated[Path, typer.Option(help="folder to write to; made if need be")],
    format: Annotated[Format, typer.Option("--format", help="what to write")] = Format.svg,
) -> None:
    """Draw a recorded flight: trajectories, errors, distances, inputs, estimate, cameras, times. One file a figure."""
    from chaserdock.analysis.figures import write_figures

    files, missing = write_figures(log, out, format.value)
    for file in files:
        print(file)
    for name, reason in missing.items():
        print(f"{name}: not drawn: {reason}")
    raise typer.Exit(0 if files else 1)


def report(
    log: LogArg,
    out: Annotated[
        Path | None, typer.Option(help="page to write; report.html beside the log by default")
    ] = None,
) -> None:
    """Write one self-contained page on a recorded flight: verdict, tables, 3-D replay, figures, events, scenario."""
    from chaserdock.analysis.report import write_report

    print(write_report(log, out))


def video(
    log: LogArg,
    out: Annotated[Path, typer.Option(help="film to write: .mp4 (H.264), .webp or .gif")],
    speed: Annotated[
        float, typer.Option(min=0.01, max=1000.0, help="simulated seconds a second of film")
    ] = 1.0,
    fps: Annotated[int, typer.Option(min=1, max=60, help="frames a second of film")] = 15,
    width: Annotated[int, typer.Option(min=320, max=3840, help="pixels, even")] = 1280,
    height: Annotated[int, typer.Option(min=180, max=2160, help="pixels, even")] = 720,
    from_s: Annotated[
        float, typer.Option("--from", min=0.0, help="simulated time of the first frame, s")
    ] = 0.0,
    to_s: Annotated[float, typer.Option("--to", help="simulated time of the last frame, s")] = float("inf"),
    quality: Annotated[int, typer.Option(min=0, max=100, help=".webp: fewer bytes to better images")] = 60,
) -> None:
    """Film a recorded flight: the mission from outside beside the cameras' images with what was found in them."""
    from chaserdock.analysis.video import write_video

    number = write_video(log, out, speed, fps, width, height, (from_s, to_s), quality)
    print(f"{out}: {number} frames, {number / fps:.1f} s")
