# SPDX-License-Identifier: Apache-2.0
"""Execution of runs: one ``chaserdock run`` process each, on this machine or on the workers of a
Dask cluster.

A finished run leaves ``runs/NAME/result.json``, written atomically. A later call skips the runs
that have one.
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
from chaserdock_protocol.errors import ChaserdockError, require_extra
from chaserdock_protocol.recording.scan import LOG_NAME

from .plan import Campaign, Run

Keep = Literal["failures", "all", "none"]


class CampaignError(ChaserdockError):
    """The campaign cannot continue."""


class FinishedRun(msgspec.Struct, frozen=True):
    """Outcome of a run: exit status, summary (None without one), last output line, path of a kept
    log.
    """

    name: str
    status: int
    summary: dict[str, Any] | None
    last_words: str
    log: str | None = None


def result_path(folder: Path, run: Run) -> Path:
    """Return the path of a finished run's result."""
    return folder / "runs" / run.name / "result.json"


def read_result(folder: Path, run: Run) -> FinishedRun | None:
    """Return the result of an earlier run, or None. Raise CampaignError for a damaged file."""
    path = result_path(folder, run)
    try:
        return msgspec.json.decode(path.read_bytes(), type=FinishedRun)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError) as error:
        raise CampaignError(
            f"{path}: not a result of a run: {error}; delete it to fly the run again"
        ) from None


def write_result(folder: Path, run: Run, result: FinishedRun) -> None:
    """Write a result atomically."""
    path = result_path(folder, run)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    with temporary.open("wb") as file:
        file.write(msgspec.json.format(msgspec.json.encode(result)) + b"\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def fly(run: Run, keep: Keep, logs: Path) -> FinishedRun:
    """Fly one run in a temporary folder; move its log to ``logs`` if ``keep`` says so.

    Also runs on Dask workers, so that arguments and result are plain values. Where ``logs`` is not
    writable (no shared disk), a kept log stays on the worker's machine and the result names host
    and path.
    """
    folder = Path(tempfile.mkdtemp(prefix=f"chaserdock-{run.name}-"))
    try:
        out = folder / "run"
        sets = [item for override in run.overrides for item in ("--set", override)]
        program = [sys.executable, "-m", "chaserdock", "run", str(run.scenario)]
        # A session of its own: Ctrl-C in the terminal reaches this process only, which lets the run
        # finish.
        done = subprocess.run(
            [*program, "--out", str(out), "--quiet", *sets],
            capture_output=True,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        summary_file = out / "summary.json"
        summary = json.loads(summary_file.read_text()) if summary_file.is_file() else None
        output = (done.stderr.strip() or done.stdout.strip()).splitlines()
        keep_log = keep == "all" or (keep == "failures" and done.returncode != 0)
        log = out / LOG_NAME
        kept = _move_log(log, logs / run.name) if keep_log and log.is_file() else None
        return FinishedRun(run.name, done.returncode, summary, output[-1] if output else "", kept)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _move_log(log: Path, folder: Path) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.move(log, folder / LOG_NAME)
        return str(folder / LOG_NAME)
    except OSError:
        local = Path(tempfile.mkdtemp(prefix=f"chaserdock-log-{folder.name}-")) / LOG_NAME
        shutil.move(log, local)
        return f"{socket.gethostname()}:{local}"


def fly_locally(
    runs: list[Run], keep: Keep, folder: Path, jobs: int, stop: threading.Event
) -> Iterator[tuple[Run, FinishedRun]]:
    """Fly ``jobs`` runs at a time on this machine; yield each as it ends. Start none after
    ``stop``.
    """
    waiting = iter(runs)
    with ThreadPoolExecutor(jobs) as pool:
        active: dict[Any, Run] = {}
        while True:
            while (
                len(active) < jobs
                and not stop.is_set()
                and (run := next(waiting, None)) is not None
            ):
                active[pool.submit(fly, run, keep, folder / "runs")] = run
            if not active:
                return
            for future in wait(active, return_when=FIRST_COMPLETED).done:
                yield active.pop(future), future.result()


def fly_on_cluster(
    runs: list[Run], keep: Keep, folder: Path, address: str, stop: threading.Event
) -> Iterator[tuple[Run, FinishedRun]]:
    """Fly runs on the workers of the Dask scheduler at ``address``; yield each as it ends.

    Raise CampaignError, and MissingPackageError without Dask.
    """
    require_extra("distributed", "cluster")
    from distributed import Client, as_completed

    try:
        client = Client(address, timeout=5)
    except (OSError, ValueError, TimeoutError) as error:
        raise CampaignError(f"--cluster {address}: no Dask scheduler answers: {error}") from None
    with client:
        by_key = {}
        for run in runs:
            # pure=False: Dask must not reuse a result. retries=1: the run of a lost worker is flown
            # again.
            future = client.submit(
                fly, run, keep, folder / "runs", key=f"{run.name}", pure=False, retries=1
            )
            by_key[future.key] = (run, future)
        for future in as_completed([f for _, f in by_key.values()]):
            run = by_key[future.key][0]
            if future.status == "error":
                raise CampaignError(f"run {run.name} failed on the cluster: {future.exception()}")
            yield run, future.result()
            if stop.is_set():
                client.cancel([f for _, f in by_key.values()])
                return


def fly_campaign(
    campaign: Campaign,
    folder: Path,
    keep: Keep,
    jobs: int,
    cluster: str | None,
    report_progress: Callable[[int, int, Run, FinishedRun], None],
    stop: threading.Event,
) -> list[tuple[Run, FinishedRun]]:
    """Fly the runs without a result; return all finished runs in the campaign's order.

    ``report_progress`` receives the number of finished runs, the number of runs, and the run that
    has just ended.
    """
    folder.mkdir(parents=True, exist_ok=True)
    results = {
        r.name: earlier for r in campaign.runs if (earlier := read_result(folder, r)) is not None
    }
    remaining = [r for r in campaign.runs if r.name not in results]
    flights = (
        fly_locally(remaining, keep, folder, jobs, stop)
        if cluster is None
        else fly_on_cluster(remaining, keep, folder, cluster, stop)
    )
    for run, result in flights:
        write_result(folder, run, result)
        results[run.name] = result
        report_progress(len(results), len(campaign.runs), run, result)
    return [(r, results[r.name]) for r in campaign.runs if r.name in results]
