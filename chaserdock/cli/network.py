"""Verbs of a mission that is spread over containers or hosts: its router, its keys, who is there, how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import (
    ConfigOpt,
    ConnectOpt,
    JsonOpt,
    KeysOpt,
    LinesOpt,
    ListenOpt,
    NamespaceOpt,
    NetModeOpt,
    QuietOpt,
    WatchOpt,
    errors_as_lines,
    fail,
    link_of,
    show_of,
)
from .plain import PlainGroup
from .processes import start_process

keys = typer.Typer(
    cls=PlainGroup, rich_markup_mode=None, help="Keys and certificates of a mission.", no_args_is_help=True
)


def router(
    listen: ListenOpt = None,
    keys: KeysOpt = None,
    namespace: NamespaceOpt = "chaserdock",
    config: ConfigOpt = None,
    lease_ms: Annotated[
        int, typer.Option("--lease-ms", help="after that long a silent client counts as lost")
    ] = 10_000,
    until: Annotated[
        str | None, typer.Option(metavar="PROCESS", help="end when this process has come and gone")
    ] = None,
    watch_parent: WatchOpt = False,
) -> None:
    """The router that a mission's processes connect to, as clients; with --keys it holds each to its rights."""
    from chaserdock_protocol.process import ProcessOptions
    from chaserdock_protocol.topics import is_process_name
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT, Link

    from .options import tls_of

    if until is not None and not is_process_name(until):
        raise fail(f"--until {until}: must be a process, such as operator or chaser/0")
    if config is not None and not config.is_file():
        raise fail(f"--config {config}: no such file")
    scheme = "tls/" if keys is not None else "tcp/"
    endpoints = tuple(listen or [DEFAULT_ENDPOINT.replace("tcp/", scheme)])
    if keys is not None and (plain := [e for e in endpoints if not e.startswith("tls/")]):
        raise fail(
            f"--listen {plain[0]}: with --keys it must be tls/ADDRESS:PORT, or rights could be gone round"
        )
    tls = tls_of(keys, "router") if keys is not None else None
    link = Link(namespace, (), endpoints, "router", config, lease_ms, tls)
    start_process("router", ProcessOptions(link=link, until=until, watch_parent=watch_parent))


def status(
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    seconds: Annotated[float, typer.Option(help="how long to look on")] = 3.0,
    as_json: JsonOpt = False,
) -> None:
    """Show who is there on a mission's network, the tick, and each chaser's phase; status 2 when nobody is."""
    import json

    from rich.console import Console

    from chaserdock.launch.status import look_on, table_of

    seen = look_on(link_of(namespace, connect, None, net_mode, config, 60_000, keys), seconds)
    if as_json:
        print(json.dumps(seen.as_dict(), indent=2))
    else:
        Console().print(table_of(seen))


def judge(
    out: Annotated[Path, typer.Argument(help="the folder that the recorder writes to with --by-run")],
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease_ms: Annotated[int, typer.Option("--lease-ms")] = 60_000,
    patience: Annotated[float, typer.Option(help="seconds to wait for a mission")] = 120.0,
    world_away: Annotated[
        float, typer.Option(help="seconds after which a world that is gone is lost")
    ] = 60.0,
    quiet: QuietOpt = False,
    as_json: LinesOpt = False,
) -> None:
    """Watch a mission that others fly, wait for its log, judge it; status 0 only if it was a success."""
    from chaserdock.launch.judge import judge_mission

    show = show_of(quiet, as_json)
    link = link_of(namespace, connect, None, net_mode, config, lease_ms, keys)
    with errors_as_lines(as_json):
        raise typer.Exit(judge_mission(out, link, patience, world_away, show))


@keys.command("init")
def init(
    folder: Annotated[Path, typer.Argument(help="where to; a folder for each process is made in it")],
    host: Annotated[
        list[str] | None, typer.Option(help="a name or address of the router's host; may be given again")
    ] = None,
    chasers: Annotated[int, typer.Option(min=1, max=256, help="for how many chasers")] = 16,
    days: Annotated[int, typer.Option(min=1, max=3650, help="how long they hold")] = 90,
    shared: Annotated[
        bool, typer.Option(help="readable by all who reach the folder (volumes of one process each)")
    ] = False,
    renew: Annotated[
        bool, typer.Option(help="keep keys that are there and hold; replace them when they have ended")
    ] = False,
) -> None:
    """Make a mission's keys: FOLDER/NAME holds all that process NAME may know. Existing keys are not overwritten."""
    from datetime import UTC, datetime

    from chaserdock.launch.keys import init_keys, names, remove_keys, why_not_usable

    now = datetime.now(UTC)
    if renew:
        reason = why_not_usable(folder, chasers, now)
        if reason is None:
            print(f"{folder}: keys are there and hold")
            return
        remove_keys(folder, chasers)
    hosts = ("localhost", "127.0.0.1", *(host or ()))
    init_keys(folder, chasers, hosts, days, now, shared=shared)
    print(f"{folder}: keys of {', '.join(names(chasers))}; router at {', '.join(hosts)}; {days} days")
