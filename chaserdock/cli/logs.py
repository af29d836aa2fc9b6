# SPDX-License-Identifier: Apache-2.0
"""Commands for recorded logs: ``chaserdock log …``."""

from __future__ import annotations

import math
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated

import typer

from chaserdock.exit_codes import DONE, STOPPED

from .help import add_command, command_group
from .options import JsonOpt, LinkOptions, print_result, with_link_options

app = command_group("log", "Inspect, repair, export and play a log.")

LogFilesArg = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG", help="folder of a run, its mission.mcap, or the files of a rotated log"
    ),
]
FolderOpt = Annotated[Path, typer.Option("--out", help="folder to write into")]


class ExportFormat(StrEnum):
    """What a log is exported to."""

    parquet = "parquet"
    csv = "csv"
    rosbag2 = "rosbag2"


def _source(log: list[Path]) -> Path | list[Path]:
    return log[0] if len(log) == 1 else log


def info(log: LogFilesArg, as_json: JsonOpt = False) -> None:
    """Check all of a log and print what it holds. Status 1 when it is incomplete (cut off, messages
    lost or rejected).
    """
    import msgspec

    from chaserdock.logs.info import info_lines, info_of

    result = info_of(_source(log))
    print_result(
        as_json, {"whole": result.whole, **msgspec.to_builtins(result)}, info_lines(result)
    )
    raise typer.Exit(0 if result.whole else 1)


def recover(
    log: Annotated[Path, typer.Argument(help="log that is cut off or damaged")],
    out: Annotated[Path, typer.Option(help="file to write the readable messages to")],
    as_json: JsonOpt = False,
) -> None:
    """Copy the readable messages of a damaged log to a new one. Status 1 when messages in its
    middle are lost.
    """
    import msgspec

    from chaserdock.logs.recover import recover as recover_log

    result = recover_log(log, out)
    lines = [f"{out}: {result.messages} messages in {result.chunks} chunks recovered"]
    if result.skipped_bytes:
        lines.append(f"{result.skipped_bytes} bytes are not readable")
    lost = result.broken_records or result.messages_without_channel
    if lost:
        lines.append(
            f"lost: {result.broken_records} damaged records, {result.messages_without_channel} messages whose "
            "channel is declared in one of them"
        )
    print_result(as_json, msgspec.to_builtins(result), lines)
    raise typer.Exit(1 if lost else 0)


def export(
    log: LogFilesArg,
    out: FolderOpt,
    format: Annotated[
        ExportFormat,
        typer.Option(
            help="parquet keeps types and units; csv is readable everywhere; rosbag2 is a bag of ROS 2 (MCAP), "
            "which needs chaserdock[ros2]"
        ),
    ] = ExportFormat.parquet,
    images: Annotated[bool, typer.Option("--images", help="include the images")] = False,
) -> None:
    """Write one table per topic, all chasers together, or a bag of ROS 2."""
    if format is ExportFormat.rosbag2:
        from chaserdock.logs.rosbag import export_bag

        for topic, messages in export_bag(_source(log), out, images).items():
            print(f"{topic}: {messages} messages")
        return
    from chaserdock.logs.export import export as write

    for name, rows in write(_source(log), out, format.value, images).items():
        print(f"{out / name}: {rows} rows")


def tracks(
    log: LogFilesArg,
    out: FolderOpt,
    from_s: Annotated[
        float, typer.Option("--from", min=0.0, help="simulated time of the first point, seconds")
    ] = 0.0,
    to_s: Annotated[
        float | None,
        typer.Option(
            "--to", min=0.0, help="simulated time of the last point, seconds; the end by default"
        ),
    ] = None,
) -> None:
    """Write trajectories as TUM files: truth of all bodies, target estimate, odometry, references."""
    from chaserdock.logs.tracks import write_tracks

    end_s = math.inf if to_s is None else to_s
    for name, points in write_tracks(_source(log), out, from_s, end_s).items():
        print(f"{out / name}: {points} points")


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


for member in (info, recover, export, tracks, play):
    add_command(app, member)
