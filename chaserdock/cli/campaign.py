# SPDX-License-Identifier: Apache-2.0
"""The command that flies a Monte Carlo campaign."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .options import fail


class KeepLogs(StrEnum):
    """Runs whose logs are kept."""

    failures = "failures"
    all = "all"
    none = "none"


def campaign(
    file: Annotated[Path, typer.Argument(help="campaign file (TOML)")],
    out: Annotated[
        Path | None, typer.Option(help="folder for table and report; campaigns/NAME by default")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="concurrent runs on this machine; its CPU cores by default")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler, e.g. tcp://host:8786")
    ] = None,
    keep_logs: Annotated[KeepLogs, typer.Option(help="runs whose logs are kept")] = KeepLogs.failures,
    only: Annotated[int | None, typer.Option(min=0, help="fly this run only, and print its result")] = None,
) -> None:
    """Fly many runs of a scenario; a stopped campaign resumes. Status 0 when all runs have finished."""
    from chaserdock.campaign.scheduler import direct

    if only is not None and (cluster is not None or jobs is not None):
        raise fail("--only flies one run on this machine; it excludes --cluster and --jobs")
    raise typer.Exit(direct(file, out, jobs, cluster, keep_logs.value, only))
