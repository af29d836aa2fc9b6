# SPDX-License-Identifier: Apache-2.0
"""Commands for recorded logs: ``chaserdock log`` and ``chaserdock play``."""

from __future__ import annotations

import math
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated

import typer

from chaserdock.exit_codes import DONE, STOPPED

from .options import (
    FromOpt,
    JsonOpt,
    LinkOptions,
    LogFilesArg,
    ToOpt,
    fail,
    print_result,
    refuse_options,
    with_link_options,
)


class ExportFormat(StrEnum):
    """What a log is exported to."""

    parquet = "parquet"
    csv = "csv"
    tum = "tum"
    rosbag2 = "rosbag2"
    glb = "glb"


def _source(log: list[Path]) -> Path | list[Path]:
    return log[0] if len(log) == 1 else log


def log(
    context: typer.Context,
    log: LogFilesArg,
    export: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="write the log's content into this folder")
    ] = None,
    format: Annotated[
        ExportFormat,
        typer.Option(
            help="--export: a table per topic as parquet (with types and units) or csv; tum: "
            "trajectories of truth, measured poses, estimate, odometry and references; rosbag2: a "
            "bag of ROS 2 (MCAP), which needs chaserdock[ros2]; glb: the surface of a target of "
            "unknown shape, by the last map"
        ),
    ] = ExportFormat.parquet,
    images: Annotated[
        bool, typer.Option("--images", help="--export: include the images; not in tum, glb")
    ] = False,
    from_s: FromOpt = 0.0,
    to_s: ToOpt = None,
    recover: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="copy the readable messages of a damaged log into a new one"
        ),
    ] = None,
    as_json: JsonOpt = False,
) -> None:
    """Check all of a log and print what it holds; or export it, or repair it. Status 1 when it is
    incomplete (cut off, messages lost or rejected).

    --from and --to limit trajectories (--format tum).
    """
    if export is not None and recover is not None:
        raise fail("--export and --recover exclude each other")
    if export is None:
        refuse_options(context, ("format", "images"), "only with --export")
    else:
        refuse_options(context, ("as_json",), "not with --export")
    if format in (ExportFormat.tum, ExportFormat.glb):
        refuse_options(context, ("images",), f"not with --format {format.value}")
    if format is not ExportFormat.tum:
        refuse_options(context, ("from_s", "to_s"), "only with --format tum")
    if export is not None:
        _export(log, export, format, images, (from_s, math.inf if to_s is None else to_s))
    elif recover is not None:
        _recover(log, recover, as_json)
    else:
        _check(log, as_json)


def _check(log: list[Path], as_json: bool) -> None:
    """Print what a log holds."""
    import msgspec

    from chaserdock.logs.info import info_lines, info_of

    result = info_of(_source(log))
    print_result(
        as_json, {"whole": result.whole, **msgspec.to_builtins(result)}, info_lines(result)
    )
    raise typer.Exit(0 if result.whole else 1)


def _export(
    log: list[Path], out: Path, format: ExportFormat, images: bool, window_s: tuple[float, float]
) -> None:
    """Write a log in another format."""
    source = _source(log)
    if format is ExportFormat.tum:
        from chaserdock.logs.tracks import write_tracks

        written, unit = write_tracks(source, out, *window_s), "points"
    elif format is ExportFormat.glb:
        from chaserdock.logs.mapped_shape import write_shape

        written, unit = write_shape(source, out), "faces"
    elif format is ExportFormat.rosbag2:
        from chaserdock.logs.rosbag import export_bag

        for topic, messages in export_bag(source, out, images).items():
            print(f"{topic}: {messages} messages")
        return
    else:
        from chaserdock.logs.export import export

        written, unit = export(source, out, format.value, images), "rows"
    for name, number in written.items():
        print(f"{out / name}: {number} {unit}")


def _recover(log: list[Path], out: Path, as_json: bool) -> None:
    """Copy what is readable; exit with status 1 when anything is known to be lost."""
    import msgspec

    from chaserdock.logs.recover import loss_lines, recover

    if len(log) > 1:
        raise fail("--recover: needs one log")
    result = recover(log[0], out)
    lines = [f"{out}: {result.messages} messages in {result.chunks} chunks recovered"]
    print_result(as_json, msgspec.to_builtins(result), lines + loss_lines(result))
    raise typer.Exit(0 if result.complete else 1)


@with_link_options("keys", "lease")
def play(
    log: LogFilesArg,
    speed: Annotated[
        float | None,
        typer.Option(min=0.01, help="simulated over wall time; as fast as possible by default"),
    ] = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="seconds to wait for a recorder")] = 60.0,
    *,
    link: LinkOptions,
) -> None:
    """Publish a log's messages again, unchanged, in place of a world, once `chaserdock record` has
    joined.
    """
    from chaserdock_protocol.process import StopSignal

    from chaserdock.logs.player import play as publish

    # Made at its first use, when the session is open: until then Ctrl-C ends the wait for a router.
    signal = cache(lambda: StopSignal(watch_parent=False))
    count = publish(
        _source(log), link.link("world", timeout), speed, timeout, stopped=lambda: signal()()
    )
    print(f"{count} messages sent")
    raise typer.Exit(STOPPED if signal()() else DONE)
