# SPDX-License-Identifier: Apache-2.0
"""Conformance of every NMPC back end; iteration budgets, approach cones and changing actuator
limits.
"""

from __future__ import annotations

import importlib.util
import shutil
from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.nmpc import BACK_ENDS, NmpcInput, make_solver, open_backend
from chaserdock_controller.nmpc.problem import check_input
from chaserdock_protocol.errors import ChaserdockError, MissingPackageError
from hypothesis import given, settings
from hypothesis import strategies as st
from nmpc_cases import (
    D_MIN_M,
    PARAMS,
    Array,
    at_rest,
    far_start,
    fixed_problem,
    fly,
    fresh,
    swap,
    with_settings,
)
from nmpc_kernels import build_rows

# Eight stages, for speed.
SHORT_HORIZON = replace(PARAMS, horizon_s=0.8)


def installed(name: str) -> bool:
    needs = {"open": "opengen"}
    found = importlib.util.find_spec(needs.get(name, "casadi")) is not None
    return found and (name != "open" or shutil.which("cargo") is not None)


def short(problem: NmpcInput, d: int = 8) -> NmpcInput:
    """Truncate a problem to its first ``d`` stages."""
    return replace(
        problem,
        references=problem.references[:, : d + 1],
        u_ref=problem.u_ref[:, :d],
        target_positions=problem.target_positions[: d + 1],
        corridors=None if problem.corridors is None else problem.corridors[:, : d + 1],
    )


def test_back_end_without_its_tools_is_one_line_for_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_backend, "missing_part", lambda: "solver 'open' needs cargo")
    with pytest.raises(ChaserdockError, match="needs cargo"):
        make_solver("open", SHORT_HORIZON, 1)


# Compiling OpEn's solver takes minutes the first time.
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n == "open" else n for n in BACK_ENDS]
)
@pytest.mark.parametrize("case", ["transfer", "keep-out", "corridor"])
def test_every_back_end_solves_the_same_problem(name: str, case: str) -> None:
    """Cost within 2 % of IPOPT's optimum, input bounds exact, distance constraints within 5 mm."""
    if not installed(name):
        with pytest.raises(MissingPackageError, match=rf"'{name}' needs"):
            make_solver(name, SHORT_HORIZON, 1)
        pytest.skip(f"{name} is not installed")
    problem_at, states = far_start(1)
    problem = problem_at(states, 0.0)
    if case != "transfer":
        moving = at_rest(np.array([-0.45, 0.05, 0.0]))
        moving[3] = 0.05
        problem = fixed_problem(moving[None], np.array([[-0.38, 0.0, 0.0]]), d_target=0.4)
    if case == "corridor":
        corridors = np.zeros((1, 31, 5))
        corridors[...] = [-1.0, 0.0, 0.0, np.deg2rad(8.0), 0.0]
        problem = replace(problem, min_distance_target_m=np.zeros(1), corridors=corridors)
    problem = short(problem)
    chosen, best = (
        fresh(name, 1, SHORT_HORIZON),
        fresh("ipopt", 1, SHORT_HORIZON).solve(problem, 0.0),
    )
    plan = chosen.solve(problem, 0.0)
    for _ in range(5):
        plan = chosen.solve(problem, 0.0)
    assert plan.status == best.status == ("solved",)
    assert plan.cost[0] == pytest.approx(best.cost[0], rel=0.02)
    assert plan.max_violation_m[0] < 5e-3
    assert np.all(np.abs(plan.inputs) <= problem.input_max[:, None, :])


def corridor_room(r: Array, corridor: Array) -> tuple[float, Array]:
    """Return the clearance inside a corridor (5,) at r (3,) from the target, m, and its gradient,
    from the linearized row.
    """
    params = with_settings(PARAMS, max_reference_distance_m=1e6, horizon_s=0.1)
    problem = short(fixed_problem(at_rest(r)[None], r[None], d_target=0.0), 1)
    problem = replace(problem, corridors=np.tile(corridor, (1, 2, 1)))
    x = np.tile(at_rest(r), (1, 2, 1))
    rows = build_rows(check_input(problem, params, 1), params, x, np.full((1, 2), 1e3))
    assert rows.n_rows[0] == 1
    return -rows.c[0, 0], rows.a[0, 0, :3]


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(0, 10_000))
def test_corridor_row_is_distance_to_the_cone(seed: int) -> None:
    """The clearance is positive inside and zero on the surface; the row's normal equals finite
    differences.
    """
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    half_angle, apex = rng.uniform(0.1, 1.2), rng.uniform(-0.5, 0.5)
    corridor = np.array([*axis, half_angle, apex])
    aside = np.cross(axis, rng.normal(size=3))
    aside /= np.linalg.norm(aside)
    along, angle = rng.uniform(0.2, 2.0), rng.uniform(0.02, 1.5)
    r = apex * axis + along * (np.cos(angle) * axis + np.sin(angle) * aside)
    room, normal = corridor_room(r, corridor)
    assert room == pytest.approx(along * np.sin(half_angle - angle), abs=1e-12)
    for i in range(3):
        e = 1e-6 * np.eye(3)[i]
        slope = corridor_room(r + e, corridor)[0] - corridor_room(r - e, corridor)[0]
        assert normal[i] == pytest.approx(slope / 2e-6, abs=1e-7)


