# SPDX-License-Identifier: Apache-2.0
"""Keep-out zones from the target's shape: signed distance, and plans that pass between panels and never through one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.guidance.phase_machine import PhaseMachine
from chaserdock_controller.nmpc.checks import check_input
from chaserdock_controller.nmpc.kernels import plan_violation
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.shape_distance import box_table, moved, signed_distance
from chaserdock_models.targets import Box
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import ScenarioError, parse_scenario
from nmpc_cases import PARAMS, at_rest, fixed_problem, fresh

CLEARANCE_M = 0.3
PANEL_M = (0.02, 1.0, 0.8)
# Two panels side by side, with a gap of 0.8 m between them.
PANELS = (Box(PANEL_M, (0.0, 0.9, 0.0)), Box(PANEL_M, (0.0, -0.9, 0.0)))
WITH_BOXES = replace(PARAMS, boxes=2)


def fly(start: Array, goal: Array, ticks: int, omega_rad_s: Array) -> tuple[Array, float]:
    """Return the last position (3,) and the least distance from the panels, which turn at a constant rate about the origin."""
    solver, state = fresh("rti", 1, WITH_BOXES), at_rest(start)
    table, times = box_table(PANELS), PARAMS.dt_s * np.arange(PARAMS.stages + 1)
    nearest = np.inf
    for tick in range(ticks):
        turned = rotations.exp((tick * PARAMS.dt_s + times)[:, None] * omega_rad_s)
        boxes = moved(table, np.zeros((len(times), 3)), turned)
        nearest = min(nearest, signed_distance(boxes[0], state[:3])[0])
        problem = replace(
            fixed_problem(state[None], goal[None], d_target=0.0),
            boxes=boxes,
            box_clearance_m=np.array([CLEARANCE_M]),
        )
        plan = solver.solve(problem, PARAMS.dt_s if tick else 0.0)
        state = plan.states[0, 1]
    return state[:3], nearest


def test_signed_distance_and_gradient_agree_with_differences_and_with_the_kernel() -> None:
    rng = np.random.default_rng(1)
    boxes = tuple(
        Box(
            tuple(rng.uniform(0.1, 1.0, 3).tolist()),
            tuple(rng.uniform(-1.0, 1.0, 3).tolist()),
            tuple(rotations.normalize(rng.normal(size=4)).tolist()),
        )
        for _ in range(2)
    )
    q = rotations.normalize(rng.normal(size=(PARAMS.stages + 1, 4)))
    table = moved(box_table(boxes), rng.normal(size=(PARAMS.stages + 1, 3)), q)
    states = np.tile(at_rest(np.zeros(3)), (PARAMS.stages + 1, 1))
    states[:, :3] = table[:, 0, :3] + rng.normal(0.0, 0.6, (PARAMS.stages + 1, 3))
    deepest = 0.0
    for row, point in zip(table, states[:, :3], strict=True):
        distance, gradient = signed_distance(row, point)
        deepest = max(deepest, CLEARANCE_M - distance)
        slopes = [
            (signed_distance(row, point + h)[0] - signed_distance(row, point - h)[0]) / 2e-6
            for h in 1e-6 * np.eye(3)
        ]
        np.testing.assert_allclose(gradient, slopes, atol=1e-5)
    problem = fixed_problem(states[:1], states[:1, :3], d_target=0.0)
    problem = replace(problem, boxes=table, box_clearance_m=np.array([CLEARANCE_M]))
    found = plan_violation(check_input(problem, WITH_BOXES, 1), states[None], 1e6)
    assert deepest > 0.1
    np.testing.assert_allclose(found, [deepest], rtol=1e-12)


def test_chaser_passes_between_turning_panels() -> None:
    end, nearest = fly(np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 250, np.array([0.02, 0.0, 0.0]))
    np.testing.assert_allclose(end, [1.0, 0.0, 0.0], atol=0.02)
    assert nearest > CLEARANCE_M - 1e-3


@pytest.mark.parametrize("aside_m", [0.5, 0.9, 1.3])
def test_chaser_never_flies_through_a_panel(aside_m: float) -> None:
    _, nearest = fly(
        np.array([-1.0, aside_m, 0.0]), np.array([1.0, aside_m, 0.0]), 150, np.array([0.02, 0.01, 0.0])
    )
    assert nearest > CLEARANCE_M - 2e-3


def with_shape(**limits: Any) -> dict[str, Any]:
    return {
        "name": "test",
        "duration_s": 10.0,
        "target": {"model": "geo_servicer", "motion": "constant_rates"},
        "perception": {"name": "model"},
        "limits": {"min_distance_target_m": 0.0, "min_distance_shape_m": 0.3, **limits},
        "chasers": [{"position_m": [-4.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }


def test_goto_into_a_panel_is_refused_and_places_that_the_sphere_forbade_are_not() -> None:
    scenario = parse_scenario(with_shape(), "test")
    machine = PhaseMachine(scenario)
    machine.target_acquired(0.0)
    box = max(scenario.target.shape().boxes, key=lambda b: float(np.linalg.norm(b.position_m)))
    refused = machine.command(OperatorCommand(command="goto", chaser=0, offset_m=box.position_m), 0.0)
    assert not refused.accepted
    assert "from the target's shape; allowed are at least 0.3 m" in refused.reason
    thin = int(np.argmin(box.size_m))
    beside = np.array(box.position_m) + rotations.to_matrix(box.q_wxyz)[:, thin] * (
        0.4 + box.size_m[thin] / 2
    )
    assert signed_distance(box_table(scenario.target.shape().boxes), beside)[0] > 0.3
    assert np.linalg.norm(beside) < np.linalg.norm(box.position_m) + 0.3
    offset = tuple(beside.tolist())
    assert machine.command(OperatorCommand(command="goto", chaser=0, offset_m=offset), 0.1).accepted


def test_places_inside_the_shape_and_other_solvers_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"limits\.min_distance_shape_m: needs controller\.solver"):
        parse_scenario(with_shape() | {"controller": {"solver": "ipopt"}}, "test")
    with pytest.raises(
        ScenarioError, match=r"chasers\.0\.position_m: .* from the target's shape, nearer than"
    ):
        parse_scenario(with_shape(min_distance_shape_m=20.0), "test")
