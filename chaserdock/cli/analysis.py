# SPDX-License-Identifier: Apache-2.0
"""Commands that look at a flight: judge, report, video."""

from __future__ import annotations

import sys
from dataclasses import fields
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from chaserdock.terminal import labelled

from .options import (
    FromOpt,
    LinkOptions,
    LogArg,
    QuietOpt,
    RendererOption,
    ToOpt,
    errors_as_json,
    fail,
    print_result,
    refuse_options,
    show_of,
    with_link_options,
)


class FigureFormat(StrEnum):
    """File formats of figures."""

    svg = "svg"
    png = "png"
    pdf = "pdf"


@with_link_options("listen")
def judge(
    context: typer.Context,
    log: Annotated[
        Path,
        typer.Argument(
            help="folder of a run, or its mission.mcap; --live: what `record --by-run` writes to"
        ),
    ],
    live: Annotated[
        bool,
        typer.Option(
            "--live", help="watch a mission that other machines fly, and wait for its log"
        ),
    ] = False,
    *,
    link: LinkOptions,
    timeout: Annotated[
        float, typer.Option(min=0.1, help="--live: seconds to wait for a mission")
    ] = 120.0,
    world_timeout: Annotated[
        float,
        typer.Option(min=0.1, help="--live: seconds after which an absent world counts as lost"),
    ] = 60.0,
    quiet: QuietOpt = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="print the summary as one JSON object; --live: JSON lines (docs/cli.md)"
        ),
    ] = False,
) -> None:
    """Judge a flight and print its summary. Status 0 only if it is a success."""
    if live:
        from chaserdock.launch.judge import judge_mission

        show = show_of(quiet, as_json)
        with errors_as_json(as_json):
            status = judge_mission(log, link.link(timeout_s=timeout), timeout, world_timeout, show)
        raise typer.Exit(status)
    link_options = (f.name for f in fields(LinkOptions))
    refuse_options(
        context, ("timeout", "world_timeout", "quiet", *link_options), "only with --live"
    )
    from chaserdock.analysis.summary import print_summary, summarize

    result = summarize(log)
    if as_json:
        print_result(as_json, result, ())
    else:
        print_summary(result)
    raise typer.Exit(0 if result["success"] else 1)


def report(
    context: typer.Context,
    log: LogArg,
    out: Annotated[
        Path | None,
        typer.Option(
            help="page to write, report.html beside the log by default; --figures: folder; "
            "--at: image, .png or .jpg"
        ),
    ] = None,
    figures: Annotated[
        bool,
        typer.Option(
            "--figures",
            help="draw figures instead, one file each: trajectories, errors, distances, inputs, "
            "estimate, cameras",
        ),
    ] = False,
    format: Annotated[
        FigureFormat, typer.Option("--format", help="--figures: file format")
    ] = FigureFormat.svg,
    at: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="draw what every camera saw at this simulated time, seconds, with detections, "
            "instead",
        ),
    ] = None,
    width: Annotated[
        int, typer.Option(min=64, max=4096, help="--at: width of each camera image, pixels")
    ] = 640,
) -> None:
    """Write a self-contained page about a recorded flight: verdict, tables, 3-D replay, figures,
    events, scenario. Or only figures, or one picture of what the cameras saw.
    """
    if not figures:
        refuse_options(context, ("format",), "only with --figures")
    if at is None:
        refuse_options(context, ("width",), "only with --at")
    if not figures and at is None:
        _write_report(log, out)
        return
    if figures and at is not None:
        raise fail("--figures and --at exclude each other")
    if out is None:
        raise fail("--out: needed with --figures and --at")
    if at is None:
        _draw_figures(log, out, format.value)
    else:
        _draw_cameras(log, out, at, width)


def _write_report(log: Path, out: Path | None) -> None:
    """Write the page; show progress and its address on standard error, its path on standard
    output.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    from chaserdock.analysis.report import write_report

    console = Console(stderr=True)
    columns = (BarColumn(20), TaskProgressColumn(), TextColumn("{task.description}"))
    hidden = not console.is_terminal  # it would print an empty line
    with Progress(*columns, console=console, transient=True, disable=hidden) as bar:
        task = bar.add_task("")

        def show(step: str, done: int, steps: int) -> None:
            bar.update(task, description=step, completed=done, total=steps)

        page = write_report(log, out, show)
    print(page, flush=True)
    print(labelled("to open it", page.absolute().as_uri()), file=sys.stderr)


def _draw_figures(log: Path, out: Path, format: str) -> None:
    from chaserdock.analysis.figures import write_figures

    files, missing = write_figures(log, out, format)
    for file in files:
        print(file)
    for name, reason in missing.items():
        print(f"{name}: not drawn: {reason}")
    raise typer.Exit(0 if files else 1)


def _draw_cameras(log: Path, out: Path, at_s: float, width: int) -> None:
    from chaserdock.analysis.snapshot import snapshot
    from chaserdock.images import write_image

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise fail(f"--out {out}: must end in .png or .jpg")
    write_image(out, snapshot(log, at_s, width))


def video(
    context: typer.Context,
    log: LogArg,
    out: Annotated[Path, typer.Option(help="video to write: .mp4 (H.264), .webp or .gif")],
    speed: Annotated[
        float, typer.Option(min=0.01, max=1000.0, help="simulated seconds per second of video")
    ] = 1.0,
    fps: Annotated[int, typer.Option(min=1, max=60, help="frames per second of video")] = 15,
    width: Annotated[int, typer.Option(min=320, max=3840, help="pixels, even")] = 1280,
    height: Annotated[int, typer.Option(min=180, max=2160, help="pixels, even")] = 720,
    from_s: FromOpt = 0.0,
    to_s: ToOpt = None,
    quality: Annotated[int, typer.Option(min=0, max=100, help=".webp: image quality")] = 60,
    renderer: Annotated[
        RendererOption, typer.Option(help="fast: as the cameras; path: path tracing, needs mitsuba")
    ] = RendererOption.fast,
    samples: Annotated[
        int, typer.Option(min=1, max=4096, help="--renderer path: paths of light per pixel")
    ] = 16,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="--renderer path: processes")] = 1,
) -> None:
    """Render a recorded flight as a video: an outside view that follows the docking, with the
    camera images and their detections, slow motion at contact, and the verdict at the end.

    With --renderer path, pictures are kept in a folder beside the video: an interrupted film is
    resumed.
    """
    from chaserdock.analysis.video import write_video

    if renderer is not RendererOption.path:
        refuse_options(context, ("samples", "jobs"), "only with --renderer path")
    window_s = (from_s, float("inf") if to_s is None else to_s)
    number = write_video(
        log, out, speed, fps, width, height, window_s, quality,
        renderer=renderer.value, samples=samples, jobs=jobs,
    )  # fmt: skip
    print(f"{out}: {number} frames, {number / fps:.1f} s")
