# SPDX-License-Identifier: Apache-2.0
"""``chaserdock study``: fly a file of cases in one process, one after the other, and append each
result.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from chaserdock_models.rotations import rotate
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.process import print_status
from chaserdock_protocol.scenario import Scenario, load_scenario

from .flight_record import FlightRecord, record_flight
from .least_transient import gauss_times, least_square_integral
from .perception import RenderedImages
from .perfect_knowledge import PerfectEstimator
from .study_cases import StudyCase, StudyError, StudyResult, line_of, read_lines

_FLOOR_S = 15.0
"""The lower bound covers this time; after it the least error is taken to be zero."""


def main(cases: Path, results: Path) -> int:
    """Fly every case of ``cases``, append to ``results``, and return 0.

    Raises StudyError or ScenarioError at the first case that is not valid; earlier results are
    kept.
    """
    todo = read_lines(cases, StudyCase)
    for number, case in enumerate(todo, start=1):
        print_status("study", f"{number} of {len(todo)}: {case.name}")
        result = fly_case(case)
        with errors_of_writing(results, StudyError), results.open("a", encoding="utf-8") as file:
            file.write(line_of(result))
    return 0


def fly_case(case: StudyCase) -> StudyResult:
    """Fly and measure one case. Raises ScenarioError or StudyError if the case is not valid."""
    scenario = load_scenario(Path(case.scenario), case.overrides)
    fixed_s = case.delay_s
    _check(case, scenario)
    delay = None
    if case.delay_measured:
        delay = _measured
    elif fixed_s is not None:
        delay = lambda _: fixed_s  # noqa: E731
    flight = record_flight(
        scenario, RenderedImages(scenario) if case.images else None, solve_delay_s=delay
    )
    position, angle = flight.position_error_m[:, 0] ** 2, flight.orientation_error_rad[:, 0] ** 2
    late = flight.time_s >= scenario.settling_s
    return StudyResult(
        case=case,
        duration_s=scenario.duration_s,
        position_mse_m2=float(np.mean(position)),
        orientation_mse_rad2=float(np.mean(angle)),
        steady_position_mse_m2=float(np.mean(position[late])),
        steady_orientation_mse_rad2=float(np.mean(angle[late])),
        min_distance_target_m=float(flight.target_distance_m[:, 0].min()),
        failed_solves=flight.failed_solves,
        solve_p50_s=float(np.median(flight.solve_s)),
        solve_max_s=float(np.max(flight.solve_s)),
        floor_m2_s=position_error_floor(scenario, flight) if case.floor else None,
    )


def _measured(took_s: float) -> float:
    return took_s


def _check(case: StudyCase, scenario: Scenario) -> None:
    fixed_s = case.delay_s
    if fixed_s is not None and (case.delay_measured or not 0.0 <= fixed_s < math.inf):
        raise StudyError(
            f"{case.name}: delay_s must be finite, not negative and not beside delay_measured"
        )
    if scenario.target.motion == "torque_free" and (case.floor or not case.images):
        raise StudyError(
            f"{case.name}: target.motion must be constant_rates or static, not torque_free"
        )
    if (fixed_s is not None or case.delay_measured) and scenario.chaser.actuation != "ideal":
        raise StudyError(f'{case.name}: a delay needs chaser.actuation = "ideal"')
    if scenario.settling_s > scenario.duration_s:
        raise StudyError(
            f"{case.name}: duration_s ({scenario.duration_s:g}) ends before settling_s ({scenario.settling_s:g})"
        )


def position_error_floor(scenario: Scenario, flight: FlightRecord) -> float:
    """Return the least integral (m^2 s) of chaser 0's squared position error, with the attitudes of
    ``flight``.
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
