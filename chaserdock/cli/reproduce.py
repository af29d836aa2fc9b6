# SPDX-License-Identifier: Apache-2.0
"""Commands that reproduce the paper's results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import fail


def reproduce(
    quick: Annotated[
        bool, typer.Option("--quick", help="shorter runs, one seed: minutes, not hours")
    ] = False,
    out: Annotated[Path, typer.Option(help="folder for runs and page; a second call resumes there")] = Path(
        "runs/reproduce"
    ),
    jobs: Annotated[int, typer.Option(min=1, max=64, help="concurrent missions")] = 2,
    keep_logs: Annotated[
        bool, typer.Option("--keep-logs", help="keep every mission.mcap (gigabytes)")
    ] = False,
) -> None:
    """Fly the paper's experiments and compare with its figures: writes OUT/reproduction.md and .html."""
    from chaserdock.reproduce.main import reproduce as fly_all

    raise typer.Exit(fly_all(quick, out, jobs, keep_logs))


def study(
    cases: Annotated[
        Path,
        typer.Argument(
            help="cases, one JSON object per line (StudyCase in chaserdock/evaluation/study_cases.py)"
        ),
    ],
    out: Annotated[Path, typer.Option(help="results are appended to this file")],
) -> None:
    """Fly a file of cases in one process, with perfect knowledge of the target and without images."""
    if not cases.is_file():
        raise fail(f"{cases}: no such file")
    from chaserdock.evaluation.study import main as fly_cases

    raise typer.Exit(fly_cases(cases, out))
