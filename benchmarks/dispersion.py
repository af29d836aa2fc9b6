# SPDX-License-Identifier: Apache-2.0
"""Mission success over seeds under sensor errors and plant mismatch: ``python
benchmarks/dispersion.py [--only SCENARIO ...]``.

Flies shipped scenarios in one process with ``truth.preset = "mismatch"`` under the grades ``lab``
and ``orbit``; each seed draws other errors of sensors, cameras, mass properties, thrust and
disturbances. Scenarios with a capture are calibrated first under ``orbit`` (``calibrate`` at 15 s,
the approach 40 s later), and continue for up to 60 s after the scenario's end if a chaser has
retreated and tries again; ``in_time`` counts those that succeeded before. Perception is
statistical, or that of rendered images with ``--images``. Prints, per scenario and grade, how many
flights met the scenario's criteria on the true motion, the share of flights without any contact but
a probe's tip, the causes of misses, and false alarms of thruster fault detection.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from chaserdock_protocol.scenario import load_scenario
from common import (
    ROOT,
    Figures,
    append_line,
    commit,
    make_parser,
    percentiles,
    print_figures,
    read_lines,
    run_parts,
)

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages

SCENARIOS = {
    "four-chaser-docking": 100,
    "docking-contact": 100,
    "four-chaser-capture": 20,
    "single-thrusters": 100,
    "thruster-failure": 20,
}
"""Flights of each scenario and grade."""
GRADES = ("lab", "orbit")
CALIBRATE_AT_S, CALIBRATION_S = 15.0, 40.0
EXTRA_S = 60.0
"""Time after a scenario's end for another attempt at a capture."""


class DispersedFlight(NamedTuple):
    """How a flight ended: the criteria that it missed (none if it succeeded), whether it ended
    before the scenario does.
    """

    missed: tuple[str, ...]
    in_time: bool
    contacts: int
    retreats: int
    false_alarms: int
    tracking_m: float
    tracking_rad: float


def overrides_of(name: str, grade: str, seed: int, images: bool) -> tuple[str, ...]:
    """Return a shipped scenario's overrides for other errors; under ``orbit`` its captures follow a
    calibration of the cameras.
    """
    overrides = [f"seed={seed}", f'navigation.grade="{grade}"', 'truth.preset="mismatch"']
    if not images:
        overrides.append('perception.name="statistical"')
    nominal = load_scenario(ROOT / "scenarios" / f"{name}.toml", overrides)
    if grade != "orbit" or not nominal.success.latched:
        return tuple(overrides)
    commands = [
        {"at_s": c.at_s + CALIBRATION_S, "command": c.command, "chasers": list(c.chasers)}
        for c in nominal.timeline
    ]
    everyone = list(range(len(nominal.chasers)))
    commands.append({"at_s": CALIBRATE_AT_S, "command": "calibrate", "chasers": everyone})
    timeline = ",".join(
        "{"
        + ",".join(f"{key}={msgspec.json.encode(value).decode()}" for key, value in c.items())
        + "}"
        for c in sorted(commands, key=lambda c: c["at_s"])
    )
    return (
        *overrides,
        f"timeline=[{timeline}]",
        f"duration_s={nominal.duration_s + CALIBRATION_S}",
    )


