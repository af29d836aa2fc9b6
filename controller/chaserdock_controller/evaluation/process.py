"""Flies a file of study cases, one after the other; results are appended as they come."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from chaserdock_models.rotations import rotate
from chaserdock_protocol.process import print_status
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.study import StudyCase, StudyError, StudyResult, line_of, read_lines

from .closed_loop import Trace, fly_offline
from .least_transient import gauss_times, least_square_integral
from .perfect_knowledge import PerfectEstimator

_FLOOR_S = 15.0
"""The floor is taken over this time; from then on its error is zero."""


def main(cases: Path, results: Path) -> int:
    """Flies every case of ``cases`` and appends to ``results``; 0.

    Raises StudyError or ScenarioError for bad input, before or at the case it is in; what was flown is kept.
    """
    asked = read_lines(cases, StudyCase)
    for number, case in enumerate(asked, start=1):
        print_status("study", f"{number} of {len(asked)}: {case.name}")
        result = fly_case(case)
        try:
            with results.open("a", encoding="utf-8") as file:
                file.write(line_of(result))
        except OSError as error:
            raise StudyError(f"{results}: cannot be written: {error.strerror or error}") from None
    return 0


def fly_case(case: StudyCase) -> StudyResult:
    """One case, flown and measured. Raises ScenarioError or StudyError if it cannot be."""
    scenario = load_scenario(Path(case.scenario), case.overrides)
    fixed = case.delay_s
    if fixed is not None and (case.delay_measured or not 0.0 <= fixed < math.inf):
        raise StudyError(f"{case.name}: delay_s must be finite, not negative and not beside delay_measured")
    if scenario.target.motion == "torque_free":
        raise StudyError(f"{case.name}: target.motion must be constant_rates or static, not torque_free")
    if scenario.settling_s > scenario.duration_s:
        raise StudyError(
            f"{case.name}: duration_s ({scenario.duration_s:g}) ends before settling_s ({scenario.settling_s:g})"
        )
    delay = (lambda took_s: took_s) if case.delay_measured else None if fixed is None else lambda _: fixed
    trace = fly_offline(scenario, delay)
    position, angle = trace.position_error_m[:, 0] ** 2, trace.orientation_error_rad[:, 0] ** 2
    late = trace.time_s >= scenario.settling_s
    return StudyResult(
        case=case,
        duration_s=scenario.duration_s,
        position_mse_m2=float(np.mean(position)),
        orientation_mse_rad2=float(np.mean(angle)),
        steady_position_mse_m2=float(np.mean(position[late])),
        steady_orientation_mse_rad2=float(np.mean(angle[late])),
        failed_solves=trace.failed_solves,
        solve_p50_s=float(np.median(trace.solve_s)),
        solve_max_s=float(np.max(trace.solve_s)),
        floor_m2_s=floor_of(scenario, trace) if case.floor else None,
    )


def floor_of(scenario: Scenario, trace: Trace) -> float:
    """The least integral (m^2 s) of chaser 0's squared position error, given how it turned in ``trace``."""
    step_s = 1.0 / scenario.time.rate_hz
    steps = min(len(trace.time_s) - 1, round(_FLOOR_S / step_s))
    target, offset = PerfectEstimator(scenario.target), np.array(scenario.chasers[0].position_m)
    there = [target.estimate_at(round(t * 1e9)) for t in gauss_times(steps, step_s)]
    references = np.array([e.position_m + rotate(e.q_wxyz, offset) for e in there])
    x = trace.states[:, 0]
    return least_square_integral(
        x[0, :3],
        x[0, 3:6],
        references,
        x[:steps, 6:10],
        step_s,
        scenario.chaser.force_max_N / scenario.chaser.mass_kg,
    )
