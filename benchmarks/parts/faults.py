# SPDX-License-Identifier: Apache-2.0
"""Random faults during a shortened docking: ``fault-drill`` as separate processes with one fault,
of which kind, process, time and severity are drawn from the number of the run.

Outcomes: ``docked``; ``safe`` (not docked, and the log states why); ``no reason named``;
``collision``; ``stalled``.
"""

from __future__ import annotations

import random
import subprocess
import tempfile
import time
from argparse import ArgumentParser
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import (
    ROOT,
    BenchmarkFailed,
    Figures,
    Group,
    KeptResults,
    Options,
    chaserdock_command,
    seeds_of,
)

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.swarm import KINDS, draw_fault
from chaserdock.toml_text import toml_value

SCENARIO = "fault-drill"
TIMEOUT_S = 300.0
"""A run that lasts longer has stalled."""
GOOD = ("docked", "safe")


@dataclass(frozen=True)
class FaultResult:
    """Outcome of one run. ``reason``: the first warning or error logged since the fault began."""

    number: int
    kind: str
    fault: dict[str, Any]
    mode: str
    outcome: str
    reason: str
    log_complete: bool
    nearest_chasers_m: float
    nearest_target_m: float
    digest: str
    wall_s: float


def fault_of(number: int) -> dict[str, Any]:
    """Return the fault of a run: kinds in turn, everything else drawn from the number."""
    return draw_fault(KINDS[number % len(KINDS)], random.Random(f"fault {number}"), chasers=4)


def fly(number: int, mode: str) -> FaultResult:
    """Fly one run. Raise SystemExit if the scenario is refused."""
    fault = fault_of(number)
    with tempfile.TemporaryDirectory() as folder:
        out, begin_s = Path(folder) / "run", time.monotonic()
        changes = ("--mode", mode, "--set", f"fault=[{toml_value(fault)}]")
        process = subprocess.Popen(
            chaserdock_command("run", SCENARIO, "--out", out, "-q", *changes),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        try:
            output, ended = process.communicate(timeout=TIMEOUT_S)[0], True
        except subprocess.TimeoutExpired:
            process.terminate()
            output, ended = process.communicate(timeout=60)[0], False
        if process.returncode == 2:
            raise SystemExit(f"run {number}: {output}")
        return evaluate(number, mode, fault, out, ended, time.monotonic() - begin_s)


def evaluate(
    number: int, mode: str, fault: dict[str, Any], out: Path, ended: bool, wall_s: float
) -> FaultResult:
    """Evaluate the log of a run."""
    flight = load_flight(out / "mission.mcap")
    summary = summary_of(flight)
    begins = [k for k, e in enumerate(flight.events) if e.what == "fault begins"]
    later = flight.events[begins[0] :] if begins else []
    warnings = [e for e in later if e.level != "info" and not e.what.startswith("fault ")]
    reason = next((f"{e.process}: {e.what} {e.detail}".strip() for e in warnings), "")
    recorder_killed = fault["kind"] == "kill" and fault["process"] == "recorder"
    if recorder_killed:
        reason = f"the log ends at {summary['sim_time_s']:.2f} s with the recorder"
    if not ended:
        outcome = "stalled"
    elif summary["collisions"]:
        outcome = "collision"
    elif all(summary["chasers"][i]["docked"] for i in ("0", "3")):
        outcome = "docked"
    else:
        outcome = "safe" if reason else "no reason named"
    lost = sum(m["lost"] for m in summary["messages"].values())
    end_s = fault["at_s"] - 1.0 if recorder_killed else flight.scenario.duration_s - 0.2
    return FaultResult(
        number=number,
        kind=fault["kind"],
        fault=fault,
        mode=mode,
        outcome=outcome,
        reason=reason,
        log_complete=lost == 0
        and summary["sim_time_s"] > end_s
        and (recorder_killed or bool(begins)),
        nearest_chasers_m=summary["min_distance_chasers_m"],
        nearest_target_m=min(c["min_distance_target_m"] for c in summary["chasers"].values()),
        digest=summary["digest"],
        wall_s=wall_s,
    )


def table(results: list[FaultResult]) -> str:
    """Return the outcomes by kind of fault as a table."""
    outcomes = sorted({r.outcome for r in results}, key=lambda o: (o not in GOOD, o))
    columns = ["runs", *outcomes, "log complete", "nearest chasers", "nearest target"]
    lines = [f"{'':14}" + "".join(f"{c:>17}" for c in columns)]
    for kind in (*KINDS, "all"):
        if rows := [r for r in results if kind in (r.kind, "all")]:
            counts = Counter(r.outcome for r in rows)
            numbers = [len(rows), *(counts[o] for o in outcomes), sum(r.log_complete for r in rows)]
            near_m = min(r.nearest_chasers_m for r in rows), min(r.nearest_target_m for r in rows)
            cells = [*map(str, numbers), *(f"{m:.3f} m" for m in near_m)]
            lines.append(f"{kind:14}" + "".join(f"{c:>17}" for c in cells))
    return "\n".join(lines)


def faults(options: Options) -> Figures:
    """Fly 200 random faults (``--quick``: one of each kind); every run must dock or be safe, with a
    complete log.
    """
    numbers = seeds_of(options, 200, len(KINDS))
    results = KeptResults(options.results, {"faults": options.mode}, FaultResult)
    flown = results.of(numbers, lambda number: fly(number, options.mode), line_of)
    print(table(flown))
    bad = [r for r in flown if r.outcome not in GOOD or not r.log_complete]
    outcomes = Counter(r.outcome for r in flown)
    figures: Figures = {
        "runs": len(flown),
        **{f"outcome_{name.replace(' ', '_')}": number for name, number in outcomes.items()},
        "log_complete": sum(r.log_complete for r in flown),
        "bad": len(bad),
        "nearest_chasers_m": min(r.nearest_chasers_m for r in flown),
        "nearest_target_m": min(r.nearest_target_m for r in flown),
    }
    if bad:
        raise BenchmarkFailed(f"neither docked nor safe, or no complete log: {bad}", figures)
    return figures


def line_of(result: FaultResult) -> str:
    """Return one line for people."""
    log = "" if result.log_complete else ", log incomplete"
    text = f"{toml_value(result.fault)}: {result.outcome}{log}: {result.reason}"
    return f"{text} ({result.wall_s:.0f} s)"


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--mode", choices=("lockstep", "realtime"), default="lockstep", help="of faults"
    )


GROUP = Group({"faults": faults}, ("flights", "first", "results"), add_options)
