# SPDX-License-Identifier: Apache-2.0
"""The NMPC in closed loop: against ipopt's, constraints, stationary points, invariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.nmpc import NmpcPlan, make_solver
from chaserdock_controller.nmpc.problem import check_input
from chaserdock_controller.nmpc.warm_start import shift_inputs, warm_start
from chaserdock_models import rotations
from hypothesis import given, settings
from hypothesis import strategies as st
from nmpc_cases import (
    D_MIN_M,
    LEVEL,
    PARAMS,
    at_rest,
    far_start,
    fixed_problem,
    fly,
    fresh,
    swap,
    tumbling,
    with_settings,
)


@pytest.mark.parametrize("control_s", [1 / 15, 1 / 30])
def test_steady_error_with_feed_forward(control_s: float) -> None:
    problem_at, states = tumbling(1)
    for feed, bound_m in ((True, 5e-4), (False, 2e-2)):
        problem_at, states = tumbling(1, feed)
        flight = fly(fresh("rti", 1), problem_at, states, control_s, 20.0)
        end = problem_at(flight.states[-1], 20.0).references[0, 0]
        error = np.linalg.norm(flight.states[-1, 0, :3] - end[:3])
        assert error < bound_m
        if not feed:
            assert error > 5e-4  # the bias of u_ref = 0, which the feed-forward removes


@pytest.mark.slow
@pytest.mark.parametrize("case", ["N=1 saturated", "N=1 obstacle", "N=2 swap"])
def test_closed_loop_cost_against_ipopt(case: str) -> None:
    if case == "N=1 saturated":
        (problem_at, states), time_s = far_start(1), 6.0
    elif case == "N=1 obstacle":
        states, time_s = np.array([at_rest(np.array([-0.6, 0.12, 0.0]))]), 8.0
        problem_at = lambda x, _t: fixed_problem(x, np.array([[0.6, 0.0, 0.0]]))  # noqa: E731
    else:
        (problem_at, states), time_s = swap(0.2, 0.5), 7.0
    costs = {}
    for name in ("rti", "ipopt"):
        flight = fly(fresh(name, len(states)), problem_at, states, 0.1, time_s)
        costs[name] = flight.cost
        if "swap" in case:
            assert flight.between() > D_MIN_M - 1e-3
        if "obstacle" in case:
            assert flight.from_target() > D_MIN_M - 1e-3
    assert costs["rti"] < 1.05 * costs["ipopt"]


@pytest.mark.parametrize("control_s", [1 / 15, 1 / 30])
def test_head_on_swap_keeps_the_distance(control_s: float) -> None:
    problem_at, states = swap()
    flight = fly(fresh("rti", 2), problem_at, states, control_s, 30.0)
    assert flight.between() > D_MIN_M
    assert np.max(np.linalg.norm(flight.states[-1, :, :3] - states[::-1, :3], axis=-1)) < 0.05
    assert all(s == "solved" for plan in flight.plans for s in plan.status)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_symmetric_obstacle_is_passed(axis: int) -> None:
    start, goal = np.zeros(3), np.zeros(3)
    start[axis], goal[axis] = -1.0, 1.0
    flight = fly(
        fresh("rti", 1),
        lambda x, _t: fixed_problem(x, goal[None]),
        np.array([at_rest(start)]),
        1 / 15,
        30.0,
    )
    assert flight.from_target() > D_MIN_M
    assert np.linalg.norm(flight.states[-1, 0, :3] - goal) < 0.05


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, 0, -1.0], [0.6, 0.0, 0.8]])
def test_half_turn_is_not_a_stationary_point(axis: list[float]) -> None:
    q = np.concatenate([[0.0], axis])
    position = np.array([-1.0, 0, 0])
    flight = fly(
        fresh("rti", 1),
        lambda x, _t: fixed_problem(x, position[None]),
        np.array([at_rest(position, q)]),
        1 / 15,
        45.0,
    )
    assert rotations.angle_between(flight.states[-1, 0, 6:10], LEVEL) < 0.05


@pytest.mark.parametrize("start", [[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [-0.2, 0.1, 0.05]])
def test_start_inside_the_keep_out_comes_out(start: list[float]) -> None:
    """The reference lies on the far side: the way there leads out first, not through."""
    states = np.array([at_rest(np.array(start))])
    goal = np.array([[-1.0, 0, 0.0]])
    flight = fly(fresh("rti", 1), lambda x, _t: fixed_problem(x, goal), states, 1 / 15, 10.0)
    assert flight.plans[0].status == ("infeasible_relaxed",)
    assert flight.plans[0].max_violation_m[0] > D_MIN_M - np.linalg.norm(start) - 1e-6
    distance = np.linalg.norm(flight.states[:, 0, :3], axis=-1)
    assert np.all(np.diff(distance[:15]) > -1e-9)
    out = int(np.argmax(distance > D_MIN_M))
    assert 0 < out < 60
    assert np.min(distance[out:]) > D_MIN_M - 1e-3
    assert flight.plans[-1].status == ("solved",)


def test_chasers_that_start_too_close_move_apart() -> None:
    states = np.array([at_rest(np.array([-0.1, 1.0, 0.0])), at_rest(np.array([0.1, 1.0, 0.0]))])
    goals = states[:, :3].copy()
    flight = fly(fresh("rti", 2), lambda x, _t: fixed_problem(x, goals), states, 1 / 15, 10.0)
    assert flight.plans[0].status == ("infeasible_relaxed",) * 2
    gap = np.linalg.norm(flight.states[:, 0, :3] - flight.states[:, 1, :3], axis=-1)
    assert np.all(np.diff(gap[:15]) > 0.0)
    assert np.min(gap[90:]) > D_MIN_M


def test_outer_bound_is_respected() -> None:
    """A chaser that coasts away is bounded by the tangent plane, as far as its thrust can."""
    params = with_settings(
        PARAMS, max_reference_distance_m=1.0, weight_position=0.0, weight_final_position=0.0
    )
    state = at_rest(np.array([0.8, 1.0, 0.0]))
    state[3] = 0.05
    states = np.array([state])
    goal = np.array([[0.0, 1.0, 0.0]])
    flight = fly(fresh("rti", 1, params), lambda x, _t: fixed_problem(x, goal), states, 0.1, 10.0)
    assert np.max(np.linalg.norm(flight.states[:, 0, :3] - goal, axis=-1)) < 1.0 + 1e-3


@settings(derandomize=True, deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_box_holds_exactly_from_any_start(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, 13))
    states[:, 6:10] = rotations.normalize(states[:, 6:10])
    states[:, 3:6] *= 0.1
    states[:, 10:] *= 0.1
    problem = fixed_problem(
        states, rng.normal(size=(n, 3)), rotations.normalize(rng.normal(size=4))
    )
    limits = PARAMS.input_limits() * rng.uniform(0.0, 1.0, size=(n, 6))
    limits[rng.random((n, 6)) < 0.2] = 0.0  # thrusters lost
    problem = replace(problem, input_max=limits)
    chosen = fresh("rti", 4)
    for shift_s in (0.0, 1 / 15):
        plan = chosen.solve(problem, shift_s)
        assert np.all(np.abs(plan.inputs) <= limits[:, None, :])
        assert np.all(np.isfinite(plan.states))
        assert set(plan.status) <= {"solved", "infeasible_relaxed"}


def test_permuting_the_chasers_permutes_the_plan() -> None:
    problem_at, states = far_start(4)
    problem = problem_at(states, 0.0)
    order = [2, 0, 3, 1]
    turned = replace(
        problem,
        states=problem.states[order],
        references=problem.references[order],
        u_ref=problem.u_ref[order],
    )
    one, other = make_solver("rti", PARAMS, 4), make_solver("rti", PARAMS, 4)
    for shift_s in (0.0, 1 / 15, 1 / 15):
        a = one.solve(problem, shift_s, ids=[0, 1, 2, 3])
        b = other.solve(turned, shift_s, ids=order)
        np.testing.assert_allclose(b.inputs, a.inputs[order], rtol=0, atol=1e-9)
    assert a.iterations.any()


def test_warm_start_follows_the_chaser_that_stays() -> None:
    problem_at, states = far_start(2)
    # Without pair constraints, so that the one leaves no trace in the other's plan.
    problem = replace(problem_at(states, 0.0), min_distance_chasers_m=0.0)
    alone = replace(
        problem,
        states=problem.states[1:],
        references=problem.references[1:],
        u_ref=problem.u_ref[1:],
        min_distance_target_m=problem.min_distance_target_m[1:],
        input_max=problem.input_max[1:],
    )
    chosen, twin = make_solver("rti", PARAMS, 2), make_solver("rti", PARAMS, 2)
    chosen.solve(problem, 0.0, ids=[7, 9])
    twin.solve(alone, 0.0, ids=[9])
    left = chosen.solve(alone, 1 / 15, ids=[9])
    np.testing.assert_array_equal(left.inputs, twin.solve(alone, 1 / 15, ids=[9]).inputs)
    stranger = chosen.solve(alone, 1 / 15, ids=[7])
    assert not np.array_equal(left.inputs, stranger.inputs)


@pytest.mark.parametrize("name", ["rti", "ipopt"])
def test_equal_inputs_give_equal_plans(name: str) -> None:
    problem_at, states = far_start(1)
    chosen = fresh(name, 1)

    def run() -> list[NmpcPlan]:
        chosen.reset()
        return [chosen.solve(problem_at(states, 0.0), s) for s in (0.0, 0.05)]

    for a, b in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(a.inputs, b.inputs)


def test_rti_converges_to_ipopts_plan() -> None:
    """Iterated on a frozen problem, the real-time iteration reaches a point that ipopt agrees
    with.
    """
    problem_at, states = far_start(1)
    problem = problem_at(states, 0.0)
    chosen = fresh("rti", 1)
    plan = chosen.solve(problem, 0.0)
    for _ in range(7):
        plan = chosen.solve(problem, 0.0)
    best = fresh("ipopt", 1).solve(problem, 0.0)
    assert best.status == ("solved",)
    assert plan.cost[0] == pytest.approx(best.cost[0], rel=2e-3)


def test_euler_is_the_papers_and_flies() -> None:
    params = replace(PARAMS, integrator="euler")
    problem_at, states = far_start(1)
    flight = fly(fresh("rti", 1, params), problem_at, states, 0.1, 15.0)
    goal = problem_at(flight.states[-1], 15.0).references[0, 0, :3]
    assert np.linalg.norm(flight.states[-1, 0, :3] - goal) < 0.02


@pytest.mark.parametrize("shift_s", [0.0, 1 / 30, 0.1, 0.25, 1.0, 100.0])
def test_shift_keeps_the_impulse(shift_s: float) -> None:
    plan = np.random.default_rng(1).normal(size=(30, 6))
    shifted = shift_inputs(plan, shift_s, 0.1)
    edges = np.linspace(0.0, 3.0, 31)
    held = np.vstack([plan, np.tile(plan[-1], (2000, 1))])
    integral = np.vstack([np.zeros((1, 6)), np.cumsum(held, axis=0) * 0.1])
    grid = 0.1 * np.arange(len(integral))
    for j in range(6):
        total = np.interp(edges + shift_s, grid, integral[:, j])
        np.testing.assert_allclose(shifted[:, j], np.diff(total) / 0.1, atol=1e-9)


def test_four_chasers_cross_through_the_target() -> None:
    """Every chaser wants the opposite side, all straight through the target and each other."""
    starts = 1.2 * np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
    states = np.array([at_rest(p) for p in starts])
    flight = fly(fresh("rti", 4), lambda x, _t: fixed_problem(x, -starts), states, 1 / 15, 25.0)
    assert flight.from_target() > D_MIN_M
    p = flight.states[:, :, :3]
    gaps = np.linalg.norm(p[:, :, None] - p[:, None], axis=-1) + np.eye(4)
    assert np.min(gaps) > D_MIN_M
    assert np.max(np.linalg.norm(p[-1] + starts, axis=-1)) < 0.05


def test_a_warm_start_keeps_the_limits_of_the_inputs() -> None:
    problem = fixed_problem(at_rest(np.array([1.0, 0.0, 0.0]))[None], np.array([[1.0, 0.0, 0.0]]))
    limits = problem.input_max[0]
    for sign in (-1.0, 1.0):
        beyond = replace(problem, u_ref=np.tile(2.0 * sign * limits, (1, PARAMS.stages, 1)))
        start = warm_start({}, (0,), beyond, 0.0, PARAMS.dt_s)
        np.testing.assert_array_equal(start[0], np.tile(sign * limits, (PARAMS.stages, 1)))


@pytest.mark.parametrize("half_angle_rad", [0.0, np.pi / 2, 2.0])
def test_a_corridor_that_is_no_cone_is_invalid(half_angle_rad: float) -> None:
    problem = fixed_problem(at_rest(np.array([1.0, 0.0, 0.0]))[None], np.array([[1.0, 0.0, 0.0]]))
    corridors = np.tile([1.0, 0.0, 0.0, half_angle_rad, 0.1], (1, PARAMS.stages + 1, 1))
    with pytest.raises(ValueError, match="half angles"):
        check_input(replace(problem, corridors=corridors), PARAMS, 1)
