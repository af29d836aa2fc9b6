"""The web viewer's verb."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import (
    ConfigOpt,
    ConnectOpt,
    KeysOpt,
    LeaseOpt,
    ListenOpt,
    NamespaceOpt,
    NetModeOpt,
    WatchOpt,
    fail,
    link_of,
)


def view(
    log: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG]",
            help="a mission.mcap, a run's folder or the files of a rotated log; without, the running mission",
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="address to serve the page on; whoever reaches it can command the mission")
    ] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="the first free one from 8080 on by default")
    ] = None,
    dark: Annotated[bool, typer.Option("--dark", help="begin in dark colours")] = False,
    truth: Annotated[bool, typer.Option(help="show ground truth, too, where it may be read")] = True,
    at: Annotated[
        float | None, typer.Option(min=0, help="a log: stand still at this simulated second")
    ] = None,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease_ms: LeaseOpt = 60_000,
    watch_parent: WatchOpt = False,
) -> None:
    """Show a running mission, or a log, in a web browser: scene, images, plots, phases, commands."""
    from chaserdock.viewer.live import ViewOptions, view_live

    options = ViewOptions(host, port, dark, truth)
    if log:
        from chaserdock.viewer.player import view_log

        raise typer.Exit(view_log(log[0] if len(log) == 1 else log, options, at, watch_parent))
    if at is not None:
        raise fail("--at: goes with a log")
    link = link_of(namespace, connect, listen, net_mode, config, lease_ms, keys, "viewer")
    raise typer.Exit(view_live(link, options, watch_parent))
