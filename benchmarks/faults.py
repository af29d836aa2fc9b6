# SPDX-License-Identifier: Apache-2.0
"""Seeded random faults at a shortened docking: ``python benchmarks/faults.py [--runs N] [--quick] [--json FILE]``.

Each run flies the scenario ``fault-drill`` as separate processes with one fault of a kind, a process, a moment and a
severity drawn from its number, and judges the log: docked; safe, and the log names why it is not docked; collision.
Results are appended to ``--out`` (JSON lines) and runs found there are not flown again. ``--quick``: one run a kind.
Status 1 when a run ended in a collision, with no reason named, without its end, or with a log that lacks something.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from chaserdock_protocol.scenario.faults import FaultKind
from results import options_of, write_json

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = "fault-drill"
KINDS: tuple[str, ...] = get_args(FaultKind)
CHASERS = [f"chaser/{i}" for i in range(4)]
RECEIVED = {
    "world": ["actuators"],
    "controller": ["odometry", "sighting"],
    "chaser": ["image", "odometry", "wrench"],
}
PUBLISHED = {"world": ["image", "odometry"], "controller": ["wrench"], "chaser": ["sighting", "actuators"]}
PATIENCE_S = 300.0
GOOD = ("docked", "safe")


@dataclass(frozen=True)
class Result:
    """What became of one run. ``reason``: the first thing that the log says went wrong after the fault began."""

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


def drawn_fault(number: int) -> dict[str, Any]:
    """The fault of run ``number``: kinds in turn, everything else drawn."""
    kind, draw = KINDS[number % len(KINDS)], random.Random(f"fault {number}")
    fault: dict[str, Any] = {"kind": kind, "at_s": round(draw.uniform(0.5, 20.0), 2)}
    duration_s = round(draw.choice([0.3, 1.0, 3.0, 8.0]) * draw.uniform(0.5, 1.5), 2)
    if kind != "kill":
        fault["duration_s"] = min(duration_s, 3.0) if kind == "freeze" else duration_s
    everybody = ["world", "controller", *CHASERS]
    if kind == "kill":
        fault["process"] = draw.choice(["controller", "recorder", *CHASERS])
    elif kind == "freeze":
        fault["process"] = draw.choice([*everybody, "recorder"])
    elif kind == "cut":
        fault["process"] = draw.choice(CHASERS)
        if draw.random() < 0.5:
            fault["peer"] = "controller"
    elif kind in ("camera_off", "lying_sensor", "odometry_lie"):
        fault["process"] = draw.choice(CHASERS)
    elif kind == "clock_jump":
        fault["process"] = draw.choice(["controller", *CHASERS])
        fault["offset_s"] = round(draw.choice([-1, 1]) * 10 ** draw.uniform(-2, 2), 3)
    else:
        fault["process"] = draw.choice(everybody)
        topics = PUBLISHED if kind == "flood" else RECEIVED
        fault["topic"] = draw.choice(topics[fault["process"].partition("/")[0]])
    if kind in ("drop", "duplicate", "reorder", "corrupt"):
        fault["share"] = draw.choice([0.1, 0.5, 1.0])
    if kind == "delay":
        fault["delay_s"] = round(draw.uniform(0.1, 1.0), 2)
    if kind == "flood":
        fault["copies"] = draw.choice([5, 50, 200])
    if kind in ("lying_sensor", "odometry_lie"):
        fault["offset_m"] = [round(draw.gauss(0.0, 0.1), 3) for _ in range(3)]
        fault["rotation_deg"] = [round(draw.gauss(0.0, 5.0), 2) for _ in range(3)]
    return fault


def toml(value: Any) -> str:
    """A fault as ``--set fault=[…]`` takes it."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + "}"
    return json.dumps(value)


def fly(number: int, mode: str) -> Result:
    """One run; raises SystemExit when the scenario is refused."""
    fault = drawn_fault(number)
    with tempfile.TemporaryDirectory() as folder:
        out, begun_s = Path(folder) / "run", time.monotonic()
        command = [sys.executable, "-m", "chaserdock", "run", SCENARIO, "--out", str(out), "-q"]
        command += ["--mode", mode, "--set", f"fault=[{toml(fault)}]"]
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            said = process.communicate(timeout=PATIENCE_S)[0].decode(errors="replace")
            ended = True
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGTERM)
            said, ended = process.communicate(timeout=60)[0].decode(errors="replace"), False
        if process.returncode == 2:
            raise SystemExit(f"run {number}: {said}")
        return judged(number, mode, fault, out, ended, time.monotonic() - begun_s)


