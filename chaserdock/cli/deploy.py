# SPDX-License-Identifier: Apache-2.0
"""``chaserdock deploy``: what a mission needs on several machines or in containers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import fail, refuse_options


def deploy(
    context: typer.Context,
    chasers: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="number of chasers; 4 by default, 16 with --keys"),
    ] = None,
    standby: Annotated[bool, typer.Option("--standby", help="with a standby controller")] = False,
    view: Annotated[
        bool,
        typer.Option(
            "--view", help="with the viewer, which `docker compose --profile view up` starts"
        ),
    ] = False,
    keys: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="make keys and certificates instead, in one folder per process inside this one",
        ),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(help="--keys: name or address of the router's host; repeatable"),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="--keys: validity, days")] = 90,
    shared: Annotated[
        bool,
        typer.Option(
            help="--keys: make keys readable by every user (for volumes that one process mounts)"
        ),
    ] = False,
    renew: Annotated[
        bool, typer.Option(help="--keys: keep valid keys, replace missing or expired ones")
    ] = False,
) -> None:
    """Print the Docker Compose file of a mission, a service per process, with access control; or
    make its keys. Existing keys are not overwritten.
    """
    if keys is not None:
        refuse_options(context, ("standby", "view"), "not with --keys")
        _make_keys(keys, chasers or 16, host or [], days, shared, renew)
        return
    refuse_options(context, ("host", "days", "shared", "renew"), "only with --keys")
    from chaserdock_protocol.scenario.fields import MAX_CHASERS

    from chaserdock.launch.compose_file import compose_file

    number = chasers or 4
    if number > MAX_CHASERS:
        raise fail(f"--chasers {number}: at most {MAX_CHASERS} without --keys")
    print(compose_file(number, standby=standby, view=view), end="")


def _make_keys(
    folder: Path, chasers: int, hosts: list[str], days: int, shared: bool, renew: bool
) -> None:
    """Make a mission's keys: FOLDER/NAME holds all that process NAME needs."""
    from datetime import UTC, datetime

    from chaserdock.launch.keys import init_keys, names, remove_keys, why_not_usable

    now = datetime.now(UTC)
    if renew:
        if why_not_usable(folder, chasers, now) is None:
            print(f"{folder}: all keys are valid")
            return
        remove_keys(folder, chasers)
    reached_at = ("localhost", "127.0.0.1", *hosts)
    init_keys(folder, chasers, reached_at, days, now, shared=shared)
    print(
        f"{folder}: keys of {', '.join(names(chasers))}; router at {', '.join(reached_at)}; "
        f"{days} days"
    )
