# SPDX-License-Identifier: Apache-2.0
"""Controller performance in closed loop: ``python benchmarks/closed_loop.py [--only PART ...]
[--quick] [--json FILE]``.

Complete missions in one process (``chaserdock.experiments.in_process``). Parts:

- ``avoidance``: 20 seeded variations of ``collision-avoidance`` with images of 640 x 360
  (``--full-images``: the scenario's own, with four times as many pixels), every fourth exactly
  symmetric;
- ``swap``: 20 variations of ``swap``, target measured with noise of 2 mm and 0.1 degrees; seed 0 is
  exactly head-on;
- ``clutter``, ``clutter-dense``: sixteen chasers at random places fly to random places, all at
  once, in 100 seeds; exact knowledge;
- ``swap-images``: the first ``--images`` of them with rendered images;
- ``tracking``: the paper's tumble with perfect knowledge, with and without feed-forward, with 5 %
  actuator gain error;
- ``tracking-images``: the same with rendered images: servicer, two chasers on the paper's target,
  stronger actuators;

``--first`` and ``--flights`` choose seeds (20 by default, of ``clutter`` 100); ``--quick`` flies
two variations and shorter runs. Distances are true, at every tick, between centres and, in clutter,
between shapes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from chaserdock_protocol.scenario import Scenario
from common import Figures, make_parser, run_parts
from flights import load_shipped
from flights.measured_poses import measurement_model
from flights.transfers import CLUTTER, DENSE_CLUTTER, avoidance, clutter, fly_transfer, swap

from chaserdock.experiments.flight_record import FlightRecord, record_flight
from chaserdock.experiments.perception import PerceptionModel, RenderedImages

NOISE_M, NOISE_RAD = 0.002, math.radians(0.1)
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


def tracking(duration_s: float) -> Figures:
    """Measure steady errors at the paper's tumble with perfect knowledge, starting 0.85 m behind
    the reference.
    """
    out: Figures = {}
    for name, overrides, gain in (
        ("feed_forward", (), 1.0),
        ("u_ref_0", ("controller.feed_forward=false",), 1.0),
        ("actuators_5_percent_stronger", (), 1.05),
        ("actuators_5_percent_weaker", (), 0.95),
    ):
        scenario = load_shipped("single", f"duration_s={duration_s}", *overrides)
        add_errors(out, f"tracking_{name}", steady(record_flight(scenario, actuator_gain=gain)))
    return out


def tracking_with_images(duration_s: float) -> Figures:
    """Measure steady errors at the paper's tumble with images; the worst chaser of each flight."""
    out: Figures = {}
    length = f"duration_s={duration_s}"
    servicer = load_shipped("single", "target.model='servicer'", length)
    for name, scenario, gain in (
        ("servicer", servicer, 1.0),
        ("two_chasers_paper_target", load_shipped("two-chaser-tracking", length), 1.0),
        ("servicer_actuators_5_percent_stronger", servicer, 1.05),
    ):
        flight = record_flight(scenario, RenderedImages(scenario), actuator_gain=gain)
        add_errors(out, f"tracking_images_{name}", steady(flight))
    return out


PARTS = (
    "avoidance",
    "swap",
    "clutter",
    "clutter-dense",
    "swap-images",
    "tracking",
    "tracking-images",
)
_CLUTTER_STAY_S = 3.0
"""A flight in clutter ends once all chasers are at their goals for this long."""


def main() -> None:
    parser = make_parser(__doc__, PARTS)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--flights", type=int, help="number of seeds")
    parser.add_argument("--images", type=int, default=2, help="number of seeds of swap with images")
    parser.add_argument(
        "--full-images", action="store_true", help="avoidance with the scenario's image size"
    )
    options = parser.parse_args()
    duration_s = 60.0 if options.quick else 120.0

    def seeds_of(default: int) -> range:
        flights = 2 if options.quick else options.flights or default
        return range(options.first, options.first + flights)

    def in_clutter(name: str, places_m: tuple[float, float, float]) -> Figures:
        return variations(
            name,
            seeds_of(100),
            lambda seed: clutter(seed, places_m=places_m),
            lambda _: None,
            _CLUTTER_STAY_S,
        )

    seeds = seeds_of(20)
    parts = {
        "avoidance": lambda: variations(
            "avoidance", seeds, lambda seed: avoidance(seed, options.full_images), RenderedImages
        ),
        "clutter": lambda: in_clutter("clutter", CLUTTER),
        "clutter-dense": lambda: in_clutter("clutter-dense", DENSE_CLUTTER),
        "swap": lambda: variations("swap", seeds, swap, noisy),
        "swap-images": lambda: variations(
            "swap-images", seeds[: options.images], swap, RenderedImages
        ),
        "tracking": lambda: tracking(duration_s),
        "tracking-images": lambda: tracking_with_images(min(duration_s, 80.0)),
    }
    run_parts(options, parts)


if __name__ == "__main__":
    main()
