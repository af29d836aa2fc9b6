# SPDX-License-Identifier: Apache-2.0
"""The controller in closed loop: complete missions in one process.

Distances are true, at every tick, between centres and, in clutter, between shapes.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser
from collections.abc import Callable, Iterable

from chaserdock_protocol.scenario import Scenario
from common import Figures, Group, Options, seeds_of
from flights import load_shipped
from flights.measured_poses import measurement_model
from flights.transfers import CLUTTER, DENSE_CLUTTER, avoidance, clutter, fly_transfer, swap

from chaserdock.experiments.flight_record import FlightRecord, record_flight
from chaserdock.experiments.perception import PerceptionModel, RenderedImages

NOISE_M, NOISE_RAD = 0.002, math.radians(0.1)
"""White noise of measured poses, per axis: coarser than markers at 1 m."""
STEADY_FROM_S = 40.0
"""From here on the transient of a start 0.85 m away has decayed."""


def noisy(scenario: Scenario) -> PerceptionModel:
    """Return a measurement model with 2 mm and 0.1 degrees of white noise."""
    return measurement_model(scenario, scenario.seed, NOISE_M, NOISE_RAD)


def variations(
    name: str,
    seeds: Iterable[int],
    scenario_of: Callable[[int], Scenario],
    perception_of: Callable[[Scenario], PerceptionModel | None],
    stay_s: float = math.inf,
) -> Figures:
    """Fly every seed, and return the worst of each figure; ``stay_s`` as in ``fly_transfer``."""
    outcomes = []
    for seed in seeds:
        scenario = scenario_of(seed)
        outcomes.append(fly_transfer(seed, scenario, perception_of(scenario), stay_s))
        print(f"  {outcomes[-1].line()}", flush=True)
    limits = scenario_of(0).limits
    safe = [
        o.to_target_m >= limits.min_distance_target_m
        and o.between_m >= limits.min_distance_chasers_m
        and o.shapes_m >= limits.min_distance_shape_m
        for o in outcomes
    ]
    key = name.replace("-", "_")
    return {
        f"{key}_flights": len(outcomes),
        f"{key}_distances_kept": sum(safe),
        f"{key}_reached": sum(not math.isnan(o.reached_s) for o in outcomes),
        f"{key}_chasers_not_at_goal": sum(o.missed for o in outcomes),
        f"{key}_min_distance_target_m": min(o.to_target_m for o in outcomes),
        f"{key}_min_distance_chasers_m": min(o.between_m for o in outcomes),
        f"{key}_min_distance_shapes_m": min(o.shapes_m for o in outcomes),
        f"{key}_max_time_to_goal_s": max(
            math.inf if math.isnan(o.reached_s) else o.reached_s for o in outcomes
        ),
        f"{key}_failed_solves": sum(o.failed for o in outcomes),
        f"{key}_contacts": sum(o.contacts for o in outcomes),
    }


def steady(flight: FlightRecord) -> tuple[float, float]:
    """Return the worst chaser's steady RMS errors: position (m), orientation (rad)."""
    each = [flight.rms(STEADY_FROM_S, i) for i in range(flight.states.shape[1])]
    return max(p for p, _ in each), max(a for _, a in each)


def add_errors(out: Figures, name: str, errors: tuple[float, float]) -> None:
    """Store the steady errors of a flight."""
    out[f"{name}_position_rms_m"], out[f"{name}_orientation_rms_rad"] = errors


def tracking(options: Options) -> Figures:
    """Measure steady errors at the paper's tumble with perfect knowledge, starting 0.85 m behind
    the reference: with and without feed-forward, with actuators 5 % off.
    """
    duration_s, out = 60.0 if options.quick else 120.0, Figures()
    for name, overrides, gain in (
        ("feed_forward", (), 1.0),
        ("u_ref_0", ("controller.feed_forward=false",), 1.0),
        ("actuators_5_percent_stronger", (), 1.05),
        ("actuators_5_percent_weaker", (), 0.95),
    ):
        scenario = load_shipped("single", f"duration_s={duration_s}", *overrides)
        add_errors(out, f"tracking_{name}", steady(record_flight(scenario, actuator_gain=gain)))
    return out


_CLUTTER_STAY_S = 3.0
"""A flight in clutter ends once all chasers are at their goals for this long."""


def fly_avoidance(options: Options) -> Figures:
    """Fly 20 variations of ``collision-avoidance`` with images of 640 x 360, every fourth exactly
    symmetric.
    """
    return variations(
        "avoidance",
        seeds_of(options, 20, 2),
        lambda seed: avoidance(seed, options.full_images),
        RenderedImages,
    )


def fly_swap(options: Options) -> Figures:
    """Fly 20 variations of ``swap``, the target measured with noise of 2 mm and 0.1 degrees; seed 0
    is exactly head-on.
    """
    return variations("swap", seeds_of(options, 20, 2), swap, noisy)


def in_clutter(name: str, places_m: tuple[float, float, float], options: Options) -> Figures:
    """Fly chasers from random places to random places."""
    return variations(
        name,
        seeds_of(options, 100, 1),
        lambda seed: clutter(seed, 4 if options.quick else 16, places_m),
        lambda _: None,
        _CLUTTER_STAY_S,
    )


def fly_clutter(options: Options) -> Figures:
    """Fly sixteen chasers (``--quick``: four) at random places to random places, all at once, with
    exact knowledge: 100 seeds.
    """
    return in_clutter("clutter", CLUTTER, options)


def fly_dense_clutter(options: Options) -> Figures:
    """Fly the same at places that are nearer together."""
    return in_clutter("clutter-dense", DENSE_CLUTTER, options)


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--full-images", action="store_true", help="avoidance with the scenario's image size"
    )


GROUP = Group(
    {
        "avoidance": fly_avoidance,
        "swap": fly_swap,
        "clutter": fly_clutter,
        "clutter-dense": fly_dense_clutter,
        "tracking": tracking,
    },
    ("flights", "first"),
    add_options,
)
