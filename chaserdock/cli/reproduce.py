"""Verbs that lay our figures beside the paper's."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated

import typer

from .options import fail


def reproduce(
    quick: Annotated[
        bool, typer.Option("--quick", help="shorter runs, one seed: minutes, not hours")
    ] = False,
    out: Annotated[
        Path, typer.Option(help="folder of runs and of the page; a second call goes on there")
    ] = Path("runs/reproduce"),
    jobs: Annotated[int, typer.Option(min=1, max=64, help="missions at a time")] = 2,
    keep_logs: Annotated[
        bool, typer.Option("--keep-logs", help="keep every mission.mcap (gigabytes)")
    ] = False,
) -> None:
    """Fly the paper's table and missions, and write them beside the paper's figures: OUT/reproduction.md and .html."""
    from chaserdock.reproduce.main import reproduce as work

    raise typer.Exit(work(quick, out, jobs, keep_logs))


def study(
    cases: Annotated[
        Path, typer.Argument(help="StudyCases (chaserdock_protocol/study.py), one a line, as JSON")
    ],
    out: Annotated[Path, typer.Option(help="results are appended here")],
) -> None:
    """Fly the controller by itself on perfect knowledge, without images: a file of cases."""
    found = [e for e in entry_points(group="chaserdock.studies") if e.name == "controller"]
    if not found:
        raise fail("no study of the controller is installed")
    sys.exit(found[0].load()(cases, out))