def fly(name: str, grade: str, images: bool, seed: int) -> DispersedFlight:
    """Fly a mission to its end and judge it on the true motion."""
    overrides = overrides_of(name, grade, seed, images)
    path = ROOT / "scenarios" / f"{name}.toml"
    scenario = load_scenario(path, overrides)
    end_s, success = scenario.duration_s, scenario.success
    if success.latched:
        scenario = load_scenario(path, (*overrides, f"duration_s={end_s + EXTRA_S}"))
    approach = scenario.approach
    inside_since = dict.fromkeys(success.docked, math.inf)
    steady, late = [], False
    with InProcessMission(scenario, RenderedImages(scenario)) as mission:
        for tick in mission.ticks():
            for i in inside_since:
                distance_m, angle_rad = tick.tracking_errors[i]
                fits = distance_m <= approach.docked_position_m and angle_rad <= math.radians(
                    approach.docked_angle_deg
                )
                docked = mission.phase(i) in ("docked", "approach") and fits
                inside_since[i] = min(inside_since[i], tick.time_s) if docked else math.inf
            if scenario.settling_s <= tick.time_s < (scenario.steady_until_s or end_s):
                steady += list(tick.tracking_errors.values())
            late = tick.time_s > end_s
            captured = success.latched and all(
                mission.phase(i) == "verified" for i in success.latched
            )
            if captured and tick.time_s >= end_s:
                break
        missed = [
            f"chaser {i} is not docked, phase {mission.phase(i)}"
            for i, since in inside_since.items()
            if mission.phase(i) != "docked" or end_s - since < approach.docked_time_s
        ]
        missed += [
            f"chaser {i} is not verified, phase {mission.phase(i)}"
            + "".join(f", after a retreat {reason}" for reason in mission.retreats(i)[-1:])
            for i in success.latched
            if mission.phase(i) != "verified"
        ]
        missed += [f"contact of {a} and {b}" for a, b in sorted(mission.contacts)]
        retreats = sum(len(mission.retreats(i)) for i in mission.chasers)
        detected = [
            (chaser, text) for _, chaser, text in mission.thruster_events if ": detected" in text
        ]
    wrong = 0
    planned = [
        (f.chaser, f"thruster {f.thruster} {f.kind.replace('_', ' ')}: detected")
        for f in scenario.thruster_failure
    ]
    for chaser, text in detected:
        known = next((p for p in planned if p[0] == chaser and text.startswith(p[1])), None)
        wrong += known is None
        if known is not None:
            planned.remove(known)
    missed += [
        f"chaser {chaser}: missed {text.removesuffix(': detected')}" for chaser, text in planned
    ]
    rms = [math.sqrt(sum(e[k] ** 2 for e in steady) / len(steady)) for k in (0, 1)]
    return DispersedFlight(tuple(missed), not late, len(mission.contacts), retreats, wrong, *rms)


def fly_all(options: argparse.Namespace, name: str) -> Figures:
    """Fly a scenario under every grade; return and print its figures."""
    figures: Figures = {}
    number = min(2, SCENARIOS[name]) if options.quick else (options.seeds or SCENARIOS[name])
    for grade in options.grades:
        key: dict[str, Any] = {"scenario": name, "grade": grade, "images": options.images}
        rows = [r for r in read_lines(options.results) if key.items() <= r.items()]
        known = {r["seed"]: msgspec.convert(r["outcome"], DispersedFlight) for r in rows}
        todo = [seed for seed in range(number) if seed not in known]
        with ProcessPoolExecutor(options.jobs) as pool:
            for seed, outcome in zip(
                todo, pool.map(partial(fly, name, grade, options.images), todo), strict=True
            ):
                known[seed] = outcome
                append_line(
                    options.results, key | {"seed": seed, "commit": commit(), "outcome": outcome}
                )
                if outcome.missed:
                    print(f"{name} {grade} seed {seed}: {'; '.join(outcome.missed)}", flush=True)
        part = figures_of(f"{name}_{grade}".replace("-", "_"), [known[s] for s in range(number)])
        print_figures(part)
        figures |= part
    return figures


def figures_of(label: str, outcomes: list[DispersedFlight]) -> Figures:
    """Return the figures of a scenario's flights by name, and print the causes of misses."""
    for cause, count in Counter(text for o in outcomes for text in o.missed).most_common():
        print(f"  {label}: {count} x {cause}")
    return {
        f"{label}_flights": len(outcomes),
        f"{label}_successes": sum(not o.missed for o in outcomes),
        f"{label}_successes_in_time": sum(not o.missed and o.in_time for o in outcomes),
        f"{label}_contacts": sum(o.contacts for o in outcomes),
        f"{label}_retreats": sum(o.retreats for o in outcomes),
        f"{label}_false_alarms": sum(o.false_alarms for o in outcomes),
        **percentiles([o.tracking_m for o in outcomes], f"{label}_tracking", "m", "median", "max"),
        **percentiles(
            [o.tracking_rad for o in outcomes], f"{label}_tracking", "rad", "median", "max"
        ),
    }


def main() -> None:
    """Fly the scenarios."""
    parser = make_parser(__doc__, SCENARIOS)
    parser.add_argument(
        "--grades", nargs="+", choices=GRADES, default=GRADES, help="grades (default: both)"
    )
    parser.add_argument(
        "--seeds", type=int, metavar="N", help="flights (default: 100, 20 for the long ones)"
    )
    parser.add_argument(
        "--images", action="store_true", help="rendered images instead of statistics"
    )
    parser.add_argument(
        "--jobs", type=int, default=2, metavar="N", help="flights at a time (default: 2)"
    )
    parser.add_argument(
        "--results",
        type=Path,
        metavar="FILE",
        help="append flights; flights in it are not repeated",
    )
    options = parser.parse_args()
    run_parts(options, {name: partial(fly_all, options, name) for name in SCENARIOS})


if __name__ == "__main__":
    main()
