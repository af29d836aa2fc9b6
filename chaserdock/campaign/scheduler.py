"""``chaserdock campaign``: flies, shows progress, writes the table and the report."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

from chaserdock.exit_codes import DONE, FAILED, STOPPED

from .plan import Campaign, Run, load_campaign
from .report import page
from .table import Row, again, rows_of, wilson
from .worker import CampaignError, Keep, Result, fly, fly_campaign


def direct(
    file: Path, out: Path | None, jobs: int | None, cluster: str | None, keep: Keep, only: int | None
) -> int:
    """Flies the campaign of ``file``; the exit status (``statuses``): 0 when every run has been flown.

    Raises ScenarioError for a file that is wrong, CampaignError when the campaign cannot go on.
    """
    campaign = load_campaign(file)
    folder = (out or Path("campaigns") / campaign.name).absolute()
    if only is not None:
        return _fly_one(campaign, folder, only)
    stop = threading.Event()
    before = {s: signal.signal(s, lambda number, frame: _stop(stop)) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        told = _Teller()
        flown = fly_campaign(campaign, folder, keep, jobs or os.cpu_count() or 1, cluster, told, stop)
    except OSError as error:
        raise CampaignError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if not flown:
        print("chaserdock: stopped before any run was over", file=sys.stderr)
        return STOPPED
    rows = rows_of(flown)
    write_table(rows, folder / "results.parquet")
    (folder / "report.html").write_text(page(campaign, rows, folder), encoding="utf-8")
    passed = sum(bool(r["success"]) for r in rows)
    low, high = wilson(passed, len(rows))
    print(
        f"{campaign.name}: {passed} of {len(rows)} passed, {100 * passed / len(rows):.1f} % "
        f"(95 %: {100 * low:.1f} to {100 * high:.1f} %)\n{folder / 'results.parquet'}\n{folder / 'report.html'}"
    )
    if len(rows) < len(campaign.runs):
        print(
            f"chaserdock: stopped, {len(campaign.runs) - len(rows)} runs left; the same command goes on",
            file=sys.stderr,
        )
        return STOPPED
    return DONE


def write_table(rows: list[Row], path: Path) -> None:
    """The table as Parquet; units are in the columns' names."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    fresh = path.with_suffix(".tmp")
    pq.write_table(pa.Table.from_pylist(rows), fresh)
    fresh.replace(path)


def _fly_one(campaign: Campaign, folder: Path, only: int) -> int:
    if not 0 <= only < len(campaign.runs):
        raise CampaignError(f"--only {only}: the runs are 0 to {len(campaign.runs) - 1}")
    run = campaign.runs[only]
    print(again(campaign, run))
    result = fly(run, campaign.scenario, "all", folder / "alone")
    print(
        f"run {only} ({run.name}): {'passed' if result.status == 0 else result.last_words}\n{result.log or 'no log'}"
    )
    return DONE if result.status == 0 else FAILED


def _stop(stop: threading.Event) -> None:
    if not stop.is_set():
        print("\nchaserdock: stopping when the runs in flight are over", file=sys.stderr)
    stop.set()


class _Teller:
    """One line a run that is over, with how many are left and for how long."""

    def __init__(self) -> None:
        self._begun_s = time.monotonic()
        self._first: int | None = None

    def __call__(self, done: int, of: int, run: Run, result: Result) -> None:
        if self._first is None:
            self._first = done - 1
        each_s = (time.monotonic() - self._begun_s) / (done - self._first)
        outcome = (
            "passed" if result.status == 0 else f"FAILED: {result.last_words.removeprefix('chaserdock: ')}"
        )
        left = f", about {each_s * (of - done) / 60:.0f} min left" if done < of else ""
        print(f"{done}/{of} run {run.index}: {outcome}{left}", flush=True)
