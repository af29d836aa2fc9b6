# SPDX-License-Identifier: Apache-2.0
"""Docking success: ``python benchmarks/docking.py [--quick] [--json FILE] [--flights N] [--images
N] [--aborts N] [--aborts-images N] [--failures N] [--results FILE]``.

Flies ``docking-contact`` many times in one process: from seeded starts, at target rates from zero
to three times the paper's about any axis. ``--flights`` with a measurement model (2 mm and 0.1
degrees of white noise, no detection in every tenth image), ``--images`` with rendered images and
the real perception, ``--aborts`` aborted at a random time (``--aborts-images`` with images), with a
second approach after every fifth. ``--failures`` with a thruster that sticks open, and as many with
one that sticks shut, not reported, thruster after thruster: at ``--failed-at``, or at a random time
between 2 and 24 s. The approach is commanded at ``--approach-at``; ``--first`` is the first seed.
Prints outcomes by cause, and figures at contact.

``--results FILE`` appends every flight to FILE (JSON lines) and does not repeat flights that are in
it, so that an interrupted batch continues.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from chaserdock_protocol.scenario import Scenario
from common import (
    Figures,
    append_line,
    commit,
    make_parser,
    percentiles,
    print_figures,
    read_lines,
    write_json,
)
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
KINDS = ("stuck_on", "stuck_off")


class DockingRow(msgspec.Struct, frozen=True):
    """One flight in the results file: part, settings, commit and outcome."""

    part: str
    settings: str
    commit: str
    outcome: DockingOutcome


@dataclass
class Batch:
    """Flights, each flown once; with a ``path``, results are kept there."""

    path: Path | None
    settings: str

    def __post_init__(self) -> None:
        rows = [msgspec.convert(line, DockingRow) for line in read_lines(self.path)]
        matching = [row for row in rows if row.settings == self.settings]
        self._known = {(row.part, row.outcome.seed): row.outcome for row in matching}
        self.commits = {row.commit for row in matching}
        self._commit = commit()

    def fly(self, part: str, seed: int, flight: Callable[[int], DockingOutcome]) -> DockingOutcome:
        """Return the outcome of a flight from the results file, or fly it."""
        known = self._known.get((part, seed))
        if known is not None:
            return known
        outcome = flight(seed)
        self.commits.add(self._commit)
        print(f"{part} {outcome.line()}", file=sys.stderr, flush=True)
        append_line(
            self.path, msgspec.to_builtins(DockingRow(part, self.settings, self._commit, outcome))
        )
        return outcome


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
    for key, unit, values in (
        ("contact_lateral", "m", [t.lateral_m for t in touches]),
        ("contact_angle", "rad", [t.angle_rad for t in touches]),
        ("contact_closing", "m_s", [t.closing_m_s for t in touches]),
        ("contact_lateral_speed", "m_s", [t.lateral_speed_m_s for t in touches]),
        (
            "momentum_error",
            "share",
            [o.linear_error for o in outcomes if o.linear_error is not None],
        ),
        (
            "angular_momentum_error",
            "share",
            [o.angular_error for o in outcomes if o.angular_error is not None],
        ),
        ("verified_after", "s", [o.verified_s for o in outcomes if o.verified_s is not None]),
        ("detection_delay", "s", [t for o in outcomes if (t := o.detection_delay_s()) is not None]),
        ("peak_error", "m", [o.peak_m for o in outcomes if o.peak_m is not None]),
        ("propellant", "kg", [o.propellant_kg for o in outcomes if o.verified and o.propellant_kg]),
    ):
        if values:
            out |= percentiles(values, f"{name}_{key}", unit, "median", "max")
    return out


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


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--images", type=int, default=100)
    parser.add_argument("--aborts", type=int, default=50)
    parser.add_argument("--aborts-images", type=int, default=10)
    parser.add_argument("--failures", type=int, default=12)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="kinds of failure")
    parser.add_argument("--failed-at", type=float, help="s; default: random")
    parser.add_argument(
        "--approach-at", type=float, default=APPROACH_AT_S, help="s; not for aborts"
    )
    parser.add_argument("--actuation", choices=("thrusters", "ideal"), default="thrusters")
    parser.add_argument(
        "--rate", type=int, help="Hz, of control and images; default: the scenario's"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="scenario override"
    )
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument(
        "--results",
        type=Path,
        metavar="FILE",
        help="append flights; flights in it are not repeated",
    )
    o = parser.parse_args()
    flights, images, aborts, aborts_images = (
        (4, 1, 4, 0) if o.quick else (o.flights, o.images, o.aborts, o.aborts_images)
    )
    failures = 0 if o.actuation == "ideal" else min(o.failures, 2) if o.quick else o.failures
    settings = f"{o.actuation} rate={o.rate} approach={o.approach_at:g} failed={o.failed_at} set={sorted(o.set)}"
    batch = Batch(o.results, settings)
    result: Figures = {}

    def scenario_of(seed: int, failure: Failure | None = None) -> Scenario:
        return docking_scenario(seed, o.actuation, o.rate, failure, tuple(o.set))

    def failure_of(kind: str, seed: int) -> Failure:
        at_s = o.failed_at or float(np.random.default_rng([seed, 0xFA1]).uniform(2.0, 24.0))
        return kind, seed % 12, at_s

    def dock_with(
        perception_of: PerceptionOf, kind: str | None = None
    ) -> Callable[[int], DockingOutcome]:
        def flight(seed: int) -> DockingOutcome:
            failure = None if kind is None else failure_of(kind, seed)
            return dock(seed, scenario_of(seed, failure), perception_of, failure, o.approach_at)

        return flight

    def abort_with(perception_of: PerceptionOf) -> Callable[[int], DockingOutcome]:
        return lambda seed: abort(seed, scenario_of(seed), perception_of, again=seed % 5 == 0)

    for part, number, flight, evaluate in (
        ("noise", flights, dock_with(noisy), docking_figures),
        ("images", images, dock_with(RenderedImages), docking_figures),
        *((kind, failures, dock_with(noisy, kind), docking_figures) for kind in o.kinds),
        ("aborts", aborts, abort_with(noisy), abort_figures),
        ("aborts_images", aborts_images, abort_with(RenderedImages), abort_figures),
    ):
        outcomes = [batch.fly(part, seed, flight) for seed in range(o.first, o.first + number)]
        if outcomes:
            print_causes(part, outcomes)
            result |= evaluate(part, outcomes)
    print_figures(result)
    print(f"flown by {', '.join(sorted(batch.commits))}", file=sys.stderr)
    write_json(o.json, result)


if __name__ == "__main__":
    main()
