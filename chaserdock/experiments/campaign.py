# SPDX-License-Identifier: Apache-2.0
"""``chaserdock campaign``: fly a campaign file, write the table and the report."""

from __future__ import annotations

import sys
from pathlib import Path

from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import write_atomically

from chaserdock.analysis.report import write_report
from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.launch.signals import stop_on_signals
from chaserdock.terminal import labelled, wrapped

from .campaign_file import load_campaign
from .campaign_report import PAGE, SINGLE_RUNS, TABLE, sections, with_log
from .page import html
from .plan import ExperimentError, ExperimentPlan
from .results import (
    ResultRow,
    campaign_command,
    qualification,
    rate,
    repeat_command,
    rows_of,
    run_command,
    verdict_of_flight,
    write_table,
)
from .worker import ExperimentProgress, Workers, fly, fly_plan


def fly_campaign(file: Path, out: Path | None, workers: Workers, only: int | None) -> int:
    """Fly the campaign of ``file``. Returns the exit status: 0 when every flight has ended,
    whatever its outcome.

    ``only``: index of the one flight to fly. Raise ScenarioError for an invalid file,
    ExperimentError when the campaign cannot continue.
    """
    plan = load_campaign(file)
    shown = out or Path("campaigns") / plan.name
    folder = shown.absolute()
    if only is not None:
        return _fly_one(plan, shown, only)
    with (
        errors_of_writing(folder, ExperimentError),
        stop_on_signals("stopping after the active runs") as stop,
    ):
        outcomes = fly_plan(plan, folder, workers, ExperimentProgress(), stop)
    if not outcomes:
        print("chaserdock: stopped before any run ended", file=sys.stderr)
        return STOPPED
    rows = rows_of(plan, outcomes)
    write_table(rows, folder / TABLE)
    command = campaign_command(file.absolute(), folder)
    page = html(plan.name, sections(plan, rows, outcomes, folder, command))
    write_atomically(folder / PAGE, page)
    verdict = "; ".join([f"{plan.name}: {rate(rows)}", *qualification(rows)])
    say = repeat_command(campaign_command(file, out), _most_telling(rows))
    print("\n".join(wrapped([verdict])))
    print(labelled(f"report, with {TABLE} beside it", str(shown / PAGE)))
    print(labelled(f"a run again{with_log(plan)}", say))
    if remaining := len(plan.flights) - len(rows):
        print(
            f"chaserdock: stopped, {remaining} runs remain; repeat the command to resume",
            file=sys.stderr,
        )
        return STOPPED
    return DONE


def _most_telling(rows: list[ResultRow]) -> int:
    """Return the index of the first run that failed, else of one that is qualified, else of the
    first.
    """
    doubtful = (r for r in rows if r["not_judged"] != "[]" or r["doubts"] != "[]")
    failed = (r for r in rows if not r["success"])
    return int(next(failed, next(doubtful, rows[0]))["index"])


def _fly_one(plan: ExperimentPlan, shown: Path, only: int) -> int:
    if not 0 <= only < len(plan.flights):
        raise ExperimentError(f"--only {only}: the runs are 0 to {len(plan.flights) - 1}")
    flight = plan.flights[only]
    outcome = fly(flight, "all", shown.absolute() / SINGLE_RUNS)
    verdict = verdict_of_flight(outcome)
    head = f"{flight.label} ({flight.name}): {verdict.headline}"
    print("\n".join(wrapped([head, *(f"  {line}" for line in verdict.lines())])))
    log = Path(outcome.log or "")
    if log.is_absolute():
        write_report(log)
        page = shown / SINGLE_RUNS / flight.name / PAGE
        print(labelled("report, with its log beside it", str(page)))
    else:
        print(outcome.log or ("no log: the controller flew alone" if flight.module else "no log"))
    if command := run_command(flight):
        print(labelled("with its progress", command))
    return DONE if outcome.status == 0 else FAILED