def test_docking_chaser_stays_in_corridor_and_the_other_outside_keep_out() -> None:
    """Chaser 0 approaches to 0.2 m from beside its axis; chaser 1 has the same goal distance
    without a corridor.
    """
    states = np.array([at_rest(np.array([-1.0, 0.25, 0.0])), at_rest(np.array([1.0, 0.2, 0.0]))])
    goals = np.array([[-0.2, 0.0, 0.0], [0.2, 0.0, 0.0]])
    corridors = np.zeros((2, 31, 5))
    corridors[0, :] = [-1.0, 0.0, 0.0, np.deg2rad(15.0), 0.05]
    problem = fixed_problem(states, goals)
    problem = replace(problem, corridors=corridors, min_distance_target_m=np.array([0.15, D_MIN_M]))
    flight = fly(fresh("rti", 2), lambda x, _t: replace(problem, states=x), states, 1 / 15, 30.0)
    room = [corridor_room(p, corridors[0, 0])[0] for p in flight.states[:, 0, :3]]
    assert min(room) > -1e-3
    assert np.linalg.norm(flight.states[-1, 0, :3] - goals[0]) < 0.02
    assert np.min(np.linalg.norm(flight.states[:, 1, :3], axis=-1)) > D_MIN_M - 1e-3


@pytest.mark.parametrize("budget", [0, 3, 10])
def test_iteration_budget_returns_feasible_plan(budget: int) -> None:
    """The number of iterations never exceeds the budget, and the chasers keep their distance."""
    problem_at, states = swap(0.2, 0.4)
    chosen = make_solver("rti", PARAMS, 2, budget)
    plan = chosen.solve(problem_at(states, 0.0), 0.0)
    assert plan.iterations.sum() <= budget
    assert "budget" in plan.status
    flight = fly(chosen, problem_at, states, 0.1, 3.0)
    assert all(p.iterations.sum() <= budget for p in flight.plans)
    assert flight.between() > D_MIN_M - 1e-3


def test_plan_at_iteration_limit_is_used_if_better_than_the_guess() -> None:
    """Keeping the initial guess instead would repeat it in every tick."""
    problem_at, states = far_start(1)
    problem = short(problem_at(states, 0.0))
    chosen = make_solver("ipopt", SHORT_HORIZON, 1, 3)
    plan = chosen.solve(problem, 0.0)
    assert plan.status == ("iteration_limit",)
    assert plan.cost[0] < fresh("ipopt", 1, SHORT_HORIZON).solve(problem, 0.0).cost[0] * 1.5
    assert plan.inputs.any()


def test_actuator_limits_change_in_flight() -> None:
    """The force limit along X drops to a quarter at 4 s; the chaser still reaches its goal."""
    problem_at, states = far_start(1)

    def weakening(x: Array, now_s: float) -> NmpcInput:
        problem = problem_at(x, now_s)
        weak = problem.input_max * (np.array([0.25, 1, 1, 1, 1, 1]) if now_s >= 4.0 else 1.0)
        return replace(problem, input_max=weak)

    flight = fly(fresh("rti", 1), weakening, states, 0.1, 40.0)
    goal = weakening(flight.states[-1], 40.0).references[0, 0, :3]
    assert np.linalg.norm(flight.states[-1, 0, :3] - goal) < 0.02


def test_distant_chasers_plan_independently() -> None:
    """The plan of a chaser does not depend on which distant chasers join or leave."""
    states = np.array([at_rest(np.array([3.0 * i - 4.0, 2.0, 0.0])) for i in range(3)])
    goals = states[:, :3] + np.array([0.0, 0.3, 0.1])
    single, several = make_solver("rti", PARAMS, 3), make_solver("rti", PARAMS, 3)
    for ids in ([0, 1], [0, 1, 2], [0, 2], [0]):
        one = single.solve(fixed_problem(states[:1], goals[:1]), 0.1, [0])
        many = several.solve(fixed_problem(states[ids], goals[ids]), 0.1, ids)
        np.testing.assert_allclose(many.inputs[0], one.inputs[0], rtol=0, atol=1e-12)


def test_unreachable_reference_saturates_the_input() -> None:
    """A goal 10 km away with reversed attitude: finite plan at the force limit, no failure."""
    states = np.array([at_rest(np.array([-1.0, 0.0, 0.0]))])
    problem = fixed_problem(states, np.array([[-1e4, 0.0, 0.0]]), np.array([0.0, 0, 0, 1.0]))
    plan = fresh("rti", 1).solve(problem, 0.0)
    assert plan.status[0] in ("solved", "infeasible_relaxed", "iteration_limit")
    assert plan.inputs[0, 0, 0] < -0.9 * PARAMS.force_max_N
    assert np.all(np.abs(plan.inputs) <= problem.input_max[:, None, :])
    assert np.isfinite(plan.states).all()
