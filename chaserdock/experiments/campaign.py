# SPDX-License-Identifier: Apache-2.0
"""``chaserdock campaign``: fly a campaign file, write the table and the report."""

from __future__ import annotations

import sys
from pathlib import Path

from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import write_atomically

from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.launch.signals import stop_on_signals

from .campaign_file import load_campaign
from .campaign_report import qualification, sections
from .page import html
from .plan import ExperimentError, ExperimentPlan
from .results import repeat_command, rows_of, verdict_of_flight, wilson, write_table
from .worker import ExperimentProgress, Workers, fly, fly_plan


def fly_campaign(file: Path, out: Path | None, workers: Workers, only: int | None) -> int:
    """Fly the campaign of ``file``. Returns the exit status: 0 when every flight has ended,
    whatever its outcome.

    ``only``: index of the one flight to fly. Raise ScenarioError for an invalid file,
    ExperimentError when the campaign cannot continue.
    """
    plan = load_campaign(file)
    folder = (out or Path("campaigns") / plan.name).absolute()
    if only is not None:
        return _fly_one(plan, folder, only)
    with (
        errors_of_writing(folder, ExperimentError),
        stop_on_signals("stopping after the active runs") as stop,
    ):
        outcomes = fly_plan(plan, folder, workers, ExperimentProgress(), stop)
    if not outcomes:
        print("chaserdock: stopped before any run ended", file=sys.stderr)
        return STOPPED
    rows = rows_of(plan, outcomes)
    table, report = folder / "results.parquet", folder / "report.html"
    write_table(rows, table)
    write_atomically(report, html(plan.name, sections(plan, rows, folder)))
    passed = sum(bool(r["success"]) for r in rows)
    low, high = wilson(passed, len(rows))
    print(
        f"{plan.name}: {passed} of {len(rows)} passed, {100 * passed / len(rows):.1f} % "
        f"(95 %: {100 * low:.1f} to {100 * high:.1f} %)"
    )
    print("\n".join([*qualification(rows), str(table), str(report)]))
    if remaining := len(plan.flights) - len(rows):
        print(
            f"chaserdock: stopped, {remaining} runs remain; repeat the command to resume",
            file=sys.stderr,
        )
        return STOPPED
    return DONE


def _fly_one(plan: ExperimentPlan, folder: Path, only: int) -> int:
    if not 0 <= only < len(plan.flights):
        raise ExperimentError(f"--only {only}: the runs are 0 to {len(plan.flights) - 1}")
    flight = plan.flights[only]
    print(repeat_command(flight))
    outcome = fly(flight, "all", folder / "single-runs")
    verdict = verdict_of_flight(outcome)
    print(f"{flight.label} ({flight.name}): {verdict.headline}")
    print("\n".join([*(f"  {line}" for line in verdict.lines()), outcome.log or "no log"]))
    return DONE if outcome.status == 0 else FAILED
