# SPDX-License-Identifier: Apache-2.0
"""Plans of least propellant for a stack, and the loads on its ports."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.guidance.detumble import planner as planner_module
from chaserdock_controller.guidance.detumble.allocation import minimum_time
from chaserdock_controller.guidance.detumble.planner import ActivePlan, StackPlanner
from chaserdock_controller.guidance.detumble.planning import (
    StackPlan,
    StackProblem,
    fly,
    improve,
    plan_stop,
    predicted,
    sensitivity,
)
from chaserdock_controller.guidance.detumble.port_loads import fire_in_turn, load_model
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.wrench_set import wrench_matrix
from detumble_cases import BODY, PORTS, mounted, stack_of, stack_thrusters, target_alone, tumble
from general_position import BODY as STACK
from general_position import INERTIA, attitude, matrix
from hypothesis import given, settings
from hypothesis import strategies as st

SEEDS = st.integers(0, 2**32 - 1)


def problem(seed: int, chasers: tuple[int, ...], at_once: int | None = None) -> StackProblem:
    body, wrenches, limits = stack_thrusters(chasers)
    q = rotations.normalize(np.random.default_rng(seed).normal(size=4))
    own = tumble(seed, body)
    momentum = np.concatenate([rotations.rotate(q, own[:3]), rotations.rotate(q, own[3:])])
    groups = np.repeat(np.arange(len(chasers)), 12)
    return StackProblem(momentum, q, body.inertia_kg_m2, wrenches, limits, groups, at_once)


@settings(deadline=None, max_examples=5)
@given(SEEDS)
def test_the_sensitivity_is_the_derivative_of_the_flight(seed: int) -> None:
    p = problem(seed, (0, 3))
    rng = np.random.default_rng(seed)
    thrusts = np.where(p.limits_N > 0.0, rng.uniform(0.0, 0.3, (12, 24)), 0.0)
    able = np.flatnonzero(p.limits_N > 0.0)
    jacobian = sensitivity(p, fly(p, thrusts, 0.5), 0.5, able)
    shift = np.zeros_like(thrusts)
    shift[:, able] = rng.normal(size=(12, len(able))) * 1e-4
    ends = [fly(p, thrusts + sign * shift, 0.5).end for sign in (1.0, -1.0)]
    expected = jacobian @ shift[:, able].reshape(-1)
    assert (ends[0] - ends[1]) / 2.0 == pytest.approx(expected, rel=0.02, abs=2e-6)


RATE_HZ, PERIOD_NS = 10, 100_000_000


def first_plan(planner: StackPlanner, p: StackProblem) -> tuple[StackProblem, ActivePlan, int]:
    """Coast until the planner has its first plan; return the problem, the plan, and the time at
    which it begins.
    """
    now_ns = 0
    while True:
        thrusts = planner.thrusts(p, now_ns)
        assert planner.active is not None
        assert thrusts is not None
        if planner.active.begin_ns == now_ns > 0:
            return p, planner.active, now_ns
        assert not thrusts.any()
        p = predicted(p, np.zeros((1, len(p.limits_N))), PERIOD_NS / 1e9)
        now_ns += PERIOD_NS


@pytest.mark.parametrize(("chasers", "seconds"), [((0, 1, 2, 3), 13.0), ((0, 3), 14.0)])
def test_a_plan_stops_the_stack_cheaply_within_the_time(
    chasers: tuple[int, ...], seconds: float
) -> None:
    p, active, begin_ns = first_plan(StackPlanner(seconds, RATE_HZ), problem(3, chasers))
    plan = active.plan
    assert begin_ns < 1.5e9
    assert begin_ns / 1e9 + plan.duration_s == pytest.approx(seconds)
    assert np.all(plan.thrusts_N >= 0.0)
    assert np.all(plan.thrusts_N <= p.limits_N)
    exact = fly(p, np.repeat(plan.thrusts_N, 4, axis=0), plan.step_s / 4.0).end
    assert np.linalg.norm(exact) < 0.02 * np.linalg.norm(p.momentum)
    least = minimum_time(p.wrenches, tumble(3, stack_of(mounted(chasers))), p.limits_N)
    assert least is not None
    assert plan.impulse_N_s < 0.85 * least.impulse_N_s


@pytest.mark.slow
def test_a_first_plan_leaves_a_local_minimum() -> None:
    """From no thrust this tumble's programme ends in a minimum that is 1.6 times as expensive."""
    p = problem(0, (0, 3))
    from_no_thrust = plan_stop(p, np.zeros((28, 24)), 0.5, 60)
    at_begin, active, _ = first_plan(StackPlanner(14.0, RATE_HZ), p)
    assert active.plan.cost_N_s < 0.75 * from_no_thrust.cost_N_s
    assert np.linalg.norm(active.plan.remaining) < 0.02 * np.linalg.norm(at_begin.momentum)


