# SPDX-License-Identifier: Apache-2.0
"""Fly a policy and the NMPC in the whole mission, from the same starts: ``python fly.py``.

Starts are drawn as those of the training environment ([learning.start]), bodies and actuators by
[truth] and the seed. All processes fly unchanged, in virtual time. The policy's solver must be
installed: ``pip install --no-deps ./examples/learning``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario import load_scenario

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate
from chaserdock.summary import Summary
from chaserdock.toml_text import toml_value

FOLDER = Path(__file__).parent


def start_of(scenario, seed):
    """Return overrides: a start drawn as those of the environment, without a rate of the chaser,
    which missions do not have.
    """
    rng, spread, chaser = np.random.default_rng(seed), scenario.learning.start, scenario.chasers[0]
    turn = np.radians(spread.rotation_deg) * rng.uniform(-1.0, 1.0, 3)
    start = rotations.multiply(rotations.exp(chaser.start_rotation_rad), rotations.exp(turn))
    drawn = {
        "chasers.0.start_offset_m": chaser.start_offset_m
        + spread.position_m * rng.uniform(-1, 1, 3),
        "chasers.0.start_rotation_rad": rotations.log(start),
        "chasers.0.start_velocity_m_s": spread.velocity_m_s * rng.uniform(-1, 1, 3),
        "target.omega_rad_s": scenario.target.omega_rad_s
        + np.radians(spread.target_rate_deg_s) * rng.uniform(-1, 1, 3),
    }
    # The spread is about the start as drawn: none is left.
    drawn["learning.start.position_m"] = np.zeros(3)
    return (*(f"{k}={toml_value(v.tolist())}" for k, v in drawn.items()), f"seed={seed}")


def flown(path, solver, sets, seed):
    """Fly a mission; return what the table shows of it."""
    overrides = (*sets, f'controller.solver="{solver}"')
    overrides += start_of(load_scenario(path, overrides), seed)
    with tempfile.TemporaryDirectory() as folder:
        flight = simulate(path, Path(folder) / "run", overrides)
        if flight.crashes or flight.stalled:
            raise SystemExit(f"{solver}, seed {seed}: {flight.crashes or flight.stalled}")
        recorded = load_flight(Path(folder) / "run" / "mission.mcap")
    summary = Summary.from_dict(summary_of(recorded))
    chaser = summary.chasers[0]
    begin_s = recorded.scenario.timeline[0].at_s
    latched_s = chaser.capture.latch_time_s
    return {
        "solver": solver,
        "seed": seed,
        "success": summary.success,
        "failures": list(summary.failures),
        "latched_after_s": None if latched_s is None else latched_s - begin_s,
        "impulse_N_s": chaser.impulse_N_s,
        "attempts": 1 + sum("retreat (" in e.what for e in recorded.events),
        "changed": 0 if chaser.assurance is None else chaser.assurance.changed,
    }


def row_of(solver, flights):
    """Return the table's row of a solver."""
    good = [f for f in flights if f["success"]]
    times = [f["latched_after_s"] for f in good] or [np.nan]
    impulses = [f["impulse_N_s"] for f in good] or [np.nan]
    changed = sum(f["changed"] > 0 for f in flights)
    failures = Counter(x for f in flights if not f["success"] for x in f["failures"])
    first = sum(f["attempts"] == 1 for f in good)
    return (
        f"| {solver} | {len(good)} of {len(flights)} | {first} | {np.median(times):.1f} "
        f"({np.quantile(times, 0.95):.1f}) | {np.median(impulses):.2f} "
        f"({np.quantile(impulses, 0.95):.2f}) | {changed} | "
        f"{', '.join(f'{n} {x}' for x, n in failures.items()) or 'none'} |"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", type=Path, default=FOLDER / "flight.toml")
    parser.add_argument("--solver", nargs="+", default=["policy", "rti"])
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--results", type=Path, help="append flights; what it has is not flown")
    options = parser.parse_args()
    kept = {}
    if options.results and options.results.exists():
        for line in options.results.read_text("utf-8").splitlines():
            flight = json.loads(line)
            kept[flight["solver"], flight["seed"]] = flight
    for seed in range(options.first, options.first + options.flights):
        for solver in options.solver:
            if (solver, seed) in kept:
                continue
            kept[solver, seed] = flown(options.scenario, solver, tuple(options.set), seed)
            line = json.dumps(kept[solver, seed])
            print(line, flush=True)
            if options.results:
                with options.results.open("a", encoding="utf-8") as file:
                    file.write(line + "\n")
    print(
        "| solver | docked | at the first attempt | s to the latch (95 %) | N s (95 %) | flights "
        "with changed commands | failures |\n| --- | --- | --- | --- | --- | --- | --- |"
    )
    for solver in options.solver:
        print(row_of(solver, [f for (name, _), f in kept.items() if name == solver]))


if __name__ == "__main__":
    main()