def judged(number: int, mode: str, fault: dict[str, Any], out: Path, ended: bool, wall_s: float) -> Result:
    """The verdict on a run by its log."""
    flight = load_flight(out / "mission.mcap")
    summary = summary_of(flight)
    begins = [k for k, e in enumerate(flight.events) if e.what == "fault begins"]
    later = flight.events[begins[0] :] if begins else []
    said = [e for e in later if e.level != "info" and not e.what.startswith("fault ")]
    reason = next((f"{e.process}: {e.what} {e.detail}".strip() for e in said), "")
    killed_recorder = fault["kind"] == "kill" and fault["process"] == "recorder"
    if killed_recorder:
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
    whole = summary["sim_time_s"] > (
        fault["at_s"] - 1.0 if killed_recorder else flight.scenario.duration_s - 0.2
    )
    return Result(
        number=number,
        kind=fault["kind"],
        fault=fault,
        mode=mode,
        outcome=outcome,
        reason=reason,
        log_complete=lost == 0 and whole and (killed_recorder or bool(begins)),
        nearest_chasers_m=summary["min_distance_chasers_m"],
        nearest_target_m=min(c["min_distance_target_m"] for c in summary["chasers"].values()),
        digest=summary["digest"],
        wall_s=wall_s,
    )


def read_results(path: Path, mode: str) -> dict[int, Result]:
    """Runs flown before; a line that was cut off is left out."""
    found: dict[int, Result] = {}
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            result = Result(**json.loads(line))
        except (ValueError, TypeError):
            continue
        # A number whose fault is drawn otherwise by now is another run.
        if result.mode == mode and result.fault == drawn_fault(result.number):
            found[result.number] = result
    return found


def table(results: list[Result]) -> str:
    """Outcomes by kind of fault."""
    outcomes = sorted({r.outcome for r in results}, key=lambda o: (o not in GOOD, o))
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for r in results:
        rows[r.kind][r.outcome] += 1
        rows[r.kind]["log complete"] += r.log_complete
        rows[r.kind]["runs"] += 1
    columns = ["runs", *outcomes, "log complete"]
    lines = [
        f"{'':14}" + "".join(f"{c:>17}" for c in columns) + f"{'nearest chasers':>17}{'nearest target':>16}"
    ]
    for kind in [*KINDS, "all"]:
        of = [r for r in results if kind in (r.kind, "all")]
        if not of:
            continue
        counts = rows[kind] if kind != "all" else sum(rows.values(), Counter())
        near = (
            f"{min(r.nearest_chasers_m for r in of):>15.3f} m{min(r.nearest_target_m for r in of):>14.3f} m"
        )
        lines.append(f"{kind:14}" + "".join(f"{counts[c]:>17}" for c in columns) + near)
    return "\n".join(lines)


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--mode", choices=["lockstep", "realtime"], default="lockstep")
    parser.add_argument("--out", type=Path, default=Path("runs") / "faults.jsonl")
    options = parser.parse_args()
    numbers = range(options.first, options.first + (len(KINDS) if options.quick else options.runs))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    results = read_results(options.out, options.mode)
    for number in numbers:
        if number in results:
            continue
        result = results[number] = fly(number, options.mode)
        with options.out.open("a") as file:
            file.write(json.dumps(asdict(result)) + "\n")
        mark = "" if result.outcome in GOOD and result.log_complete else "  <-- "
        told = f"{result.outcome}{'' if result.log_complete else ', LOG NOT COMPLETE'}: {result.reason}"
        print(f"{number:4} {toml(result.fault)}: {told} ({result.wall_s:.0f} s){mark}", flush=True)
    flown = [results[n] for n in numbers if n in results]
    print(table(flown))
    outcomes = Counter(r.outcome for r in flown)
    bad = [r for r in flown if r.outcome not in GOOD or not r.log_complete]
    figures: dict[str, float] = {"runs": len(flown), "bad": len(bad)}
    figures |= {f"outcome_{name.replace(' ', '_')}": float(count) for name, count in outcomes.items()}
    figures["log_complete"] = float(sum(r.log_complete for r in flown))
    figures["nearest_chasers_m"] = min(r.nearest_chasers_m for r in flown)
    figures["nearest_target_m"] = min(r.nearest_target_m for r in flown)
    write_json(options.json, figures)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
