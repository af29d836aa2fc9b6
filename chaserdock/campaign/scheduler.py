# SPDX-License-Identifier: Apache-2.0
"""``chaserdock campaign``: fly the runs, print progress, write the table and the report."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from chaserdock_protocol.errors import errors_of_writing

from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.launch.signals import stop_on_signals

from .plan import Campaign, Run, load_campaign
from .report import page
from .table import rerun_command, rows_of, wilson, write_table
from .worker import CampaignError, FinishedRun, Keep, fly, fly_campaign

AFTER_ACTIVE_RUNS = "stopping after the active runs"


def direct(
    file: Path,
    out: Path | None,
    jobs: int | None,
    cluster: str | None,
    keep: Keep,
    only: int | None,
) -> int:
    """Fly the campaign of ``file``; return the exit status: 0 when every run has ended, whatever
    its outcome.

    Raise ScenarioError for an invalid file, CampaignError when the campaign cannot continue.
    """
    campaign = load_campaign(file)
    folder = (out or Path("campaigns") / campaign.name).absolute()
    if only is not None:
        return _fly_one(campaign, folder, only)
    with errors_of_writing(folder, CampaignError), stop_on_signals(AFTER_ACTIVE_RUNS) as stop:
        finished = fly_campaign(
            campaign, folder, keep, jobs or os.cpu_count() or 1, cluster, CampaignProgress(), stop
        )
    if not finished:
        print("chaserdock: stopped before any run ended", file=sys.stderr)
        return STOPPED
    rows = rows_of(finished)
    write_table(rows, folder / "results.parquet")
    (folder / "report.html").write_text(page(campaign, rows, folder), encoding="utf-8")
    passed = sum(bool(r["success"]) for r in rows)
    low, high = wilson(passed, len(rows))
    print(
        f"{campaign.name}: {passed} of {len(rows)} passed, {100 * passed / len(rows):.1f} % "
        f"(95 %: {100 * low:.1f} to {100 * high:.1f} %)\n{folder / 'results.parquet'}\n{folder / 'report.html'}"
    )
    if len(rows) < len(campaign.runs):
        remaining = len(campaign.runs) - len(rows)
        print(
            f"chaserdock: stopped, {remaining} runs remain; repeat the command to resume",
            file=sys.stderr,
        )
        return STOPPED
    return DONE


def _fly_one(campaign: Campaign, folder: Path, only: int) -> int:
    if not 0 <= only < len(campaign.runs):
        raise CampaignError(f"--only {only}: the runs are 0 to {len(campaign.runs) - 1}")
    run = campaign.runs[only]
    print(rerun_command(run))
    result = fly(run, "all", folder / "single-runs")
    outcome = "passed" if result.status == 0 else result.last_words
    print(f"run {only} ({run.name}): {outcome}\n{result.log or 'no log'}")
    return DONE if result.status == 0 else FAILED


class CampaignProgress:
    """Prints one line per finished run: its outcome and the estimated time left."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._finished_before: int | None = None

    def __call__(self, finished: int, total: int, run: Run, result: FinishedRun) -> None:
        if self._finished_before is None:
            self._finished_before = finished - 1
        per_run_s = (time.monotonic() - self._start_s) / (finished - self._finished_before)
        passed = result.status == 0
        outcome = (
            "passed" if passed else f"FAILED: {result.last_words.removeprefix('chaserdock: ')}"
        )
        left = (
            f", about {per_run_s * (total - finished) / 60:.0f} min left"
            if finished < total
            else ""
        )
        varied = ", ".join(f"{name}={value}" for name, value in run.varied.items())
        label = f"run {run.index}" + (f" ({varied})" if varied else "")
        print(f"{finished}/{total} {label}: {outcome}{left}", flush=True)
