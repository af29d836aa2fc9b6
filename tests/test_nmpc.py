"""The NMPC: its own QP, its closed loop against ipopt's, constraints, stationary points, bad input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from chaserdock_controller.nmpc import NmpcInput, NmpcParameters, NmpcPlan, NmpcSolver, make_solver
from chaserdock_controller.nmpc import kernels, planes, riccati
from chaserdock_controller.nmpc.cost import quadratic_model
from chaserdock_controller.nmpc.ipm import CONVERGED, FREE, MU_STOP, solve_qp
from chaserdock_controller.nmpc.problem import SLACK_L1, SLACK_L2
from chaserdock_controller.nmpc.types import shift_inputs
from chaserdock_controller.reference import feed_forward, predict_target, reference_state, reference_trajectory
from chaserdock_protocol import rotations
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

Array = NDArray[np.float64]

# The paper's chaser and tumble (paper/reference.toml).
MASS_KG = 30.0
_LONG, _FLAT = MASS_KG / 12 * (0.25**2 + 0.25**2), MASS_KG / 12 * (0.25**2 + 0.05**2)
INERTIA = ((_FLAT, 0.0, 0.0), (0.0, _FLAT, 0.0), (0.0, 0.0, _LONG))
PARAMS = NmpcParameters(mass_kg=MASS_KG, inertia_kg_m2=INERTIA, force_max_N=2.0, torque_max_N_m=0.05)
V_TARGET = np.array([1.5e-2, 0.75e-2, 3e-2])
W_TARGET = np.array([1.5e-2, 4.5e-2, 3e-2])
HALF = np.sqrt(0.5)
OFFSETS = np.array([[-1.0, 0, 0], [0, -1.0, 0], [0, 1.0, 0], [1.0, 0, 0]])
Q_OFFSETS = np.array([[1.0, 0, 0, 0], [HALF, 0, 0, HALF], [HALF, 0, 0, -HALF], [0, 0, 0, 1.0]])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
D_MIN_M = 0.35
NODES, WEIGHTS = kernels.RK_NODES["rk4"], kernels.RK_WEIGHTS["rk4"]
MATRIX = np.array(INERTIA)
INVERSE = np.ascontiguousarray(np.linalg.inv(MATRIX))


@cache
def solver(name: str, n: int, params: NmpcParameters = PARAMS) -> NmpcSolver:
    """One per kind: building is what costs time. Every user resets it."""
    return make_solver(name, params, n)


def fresh(name: str, n: int, params: NmpcParameters = PARAMS) -> NmpcSolver:
    chosen = solver(name, n, params)
    chosen.reset()
    return chosen


def at_rest(position: Array, q: Array = LEVEL) -> Array:
    return np.concatenate([position, np.zeros(3), q, np.zeros(3)])


def fixed_problem(
    states: Array,
    goals: Array,
    q_goal: Array = LEVEL,
    target: Array | None = None,
    d_target: float = D_MIN_M,
    d_chasers: float = D_MIN_M,
) -> NmpcInput:
    """Poses that do not move: goals (N, 3), attitude ``q_goal``."""
    n, d = len(states), PARAMS.stages
    pose = np.concatenate([goals, np.tile(q_goal, (n, 1))], axis=1)
    return NmpcInput(
        states=states,
        references=np.repeat(pose[:, None, :], d + 1, axis=1),
        u_ref=np.zeros((n, d, 6)),
        target_positions=np.tile(np.zeros(3) if target is None else target, (d + 1, 1)),
        min_distance_target_m=np.full(n, d_target),
        min_distance_chasers_m=d_chasers,
        input_max=np.tile(PARAMS.input_limits(), (n, 1)),
    )


def advance(states: Array, inputs: Array, duration_s: float, parts: int = 4) -> Array:
    """True motion: a finer integration than the plan's."""
    after = np.empty_like(states)
    for i, (x, u) in enumerate(zip(states, inputs, strict=True)):
        state, out = x.copy(), np.empty(13)
        for _ in range(parts):
            h = duration_s / parts
            kernels.step(state, u, h, NODES, WEIGHTS, MASS_KG, MATRIX, INVERSE, out, np.empty(24))
            state = out.copy()
        after[i] = state
    return after


