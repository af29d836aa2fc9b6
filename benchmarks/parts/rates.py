# SPDX-License-Identifier: Apache-2.0
"""Scenarios with thrusters at other rates of ticks, images and carriers, by ``simulate``."""

from __future__ import annotations

import math
import tempfile
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, stdev

from chaserdock_protocol.scenario import ScenarioError, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from common import Figures, Group, KeptResults, Options, seeds_of

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate
from chaserdock.summary import Summary

SCENARIOS = (
    "docking-contact",
    "single-thrusters",
    "four-chaser-docking-thrusters",
    "four-chaser-capture",
)
RATES_HZ, CARRIERS = (5, 8, 10, 15, 30, 60), (1, 2, 4)
"""Ticks and images per second; carrier periods in a tick."""
STATISTICAL = 'perception.name="statistical"'
FREEDOMS = 6.0
"""Expected NEES of a pose."""


@dataclass(frozen=True)
class RatedFlight:
    """How a flight ended: ``missed`` criteria, and of each chaser the mean NEES of its pose
    relative to the target.
    """

    missed: tuple[str, ...]
    nees: tuple[float, ...]

    def line(self) -> str:
        """Return the flight as a line of text."""
        nees = ", ".join(f"{value:.1f}" for value in self.nees)
        return f"NEES {nees} of 6; {'; '.join(self.missed) or 'success'}"


def fly_at(name: str, overrides: tuple[str, ...], seed: int) -> RatedFlight:
    """Fly a scenario with other errors of its sensors, as ``seed`` draws them."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        flight = simulate(find_scenario(name), out, (*overrides, f"seed={seed}"))
        if flight.crashes or flight.stalled:
            return RatedFlight((f"{flight.crashes or flight.stalled}",), ())
        summary = Summary.from_dict(summary_of(load_flight(out / "mission.mcap")))
    estimates = [c.relative_estimate for c in summary.chasers.values()]
    nees = tuple(e.nees_mean for e in estimates if e is not None and e.nees_mean is not None)
    return RatedFlight(tuple(summary.failures), nees)


def fly_rates(options: Options) -> Figures:
    """Fly four scenarios with thrusters at six rates with three carriers each, and state how many
    flights succeed and the mean NEES of the relative poses. Combinations that validation refuses
    are named. An option chooses scenarios, rates, carriers, seeds, and the file of results.
    """
    figures: Figures = {}
    names, rates, carriers = options.scenarios, options.rates_hz, options.carriers
    if options.quick:
        names, rates, carriers = SCENARIOS[:1], (5,), (4,)
    for name in names:
        for rate in rates:
            for carrier in carriers:
                figures |= fly_combination(name, rate, rate * carrier, options)
    return figures


def fly_combination(name: str, rate_hz: int, carrier_hz: int, options: Options) -> Figures:
    """Fly the seeds of one scenario at one rate with one carrier."""
    overrides = (
        f"time.rate_hz={rate_hz}",
        f"time.image_hz={rate_hz}",
        f"chaser.modulation.carrier_hz={carrier_hz}",
        *(() if options.images else (STATISTICAL,)),
        *options.set,
    )
    label = f"{name} at {rate_hz} Hz, carrier {carrier_hz} Hz"
    try:
        load_scenario(find_scenario(name), overrides)
    except ScenarioError as error:
        print(f"{label}: refused: {error}", flush=True)
        return {}
    results = KeptResults(options.results, {"scenario": name, "set": list(overrides)}, RatedFlight)
    flights = results.of(
        seeds_of(options, 20, 1),
        partial(fly_at, name, overrides),
        RatedFlight.line,
        jobs=options.jobs,
    )
    successes = sum(not flight.missed for flight in flights)
    mean, sigma = mean_nees(flights)
    print(
        f"{label}: {successes} of {len(flights)}, NEES {mean:.2f} +- {sigma:.2f} of 6", flush=True
    )
    key = f"{name}_{rate_hz}_{carrier_hz}".replace("-", "_")
    return {
        f"{key}_flights": len(flights),
        f"{key}_successes": successes,
        f"{key}_relative_nees": mean,
        f"{key}_relative_nees_sigma": sigma,
    }


def mean_nees(flights: Sequence[RatedFlight]) -> tuple[float, float]:
    """Return the mean NEES of all relative poses, and its standard error.

    A flight is one sample: the errors of its cameras are constant, and its chasers have the target
    in common. NaN without samples.
    """
    means = [fmean(flight.nees) for flight in flights if flight.nees]
    if not means:
        return math.nan, math.nan
    return fmean(means), stdev(means) / math.sqrt(len(means)) if len(means) > 1 else math.nan


def _add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--scenarios", nargs="+", default=SCENARIOS, help="of rates (default: four)"
    )
    parser.add_argument("--rates-hz", nargs="+", type=int, default=RATES_HZ, help="of rates")
    parser.add_argument(
        "--carriers", nargs="+", type=int, default=CARRIERS, help="carrier periods in a tick"
    )
    parser.add_argument("--images", action="store_true", help="render images (rates only)")


GROUP = Group(
    {"rates": fly_rates}, ("flights", "first", "set", "results", "jobs"), _add_options, ("rates",)
)
