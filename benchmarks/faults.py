# SPDX-License-Identifier: Apache-2.0
"""Random faults during a shortened docking: ``python benchmarks/faults.py [--runs N] [--quick]
[--json FILE]``.

Each run flies the scenario ``fault-drill`` as separate processes with one fault; kind, process,
time and severity are drawn from the number of the run. Outcomes: ``docked``; ``safe`` (not docked,
and the log states why); ``no reason named``; ``collision``; ``stalled``. Results are appended to
``--out`` (JSON lines); runs that it contains are not repeated. ``--quick``: one run of each kind.
Status 1 if a run is neither docked nor safe, or its log is incomplete.
"""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from common import (
    ROOT,
    Figures,
    append_line,
    chaserdock_command,
    make_parser,
    print_figures,
    read_lines,
    write_json,
)

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.swarm import KINDS, draw_fault
from chaserdock.toml_text import toml_value

SCENARIO = "fault-drill"
TIMEOUT_S = 300.0
GOOD = ("docked", "safe")


@dataclass(frozen=True)
class FaultResult:
    """Outcome of one run. ``reason``: the first warning or error in the log after the fault began."""

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


def read_results(path: Path, mode: str) -> dict[int, FaultResult]:
    """Return earlier results by number; a result whose fault is no longer that of its number is
    ignored.
    """
    results = [FaultResult(**row) for row in read_lines(path)]
    return {r.number: r for r in results if r.mode == mode and r.fault == fault_of(r.number)}


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


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--mode", choices=["lockstep", "realtime"], default="lockstep")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "faults.jsonl")
    options = parser.parse_args()
    numbers = range(options.first, options.first + (len(KINDS) if options.quick else options.runs))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    results = read_results(options.out, options.mode)
    for number in numbers:
        if number in results:
            continue
        result = results[number] = fly(number, options.mode)
        append_line(options.out, asdict(result))
        log = "" if result.log_complete else ", log incomplete"
        print(
            f"{number:4} {toml_value(result.fault)}: {result.outcome}{log}: {result.reason} ({result.wall_s:.0f} s)",
            flush=True,
        )
    flown = [results[n] for n in numbers]
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
    print_figures(figures)
    write_json(options.json, figures)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
