# SPDX-License-Identifier: Apache-2.0
"""Every shipped scenario under other errors: ``python benchmarks/shipped.py [--only SCENARIO
...]``.

Flies each scenario under every grade with rendered images and plant mismatch (``truth.preset =
"mismatch"``), all processes in one (``chaserdock simulate``), which gives the same flight as
separate ones. Each seed draws other errors of sensors, cameras, mass properties, thrust and
disturbances. Under ``orbit`` captures follow a calibration of the cameras (``calibrate`` at 15 s,
the approach 40 s later). Prints a row of a table for each scenario: RMS tracking error of the worst
chaser in steady state against ground truth, and the criteria that the flights missed.

``--digests FILE`` flies the scenarios as shipped instead, the longest ones shortened, and writes a
JSON object of the digests of their messages by name: equal digests before and after a change of the
sources prove equal behaviour on one machine. ``--compare BASE`` compares with an earlier such file;
status 1 if they differ.
"""

from __future__ import annotations

import json
import math
import tempfile
from argparse import ArgumentParser
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.navigation import GRADES
from chaserdock_protocol.shipped_scenarios import find_scenario
from common import (
    Figures,
    KeptResults,
    Options,
    add_shared,
    make_parser,
    map_jobs,
    percentiles,
    seeds_of,
    write_json,
)

import chaserdock as cd
from chaserdock.analysis.flight import RecordedFlight, load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate
from chaserdock.summary import Summary

NOT_GRADED = ("endurance", "paper-single")
"""An hour long; as in the paper, exact."""
CALIBRATE_AT_S, CALIBRATION_S = 15.0, 40.0
"""The manoeuvre takes 30 s."""
STATISTICAL = "perception.name='statistical'"
LONGEST_S = {
    "endurance": 300.0,
    "arch-comp-rendezvous": 14_300.0,
    "v-bar": 400.0,
    "v-bar-images": 520.0,
    "afrl-docking": 400.0,
    "r-bar": 400.0,
}
"""Durations of digests: enough for each phase of the flight, in minutes of processor time."""
LONGEST_WITH_IMAGES_S = {**LONGEST_S, "v-bar-images": 60.0}
"""With images, `v-bar-images` costs much more."""
QUICK_S = 5.0
"""With ``--quick``."""
QUICK = ("fault-drill", "single")


# -- Grades ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ShippedOutcome:
    """How a flight ended: the criteria that it missed (none if it succeeded), RMS tracking errors
    of the worst chaser (NaN without steady state), and wrong diagnoses of thrusters.
    """

    missed: tuple[str, ...]
    tracking_m: float
    tracking_rad: float
    collisions: int
    false_alarms: int


def overrides_of(name: str, grade: str, seed: int, statistical: bool) -> tuple[str, ...]:
    """Return a scenario's overrides for other errors; under ``orbit`` its captures follow a
    calibration of the cameras.
    """
    overrides = [f"seed={seed}", f'navigation.grade="{grade}"', 'truth.preset="mismatch"']
    if statistical:
        overrides.append(STATISTICAL)
    nominal = load_scenario(find_scenario(name), overrides)
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


def fly(name: str, overrides: tuple[str, ...]) -> RecordedFlight:
    """Fly a shipped scenario. Raises SystemExit without a complete log."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        flight = simulate(find_scenario(name), out, overrides)
        if flight.crashes or flight.stalled:
            raise SystemExit(f"{name}: {flight.crashes or flight.stalled}")
        return load_flight(out / "mission.mcap")


def fly_graded(name: str, grade: str, options: Options, seed: int) -> ShippedOutcome:
    """Fly a scenario under a grade and judge it."""
    overrides = overrides_of(name, grade, seed, options.statistical)
    flight = fly(name, (*overrides, *options.set))
    summary = Summary.from_dict(summary_of(flight))
    steady = [c.steady for c in summary.chasers.values()]
    position, angle = (
        math.sqrt(max((x for x in values if x is not None), default=math.nan))
        for values in (
            [s.position_mse_m2 for s in steady],
            [s.orientation_mse_rad2 for s in steady],
        )
    )
    assert summary.collisions is not None  # simulated flights have ground truth
    return ShippedOutcome(
        tuple(summary.failures), position, angle, summary.collisions, false_alarms(flight)
    )


def false_alarms(flight: RecordedFlight) -> int:
    """Return the number of diagnoses of thrusters that did not fail so."""
    planned = [
        (f"chaser/{f.chaser}", f"thruster {f.thruster} {f.kind.replace('_', ' ')}: detected")
        for f in flight.scenario.thruster_failure
    ]
    wrong = 0
    for event in flight.events:
        text = f"{event.what}: {event.detail}"
        if ": detected" in text:
            known = next((p for p in planned if (event.process, text[: len(p[1])]) == p), None)
            wrong += known is None
            if known is not None:
                planned.remove(known)
    return wrong


def cell_of(outcomes: list[ShippedOutcome]) -> str:
    """Return the cell of the table for the flights of a scenario under a grade."""
    causes = Counter(text for o in outcomes for text in o.missed)
    if len(outcomes) == 1:
        (o,) = outcomes
        text = f"{o.tracking_m * 1e3:.2f} mm, {math.degrees(o.tracking_rad):.3f} deg"
        return text + "".join(f"; missed: {cause}" for cause in o.missed)
    text = f"{sum(not o.missed for o in outcomes)} of {len(outcomes)}"
    return text + "".join(f"; {n} x {cause}" for cause, n in causes.most_common())


def figures_of(label: str, outcomes: list[ShippedOutcome]) -> Figures:
    """Return the figures of a scenario's flights under a grade."""
    out: Figures = {
        f"{label}_flights": len(outcomes),
        f"{label}_successes": sum(not o.missed for o in outcomes),
        f"{label}_collisions": sum(o.collisions for o in outcomes),
        f"{label}_false_alarms": sum(o.false_alarms for o in outcomes),
    }
    for unit, values in (
        ("m", [o.tracking_m for o in outcomes]),
        ("rad", [o.tracking_rad for o in outcomes]),
    ):
        out |= percentiles(values, f"{label}_tracking", unit, "median", "max")
    return out


