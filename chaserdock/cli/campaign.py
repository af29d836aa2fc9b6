"""The verb for many runs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .options import fail


class KeepLogs(StrEnum):
    """Whose logs stay."""

    failures = "failures"
    all = "all"
    none = "none"


def campaign(
    file: Annotated[Path, typer.Argument(help="campaign file (TOML)")],
    out: Annotated[
        Path | None, typer.Option(help="folder for table and report; campaigns/NAME by default")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="runs at a time on this machine; its cores by default")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler, such as tcp://host:8786")
    ] = None,
    keep_logs: Annotated[KeepLogs, typer.Option(help="whose logs stay")] = KeepLogs.failures,
    only: Annotated[
        int | None, typer.Option(help="fly run number ONLY, say how it went, and nothing else")
    ] = None,
) -> None:
    """Fly many runs of a scenario; resumes where it was stopped. Status 0 when all were flown, whatever their outcome."""
    from chaserdock.campaign.scheduler import direct

    if only is not None and (cluster is not None or jobs is not None):
        raise fail("--only flies one run here: it goes without --cluster and --jobs")
    raise typer.Exit(direct(file, out, jobs, cluster, keep_logs.value, only))
