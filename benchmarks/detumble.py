# SPDX-License-Identifier: Apache-2.0
"""Stopping a tumbling client: ``python benchmarks/detumble.py [--only PART ...]``.

Stacks of the client of ``detumble`` and some of its chasers, latched from the start with errors of
a few millimetres. Tumbles of 5 to 10 degrees/s and attitudes are drawn from the seed. A set such as
``03`` names chasers of the scenario: 0 and 3 are at opposite faces, 0 and 1 at adjacent ones.

Time until the stack stays below 0.05 degrees/s and 1 mm/s, impulse of all thrusters until then, and
both over those of the linear programme: the shortest time, and the least impulse in that time, if
the attitude were frozen. Largest loads at a port are those of the physics engine's joints in every
step (``engine``), or of the equations of motion at the same rate of 960 Hz.

All parts but ``engine`` fly identification and plan in closed loop with the stack as one rigid body
(``flights.rigid_control``). The stated mass and inertia are 30 % wrong, the stated centre of mass
88 mm; thrusts (3 %) and pulses (2 %) have errors.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
from chaserdock_protocol.scenario import Scenario
from common import Figures, Group, KeptResults, Options, described, main, seeds_of, summaries
from flights.detumble_flights import (
    DetumbleOutcome,
    fly_stack,
    stack_scenario,
    with_load_limits,
)
from flights.free_tumble_flights import TumbleOutcome, tumble_scenario, watch_tumble
from flights.rigid_control import (
    FlightEvents,
    fly_controlled,
    optimum_share,
    right_knowledge,
    wrong_knowledge,
)

from chaserdock.experiments.perception import RenderedImages

VISION_DEG_S, VISION_S = 7.0, 60.0
"""Rate of a free tumble, and how long it is watched."""
OPTIMUM_S, OPTIMUM_GUESSES = 15.5, 40
"""Time in which the least impulse stops a stack, and random guesses from which it is searched."""
ALONE = ("detumble.rate_deg_s=0.1", "detumble.speed_m_s=0.002")
"""Limits of rest of a single chaser, whose thrusters push one way only."""
ALONE_S = 90.0
"""Time that a single chaser is given to stop the stack."""

T = TypeVar("T")


def plan_of(chasers: int) -> list[str]:
    """Return the time of the plan: two chasers need 14.4 s, more 13.5 s."""
    return [f"detumble.plan_s={14.4 if chasers == 2 else 13.5}"]


def nothing(_: np.random.Generator, __: int) -> tuple[list[str], FlightEvents]:
    """Let nothing happen."""
    return [], FlightEvents()


def stuck(rng: np.random.Generator, chasers: int) -> tuple[list[str], FlightEvents]:
    """Let a drawn thruster be stuck off from the start, not reported."""
    chaser, thruster = drawn_thruster(rng, chasers)
    failure = f"{{chaser={chaser},thruster={thruster},at_s=0.0,kind='stuck_off'}}"
    return [f"thruster_failure=[{failure}]"], FlightEvents()


def reported(rng: np.random.Generator, chasers: int) -> tuple[list[str], FlightEvents]:
    """Let a drawn thruster be stuck off, and its chaser report it."""
    chaser, thruster = drawn_thruster(rng, chasers)
    failure = f"{{chaser={chaser},thruster={thruster},at_s=0.0,kind='stuck_off'}}"
    return [f"thruster_failure=[{failure}]"], FlightEvents(reported=(chaser, thruster))


def lost(rng: np.random.Generator, chasers: int) -> tuple[list[str], FlightEvents]:
    """Let a drawn chaser die at a random moment."""
    at_s = float(rng.uniform(0.5, 10.0))
    return [], FlightEvents(loss=(at_s, int(rng.integers(chasers))))


def drawn_thruster(rng: np.random.Generator, chasers: int) -> tuple[int, int]:
    """Return chaser and number of one of the thrusters that may fire: those that push their chaser
    towards the port.
    """
    scenario = stack_scenario(0, list(range(chasers)))
    able = [k for k, t in enumerate(scenario.chaser.thrusters) if t.direction[0] > 0.0]
    return int(rng.integers(chasers)), int(rng.choice(able))


@dataclass(frozen=True)
class RigidCase:
    """A case of a stack as one rigid body.

    ``draw``: overrides and events by a generator and the number of chasers. ``limits``: of force
    (N) and torque (N m) at every port.
    """

    text: str
    draw: Callable[[np.random.Generator, int], tuple[list[str], FlightEvents]] = nothing
    plans: bool = True
    knows: bool = False
    duration_s: float = 20.0
    identify_s: float = 0.0
    limits: tuple[float, float] | None = None


CASES: Mapping[str, RigidCase] = {
    "plan": RigidCase("Stop by a plan of 13.5 s (two chasers 14.4 s)."),
    "known": RigidCase("Stop so with mass, centre and inertia stated as they are.", knows=True),
    "identify": RigidCase("Stop so after 10 s of identifying pulses.", identify_s=10.0),
    "fast": RigidCase("Stop by feedback only.", plans=False),
    "stuck": RigidCase("Stop with a thruster stuck off, not reported.", stuck, duration_s=40.0),
    "reported": RigidCase("Stop with a thruster stuck off, reported.", reported, duration_s=40.0),
    "lost": RigidCase("Stop while a drawn chaser dies at a random moment.", lost, duration_s=40.0),
    "limited": RigidCase("Stop with at most 2.5 N and 0.9 N m at every port.", duration_s=40.0,
                         limits=(2.5, 0.9)),
    "silent": RigidCase("Stop without a controller from 1 s on: each chaser by its own odometry.",
                        lambda *_: ([], FlightEvents(silent_from_s=1.0)), False, duration_s=120.0),
    "uncommanded": RigidCase("Stop without a controller from the start.",
                             lambda *_: ([], FlightEvents(silent_from_s=0.0)), False,
                             duration_s=120.0),
}  # fmt: skip


def fly_rigid(name: str, options: Options, chasers: str, seed: int) -> DetumbleOutcome:
    """Fly a case."""
    case, count, alone = CASES[name], len(chasers), len(chasers) == 1
    changes, events = case.draw(np.random.default_rng([seed, 0xFA]), count)
    known = right_knowledge() if case.knows else []
    settings = [
        *wrong_knowledge(seed),
        *known,
        *options.set,
        *(plan_of(count) if case.plans else []),
    ]
    scenario = stack_scenario(
        seed, numbers_of(chasers), [*settings, *(ALONE if alone else ()), *changes]
    )
    return fly_controlled(
        limited(scenario, options.limits or case.limits),
        ALONE_S if alone else case.duration_s,
        case.identify_s,
        events,
    )


def limited(scenario: Scenario, limits: tuple[float, float] | None) -> Scenario:
    """Return the scenario with load limits of every port, if there are any."""
    return with_load_limits(scenario, *limits) if limits else scenario


def fly_in_engine(options: Options, chasers: str, seed: int) -> DetumbleOutcome:
    """Fly a stack in the physics engine with statistical perception."""
    scenario = stack_scenario(seed, numbers_of(chasers), options.set)
    duration_s = 20.0 if options.quick else options.duration_s
    return fly_stack(limited(scenario, options.limits), RenderedImages, duration_s)


def watch(options: Options, chasers: str, seed: int) -> TumbleOutcome:
    """Watch a free tumble."""
    scenario = tumble_scenario(seed, numbers_of(chasers), VISION_DEG_S, options.set)
    return watch_tumble(scenario, 15.0 if options.quick else VISION_S)


def search_optimum(options: Options, chasers: str, seed: int) -> float:
    """Return the least impulse found over that of the linear programme."""
    scenario = stack_scenario(seed, numbers_of(chasers), [*wrong_knowledge(seed), *options.set])
    return optimum_share(scenario, OPTIMUM_S, 2 if options.quick else OPTIMUM_GUESSES)


def fly_sets(
    part: str,
    kind: type[T],
    fly: Callable[[Options, str, int], T],
    line: Callable[[T], str],
    figures: Callable[[str, list[T]], Figures],
    options: Options,
) -> Figures:
    """Fly every set of chasers with 50 seeds (``--quick``: one set with one)."""
    found = Figures()
    for chasers in options.sets[:1] if options.quick else options.sets:
        key = {"part": part, "chasers": chasers, "set": sorted(options.set)}
        key |= {"limits": options.limits, "duration_s": options.duration_s}
        outcomes = KeptResults(options.results, key, kind).of(
            seeds_of(options, 50, 1), partial(fly, options, chasers), line, options.jobs
        )
        found |= figures(f"{part}_{chasers}", outcomes)
    return found


def detumble_figures(name: str, flights: list[DetumbleOutcome]) -> Figures:
    """Return the figures of a set of chasers."""
    stopped = [f for f in flights if f.time_s is not None]
    judged = [f for f in flights if not f.refused]
    out: Figures = {
        f"{name}_flights": len(flights),
        f"{name}_stopped": len(stopped),
        f"{name}_refused": len(flights) - len(judged),
        f"{name}_thrusters_isolated": sum(bool(f.failed) for f in flights),
    }
    least = [
        (f, f.time_s, f.least) for f in stopped if f.time_s is not None and f.least is not None
    ]
    out |= summaries(
        name,
        (
            ("time", "s", [f.time_s for f in stopped]),
            ("impulse", "N_s", [f.impulse_N_s for f in stopped]),
            ("impulse_at_rest", "N_s", [f.held_N_s for f in stopped]),
            ("lp_time", "s", [x.time_s for _, _, x in least]),
            ("lp_impulse", "N_s", [x.impulse_N_s for _, _, x in least]),
            ("time_over_lp", "ratio", [time_s / x.time_s for _, time_s, x in least]),
            ("impulse_over_lp", "ratio", [f.impulse_N_s / x.impulse_N_s for f, _, x in least]),
            ("final_rate", "deg_s", [f.final_rate_deg_s for f in judged]),
            ("final_speed", "m_s", [f.final_speed_m_s for f in judged]),
            ("mass_error", "share", [f.mass_share for f in judged]),
            ("centre_error", "m", [f.centre_m for f in judged]),
            ("inertia_error", "share", [f.inertia_share for f in judged]),
            ("nees", "ratio", [f.nees for f in judged]),
            ("port_force", "N", [f.peak_force_N for f in judged]),
            ("port_torque", "N_m", [f.peak_torque_N_m for f in judged]),
        ),
    )
    known = [f.nees for f in judged if f.nees is not None]
    if known:
        out[f"{name}_nees_mean_ratio"] = float(np.mean(known))
    if held_s := sum(f.held_s for f in stopped):
        out[f"{name}_held_N_s_per_minute"] = 60.0 * sum(f.held_N_s for f in stopped) / held_s
    return out


def vision_figures(name: str, tumbles: list[TumbleOutcome]) -> Figures:
    """Return the figures of a set of chasers that watch the free target."""
    out: Figures = {f"{name}_tumbles": len(tumbles)}
    columns = (
        ("ratio_error", "share", [t.ratio_error for t in tumbles]),
        ("stated_error", "share", [t.stated_error for t in tumbles]),
        ("centre_error", "m", [t.centre_m for t in tumbles]),
        ("ratio_nees", "of_5", [t.ratio_nees for t in tumbles]),
        ("centre_nees", "of_3", [t.centre_nees for t in tumbles]),
        ("pose_nees", "of_6", [t.nees for t in tumbles]),
    )
    for key, unit, values in columns:
        out[f"{name}_{key}_mean_{unit}"] = float(np.mean(values))
    return out | summaries(name, columns)


def optimum_figures(name: str, shares: list[float]) -> Figures:
    """Return the figures of a set of chasers for which the least impulse was searched."""
    return summaries(name, [("over_lp", "ratio", shares)])


def numbers_of(chasers: str) -> list[int]:
    """Return the numbers of a set of chasers."""
    return [int(c) for c in chasers]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sets", nargs="+", default=["0123", "013", "03"], metavar="CHASERS")
    parser.add_argument(
        "--limits",
        type=float,
        nargs=2,
        metavar=("FORCE", "TORQUE"),
        help="of every port, N and N m, kept by the controller",
    )
    parser.add_argument(
        "--duration-s", type=float, default=30.0, metavar="S", help="of engine, from the command on"
    )


def rigid_part(name: str, options: Options) -> Figures:
    """Fly a case with every set of chasers."""
    fly = partial(fly_rigid, name)
    return fly_sets(name, DetumbleOutcome, fly, DetumbleOutcome.line, detumble_figures, options)


def engine(options: Options) -> Figures:
    """Stop a stack in the physics engine, with statistical perception."""
    line = DetumbleOutcome.line
    return fly_sets("engine", DetumbleOutcome, fly_in_engine, line, detumble_figures, options)


def optimum(options: Options) -> Figures:
    """Search the least impulse that stops the true stack in 15.5 s, from 40 random guesses: what no
    controller can be expected to undercut.
    """
    return fly_sets("optimum", float, search_optimum, str, optimum_figures, options)


def vision(options: Options) -> Figures:
    """Watch the free target tumble at 7 degrees/s for 60 s, without a capture.

    Errors of the ratios of its inertia (elements over trace, as a share of the largest moment over
    trace) and of its centre of mass; normalized squared errors of ratios (5 expected), centre (3)
    and relative poses (6). Sightings are drawn, or with ``--set perception.name=default`` those of
    images.
    """
    return fly_sets("vision", TumbleOutcome, watch, str, vision_figures, options)


GROUPS = (
    Group(
        {
            "engine": engine,
            **{
                name: described(partial(rigid_part, name), case.text)
                for name, case in CASES.items()
            },
            "optimum": optimum,
            "vision": vision,
        },
        ("flights", "first", "jobs", "set", "results"),
        add_options,
    ),
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