@dataclass
class Flight:
    states: Array  # (ticks + 1, N, 13)
    plans: list[NmpcPlan]
    cost: float  # eq. 3's stage cost along the true motion, times the control period

    def between(self) -> float:
        p = self.states[:, :, :3]
        return float(np.min(np.linalg.norm(p[:, 0] - p[:, 1], axis=-1)))

    def from_target(self, target: Array | None = None) -> float:
        centre = np.zeros(3) if target is None else target
        return float(np.min(np.linalg.norm(self.states[:, :, :3] - centre, axis=-1)))


def fly(
    chosen: NmpcSolver, problem_at: Callable[[Array, float], NmpcInput], states: Array, control_s: float, time_s: float
) -> Flight:
    history, plans, cost = [states], [], 0.0
    for k in range(round(time_s / control_s)):
        problem = problem_at(states, k * control_s)
        plan = chosen.solve(problem, control_s if k else 0.0)
        plans.append(plan)
        assert np.all(np.abs(plan.inputs) <= problem.input_max[:, None, :])
        for x, u, ref, free in zip(states, plan.inputs[:, 0], problem.references[:, 0], problem.u_ref[:, 0], strict=True):
            error = rotations.multiply(x[6:10], rotations.conjugate(ref[3:]))[1:]
            cost += control_s * (65.0 * np.sum((x[:3] - ref[:3]) ** 2) + 35.0 * np.sum(error**2))
            cost += control_s * np.sum(np.array([3.5] * 3 + [40.0] * 3) * (u - free) ** 2)
        states = advance(states, plan.inputs[:, 0], control_s)
        history.append(states)
    return Flight(np.array(history), plans, float(cost))


def tumbling(n: int, feed: bool = True) -> tuple[Callable[[Array, float], NmpcInput], Array]:
    """The paper's tracking: problem as a function of state and time, and the states on the references."""
    d = PARAMS.stages
    times = PARAMS.dt_s * np.arange(d + 1)

    def problem_at(states: Array, now_s: float) -> NmpcInput:
        p, q = (a[0] for a in predict_target(np.zeros(3), V_TARGET, LEVEL, W_TARGET, [now_s]))
        references = [
            reference_trajectory(p, V_TARGET, q, W_TARGET, OFFSETS[i], Q_OFFSETS[i], times) for i in range(n)
        ]
        zero = np.zeros((d, 3))
        wrench = [
            feed_forward(W_TARGET, np.tile(OFFSETS[i], (d, 1)), zero, zero, Q_OFFSETS[i], MASS_KG, INERTIA)
            for i in range(n)
        ]
        return NmpcInput(
            states=states,
            references=np.array(references),
            u_ref=np.array(wrench) * feed,
            target_positions=predict_target(p, V_TARGET, q, W_TARGET, times)[0],
            min_distance_target_m=np.full(n, D_MIN_M),
            min_distance_chasers_m=D_MIN_M,
            input_max=np.tile(PARAMS.input_limits(), (n, 1)),
        )

    start = [
        reference_state(np.zeros(3), V_TARGET, LEVEL, W_TARGET, OFFSETS[i], np.zeros(3), Q_OFFSETS[i])
        for i in range(n)
    ]
    return problem_at, np.array(start)


# The QP


def qp_data(problem: NmpcInput, u: Array) -> tuple[list[Array], list[Array], Array]:
    """solve_qp's matrices for each chaser, linearized about u (N, D, 6), and the rolled states."""
    n, d = len(problem.states), PARAMS.stages
    weights_p, weights_q = PARAMS.stage_weights()
    weights_u = np.array([3.5] * 3 + [40.0] * 3)
    x, c, b = np.empty((n, d + 1, 13)), np.empty((n, d, 12, 6)), np.empty((n, d, 12, 6))
    x[:, 0] = problem.states
    kernels.roll_linearized(x, u, problem.input_max, 0.1, NODES, WEIGHTS, MASS_KG, MATRIX, INVERSE, c, b)
    row_a, row_c = np.zeros((n, d + 1, n + 1, 3)), np.zeros((n, d + 1, n + 1))
    n_rows = np.zeros((n, d + 1), dtype=np.int64)
    planes.build_rows(
        x, problem.references, problem.target_positions, problem.min_distance_target_m,
        np.full((n, n), problem.min_distance_chasers_m), 25.0, np.full((n, d + 1), 10.0), row_a, row_c, n_rows,
    )  # fmt: skip
    data, rows = [], []
    for i in range(n):
        q_pos, q_att, qx = np.empty((d + 1, 3, 3)), np.empty((d + 1, 3, 3)), np.empty((d + 1, 12))
        r_diag, r, w_bar = np.empty((d, 6)), np.empty((d, 6)), np.empty((d, 6))
        quadratic_model(
            x[i], u[i], problem.references[i], problem.u_ref[i], problem.input_max[i],
            weights_p, weights_q, weights_u, q_pos, q_att, qx, r_diag, r, w_bar,
        )  # fmt: skip
        data.append([c[i], b[i], 0.1, q_pos, q_att, qx, r_diag, r, w_bar])
        rows.append([row_a[i], row_c[i], n_rows[i]])
    return data, rows, x


