# SPDX-License-Identifier: Apache-2.0
"""The command that serves the web viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import LinkOptions, WatchOpt, fail, with_link_options


@with_link_options()
def view(
    log: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG]",
            help="folder of a run, its mission.mcap, or the files of a rotated log; the running mission by default",
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="address to serve the page on; every client can command the mission")
    ] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="port; the first free one from 8080 by default")
    ] = None,
    dark: Annotated[bool, typer.Option("--dark", help="start with dark colours")] = False,
    truth: Annotated[bool, typer.Option(help="show ground truth where it is readable")] = True,
    at: Annotated[
        float | None, typer.Option(min=0, help="log: pause at this simulated time, seconds")
    ] = None,
    *,
    link: LinkOptions,
    watch_parent: WatchOpt = False,
) -> None:
    """Show a running mission, or a log, in a web browser: scene, images, plots, phases, commands."""
    from chaserdock.viewer.live import ViewOptions, view_live

    options = ViewOptions(host, port, dark, truth)
    if log:
        from chaserdock.viewer.player import view_log

        raise typer.Exit(view_log(log[0] if len(log) == 1 else log, options, at, watch_parent))
    if at is not None:
        raise fail("--at: needs a log")
    raise typer.Exit(view_live(link.link("viewer"), options, watch_parent))