def fly_grades(names: list[str], options: Options) -> Figures:
    """Fly the scenarios under every grade, and print the table."""
    figures: Figures = {}
    print(f"| scenario | {' | '.join(options.grades)} |\n|{' --- |' * (1 + len(options.grades))}")
    for name in names:
        cells = []
        for grade in options.grades:
            key = {"scenario": name, "grade": grade, "set": options.set}
            results = KeptResults(
                options.results, key | {"statistical": options.statistical}, ShippedOutcome
            )
            outcomes = results.of(
                seeds_of(options, 1, 1),
                partial(fly_graded, name, grade, options),
                jobs=options.jobs,
            )
            cells.append(cell_of(outcomes))
            figures |= figures_of(f"{name}_{grade}".replace("-", "_"), outcomes)
        print(f"| `{name}` | {' | '.join(cells)} |", flush=True)
    return figures


# -- Digests ---------------------------------------------------------------------------------------


def shortened(scenario: Scenario, longest_s: float) -> list[str]:
    """Return overrides by which a scenario lasts ``longest_s`` at most, without its timeline if
    that is not over by then.
    """
    if longest_s >= scenario.duration_s:
        return []
    overrides = [f"duration_s={longest_s}"]
    if any(entry.at_s >= longest_s for entry in scenario.timeline):
        overrides.append("timeline=[]")
    if scenario.settling_s >= longest_s:
        overrides.append("settling_s=0.0")
    return overrides


def digest_of(statistical: bool, quick: bool, name: str) -> str:
    """Return the digest of a scenario as shipped, or why it has none."""
    scenario = load_scenario(find_scenario(name))
    longest = LONGEST_S if statistical else LONGEST_WITH_IMAGES_S
    longest_s = QUICK_S if quick else longest.get(name, math.inf)
    overrides = shortened(scenario, longest_s)
    if statistical and scenario.perception.name != "statistical":
        overrides.append(STATISTICAL)
    try:
        return fly(name, tuple(overrides)).digest
    except SystemExit as failure:  # the others are flown nevertheless
        return str(failure)


def write_digests(names: list[str], options: Options) -> None:
    """Write the digests of the scenarios, and compare them if there is a base. Raises SystemExit if
    they differ.
    """
    digests: dict[str, str] = {}
    flown = map_jobs(partial(digest_of, options.statistical, options.quick), names, options.jobs)
    for name, digest in zip(names, flown, strict=True):
        digests[name] = digest
        print(f"{name} {digest}", flush=True)
        options.digests.write_text(json.dumps(digests, indent=1) + "\n", encoding="utf-8")
    if options.compare is not None:
        base = json.loads(options.compare.read_text(encoding="utf-8"))
        differing = [name for name in names if base.get(name) != digests[name]]
        print(f"{len(names) - len(differing)} of {len(names)} equal")
        if differing:
            raise SystemExit(f"different: {', '.join(differing)}")


def add_options(parser: ArgumentParser, names: list[str]) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--only", nargs="+", choices=names, metavar="SCENARIO", help="default: all")
    parser.add_argument("--grades", nargs="+", choices=GRADES, default=["exact", "lab", "orbit"])
    parser.add_argument(
        "--statistical", action="store_true", help="statistical perception in place of images"
    )
    parser.add_argument("--digests", type=Path, metavar="FILE", help="write digests instead")
    parser.add_argument("--compare", type=Path, metavar="BASE", help="of digests: earlier ones")


def main() -> None:
    """Fly the scenarios and print the table, or write digests."""
    shipped = cd.list_scenarios()
    parser = make_parser(__doc__)
    add_options(parser, shipped)
    add_shared(parser, ("flights", "first", "jobs", "set", "results"))
    options = parser.parse_args()
    if options.digests is not None:
        write_digests(options.only or shipped, options)
        return
    names = options.only or [name for name in shipped if name not in NOT_GRADED]
    if options.quick:
        names, options.grades, options.statistical = [*(options.only or QUICK)], ["lab"], True
    write_json(options.json, fly_grades(names, options))


if __name__ == "__main__":
    main()
