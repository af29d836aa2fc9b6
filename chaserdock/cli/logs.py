"""Verbs about recorded logs: ``chaserdock log …``."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from chaserdock.exit_codes import DONE, STOPPED

from .options import ConfigOpt, ConnectOpt, JsonOpt, ListenOpt, NamespaceOpt, NetModeOpt, link_of
from .plain import PlainGroup

app = typer.Typer(
    cls=PlainGroup,
    rich_markup_mode=None,
    help="Look into a log, repair it, export it, send it again.",
    no_args_is_help=True,
)

LogArg = Annotated[
    list[Path],
    typer.Argument(metavar="LOG", help="a mission.mcap, the folder of a run, or the files of a rotated log"),
]
FolderOpt = Annotated[Path, typer.Option("--out", help="folder to write into")]


class Format(StrEnum):
    """Kinds of table files."""

    parquet = "parquet"
    csv = "csv"


def _source(log: list[Path]) -> Path | list[Path]:
    return log[0] if len(log) == 1 else log


@app.command()
def info(log: LogArg, as_json: JsonOpt = False) -> None:
    """Say what a log holds and check all of it; status 1 when it is not whole (cut off, messages missing or refused)."""
    import msgspec

    from chaserdock.logs.info import info_lines, info_of

    found = info_of(_source(log))
    if as_json:
        print(json.dumps({"whole": found.whole, **msgspec.to_builtins(found)}, indent=2))
    else:
        print("\n".join(info_lines(found)))
    raise typer.Exit(0 if found.whole else 1)


@app.command()
def recover(
    log: Annotated[Path, typer.Argument(help="a log that was cut off or damaged")],
    out: Annotated[Path, typer.Option(help="file to write what can be saved into")],
) -> None:
    """Save what is whole of a log that was cut off or damaged; status 1 when something in its middle was lost."""
    from chaserdock.logs.recover import recover as save

    found = save(log, out)
    print(f"{out}: {found.messages} messages in {found.chunks} chunks saved")
    if found.skipped_bytes:
        print(f"{found.skipped_bytes} bytes could not be read")
    if found.broken_records or found.messages_without_channel:
        print(
            f"lost: {found.broken_records} damaged records, {found.messages_without_channel} messages whose "
            "channel was declared in one of them"
        )
        raise typer.Exit(1)


@app.command()
def export(
    log: LogArg,
    out: FolderOpt,
    format: Annotated[
        Format, typer.Option(help="parquet keeps types and units; csv opens anywhere")
    ] = Format.parquet,
    images: Annotated[bool, typer.Option("--images", help="with the images' bytes")] = False,
) -> None:
    """Write one table a topic, all chasers together."""
    from chaserdock.logs.export import export as write

    for name, rows in write(_source(log), out, format.value, images).items():
        print(f"{out / name}: {rows} rows")


@app.command()
def tracks(
    log: LogArg,
    out: FolderOpt,
    from_s: Annotated[float, typer.Option(help="simulated time of the first point, s")] = 0.0,
    to_s: Annotated[float, typer.Option(help="simulated time of the last point, s")] = float("inf"),
) -> None:
    """Write trajectories as TUM files: truth of all bodies, the target's estimate, odometries, references."""
    from chaserdock.logs.tracks import write_tracks

    for name, points in write_tracks(_source(log), out, from_s, to_s).items():
        print(f"{out / name}: {points} points")


@app.command()
def play(
    log: LogArg,
    speed: Annotated[
        float | None, typer.Option(min=0.01, help="simulated over wall time; as fast as it goes by default")
    ] = None,
    patience: Annotated[float, typer.Option(min=0.1, help="seconds to wait for a recorder")] = 60.0,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
) -> None:
    """Send a log's messages again, as they were, once `chaserdock record` listens; in the place of a world."""
    from chaserdock_protocol.process import StopSignal
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT

    from chaserdock.logs.player import play as send

    if listen is None and connect is None and net_mode == "peer":
        listen = [DEFAULT_ENDPOINT]
    link = link_of(namespace, connect or [], listen, net_mode, config, 60_000)
    stop = StopSignal(watch_parent=False)
    print(f"{send(_source(log), link, speed, patience, stopped=stop)} messages sent")
    raise typer.Exit(STOPPED if stop() else DONE)
