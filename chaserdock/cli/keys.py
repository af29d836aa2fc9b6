# SPDX-License-Identifier: Apache-2.0
"""Keys and certificates of a mission: ``chaserdock keys …``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .help import HELP_OPTIONS, FiniteCommand, GroupedHelp

app = typer.Typer(
    name="keys",
    cls=GroupedHelp,
    context_settings=HELP_OPTIONS,
    rich_markup_mode=None,
    help="Make the keys and certificates of a mission.",
    no_args_is_help=True,
)


@app.callback()
def group() -> None:
    """Make the keys and certificates of a mission."""


@app.command("init", cls=FiniteCommand, context_settings=HELP_OPTIONS)
def init(
    folder: Annotated[Path, typer.Argument(help="folder to write to, one folder per process inside")],
    host: Annotated[
        list[str] | None, typer.Option(help="name or address of the router's host; repeatable")
    ] = None,
    chasers: Annotated[int, typer.Option(min=1, max=256, help="number of chasers")] = 16,
    days: Annotated[int, typer.Option(min=1, max=3650, help="validity, days")] = 90,
    shared: Annotated[
        bool, typer.Option(help="make keys readable by every user (for volumes that one process mounts)")
    ] = False,
    renew: Annotated[bool, typer.Option(help="keep valid keys, replace missing or expired ones")] = False,
) -> None:
    """Make a mission's keys: FOLDER/NAME holds all that process NAME needs. Existing keys are not overwritten."""
    from datetime import UTC, datetime

    from chaserdock.launch.keys import init_keys, names, remove_keys, why_not_usable

    now = datetime.now(UTC)
    if renew:
        if why_not_usable(folder, chasers, now) is None:
            print(f"{folder}: all keys are valid")
            return
        remove_keys(folder, chasers)
    hosts = ("localhost", "127.0.0.1", *(host or ()))
    init_keys(folder, chasers, hosts, days, now, shared=shared)
    print(f"{folder}: keys of {', '.join(names(chasers))}; router at {', '.join(hosts)}; {days} days")