def condensed(data: list[Array]) -> tuple[Array, Array, Array]:
    """Dense gradient, Hessian (6 D) and the maps (D+1, 12, 6 D) from inputs to states, by brute force."""
    c, b, h, q_pos, q_att, qx, r_diag, r, _ = data
    d = len(c)
    maps = np.zeros((d + 1, 12, 6 * d))
    for k in range(d):
        a = np.zeros((12, 12))
        a[:6, :6] = np.eye(6)
        a[:3, 3:6] = h * np.eye(3)
        a[:, 6:] = c[k]
        maps[k + 1] = a @ maps[k]
        maps[k + 1][:, 6 * k : 6 * k + 6] += b[k]
    hessian, gradient = np.diag(r_diag.ravel()), r.ravel().copy()
    for k in range(d + 1):
        q = np.zeros((12, 12))
        q[:3, :3], q[6:9, 6:9] = q_pos[k], q_att[k]
        hessian += maps[k].T @ q @ maps[k]
        gradient += maps[k].T @ qx[k]
    return gradient, hessian, maps


def random_inputs(seed: int, n: int, share: float) -> Array:
    rng = np.random.default_rng(seed)
    return share * PARAMS.input_limits() * rng.uniform(-1, 1, size=(n, PARAMS.stages, 6))


@pytest.mark.parametrize("seed", range(3))
def test_riccati_minimizes_the_quadratic_model(seed: int) -> None:
    problem_at, states = tumbling(1)
    states[:, :3] += 0.1
    data, _, _ = qp_data(problem_at(states, 0.0), random_inputs(seed, 1, 0.5))
    c, b, h, q_pos, q_att, qx, r_diag, r, _ = data[0]
    gain, chol = np.empty((30, 6, 12)), np.zeros((30, 6, 6))
    dx, dw = np.zeros((31, 12)), np.zeros((30, 6))
    assert riccati.factor(c, b, h, q_pos, q_att, r_diag, gain, chol)
    riccati.solve(c, b, h, gain, chol, qx, r, dx, dw)
    gradient, hessian, maps = condensed(data[0])
    expected = -np.linalg.solve(hessian, gradient)
    np.testing.assert_allclose(dw.ravel(), expected, rtol=0, atol=1e-8 * np.max(np.abs(expected)))
    np.testing.assert_allclose(dx, maps @ dw.ravel(), rtol=0, atol=1e-8)


