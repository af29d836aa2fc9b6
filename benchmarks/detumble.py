# SPDX-License-Identifier: Apache-2.0
"""Stopping a tumbling client: ``python benchmarks/detumble.py [--quick] [--json FILE] [--tumbles N]
[--first SEED] [--sets 0123 013 03] [--silent | --rigid CASE | --vision | --optimum] [--limits FORCE
TORQUE] [--set KEY=VALUE] [--results FILE]``.

Flies stacks of the client of ``detumble`` and some of its chasers, latched from the start, in one
process with the scenario's sensors and statistical perception. Tumbles of 5 to 10 degrees/s and
attitudes are drawn from the seed. Five seconds after the start all chasers are commanded to
detumble. A set such as ``03`` names chasers of the scenario: 0 and 3 are at opposite faces, 0 and 1
at adjacent ones.

Prints the time until the stack stays below 0.05 degrees/s and 1 mm/s, the impulse of all thrusters
until then, and both over those of the linear programme: the shortest time, and the least impulse in
that time, if the attitude were frozen. ``--silent``: nobody commands; each chaser damps the stack
by its own odometry for at most 120 s, until 10 s after it stopped. The stack is then one rigid body
(``flights.rigid_stack``), not the physics engine's.

``--limits FORCE TORQUE``: load limits (N, N m) of every port, kept by the controller. The largest
loads at a port are printed: from the physics engine's joints in every step, or with ``--rigid``
from the equations of motion at the same rate of 960 Hz.

``--rigid CASE``: identification and plan in closed loop with one rigid body
(``flights.rigid_control``). The stated mass and inertia are 30 % wrong, the stated
centre of mass 88 mm; thrusts (3 %) and pulses (2 %) have errors. CASE: ``plan`` (13.5 s; two
chasers 14.4 s, one 50 s), ``known`` (the same, but mass, centre and inertia are stated as they
are), ``identify`` (10 s of identifying pulses before it, 30 s in all), ``fast`` (feedback only),
``stuck`` (a thruster drawn from the seed is stuck off from the start, not reported), ``reported``
(the same, reported), ``lost`` (a chaser dies at a random moment), ``silent`` (feedback; no
controller from 1 s on, 120 s at most), ``limited`` (``--limits 2.5 0.9``).

``--optimum``: no flight; the least impulse found that stops the stack in 15.5 s, over that of the
linear programme, with the true stack, from 40 random guesses: what no controller can be expected to
undercut.

``--vision``: no capture; the chasers of each set keep their places around the free target for 60 s,
which tumbles at 7 degrees/s about an axis drawn from the seed, with the same wrong statements.
Prints the errors of the ratios of the inertia (its elements over its trace, as a share of the
largest moment over the trace) and of the centre of mass, and the normalized squared errors of
ratios (expected 5), centre (3) and relative poses (6). Sightings are drawn
(``flights.free_tumble_flights``), or with ``--set 'perception.name="default"'`` those
of images.

``--results FILE`` appends every flight to FILE (JSON lines) and does not repeat flights that are in
it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from common import (
    Figures,
    append_line,
    make_parser,
    percentiles,
    print_figures,
    read_lines,
    write_json,
)
from flights.detumble_flights import (
    DetumbleOutcome,
    fly_stack,
    stack_scenario,
    with_load_limits,
)
from flights.free_tumble_flights import TumbleOutcome, tumble_scenario, watch_tumble
from flights.rigid_control import (
    FlightEvents,
    StackFlight,
    fly_controlled,
    optimum_share,
    right_knowledge,
    wrong_knowledge,
)
from flights.rigid_stack import SilentOutcome, fly_silent

from chaserdock.experiments.perception import RenderedImages

VISION_DEG_S, VISION_S = 7.0, 60.0
PLAN_S = {2: 14.4}
"""Time of the plan by number of chasers, s; of more than two 13.5."""
OPTIMUM_S, OPTIMUM_GUESSES = 15.5, 40


_Outcome = TypeVar("_Outcome")


class DetumbleRow(msgspec.Struct, frozen=True):
    """One flight in the results file: chasers, settings and outcome."""

    chasers: str
    settings: str
    outcome: DetumbleOutcome


def line_of(o: DetumbleOutcome) -> str:
    """Return a flight as one line."""
    head = f"seed {o.seed}: {o.rate_deg_s:.1f} degrees/s"
    if o.refused:
        return f"{head}, refused: {o.refused}"
    least = (
        "no linear programme"
        if o.least is None
        else f"LP {o.least.time_s:.2f} s, {o.least.impulse_N_s:.1f} N s"
    )
    time = "not stopped" if o.time_s is None else f"{o.time_s:.2f} s"
    return f"{head}, {time}, {o.impulse_N_s:.1f} N s; {least}"


def figures_of(name: str, outcomes: list[DetumbleOutcome]) -> Figures:
    """Return the figures of a set of chasers."""
    stopped = [o for o in outcomes if o.time_s is not None]
    out: Figures = {
        f"{name}_flights": len(outcomes),
        f"{name}_stopped": len(stopped),
        f"{name}_refused": sum(bool(o.refused) for o in outcomes),
    }
    if not stopped:
        return out
    least = [
        (o, o.time_s, o.least) for o in stopped if o.time_s is not None and o.least is not None
    ]
    held_s = sum(o.held_s for o in stopped)
    for key, unit, values in (
        ("time", "s", [o.time_s for o in stopped if o.time_s is not None]),
        ("impulse", "N_s", [o.impulse_N_s for o in stopped]),
        ("lp_time", "s", [x.time_s for _, _, x in least]),
        ("lp_impulse", "N_s", [x.impulse_N_s for _, _, x in least]),
        ("time_over_lp", "ratio", [time_s / x.time_s for _, time_s, x in least]),
        ("impulse_over_lp", "ratio", [o.impulse_N_s / x.impulse_N_s for o, _, x in least]),
        ("final_rate", "deg_s", [o.final_rate_deg_s for o in stopped]),
        ("final_speed", "m_s", [o.final_speed_m_s for o in stopped]),
        ("port_force", "N", [o.peak_force_N for o in stopped if o.peak_force_N is not None]),
        (
            "port_torque",
            "N_m",
            [o.peak_torque_N_m for o in stopped if o.peak_torque_N_m is not None],
        ),
    ):
        if values:
            out |= percentiles(values, f"{name}_{key}", unit, "median", "max")
    return out | {f"{name}_held_N_s_per_minute": 60.0 * sum(o.held_N_s for o in stopped) / held_s}


def fly_sets(
    o: argparse.Namespace,
    seeds: range,
    known: Mapping[tuple[str, int], _Outcome],
    fly: Callable[[str, int], _Outcome],
    row: Callable[[str, int, _Outcome], msgspec.Struct],
    line: Callable[[str, int, _Outcome], str],
    figures_of_set: Callable[[str, list[_Outcome]], Figures],
) -> Figures:
    """Fly every set of chasers with every seed that is not ``known``; return the figures.

    ``row``: of a flight for the results file; ``line``: for the terminal.
    """
    figures: Figures = {}
    for chasers in o.sets:
        outcomes = []
        for seed in seeds:
            outcome = known.get((chasers, seed))
            if outcome is None:
                outcome = fly(chasers, seed)
                append_line(o.results, msgspec.to_builtins(row(chasers, seed, outcome)))
                print(line(chasers, seed, outcome), file=sys.stderr, flush=True)
            outcomes.append(outcome)
        figures |= (part := figures_of_set(chasers, outcomes))
        print_figures(part)
    return figures


class SilentRow(msgspec.Struct, frozen=True):
    """One flight without controller in the results file."""

    chasers: str
    settings: str
    seed: int
    outcome: SilentOutcome


def silent_figures(name: str, outcomes: list[SilentOutcome]) -> Figures:
    """Return the figures of a set of chasers without controller."""
    stopped = [o for o in outcomes if o.time_s is not None]
    out: Figures = {f"{name}_flights": len(outcomes), f"{name}_stopped": len(stopped)}
    for key, unit, values in (
        ("time", "s", [o.time_s for o in stopped if o.time_s is not None]),
        ("impulse", "N_s", [o.impulse_N_s for o in stopped]),
        ("impulse_at_rest", "N_s", [o.held_N_s for o in stopped]),
        ("final_rate", "deg_s", [o.final_rate_deg_s for o in outcomes]),
        ("final_speed", "m_s", [o.final_speed_m_s for o in outcomes]),
    ):
        if values:
            out |= percentiles(values, f"{name}_{key}", unit, "median", "max")
    return out


def fly_sets_silent(o: argparse.Namespace, seeds: range) -> Figures:
    """Fly every set of chasers without controller; return the figures."""
    settings = f"silent set={sorted(o.set)}"
    known = {
        (row["chasers"], row["seed"]): msgspec.convert(row, SilentRow).outcome
        for row in read_lines(o.results)
        if row["settings"] == settings
    }
    return fly_sets(
        o,
        seeds,
        known,
        lambda chasers, seed: fly_silent(
            stack_scenario(seed, numbers_of(chasers), o.set), rest_s=10.0
        ),
        lambda chasers, seed, outcome: SilentRow(chasers, settings, seed, outcome),
        lambda chasers, seed, outcome: f"{chasers} seed {seed}: {outcome}",
        lambda chasers, outcomes: silent_figures(f"silent_{chasers}", outcomes),
    )


class RigidRow(msgspec.Struct, frozen=True):
    """One flight of a rigid stack in the results file."""

    chasers: str
    case: str
    flight: StackFlight


def fly_rigid(case: str, chasers: str, seed: int, o: argparse.Namespace) -> StackFlight:
    """Fly one case."""
    numbers, one = numbers_of(chasers), len(chasers) == 1
    known = right_knowledge() if case == "known" else []
    settings, events = [*wrong_knowledge(seed), *known, *o.set], FlightEvents()
    if case not in ("fast", "silent"):
        settings.append(f"detumble.plan_s={PLAN_S.get(len(numbers), 13.5)}")
    if one:
        settings += ["detumble.rate_deg_s=0.1", "detumble.speed_m_s=0.002"]
    rng = np.random.default_rng([seed, 0xFA])
    match case:
        case "stuck" | "reported":
            chaser, thruster = drawn_thruster(rng, len(numbers))
            failure = f"{{chaser={chaser},thruster={thruster},at_s=0.0,kind='stuck_off'}}"
            settings.append(f"thruster_failure=[{failure}]")
            if case == "reported":
                events = FlightEvents(reported=(chaser, thruster))
        case "lost":
            events = FlightEvents(
                loss=(float(rng.uniform(0.5, 10.0)), int(rng.integers(len(numbers))))
            )
        case "silent":
            events = FlightEvents(silent_from_s=1.0)
    scenario = stack_scenario(seed, numbers, settings)
    limits = o.limits or ([2.5, 0.9] if case == "limited" else None)
    if limits:
        scenario = with_load_limits(scenario, *limits)
    durations_s = {"plan": 20.0, "known": 20.0, "identify": 20.0, "fast": 20.0, "silent": 120.0}
    return fly_controlled(
        scenario,
        90.0 if one else durations_s.get(case, 40.0),
        10.0 if case == "identify" else 0.0,
        events,
    )


def drawn_thruster(rng: np.random.Generator, chasers: int) -> tuple[int, int]:
    """Return chaser and number of one of the thrusters that may fire: those that push their chaser
    towards the port.
    """
    scenario = stack_scenario(0, list(range(chasers)))
    able = [k for k, t in enumerate(scenario.chaser.thrusters) if t.direction[0] > 0.0]
    return int(rng.integers(chasers)), int(rng.choice(able))


def rigid_figures(name: str, flights: list[StackFlight]) -> Figures:
    """Return the figures of a set of chasers in a case."""
    stopped = [f for f in flights if f.time_s is not None]
    out: Figures = {
        f"{name}_flights": len(flights),
        f"{name}_stopped": len(stopped),
        f"{name}_refused": sum(bool(f.refused) for f in flights),
        f"{name}_thrusters_isolated": sum(bool(f.failed) for f in flights),
    }
    least = [(f, f.least) for f in stopped if f.least is not None]
    for key, unit, values in (
        ("time", "s", [f.time_s for f in stopped if f.time_s is not None]),
        ("impulse", "N_s", [f.impulse_N_s for f in stopped]),
        ("lp_time", "s", [x.time_s for _, x in least]),
        ("impulse_over_lp", "ratio", [f.impulse_N_s / x.impulse_N_s for f, x in least]),
        ("time_over_lp", "ratio", [f.time_s / x.time_s for f, x in least if f.time_s is not None]),
        ("final_rate", "deg_s", [f.final_rate_deg_s for f in stopped]),
        ("final_speed", "m_s", [f.final_speed_m_s for f in stopped]),
        (
            "mass_error",
            "share",
            [f.mass_share for f in flights if f.mass_share is not None and not f.refused],
        ),
        (
            "centre_error",
            "m",
            [f.centre_m for f in flights if f.centre_m is not None and not f.refused],
        ),
        (
            "inertia_error",
            "share",
            [f.inertia_share for f in flights if f.inertia_share is not None and not f.refused],
        ),
        ("nees", "ratio", [f.nees for f in flights if f.nees is not None and not f.refused]),
        ("port_force", "N", [f.peak_force_N for f in flights if f.peak_force_N is not None]),
        (
            "port_torque",
            "N_m",
            [f.peak_torque_N_m for f in flights if f.peak_torque_N_m is not None],
        ),
    ):
        if values:
            out |= percentiles(values, f"{name}_{key}", unit, "median", "max")
    known = [f.nees for f in flights if f.nees is not None and not f.refused]
    return out | ({f"{name}_nees_mean_ratio": float(np.mean(known))} if known else {})


def fly_sets_rigid(o: argparse.Namespace, seeds: range) -> Figures:
    """Fly a case with every set of chasers; return the figures."""
    limits = f" limits={o.limits}" if o.limits else ""
    case = f"{o.rigid} set={sorted(o.set)}{limits}"
    known = {
        (row["chasers"], row["flight"]["seed"]): msgspec.convert(row, RigidRow).flight
        for row in read_lines(o.results)
        if row["case"] == case
    }
    return fly_sets(
        o,
        seeds,
        known,
        lambda chasers, seed: fly_rigid(o.rigid, chasers, seed, o),
        lambda chasers, _, flight: RigidRow(chasers, case, flight),
        lambda chasers, _, flight: f"{o.rigid} {chasers}: {flight}",
        lambda chasers, flights: rigid_figures(f"{o.rigid}_{chasers}", flights),
    )


def print_optima(o: argparse.Namespace, seeds: range) -> Figures:
    """Search the least impulse for every set of chasers; return the figures."""
    figures: Figures = {}
    for chasers in o.sets:
        shares = []
        for seed in seeds:
            scenario = stack_scenario(seed, numbers_of(chasers), [*wrong_knowledge(seed), *o.set])
            shares.append(optimum_share(scenario, OPTIMUM_S, OPTIMUM_GUESSES))
            print(f"{chasers}: seed {seed}: {shares[-1]:.3f}", file=sys.stderr, flush=True)
        figures |= (
            part := percentiles(shares, f"optimum_{chasers}_over_lp", "ratio", "median", "max")
        )
        print_figures(part)
    return figures


class VisionRow(msgspec.Struct, frozen=True):
    """One tumble without capture in the results file."""

    chasers: str
    settings: str
    outcome: TumbleOutcome


def vision_figures(name: str, tumbles: list[TumbleOutcome]) -> Figures:
    """Return the figures of a set of chasers that watch the free target."""
    out: Figures = {f"{name}_tumbles": len(tumbles)}
    for key, unit, values in (
        ("ratio_error", "share", [t.ratio_error for t in tumbles]),
        ("stated_error", "share", [t.stated_error for t in tumbles]),
        ("centre_error", "m", [t.centre_m for t in tumbles]),
        ("ratio_nees", "of_5", [t.ratio_nees for t in tumbles]),
        ("centre_nees", "of_3", [t.centre_nees for t in tumbles]),
        ("pose_nees", "of_6", [t.nees for t in tumbles]),
    ):
        out |= {f"{name}_{key}_mean_{unit}": float(np.mean(values))}
        out |= percentiles(values, f"{name}_{key}", unit, "median", "max")
    return out


def fly_sets_vision(o: argparse.Namespace, seeds: range) -> Figures:
    """Watch free tumbles with every set of chasers; return the figures."""
    settings = f"vision set={sorted(o.set)}"
    known = {
        (row["chasers"], row["outcome"]["seed"]): msgspec.convert(row, VisionRow).outcome
        for row in read_lines(o.results)
        if row.get("settings") == settings
    }
    return fly_sets(
        o,
        seeds,
        known,
        lambda chasers, seed: watch_tumble(
            tumble_scenario(seed, numbers_of(chasers), VISION_DEG_S, o.set), VISION_S
        ),
        lambda chasers, _, outcome: VisionRow(chasers, settings, outcome),
        lambda chasers, _, outcome: f"{chasers}: {outcome}",
        lambda chasers, outcomes: vision_figures(f"vision_{chasers}", outcomes),
    )


def fly_sets_whole(o: argparse.Namespace, seeds: range) -> Figures:
    """Fly every set of chasers with rendered images; return the figures."""
    settings = f"duration={o.duration:g} set={sorted(o.set)}"
    settings += f" limits={o.limits}" if o.limits else ""
    rows = [
        msgspec.convert(row, DetumbleRow)
        for row in read_lines(o.results)
        if row["settings"] == settings
    ]

    def fly(chasers: str, seed: int) -> DetumbleOutcome:
        scenario = stack_scenario(seed, numbers_of(chasers), o.set)
        if o.limits:
            scenario = with_load_limits(scenario, *o.limits)
        return fly_stack(scenario, RenderedImages, o.duration)

    return fly_sets(
        o,
        seeds,
        {(r.chasers, r.outcome.seed): r.outcome for r in rows},
        fly,
        lambda chasers, _, outcome: DetumbleRow(chasers, settings, outcome),
        lambda chasers, _, outcome: f"{chasers} {line_of(outcome)}",
        lambda chasers, outcomes: figures_of(f"chasers_{chasers}", outcomes),
    )


def numbers_of(chasers: str) -> list[int]:
    """Return the numbers of a set of chasers."""
    return [int(c) for c in chasers]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--silent", action="store_true", help="without a controller")
    cases = ("plan", "known", "identify", "fast", "stuck", "reported", "lost", "silent", "limited")
    parser.add_argument("--rigid", choices=cases, help="identification and plan, on one rigid body")
    parser.add_argument(
        "--vision", action="store_true", help="what the free tumble shows, without a capture"
    )
    parser.add_argument(
        "--optimum", action="store_true", help="the least impulse, without a flight"
    )
    parser.add_argument(
        "--limits",
        type=float,
        nargs=2,
        metavar=("FORCE", "TORQUE"),
        help="of every port, N and N m",
    )
    parser.add_argument("--tumbles", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sets", nargs="+", default=["0123", "013", "03"], metavar="CHASERS")
    parser.add_argument("--duration", type=float, default=30.0, help="s, from the command on")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="scenario override"
    )
    parser.add_argument("--results", type=Path, metavar="FILE")
    o = parser.parse_args()
    fly = fly_sets_whole
    if o.silent:
        fly = fly_sets_silent
    elif o.vision:
        fly = fly_sets_vision
    elif o.optimum:
        fly = print_optima
    elif o.rigid:
        fly = fly_sets_rigid
    write_json(o.json, fly(o, range(o.first, o.first + (2 if o.quick else o.tumbles))))


if __name__ == "__main__":
    main()
