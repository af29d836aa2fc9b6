"""Flying a campaign's runs: each by ``chaserdock run`` in a process of its own, here or on a Dask cluster's workers.

A run that has ended leaves ``runs/NAME/result.json``, written at once or not at all: that is what resuming goes by.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Literal

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.recording.scan import LOG_NAME

from .plan import Campaign, Run

Keep = Literal["failures", "all", "none"]


class CampaignError(ChaserdockError):
    """The campaign cannot go on; one clear line."""


class Result(msgspec.Struct, frozen=True):
    """How a run ended: the program's status and summary (None when it left none), its last words, where its log is."""

    name: str
    status: int
    summary: dict[str, Any] | None
    last_words: str
    log: str | None = None


def result_path(folder: Path, run: Run) -> Path:
    """Where a finished run's result lies."""
    return folder / "runs" / run.name / "result.json"


def finished(folder: Path, run: Run) -> Result | None:
    """The result of a run that ended earlier, or None. Raises CampaignError for a file that is none."""
    path = result_path(folder, run)
    try:
        return msgspec.json.decode(path.read_bytes(), type=Result)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError) as error:
        raise CampaignError(
            f"{path}: no result of a run: {error}; delete it to have the run flown again"
        ) from None


def note(folder: Path, run: Run, result: Result) -> None:
    """Writes a result so that a crash leaves all of it or nothing."""
    path = result_path(folder, run)
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(f".{os.getpid()}.tmp")
    with fresh.open("wb") as file:
        file.write(msgspec.json.format(msgspec.json.encode(result)) + b"\n")
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)


def fly(run: Run, scenario: Path, keep: Keep, logs: Path) -> Result:
    """Flies one run to its end, in a temporary folder; its log moves to ``logs`` if it is to be kept.

    Runs on a Dask worker as well: nothing but plain values goes in and out. Where ``logs`` cannot be written there
    (no shared disk), a kept log stays on the worker's machine, and the result says where.
    """
    work = Path(tempfile.mkdtemp(prefix=f"chaserdock-{run.name}-"))
    try:
        out = work / "run"
        sets = [item for override in run.overrides for item in ("--set", override)]
        command = [
            sys.executable,
            "-m",
            "chaserdock",
            "run",
            str(scenario),
            "--out",
            str(out),
            "--quiet",
            *sets,
        ]
        # A group of its own: Ctrl-C in the terminal is this program's to pass on.
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", start_new_session=True
        )
        summary_file = out / "summary.json"
        summary = json.loads(summary_file.read_text()) if summary_file.is_file() else None
        said = (done.stderr.strip() or done.stdout.strip()).splitlines()
        wanted = keep == "all" or (keep == "failures" and done.returncode != 0)
        kept = _keep(out / LOG_NAME, logs / run.name) if wanted and (out / LOG_NAME).is_file() else None
        return Result(run.name, done.returncode, summary, said[-1] if said else "", kept)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _keep(log: Path, folder: Path) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.move(log, folder / LOG_NAME)
        return str(folder / LOG_NAME)
    except OSError:
        stay = Path(tempfile.mkdtemp(prefix=f"chaserdock-log-{folder.name}-")) / LOG_NAME
        shutil.move(log, stay)
        return f"{socket.gethostname()}:{stay}"


def fly_here(
    campaign: Campaign, runs: list[Run], keep: Keep, folder: Path, jobs: int, stop: threading.Event
) -> Iterator[tuple[Run, Result]]:
    """Runs and their results as they end, ``jobs`` at a time on this machine; no new one after ``stop``."""
    waiting = iter(runs)
    with ThreadPoolExecutor(jobs) as pool:
        flying: dict[Any, Run] = {}
        while True:
            while len(flying) < jobs and not stop.is_set() and (run := next(waiting, None)) is not None:
                flying[pool.submit(fly, run, campaign.scenario, keep, folder / "runs")] = run
            if not flying:
                return
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                yield flying.pop(future), future.result()


def fly_on_cluster(
    campaign: Campaign, runs: list[Run], keep: Keep, folder: Path, address: str, stop: threading.Event
) -> Iterator[tuple[Run, Result]]:
    """The same on the workers of the Dask scheduler at ``address``; raises CampaignError if there is none."""
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise CampaignError('--cluster needs Dask: pip install "chaserdock[cluster]"') from None
    try:
        client = Client(address, timeout=5)
    except (OSError, ValueError, TimeoutError) as error:
        raise CampaignError(f"--cluster {address}: no Dask scheduler answers: {error}") from None
    with client:
        by_key = {}
        for run in runs:
            # Impure: Dask must not take an earlier result for this one, and a lost worker's run is flown again.
            future = client.submit(
                fly, run, campaign.scenario, keep, folder / "runs", key=f"{run.name}", pure=False, retries=1
            )
            by_key[future.key] = (run, future)
        for future in as_completed([f for _, f in by_key.values()]):
            if future.status == "error":
                raise CampaignError(
                    f"run {by_key[future.key][0].name} could not be flown on the cluster: {future.exception()}"
                )
            yield by_key[future.key][0], future.result()
            if stop.is_set():
                client.cancel([f for _, f in by_key.values()])
                return


def fly_campaign(
    campaign: Campaign,
    folder: Path,
    keep: Keep,
    jobs: int,
    cluster: str | None,
    told: Callable[[int, int, Run, Result], None],
    stop: threading.Event,
) -> list[tuple[Run, Result]]:
    """Flies what has not been flown yet; all (run, result) in the campaign's order. ``told``: after each new one."""
    folder.mkdir(parents=True, exist_ok=True)
    results = {r.name: found for r in campaign.runs if (found := finished(folder, r)) is not None}
    left = [r for r in campaign.runs if r.name not in results]
    flown = (
        fly_here(campaign, left, keep, folder, jobs, stop)
        if cluster is None
        else fly_on_cluster(campaign, left, keep, folder, cluster, stop)
    )
    for run, result in flown:
        note(folder, run, result)
        results[run.name] = result
        told(len(results), len(campaign.runs), run, result)
    return [(r, results[r.name]) for r in campaign.runs if r.name in results]