def test_quadratic_model_is_the_costs_first_order() -> None:
    """Its gradient equals finite differences of the nonlinear cost along the nonlinear dynamics."""
    problem_at, states = tumbling(1)
    states[0, 6:10] = rotations.multiply(states[0, 6:10], rotations.exp([0.8, -0.5, 0.4]))
    problem, u = problem_at(states, 0.0), random_inputs(3, 1, 0.5)
    gradient, _, _ = condensed(qp_data(problem, u)[0][0])

    def cost(inputs: Array) -> float:
        from chaserdock_controller.nmpc.cost import plan_cost

        x, value = np.empty((1, 31, 13)), np.empty(1)
        x[:, 0] = states
        kernels.roll(x, inputs, 0.1, NODES, WEIGHTS, MASS_KG, MATRIX, INVERSE)
        weights = np.array([3.5] * 3 + [40.0] * 3)
        plan_cost(x, inputs, problem.references, problem.u_ref, *PARAMS.stage_weights(), weights, value)
        return float(value[0])

    limits = PARAMS.input_limits()
    for k in (0, 7, 29):
        for j in range(6):
            e = np.zeros_like(u)
            e[0, k, j] = 1e-4 * limits[j]
            slope = (cost(u + e) - cost(u - e)) / 2e-4
            assert gradient[6 * k + j] == pytest.approx(slope, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_interior_point_meets_the_kkt_conditions(seed: int) -> None:
    """Two chasers swapping, saturated, with distances active; conditions evaluated densely."""
    rng = np.random.default_rng(seed)
    states = np.array([at_rest(np.array([-0.25, 0.6, 0.0])), at_rest(np.array([0.25, 0.6, 0.05]))])
    states[:, 3:6] = rng.normal(scale=0.05, size=(2, 3))
    problem = fixed_problem(states, np.array([[0.8, 0.5, 0], [-0.8, 0.5, 0.0]]), rotations.exp([0, 0, 0.7]))
    data, rows, _ = qp_data(problem, random_inputs(seed, 2, 0.3))
    active = 0
    for one, (row_a, row_c, n_rows) in zip(data, rows, strict=True):
        dx, dw = np.zeros((31, 12)), np.zeros((30, 6))
        # The Python source of the kernel, so that the test does not wait for a second compilation.
        code, iterations, _, mu, lam, box = solve_qp.py_func(
            *one, row_a, row_c, n_rows, SLACK_L1, SLACK_L2, dx, dw
        )
        assert code == CONVERGED
        assert 0 < iterations < 30
        gradient, hessian, maps = condensed(one)
        w = one[-1] + dw
        assert np.all(np.abs(w) < 1.0)
        stationarity = gradient + hessian @ dw.ravel() - (box[:, :, 0] - box[:, :, 1]).ravel()
        for k in range(1, 31):
            for m in range(n_rows[k]):
                normal = maps[k][:3].T @ row_a[k, m]
                stationarity -= lam[k, m] * normal
                gap = normal @ dw.ravel() - row_c[k, m]
                slack = max(-gap, 0.0)
                assert 0.0 < lam[k, m] < SLACK_L1 + SLACK_L2 * slack + 1.0
                assert lam[k, m] * (gap + slack) < 60 * MU_STOP * len(w)
                active += lam[k, m] > 1.0
        assert np.max(np.abs(stationarity)) < 1e-5 * np.max(np.abs(gradient))
        assert np.all(box > 0.0)
        assert mu <= MU_STOP
        assert np.max(np.minimum(box[:, :, 0] * (1 + w), 1e9)) < 400 * MU_STOP
    assert active > 0


def test_free_solution_needs_no_interior_point() -> None:
    problem_at, states = tumbling(4)
    plan = fresh("rti", 4).solve(problem_at(states, 0.0), 0.0)
    assert plan.status == ("solved",) * 4
    assert not plan.iterations.any()
    assert FREE != CONVERGED


# Closed loop


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


def far_start(n: int) -> tuple[Callable[[Array, float], NmpcInput], Array]:
    problem_at, states = tumbling(n)
    states[:, :3] += np.array([-0.6, 0.3, 0.2])
    for x in states:
        x[6:10] = rotations.multiply(x[6:10], rotations.exp([0.575, 0, 0]))
    return problem_at, states


def swap(n_side_m: float = 0.0) -> tuple[Callable[[Array, float], NmpcInput], Array]:
    """Two chasers that change places head-on, 2 m from the target."""
    a, b = np.array([-0.8, 2.0, 0.0]), np.array([0.8, 2.0, n_side_m])
    return (lambda x, _t: fixed_problem(x, np.array([b, a]))), np.array([at_rest(a), at_rest(b)])


@pytest.mark.parametrize("case", ["N=1 saturated", "N=1 obstacle", "N=2 swap"])
def test_closed_loop_cost_against_ipopt(case: str) -> None:
    if case == "N=1 saturated":
        (problem_at, states), time_s = far_start(1), 6.0
    elif case == "N=1 obstacle":
        states, time_s = np.array([at_rest(np.array([-0.8, 0.12, 0.0]))]), 12.0
        problem_at = lambda x, _t: fixed_problem(x, np.array([[0.8, 0.0, 0.0]]))  # noqa: E731
    else:
        (problem_at, states), time_s = swap(0.25), 12.0
    costs = {}
    for name in ("rti", "ipopt"):
        flight = fly(fresh(name, len(states)), problem_at, states, 0.1, time_s)
        costs[name] = flight.cost
        if "swap" in case:
            assert flight.between() > D_MIN_M - 1e-3
        if "obstacle" in case:
            assert flight.from_target() > D_MIN_M - 1e-3
    print(case, costs)
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
        fresh("rti", 1), lambda x, _t: fixed_problem(x, goal[None]), np.array([at_rest(start)]), 1 / 15, 30.0
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
    params = replace(PARAMS, max_reference_distance_m=1.0, weight_position=0.0, weight_final_position=0.0)
    state = at_rest(np.array([0.8, 1.0, 0.0]))
    state[3] = 0.05
    states = np.array([state])
    goal = np.array([[0.0, 1.0, 0.0]])
    flight = fly(fresh("rti", 1, params), lambda x, _t: fixed_problem(x, goal), states, 0.1, 10.0)
    assert np.max(np.linalg.norm(flight.states[:, 0, :3] - goal, axis=-1)) < 1.0 + 1e-3


# Properties


@settings(derandomize=True, deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_box_holds_exactly_from_any_start(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, 13))
    states[:, 6:10] = rotations.normalize(states[:, 6:10])
    states[:, 3:6] *= 0.1
    states[:, 10:] *= 0.1
    problem = fixed_problem(states, rng.normal(size=(n, 3)), rotations.normalize(rng.normal(size=4)))
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
    problem = problem_at(states, 0.0)
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
    """Iterated on a frozen problem, the real-time iteration reaches a point that ipopt agrees with."""
    problem_at, states = far_start(1)
    problem = problem_at(states, 0.0)
    chosen = fresh("rti", 1)
    for _ in range(8):
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


# Bad input


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"mass_kg": 0.0}, "mass_kg"),
        ({"mass_kg": float("nan")}, "mass_kg"),
        ({"weight_position": -1.0}, "weight_position"),
        ({"weight_torque": 0.0}, "weight_torque"),
        ({"horizon_s": 0.04}, "horizon_s"),
        ({"dt_s": 0.0}, "dt_s"),
        ({"falloff": 1.5}, "falloff"),
        ({"force_max_N": -2.0}, "force_max_N"),
        ({"integrator": "heun"}, "integrator"),
        ({"max_reference_distance_m": 0.0}, "max_reference_distance_m"),
        ({"inertia_kg_m2": ((1.0, 2.0, 0.0), (2.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "positive definite"),
        ({"inertia_kg_m2": ((1.0, 0.1, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "symmetric"),
    ],
)
def test_parameters_are_checked(change: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        replace(PARAMS, **change)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", ["rti", "ipopt"])
@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("states", np.full((1, 13), np.nan), "finite"),
        ("states", np.zeros((1, 12)), "shape"),
        ("states", np.zeros((1, 13)), "quaternion"),
        ("states", np.zeros((0, 13)), "shape"),
        ("references", np.zeros((1, 30, 7)), "references"),
        ("u_ref", np.full((1, 30, 6), np.inf), "u_ref"),
        ("target_positions", np.zeros((31, 2)), "target_positions"),
        ("min_distance_target_m", np.array([-0.1]), "min_distance_target_m"),
        ("min_distance_chasers_m", np.zeros((2, 2)), "min_distance_chasers_m"),
        ("input_max", np.full((1, 6), -1.0), "input_max"),
    ],
)
def test_problems_are_checked(name: str, field: str, value: Array, word: str) -> None:
    problem_at, states = tumbling(1)
    problem = replace(problem_at(states, 0.0), **{field: value})
    with pytest.raises(ValueError, match=word):
        fresh(name, 1).solve(problem, 0.0)


def test_calls_are_checked() -> None:
    problem_at, states = tumbling(2)
    problem = problem_at(states, 0.0)
    with pytest.raises(ValueError, match="N from 1 to 1"):
        fresh("rti", 1).solve(problem, 0.0)
    chosen = fresh("rti", 2)
    with pytest.raises(ValueError, match="ids"):
        chosen.solve(problem, 0.0, ids=[3, 3])
    with pytest.raises(ValueError, match="shift_s"):
        chosen.solve(problem, -0.1)
    lopsided = replace(problem, min_distance_chasers_m=np.array([[0.0, 0.3], [0.4, 0.0]]))
    with pytest.raises(ValueError, match="symmetric"):
        chosen.solve(lopsided, 0.0)
    with pytest.raises(ValueError, match="rti, ipopt"):
        make_solver("snopt", PARAMS, 1)
    with pytest.raises(ValueError, match="n_chasers"):
        make_solver("rti", PARAMS, 0)


def test_inputs_are_not_written_to() -> None:
    problem_at, states = far_start(2)
    problem = problem_at(states, 0.0)
    before = [np.copy(getattr(problem, f)) for f in problem.__dataclass_fields__]
    plan = fresh("rti", 2).solve(problem, 0.0)
    kept = plan.inputs.copy()
    solver("rti", 2).solve(problem, 0.1)
    for old, f in zip(before, problem.__dataclass_fields__, strict=True):
        np.testing.assert_array_equal(old, getattr(problem, f))
    np.testing.assert_array_equal(kept, plan.inputs)