@pytest.mark.slow
def test_a_plan_in_flight_leaves_a_local_minimum() -> None:
    planner = StackPlanner(14.0, RATE_HZ)
    p, active, now_ns = first_plan(planner, problem(0, (0, 3)))
    count = len(active.plan.thrusts_N)
    dear = plan_stop(p, np.zeros((count, 24)), active.plan.step_s, 60)
    planner.active, planner.search = replace(active, plan=dear), None
    spent = 0.0
    for _ in range(50):
        thrusts = planner.thrusts(p, now_ns)
        assert thrusts is not None
        spent += float(thrusts.sum()) * PERIOD_NS / 1e9
        p = predicted(p, thrusts[None, :], PERIOD_NS / 1e9)
        now_ns += PERIOD_NS
    assert planner.active is not None
    assert spent + planner.active.plan.cost_N_s < 0.9 * dear.cost_N_s


@pytest.mark.slow
def test_a_tick_solves_few_programmes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first plan, its renewals, and a plan without a thruster that is lost: no tick takes
    longer than ten programmes.
    """
    solved: list[int] = []

    def counted(p: StackProblem, plan: StackPlan, iterations: int) -> StackPlan:
        solved[-1] += iterations
        return improve(p, plan, iterations)

    monkeypatch.setattr(planner_module, "improve", counted)
    planner, p, now_ns = StackPlanner(8.0, RATE_HZ), problem(2, (0, 1, 3)), 0
    lost = p.limits_N.copy()
    lost[np.flatnonzero(lost)[0]] = 0.0
    while True:
        solved.append(0)
        thrusts = planner.thrusts(replace(p, limits_N=lost) if now_ns > 3e9 else p, now_ns)
        if thrusts is None:
            break
        p = predicted(p, thrusts[None, :], PERIOD_NS / 1e9)
        now_ns += PERIOD_NS
    assert max(solved) <= 10
    assert sum(solved) > 100
    assert planner.active is not None
    assert np.linalg.norm(planner.active.plan.remaining) < 0.02 * np.linalg.norm(
        problem(2, (0, 1, 3)).momentum
    )


def test_a_plan_turns_with_the_world() -> None:
    p = problem(1, (0, 3))
    turn = rotations.normalize(np.array([0.3, -0.5, 0.2, 0.7]))
    moved = StackProblem(
        np.concatenate(
            [rotations.rotate(turn, p.momentum[:3]), rotations.rotate(turn, p.momentum[3:])]
        ),
        rotations.multiply(turn, p.q_wxyz),
        p.inertia_kg_m2,
        p.wrenches,
        p.limits_N,
        p.groups,
    )
    guess = np.zeros((20, 24))
    one, two = (plan_stop(x, guess, 0.5, 3) for x in (p, moved))
    assert two.impulse_N_s == pytest.approx(one.impulse_N_s, rel=0.2)


def test_thrusters_that_must_not_fire_together_share_their_time() -> None:
    p = problem(2, (0, 1, 2, 3), at_once=1)
    plan = plan_stop(p, np.zeros((28, 48)), 0.5, 30)
    shares = (plan.thrusts_N / 1.5).reshape(28, 4, 12).sum(axis=2)
    assert shares.max() <= 1.0 + 1e-9
    assert np.linalg.norm(plan.remaining) < 0.02 * np.linalg.norm(p.momentum)


def test_a_stack_at_rest_needs_no_plan_and_invalid_figures_are_refused() -> None:
    p = problem(1, (0, 3))
    rest = StackProblem(np.zeros(6), p.q_wxyz, p.inertia_kg_m2, p.wrenches, p.limits_N, p.groups)
    assert plan_stop(rest, np.zeros((4, 24)), 0.5, 5).impulse_N_s == 0.0
    with pytest.raises(ValueError, match="step_s"):
        plan_stop(p, np.zeros((4, 24)), 0.0, 5)
    nan = StackProblem(
        np.full(6, math.nan), p.q_wxyz, p.inertia_kg_m2, p.wrenches, p.limits_N, p.groups
    )
    with pytest.raises(ValueError, match="finite"):
        plan_stop(nan, np.zeros((4, 24)), 0.5, 5)


def loads(seed: int, force_limit_N: float = np.inf):
    chasers = mounted((0, 1, 3))
    body, own = stack_of(chasers), wrench_matrix(BODY.thrusters)
    wrenches = np.concatenate(
        [c.wrench_to_stack(own, body.centre_trf_m) for c in chasers.values()], axis=1
    )
    rows = {i: (slice(12 * k, 12 * k + 12), own) for k, i in enumerate(chasers)}
    omega = np.random.default_rng(seed).normal(0.0, 0.1, 3)
    tips = {i: np.array(PORTS[i][0]) for i in chasers}
    limits = dict.fromkeys(chasers, (force_limit_N, np.inf))
    return (
        body,
        omega,
        wrenches,
        load_model(body, omega, wrenches, chasers, rows, BODY, tips, limits),
    )


@pytest.mark.parametrize("seed", range(3))
def test_load_of_a_port_is_what_accelerates_its_chaser_less_its_own_thrust(seed: int) -> None:
    """Newton and Euler for a chaser in any attitude, with three different moments of inertia."""
    rng = np.random.default_rng(seed)
    chaser: Any = SimpleNamespace(mass_kg=17.8, inertia=INERTIA)
    place, q, tip = rng.uniform(0.5, 1.0, 3), attitude(rng), rng.uniform(0.2, 0.5, 3)
    omega, thrusts = rng.uniform(-0.3, 0.3, 3), rng.uniform(0.0, 1.5, 4)
    wrenches, unit = rng.normal(size=(6, 4)), rng.normal(size=(6, 2))
    stack = STACK
    own = {0: (slice(1, 3), unit)}
    mount = {0: MountedChaser(place, q)}
    model = load_model(stack, omega, wrenches, mount, own, chaser, {0: tip}, {})
    total, r = wrenches @ thrusts, matrix(q)
    spinning = np.cross(omega, stack.inertia_kg_m2 @ omega)
    alpha = np.linalg.solve(stack.inertia_kg_m2, total[3:] - spinning)
    arm = place - stack.centre_trf_m
    acceleration = (
        total[:3] / stack.mass_kg + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    )
    inertia, pushed = r @ np.diag(INERTIA) @ r.T, unit @ thrusts[1:3]
    force = r @ pushed[:3] - chaser.mass_kg * acceleration
    turned = inertia @ alpha + np.cross(omega, inertia @ omega)
    torque = r @ pushed[3:] - turned + np.cross(place - tip, force)
    found = (model.constant + model.by_thrust @ thrusts)[0]
    np.testing.assert_allclose(found, np.concatenate([force, torque]), atol=1e-12)


@settings(deadline=None, max_examples=10)
@given(SEEDS)
def test_the_loads_of_all_ports_move_the_target(seed: int) -> None:
    """Newton and Euler for the target alone, on which only the ports act."""
    body, omega, wrenches, model = loads(seed)
    thrusts = np.random.default_rng(seed).uniform(0.0, 1.5, 36)
    port = model.constant + model.by_thrust @ thrusts
    total = wrenches @ thrusts
    alpha = np.linalg.solve(
        body.inertia_kg_m2, total[3:] - np.cross(omega, body.inertia_kg_m2 @ omega)
    )
    alone = target_alone()
    arm = alone.centre_trf_m - body.centre_trf_m
    acceleration = (
        total[:3] / body.mass_kg + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    )
    assert port[:, :3].sum(axis=0) == pytest.approx(alone.mass_kg * acceleration, abs=1e-9)
    torque = port[:, 3:].sum(axis=0)
    for row, i in zip(port, (0, 1, 3), strict=True):
        torque = torque + np.cross(np.array(PORTS[i][0]) - alone.centre_trf_m, row[:3])
    needed = alone.inertia_kg_m2 @ alpha + np.cross(omega, alone.inertia_kg_m2 @ omega)
    assert torque == pytest.approx(needed, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_no_part_of_the_thrusters_that_fire_in_turn_exceeds_the_limit(seed: int) -> None:
    """The most wanted fires first. Pulses end one after the other, so that any of the chosen
    thrusters may be open alone.
    """
    _, _, _, model = loads(1, force_limit_N=2.2)

    def largest_N(mask: Array) -> float:
        return float(
            np.linalg.norm((model.constant + 1.5 * model.by_thrust @ mask)[:, :3], axis=1).max()
        )

    wanted = np.random.default_rng(seed).uniform(0.1, 1.0, 36)
    chosen = fire_in_turn(model, wanted, np.full(36, 1.5))
    assert chosen[np.argmax(wanted)]
    rows = np.flatnonzero(chosen)
    assert 3 <= len(rows) < 16
    for part in range(2 ** len(rows)):
        mask = np.zeros(36)
        mask[rows[[k for k in range(len(rows)) if part >> k & 1]]] = 1.0
        assert largest_N(mask) <= 0.92 * 2.2
    towards = np.tile([t.direction[0] > 0.0 for t in BODY.thrusters], 3)
    assert largest_N(towards.astype(float)) > 2.2
