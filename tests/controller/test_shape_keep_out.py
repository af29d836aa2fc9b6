# SPDX-License-Identifier: Apache-2.0
"""Keep-out zones from the target's shape: signed distance, and plans that pass between panels and
never through one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.nmpc import NmpcInput
from chaserdock_controller.nmpc.kernels import plan_violation
from chaserdock_controller.nmpc.problem import check_input, native_problem
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.shape_distance import (
    box_table,
    chaser_boxes,
    distance_between,
    distance_from_cuboids,
    moved,
    reach_along,
    signed_distance,
)
from chaserdock_models.targets import Box
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import ScenarioError, parse_scenario
from chaserdock_protocol.scenario.checks import shape_distance_m
from flight_cases import fleet_of, order
from flights.shape_gaps import separations
from nmpc_cases import PARAMS, at_rest, fixed_problem, fresh, with_settings
from nmpc_kernels import build_rows

CLEARANCE_M = 0.3
PANEL_M = (0.02, 1.0, 0.8)
# Two panels side by side, with a gap of 0.8 m between them.
PANELS = (Box(PANEL_M, (0.0, 0.9, 0.0)), Box(PANEL_M, (0.0, -0.9, 0.0)))
UNBOUNDED = with_settings(PARAMS, max_reference_distance_m=1e6)


def violation(problem: NmpcInput, states: Array) -> Array:
    """Return the deepest violation (N,) of the distances by plans ``states`` (N, D+1, 13)."""
    checked = check_input(problem, UNBOUNDED, len(states))
    return plan_violation(native_problem(checked, UNBOUNDED), states)


def fly(start: Array, goal: Array, ticks: int, omega_rad_s: Array) -> tuple[Array, float]:
    """Return the last position (3,) and the least distance from the panels, which turn at a
    constant rate about the origin.
    """
    solver, state = fresh("rti", 1), at_rest(start)
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
    found = violation(problem, states[None])
    assert deepest > 0.1
    np.testing.assert_allclose(found, [deepest], rtol=1e-12)


def test_gaps_of_shapes_agree_with_the_kernel_and_are_at_most_the_distance() -> None:
    rng, nodes = np.random.default_rng(3), PARAMS.stages + 1
    table = np.repeat(box_table(PANELS)[None], nodes, axis=0)
    states = np.tile(at_rest(np.zeros(3)), (2, nodes, 1))
    states[..., :3] = rng.uniform(-0.8, 0.8, (2, nodes, 3))
    states[..., 6:10] = rotations.normalize(rng.normal(size=(2, nodes, 4)))
    problem = replace(
        fixed_problem(states[:, 0], states[:, 0, :3], d_target=0.0),
        min_distance_chasers_m=0.0,
        boxes=table,
        box_clearance_m=np.array([0.1, 0.0]),
        chaser_shape=SHAPE,
        min_distance_shapes_m=np.full((2, 2), 0.2),
    )
    found = violation(problem, states)
    poses = [[(s[:3], s[6:10]) for s in plan] for plan in states]
    between = [distance_between(SHAPE, one, other) for one, other in zip(*poses, strict=True)]
    from_panels = [distance_from_cuboids(table[0], SHAPE, *pose) for pose in poses[0]]
    deepest = 0.2 - min(between)
    np.testing.assert_allclose(found, [max(deepest, 0.1 - min(from_panels)), deepest], rtol=1e-9)
    for k in range(nodes):
        one, other = (moved(SHAPE, s[None, k, :3], s[None, k, 6:10])[0] for s in states)
        pairs = separations(np.repeat(one, 2, axis=0), np.tile(other, (2, 1)))
        assert between[k] <= pairs.min() + 1e-12 or pairs.min() > 0.0
    assert min(between) < 0.0 < max(between)


def test_chaser_passes_between_turning_panels() -> None:
    end, nearest = fly(
        np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 250, np.array([0.02, 0.0, 0.0])
    )
    np.testing.assert_allclose(end, [1.0, 0.0, 0.0], atol=0.02)
    assert nearest > CLEARANCE_M - 1e-3


@pytest.mark.parametrize("aside_m", [0.5, 0.9, 1.3])
def test_chaser_never_flies_through_a_panel(aside_m: float) -> None:
    _, nearest = fly(
        np.array([-1.0, aside_m, 0.0]),
        np.array([1.0, aside_m, 0.0]),
        150,
        np.array([0.02, 0.01, 0.0]),
    )
    assert nearest > CLEARANCE_M - 2e-3


SHAPE = box_table(chaser_boxes())
ATTITUDES = np.array([[1.0, 0.0, 0.0, 0.0], rotations.exp(np.array([0.0, 0.0, np.pi / 2]))])


def fly_chasers(starts: Array, goals: Array, apart_m: float) -> float:
    """Return the least gap between two chasers' cuboids on their way, with or without the distance
    of their shapes.
    """
    solver, states, least = fresh("rti", 2), np.array([at_rest(p) for p in starts]), np.inf
    states[:, 6:10] = ATTITUDES
    for tick in range(250):
        tables = [moved(SHAPE, s[None, :3], s[None, 6:10])[0] for s in states]
        pairs = [np.repeat(tables[0], 2, axis=0), np.tile(tables[1], (2, 1))]
        least = min(least, float(separations(*pairs).min()))
        problem = fixed_problem(states, goals, d_target=0.0)
        references = problem.references.copy()
        references[..., 3:] = ATTITUDES[:, None]
        problem = replace(
            problem,
            references=references,
            min_distance_chasers_m=0.2,
            chaser_shape=SHAPE,
            min_distance_shapes_m=np.full((2, 2), apart_m),
        )
        states = solver.solve(problem, PARAMS.dt_s if tick else 0.0).states[:, 1]
    np.testing.assert_allclose(states[:, :3], goals, atol=0.03)
    return least


def test_shapes_of_chasers_pass_each_other_at_their_distance() -> None:
    # The second flies across the probe of the first: the centres stay 0.3 m apart on the straight
    # line.
    starts = np.array([[0.0, 0.0, 0.0], [0.3, -0.8, 0.02]])
    goals = np.array([[0.0, 0.0, 0.0], [0.3, 0.8, 0.02]])
    assert fly_chasers(starts, goals, 0.0) < 0.0
    assert fly_chasers(starts, goals, 0.03) > 0.03


def test_probe_keeps_its_distance_from_a_panel() -> None:
    solver, state = fresh("rti", 1), at_rest(np.array([-1.0, 0.9, 0.0]))
    boxes = np.repeat(box_table(PANELS)[None], PARAMS.stages + 1, axis=0)
    least = np.inf
    for tick in range(150):
        table = moved(SHAPE, state[None, :3], state[None, 6:10])[0]
        one, other = np.nonzero(np.ones((2, 2)))
        least = min(least, float(separations(boxes[0][one], table[other]).min()))
        problem = replace(
            fixed_problem(state[None], np.array([[0.0, 0.9, 0.0]]), d_target=0.0),
            boxes=boxes,
            box_clearance_m=np.array([0.05]),
            chaser_shape=SHAPE,
        )
        state = solver.solve(problem, PARAMS.dt_s if tick else 0.0).states[0, 1]
    assert 0.049 < least < 0.06
    assert state[0] < -0.4


def test_planes_move_away_from_a_chaser_that_cannot_keep_its_own_distance() -> None:
    """The first chaser is 1 cm too near to the target: its neighbour yields 1 cm more, and it has 1
    cm more room.
    """
    places = np.array([[0.0, 0.34, 0.0], [0.0, 0.80, 0.0]])
    needed = {}
    for limit_m in (0.0, 0.35):
        problem = replace(
            fixed_problem(np.array([at_rest(p) for p in places]), places),
            min_distance_chasers_m=0.35,
        )
        problem = check_input(
            replace(problem, min_distance_target_m=np.array([limit_m, 0.0])), PARAMS, 2
        )
        nodes = PARAMS.stages + 1
        rollout = np.repeat(problem.states[:, None], nodes, axis=1)
        rows = build_rows(problem, PARAMS, rollout, np.full((2, nodes), 10.0))
        between = [rows.c[i, rows.n_rows[i] - PARAMS.stages : rows.n_rows[i]] for i in range(2)]
        needed[limit_m] = np.array(between)
    np.testing.assert_allclose(needed[0.35][0] - needed[0.0][0], -0.01, atol=1e-12)
    np.testing.assert_allclose(needed[0.35][1] - needed[0.0][1], 0.01, atol=1e-12)


def with_shape(**limits: Any) -> dict[str, Any]:
    return {
        "name": "test",
        "duration_s": 10.0,
        "target": {"model": "geo_servicer", "motion": "constant_rates"},
        "perception": {"name": "model"},
        "limits": {"min_distance_target_m": 0.0, "min_distance_shape_m": 0.05, **limits},
        "chasers": [{"position_m": [-4.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }


def test_goto_into_a_panel_is_refused_and_places_that_the_sphere_forbade_are_not() -> None:
    scenario = parse_scenario(with_shape(), "test")
    machine = fleet_of(scenario, acquired_s=0.0)
    box = max(scenario.target.shape().boxes, key=lambda b: float(np.linalg.norm(b.position_m)))
    refused = order(
        machine, OperatorCommand(command="goto", chaser=0, offset_m=box.position_m), 0.0
    )
    assert not refused.accepted
    assert "from the target's shape; allowed are at least 0.05 m" in refused.reason
    thin = int(np.argmin(box.size_m))
    normal = rotations.to_matrix(box.q_wxyz)[:, thin]
    beside = np.array(box.position_m) + normal * (0.4 + box.size_m[thin] / 2)
    facing = facing_attitudes((-4.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), beside)[0]
    room_m = 0.4 - reach_along(SHAPE, -normal, facing)
    assert 0.05 < shape_distance_m(scenario, 0, beside) <= room_m
    assert np.linalg.norm(beside) < np.linalg.norm(box.position_m) + 0.3
    offset = tuple(beside.tolist())
    assert order(machine, OperatorCommand(command="goto", chaser=0, offset_m=offset), 0.1).accepted


def test_places_inside_the_shape_and_other_solvers_are_refused() -> None:
    with pytest.raises(
        ScenarioError, match=r"limits\.min_distance_shape_m: needs controller\.solver"
    ):
        parse_scenario(with_shape() | {"controller": {"solver": "ipopt"}}, "test")
    with pytest.raises(
        ScenarioError,
        match=r"chasers\.0\.position_m: .* from the target's shape there, nearer than",
    ):
        parse_scenario(with_shape(min_distance_shape_m=20.0), "test")
