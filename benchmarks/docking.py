# SPDX-License-Identifier: Apache-2.0
"""Docking by capture: ``python benchmarks/docking.py [--only PART ...]``.

Flies ``docking-contact`` many times in one process: from seeded starts, at target rates from zero
to three times the paper's about any axis. Prints outcomes by cause, and figures at contact.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Callable
from functools import partial

import numpy as np
from chaserdock_protocol.scenario import Scenario
from common import Figures, Group, KeptResults, Options, described, main, seeds_of, summaries
from flights.docking_flights import (
    APPROACH_AT_S,
    DockingOutcome,
    Failure,
    abort,
    dock,
    docking_scenario,
)
from flights.measured_poses import measurement_model

from chaserdock.experiments.perception import PerceptionModel, RenderedImages

PerceptionOf = Callable[[Scenario], PerceptionModel]
KINDS = {"stuck_on": "sticks open", "stuck_off": "sticks shut"}
AGAIN_EVERY = 5
"""Every fifth aborted flight makes a second approach."""


def docking_figures(name: str, outcomes: list[DockingOutcome]) -> Figures:
    """Return the figures of docking flights by name."""
    touches = [o.touch for o in outcomes if o.touch is not None]
    out: Figures = {
        f"{name}_flights": len(outcomes),
        f"{name}_verified": sum(o.verified for o in outcomes),
        f"{name}_collisions": sum(bool(o.contacts) for o in outcomes),
        f"{name}_false_alarms": sum(o.false_alarms() for o in outcomes),
    }
    if any(o.failure for o in outcomes):
        out[f"{name}_detected"] = sum(o.detection_delay_s() is not None for o in outcomes)
    return out | summaries(
        name,
        (
            ("contact_lateral", "m", [t.lateral_m for t in touches]),
            ("contact_angle", "rad", [t.angle_rad for t in touches]),
            ("contact_closing", "m_s", [t.closing_m_s for t in touches]),
            ("contact_lateral_speed", "m_s", [t.lateral_speed_m_s for t in touches]),
            ("momentum_error", "share", [o.linear_error for o in outcomes]),
            ("angular_momentum_error", "share", [o.angular_error for o in outcomes]),
            ("verified_after", "s", [o.verified_s for o in outcomes]),
            ("detection_delay", "s", [o.detection_delay_s() for o in outcomes]),
            ("peak_error", "m", [o.peak_m for o in outcomes]),
            ("propellant", "kg", [o.propellant_kg or None for o in outcomes if o.verified]),
        ),
    )


def print_causes(name: str, outcomes: list[DockingOutcome]) -> None:
    """Print the number of flights and their first seeds by cause."""
    print(f"{name}: {len(outcomes)} flights")
    for cause, number in Counter(o.cause for o in outcomes).most_common():
        seeds = [str(o.seed) for o in outcomes if o.cause == cause]
        shown = ", ".join(seeds[:6]) + (", …" if len(seeds) > 6 else "")
        print(f"  {number:4d}  {cause}  (seeds {shown})")


def abort_figures(name: str, outcomes: list[DockingOutcome]) -> Figures:
    """Return the figures of aborted flights by name."""
    opened = [o.opened_s for o in outcomes if o.opened_s is not None]
    return {
        f"{name}_flights": len(outcomes),
        f"{name}_opened": len(opened),
        f"{name}_opened_after_max_s": max(opened, default=math.nan),
        f"{name}_collisions": sum(bool(o.contacts) for o in outcomes),
        f"{name}_second_approaches": sum(o.verified_again is not None for o in outcomes),
        f"{name}_verified_again": sum(o.verified_again is True for o in outcomes),
    }


def noisy(scenario: Scenario) -> PerceptionModel:
    """Return a measurement model with 2 mm and 0.1 degrees of noise, and no detection in every
    tenth image.
    """
    return measurement_model(scenario, scenario.seed, 0.002, math.radians(0.1), dropout=0.1)


def scenario_of(seed: int, options: Options, failure: Failure | None = None) -> Scenario:
    """Return the scenario of a seed."""
    return docking_scenario(seed, options.actuation, options.rate_hz, failure, tuple(options.set))


def failure_of(kind: str, seed: int, failed_at_s: float | None) -> Failure:
    """Return the failure of a seed: one thruster after another, at a random time of 2 to 24 s."""
    at_s = failed_at_s or float(np.random.default_rng([seed, 0xFA1]).uniform(2.0, 24.0))
    return kind, seed % 12, at_s


def fly_part(
    name: str,
    fly: Callable[[int], DockingOutcome],
    evaluate: Callable[[str, list[DockingOutcome]], Figures],
    seeds: range,
    options: Options,
) -> Figures:
    """Fly the seeds that the results file does not contain; return the figures of all."""
    settings = {
        "part": name,
        "actuation": options.actuation,
        "rate_hz": options.rate_hz,
        "approach_at_s": options.approach_at_s,
        "failed_at_s": options.failed_at_s,
        "set": sorted(options.set),
    }
    outcomes = KeptResults(options.results, settings, DockingOutcome).of(
        seeds, fly, DockingOutcome.line
    )
    print_causes(name, outcomes)
    return evaluate(name, outcomes)


def dock_many(
    name: str, perception_of: PerceptionOf, kind: str, number: int, quick: int, options: Options
) -> Figures:
    """Dock with each seed, with a thruster failure if it has a kind."""

    def fly(seed: int) -> DockingOutcome:
        failure = failure_of(kind, seed, options.failed_at_s) if kind else None
        scenario = scenario_of(seed, options, failure)
        return dock(seed, scenario, perception_of, failure, options.approach_at_s)

    return fly_part(name, fly, docking_figures, seeds_of(options, number, quick), options)


def abort_many(
    name: str, perception_of: PerceptionOf, number: int, quick: int, options: Options
) -> Figures:
    """Abort with each seed at a random time."""

    def fly(seed: int) -> DockingOutcome:
        again = seed % AGAIN_EVERY == 0
        return abort(seed, scenario_of(seed, options), perception_of, again)

    return fly_part(name, fly, abort_figures, seeds_of(options, number, quick), options)


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--failed-at-s", type=float, metavar="S", help="default: random")
    parser.add_argument(
        "--approach-at-s", type=float, default=APPROACH_AT_S, metavar="S", help="not of aborts"
    )
    parser.add_argument("--actuation", choices=("thrusters", "ideal"), default="thrusters")
    parser.add_argument(
        "--rate-hz", type=int, help="of control and images; default: the scenario's"
    )


GROUPS = (
    Group(
        {
            "noise": described(
                partial(dock_many, "noise", noisy, "", 100, 3),
                "Dock with poses with noise of 2 mm and 0.1 degrees, a tenth of them missing: "
                "100 seeds.",
            ),
            "images": described(
                partial(dock_many, "images", RenderedImages, "", 100, 1),
                "Dock with rendered images and the real perception: 100 seeds.",
            ),
            **{
                kind: described(
                    partial(dock_many, kind, noisy, kind, 12, 1),
                    f"Dock while a thruster {text}, not reported, one after another: 12 seeds.",
                )
                for kind, text in KINDS.items()
            },
            "aborts": described(
                partial(abort_many, "aborts", noisy, 50, 2),
                "Abort at a random time, with a second approach after every fifth: 50 seeds.",
            ),
            "aborts-images": described(
                partial(abort_many, "aborts_images", RenderedImages, 10, 1),
                "Abort with rendered images: 10 seeds.",
            ),
        },
        ("flights", "first", "set", "results"),
        add_options,
    ),
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
