# SPDX-License-Identifier: Apache-2.0
"""Flies a scenario in this process: the controller alone, with perfect knowledge of the target's
motion, or all of it on rendered images, for half the processor time of ``chaserdock run``.

``python -m chaserdock.experiments.controller_flight FOLDER`` reads a flight as JSON from standard
input and writes ``FOLDER/summary.json``, as ``chaserdock run`` does for whole missions.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from chaserdock_models.rotations import rotate
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.scenario import Scenario, load_scenario

from chaserdock.exit_codes import BAD_INPUT, DONE

from .flight_record import FlightRecord, record_flight
from .least_transient import gauss_times, least_square_integral
from .perception import RenderedImages
from .perfect_knowledge import PerfectEstimator
from .plan import Alone, PlannedFlight

_FLOOR_S = 15.0
"""Time, s, that the lower bound covers; it counts as zero afterwards. Twice what 2 N need to bring
30 kg over the paper's 0.85 m to rest, 2 sqrt(0.85 m / (2 N / 30 kg)) = 7.1 s.
"""


def main() -> int:
    """Fly the flight on standard input; return the exit status."""
    return write_summary(fly_planned)


def fly_planned(flight: PlannedFlight) -> Mapping[str, Any]:
    """Fly a planned flight: the controller alone, or, without ``alone``, on images."""
    scenario = load_scenario(Path(flight.scenario), flight.overrides)
    return fly_on_images(scenario) if flight.alone is None else fly_alone(scenario, flight.alone)


def write_summary(fly: Callable[[PlannedFlight], Mapping[str, Any]]) -> int:
    """Fly the flight on standard input and write its summary; return the exit status."""
    try:
        flight = msgspec.json.decode(sys.stdin.read(), type=PlannedFlight)
        summary = fly(flight)
    except ChaserdockError as error:
        print(f"chaserdock: {error}", file=sys.stderr)
        return BAD_INPUT
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "summary.json", json.dumps(summary))
    return DONE


def fly_alone(scenario: Scenario, alone: Alone | None = None) -> Mapping[str, Any]:
    """Fly a scenario with perfect knowledge. Returns the part of a summary (docs/summary.md) that
    judges a controller, with the lower bound ``floor_m2_s`` on request.
    """
    alone = alone or Alone()
    delay_s = alone.delay_s
    flight = record_flight(scenario, solve_delay_s=None if delay_s is None else lambda _: delay_s)
    summary = _tracking_summary(scenario, flight, "the controller flew alone")
    if alone.floor:
        summary["floor_m2_s"] = position_error_floor(scenario, flight)
    return summary


def fly_on_images(scenario: Scenario) -> Mapping[str, Any]:
    """Fly a scenario as ``chaserdock run`` does, with equal tracking errors. Returns the part of a
    summary that ``fly_alone`` does.
    """
    flight = record_flight(scenario, RenderedImages(scenario))
    return _tracking_summary(scenario, flight, "the flight was not recorded")


def _tracking_summary(scenario: Scenario, flight: FlightRecord, why: str) -> dict[str, Any]:
    """Return the tracking errors of a flight; ``why`` its success is not judged."""
    until_s = scenario.steady_until_s or scenario.duration_s
    late = (flight.time_s >= scenario.settling_s) & (flight.time_s < until_s)
    chasers: dict[str, Any] = {}
    for i in range(len(scenario.chasers)):
        position = flight.position_error_m[:, i] ** 2
        angle = flight.orientation_error_rad[:, i] ** 2
        chasers[str(i)] = {
            "position_mse_m2": float(np.mean(position)),
            "orientation_mse_rad2": float(np.mean(angle)),
            "steady": {
                "position_mse_m2": float(np.mean(position[late])),
                "orientation_mse_rad2": float(np.mean(angle[late])),
            },
            "min_distance_target_m": float(flight.target_distance_m[:, i].min()),
        }
    solve_s = {"p50": float(np.median(flight.solve_s)), "max": float(np.max(flight.solve_s))}
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "sim_time_s": scenario.duration_s,
        "failures": [],
        "not_judged": [f"success: {why}, against no criteria"],
        "chasers": chasers,
        "solver": {"solve_s": solve_s, "failures": flight.failed_solves},
    }


def position_error_floor(scenario: Scenario, flight: FlightRecord) -> float:
    """Return a lower bound (m^2 s) on the integral of chaser 0's squared position error, given the
    attitudes of ``flight``.
    """
    step_s = 1.0 / scenario.time.rate_hz
    steps = min(len(flight.time_s) - 1, round(_FLOOR_S / step_s))
    target, offset = PerfectEstimator(scenario.target), np.array(scenario.chasers[0].position_m)
    poses = [target.estimate_at(round(t * 1e9)) for t in gauss_times(steps, step_s)]
    references = np.array([e.position_m + rotate(e.q_wxyz, offset) for e in poses])
    x = flight.states[:, 0]
    return least_square_integral(
        x[0, :3],
        x[0, 3:6],
        references,
        x[:steps, 6:10],
        step_s,
        scenario.chaser.force_max_N / scenario.chaser.mass_kg,
    )


if __name__ == "__main__":
    sys.exit(main())
