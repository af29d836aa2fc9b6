# SPDX-License-Identifier: Apache-2.0
"""The NMPC's own quadratic programme, held against dense linear algebra, and what it refuses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.nmpc import NmpcInput, kernels, make_solver
from chaserdock_controller.nmpc.kernels import plan_cost
from chaserdock_controller.nmpc.problem import check_input, model_of, native_problem
from chaserdock_controller.nmpc.slack import SLACK_L1, SLACK_L2
from chaserdock_controller.nmpc.types import IntArray
from chaserdock_models import rotations
from chaserdock_protocol.plugins import PluginError
from nmpc_cases import (
    PARAMS,
    Array,
    at_rest,
    far_start,
    fixed_problem,
    fresh,
    solver,
    tumbling,
    with_settings,
)
from nmpc_kernels import (
    CONVERGED,
    FREE,
    MU_STOP,
    QpAnswer,
    build_rows,
    quadratic_model,
    roll_linearized,
    solve_qp,
)

Model = tuple[Array, ...]  # as `quadratic_model` returns it
MODEL = model_of(PARAMS)


@dataclass
class Qp:
    mats: Array
    model: Model
    stage: IntArray
    a: Array
    c: Array

    def solved(self) -> QpAnswer:
        return solve_qp(self.mats, 0.1, self.model, self.stage, self.a, self.c, SLACK_L1, SLACK_L2)


def qp_data(problem: NmpcInput, u: Array) -> list[Qp]:
    """The QP of each chaser, linearized about u (N, D, 6)."""
    n, d = len(problem.states), PARAMS.stages
    problem = check_input(problem, PARAMS, n)
    x, mats = np.empty((n, d + 1, 13)), np.empty((n, d, 12, 12))
    x[:, 0] = problem.states
    roll_linearized(MODEL, x, u, problem.input_max, mats)
    rows = build_rows(problem, PARAMS, x, np.full((n, d + 1), 10.0))
    out = []
    for i in range(n):
        model = quadratic_model(problem, PARAMS, i, x[i], u[i])
        m = rows.n_rows[i]
        out.append(Qp(mats[i], model, rows.stage[i, :m], rows.a[i, :m], rows.c[i, :m]))
    return out


def condensed(qp: Qp) -> tuple[Array, Array, Array]:
    """Dense gradient, Hessian (6 D) and the maps (D+1, 12, 6 D) from inputs to states, by brute
    force.
    """
    mats, (blocks, qx, r_diag, r, _) = qp.mats, qp.model
    d = len(mats)
    maps = np.zeros((d + 1, 12, 6 * d))
    for k in range(d):
        a = np.zeros((12, 12))
        a[:6, :6] = np.eye(6)
        a[:3, 3:6] = 0.1 * np.eye(3)
        a[:, 6:] = mats[k][:, :6]
        maps[k + 1] = a @ maps[k]
        maps[k + 1][:, 6 * k : 6 * k + 6] += mats[k][:, 6:]
    hessian, gradient = np.diag(r_diag.ravel()), r.ravel().copy()
    for k in range(d + 1):
        q = np.zeros((12, 12))
        q[:6, :6], q[6:, 6:] = blocks[k]
        hessian += maps[k].T @ q @ maps[k]
        gradient += maps[k].T @ qx[k]
    return gradient, hessian, maps


def random_inputs(seed: int, n: int, share: float) -> Array:
    rng = np.random.default_rng(seed)
    return share * PARAMS.input_limits() * rng.uniform(-1, 1, size=(n, PARAMS.stages, 6))


@pytest.mark.parametrize("seed", range(3))
def test_riccati_minimizes_the_quadratic_model(seed: int) -> None:
    problem_at, states = tumbling(1)
    states[:, :3] += 0.01
    (qp,) = qp_data(problem_at(states, 0.0), random_inputs(seed, 1, 0.3))
    answer = qp.solved()
    assert answer.code == FREE
    assert not answer.multipliers.any()
    gradient, hessian, maps = condensed(qp)
    expected = -np.linalg.solve(hessian, gradient)
    np.testing.assert_allclose(
        answer.dw.ravel(), expected, rtol=0, atol=1e-8 * np.max(np.abs(expected))
    )
    np.testing.assert_allclose(answer.dx, maps @ answer.dw.ravel(), rtol=0, atol=1e-8)


def test_quadratic_model_is_the_costs_first_order() -> None:
    """Its gradient equals finite differences of the nonlinear cost along the nonlinear dynamics."""
    problem_at, states = tumbling(1)
    states[0, 6:10] = rotations.multiply(states[0, 6:10], rotations.exp([0.8, -0.5, 0.4]))
    problem, u = problem_at(states, 0.0), random_inputs(3, 1, 0.5)
    gradient, _, _ = condensed(qp_data(problem, u)[0])
    checked = check_input(problem, PARAMS, 1)

    def cost(inputs: Array) -> float:
        x = np.empty((1, 31, 13))
        x[:, 0] = states
        kernels.roll(MODEL, x, inputs)
        return float(plan_cost(native_problem(checked, PARAMS), x, inputs)[0])

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
    problem = fixed_problem(
        states, np.array([[0.8, 0.5, 0], [-0.8, 0.5, 0.0]]), rotations.exp([0, 0, 0.7])
    )
    active = 0
    for qp in qp_data(problem, random_inputs(seed, 2, 0.3)):
        answer, n_rows = qp.solved(), len(qp.stage)
        assert answer.code == CONVERGED
        assert 0 < answer.iterations < 30
        gradient, hessian, maps = condensed(qp)
        dw = answer.dw.ravel()
        w = qp.model[-1].ravel() + dw
        assert np.all(np.abs(w) < 1.0)
        lam, _, low, high = np.split(answer.multipliers, np.cumsum([n_rows, n_rows, len(w)]))
        stationarity = gradient + hessian @ dw - low + high
        for j in range(n_rows):
            normal = maps[qp.stage[j]][:6].T @ qp.a[j]
            stationarity -= lam[j] * normal
            gap = normal @ dw - qp.c[j]
            slack = max(-gap, 0.0)
            # A row far from the plan takes no part: then it is met, without a multiplier.
            assert lam[j] > 0.0 or gap > 0.0
            assert 0.0 <= lam[j] < SLACK_L1 + SLACK_L2 * slack + 1.0
            assert lam[j] * (gap + slack) < 60 * MU_STOP * 30
            active += lam[j] > 1.0
        assert np.max(np.abs(stationarity)) < 1e-6 * np.max(np.abs(gradient))
        assert np.all(low > 0.0)
        assert np.all(high > 0.0)
        assert answer.complementarity <= MU_STOP
        assert np.max(low * (1 + w)) < 400 * MU_STOP
    assert active > 0


def test_free_solution_needs_no_interior_point() -> None:
    problem_at, states = tumbling(4)
    plan = fresh("rti", 4).solve(problem_at(states, 0.0), 0.0)
    assert plan.status == ("solved",) * 4
    assert not plan.iterations.any()


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
        (
            {"inertia_kg_m2": ((1.0, 2.0, 0.0), (2.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
            "positive definite",
        ),
        ({"inertia_kg_m2": ((1.0, 0.1, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "symmetric"),
    ],
)
def test_parameters_are_checked(change: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        with_settings(PARAMS, **change)


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
    with pytest.raises(PluginError, match="rti, ipopt"):
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
