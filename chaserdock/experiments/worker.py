# SPDX-License-Identifier: Apache-2.0
"""Flies a plan: one process per flight, on this machine or on a Dask cluster.

A flight that has ended leaves ``runs/NAME/result.json``, written atomically. Later calls skip it. A
flight that crashed leaves none and is flown again, and so is, last, one of other code.
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
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.recording.scan import LOG_NAME
from msgspec import Struct

from chaserdock.exit_codes import FAILED
from chaserdock.spread import Lost, Places, ServedCall, serve, spread
from chaserdock.terminal import wrapped
from chaserdock.verdict import verdict_of

from .plan import ExperimentError, ExperimentPlan, PlannedFlight
from .provenance import Provenance, provenance

Keep = Literal["failures", "all", "none"]


class FlightOutcome(Struct, frozen=True):
    """Outcome of a flight: exit status, summary (None after a crash), last line of output, path of
    a kept log, where and when it was ``flown`` (None: by an earlier version), and by which
    ``code``.
    """

    name: str
    status: int
    summary: dict[str, Any] | None
    last_words: str
    log: str | None = None
    flown: Provenance | None = None
    code: str = ""


ReportProgress = Callable[[int, int, PlannedFlight, FlightOutcome], None]
"""Receives the number of flights that have ended, of all flights, and the one that just ended."""


@dataclass(frozen=True)
class Workers(Places):
    """Where flights are flown. ``keep``: whose logs are kept."""

    keep: Keep = "none"


def fly_plan(
    plan: ExperimentPlan,
    folder: Path,
    workers: Workers,
    report: ReportProgress,
    stop: threading.Event,
) -> dict[str, FlightOutcome]:
    """Fly what has no result in ``folder`` yet, then what has one of other code, until ``stop``.
    Returns the outcomes by flight name, in the plan's order.

    A flight that was lost with its processes is FAILED, without a summary. Raise ChaserdockError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    outcomes = results_of(plan, folder)
    remaining = [f for f in plan.flights if f.name not in outcomes]
    remaining += [f for f in plan.flights if f.name in outcomes and outcomes[f.name].code != f.code]
    left = len(remaining)
    calls = (_Call(flight, workers.keep, str(folder / "runs")) for flight in remaining)
    for call, flown in spread(_FLY, calls, workers, stop.is_set):
        flight, outcome = call.flight, flown
        if isinstance(outcome, Lost):
            outcome = FlightOutcome(flight.name, FAILED, None, outcome.reason)
        write_result(folder, outcome)
        outcomes[flight.name] = outcome
        left -= 1
        report(len(plan.flights) - left, len(plan.flights), flight, outcome)
    return {f.name: outcomes[f.name] for f in plan.flights if f.name in outcomes}


class _Call(Struct, frozen=True):
    """A flight to fly, perhaps on another machine."""

    flight: PlannedFlight
    keep: Keep
    logs: str


def _fly(call: _Call) -> FlightOutcome:
    return fly(call.flight, call.keep, Path(call.logs))


_FLY = ServedCall("chaserdock.experiments.worker", _fly, _Call, FlightOutcome)


def results_of(plan: ExperimentPlan, folder: Path) -> dict[str, FlightOutcome]:
    """Return the results of a plan so far, by flight name. Raise ExperimentError for a damaged
    one.
    """
    found = ((f.name, read_result(folder, f.name)) for f in plan.flights)
    return {name: outcome for name, outcome in found if outcome is not None}


def result_path(folder: Path, name: str) -> Path:
    """Return the path of a flight's result."""
    return folder / "runs" / name / "result.json"


def read_result(folder: Path, name: str) -> FlightOutcome | None:
    """Return the result of an earlier flight, or None. Raise ExperimentError for a damaged file."""
    path = result_path(folder, name)
    try:
        return msgspec.json.decode(path.read_bytes(), type=FlightOutcome)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError) as error:
        raise ExperimentError(
            f"{path}: not a result of a flight: {error}; delete it to fly the flight again"
        ) from None


def write_result(folder: Path, outcome: FlightOutcome) -> None:
    """Write a result atomically; a flight that crashed gets none."""
    if outcome.summary is None:
        return
    path = result_path(folder, outcome.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, msgspec.json.format(msgspec.json.encode(outcome)) + b"\n")


def fly(flight: PlannedFlight, keep: Keep, logs: Path) -> FlightOutcome:
    """Fly one flight in a temporary folder. Move its log to ``logs`` if ``keep`` asks for it.

    If ``logs`` is not writable (no shared disk), a kept log stays on the worker's machine and the
    result names host and path.
    """
    folder = Path(tempfile.mkdtemp(prefix=f"chaserdock-{flight.name}-"))
    try:
        out = folder / "run"
        # In a session of its own Ctrl-C in the terminal reaches this process only, which lets the
        # flight finish.
        done = subprocess.run(
            [sys.executable, "-m", *_program(flight, out)],
            input=msgspec.json.encode(flight).decode() if flight.module else None,
            capture_output=True,
            text=True,
            errors="replace",
            start_new_session=True,
            env=os.environ | SINGLE_THREADED if flight.module else None,
        )
        summary_file = out / "summary.json"
        summary = json.loads(summary_file.read_text()) if summary_file.is_file() else None
        output = (done.stderr.strip() or done.stdout.strip()).splitlines()
        keep_log = keep == "all" or (keep == "failures" and done.returncode != 0)
        log = out / LOG_NAME
        kept = _move_log(log, logs / flight.name) if keep_log and log.is_file() else None
        last_words = output[-1].removeprefix("chaserdock: ") if output else ""
        flown = (provenance(), flight.code)
        return FlightOutcome(flight.name, done.returncode, summary, last_words, kept, *flown)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _program(flight: PlannedFlight, out: Path) -> list[str]:
    """Return module and arguments that fly a flight and write ``out/summary.json``."""
    if flight.module:
        return [flight.module, str(out)]
    sets = [item for override in flight.overrides for item in ("--set", override)]
    return ["chaserdock", "run", flight.scenario, "--out", str(out), "--quiet", *sets]


def _move_log(log: Path, folder: Path) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.move(log, folder / LOG_NAME)
        return str(folder / LOG_NAME)
    except OSError:
        local = Path(tempfile.mkdtemp(prefix=f"chaserdock-log-{folder.name}-")) / LOG_NAME
        shutil.move(log, local)
        return f"{socket.gethostname()}:{local}"


class ExperimentProgress:
    """Prints one line per flight that has ended: its outcome, and an estimate of the time left."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._ended_before: int | None = None

    def __call__(
        self, ended: int, total: int, flight: PlannedFlight, outcome: FlightOutcome
    ) -> None:
        if self._ended_before is None:
            self._ended_before = ended - 1
        each_s = (time.monotonic() - self._start_s) / (ended - self._ended_before)
        verdict = verdict_of(outcome.summary or {}).headline
        if outcome.status != 0:
            verdict = f"FAILED: {outcome.last_words}"
        left_min = each_s * (total - ended) / 60
        left = f", about {left_min:.0f} min left" if ended < total else ""
        varied = ", ".join(f"{name}={value}" for name, value in flight.varied.items())
        label = flight.label + (f" ({varied})" if varied else "")
        print("\n".join(wrapped([f"{ended}/{total} {label}: {verdict}{left}"])), flush=True)


if __name__ == "__main__":
    serve(_FLY)
