# SPDX-License-Identifier: Apache-2.0
"""Monitor of passive safety in the controller: what it logs, and which scenarios it accepts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from chaserdock_controller.interfaces import ChaserEstimate, TargetEstimation
from chaserdock_controller.nmpc import kernels, rti
from chaserdock_controller.nmpc.passive_safety import PassiveSafetyMonitor
from chaserdock_controller.nmpc.problem import check_input, model_of
from chaserdock_controller.nmpc.rti import RtiSolver
from chaserdock_controller.nmpc.terms import coast as coast_term
from chaserdock_controller.nmpc.types import CoastSafety, NmpcPlan
from chaserdock_models.passive_safety import CoastModel, CoastNoise, DisturbedMotion, disturbed
from chaserdock_protocol.scenario import (
    FlightScenario,
    ScenarioError,
    flight_scenario,
    parse_scenario,
)
from general_position import attitude
from msgspec import structs
from nmpc_cases import PARAMS, at_rest, fixed_problem, fresh, with_settings
from nmpc_kernels import build_rows


def mission(limits: dict[str, Any], **changes: Any) -> FlightScenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 10.0,
        "target": {"velocity_m_s": [0.0, 0.0, 0.0]},
        "limits": {"passive_safety_force_N": 1e-6} | limits,
        "chasers": [{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return flight_scenario(parse_scenario(values | changes, "x"))


def estimation(latched: bool = False) -> TargetEstimation:
    target = SimpleNamespace(
        position_m=np.array([1.0, 0.0, 0.0]), velocity_m_s=np.array([0.1, 0.0, 0.0])
    )
    motion = disturbed(np.diag([1e-6] * 3 + [1e-10] * 3))
    chaser = ChaserEstimate(0, disturbed=motion, latched=latched)
    values = SimpleNamespace(at_effect=target, chasers=(chaser,))
    return cast(TargetEstimation, values)


def plan(closing_m_s: float) -> np.ndarray:
    """Three states of a chaser 5 m behind the target of ``estimation``, which it follows and closes
    in on.
    """
    states = np.zeros((1, 3, 13))
    speed = 0.1 + closing_m_s
    states[0, :, 0] = -4.0 + speed * 0.1 * np.arange(3)
    states[0, :, 3] = speed
    return states


def test_changes_are_logged_once_with_margin_and_time() -> None:
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "monitor"}))
    assert monitor.duration_s == 600.0
    first = monitor.update((0,), plan(0.0), estimation())
    assert [level for level, _ in first] == ["info"]
    assert "chaser 0: passively safe: without thrust it comes to 5.00 m" in first[0][1]
    assert monitor.update((0,), plan(0.0), estimation()) == ()
    assert (
        monitor.update((0,), plan(0.05), estimation(), 100_000_000) == ()
    )  # not yet: it may be noise
    ((level, text),) = monitor.update((0,), plan(0.05), estimation(), 1_100_000_000)
    assert level == "warning"
    assert "not passively safe" in text
    assert "0.00 m of the target after 100 s" in text
    assert monitor.update((0,), plan(0.05), estimation(latched=True)) == ()
    assert monitor.chasers[0].certificate is None


def test_coast_lasts_two_orbits_or_as_long_as_stated() -> None:
    orbit = {"orbit": {"altitude_m": 4e5}}
    assert PassiveSafetyMonitor(mission({}, **orbit)).duration_s == pytest.approx(
        2 * 5553.6, rel=1e-3
    )
    assert PassiveSafetyMonitor(mission({"passive_safety_s": 50.0}, **orbit)).duration_s == 50.0


def test_monitor_needs_the_joint_estimator() -> None:
    with pytest.raises(
        ScenarioError, match=r"limits.passive_safety: needs the covariance of estimator.name"
    ):
        mission({"passive_safety": "monitor"}, estimator={"name": "paper"})


def test_chaser_that_was_safe_for_a_while_aborts_when_it_is_not_for_a_second() -> None:
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "enforce"}))
    second = 1_000_000_000
    for k in range(3):  # not yet converged
        monitor.update((0,), plan(0.05), estimation(), k * second)
        assert monitor.unsafe(0, k * second) == ""
    for k in range(3, 14):
        monitor.update((0,), plan(0.0), estimation(), k * second)
    monitor.update((0,), plan(0.05), estimation(), 14 * second)
    assert monitor.unsafe(0, 14 * second) == ""
    monitor.update((0,), plan(0.05), estimation(), 15 * second)
    assert "not passively safe" in monitor.unsafe(0, 15 * second)
    monitor.update((0,), plan(0.0), estimation(), 16 * second)
    assert monitor.unsafe(0, 16 * second) == ""


def test_chaser_that_never_was_safe_has_to_abort_after_a_minute() -> None:
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "enforce"}))
    for time_s in (0, 30, 59, 61):
        monitor.update((0,), plan(0.05), estimation(), time_s * 1_000_000_000)
        assert bool(monitor.unsafe(0, time_s * 1_000_000_000)) == (time_s > 60)


SIGMAS = 3.0
ORBIT_RAD_S, TWO_ORBITS_S = 1.13e-3, 11120.0
WITH_COASTS = with_settings(PARAMS, max_reference_distance_m=300.0)


def fly(
    coast: CoastModel,
    start: np.ndarray,
    goal: np.ndarray,
    motion: DisturbedMotion,
    ticks: int,
    enforced: bool,
) -> tuple[np.ndarray, list[float]]:
    """Return the last position (3,) of a chaser that is sent to ``goal``, and the margin of its
    plan at each tick.
    """
    solver, state, margins = fresh("rti", 1, WITH_COASTS), at_rest(start), []
    safety = CoastSafety(coast, 0.75, SIGMAS, np.zeros(3), {0: motion})
    for tick in range(ticks):
        problem = replace(
            fixed_problem(state[None], goal[None], d_target=0.0),
            coast_safety=safety if enforced else None,
        )
        found = solver.solve(problem, PARAMS.dt_s if tick else 0.0)
        margins.append(coast.certify(found.states[0, :, :6], motion, 0.75).margin_sigmas)
        state = found.states[0, 1]
    return state[:3], margins


def test_plan_to_a_place_on_v_bar_is_bent_so_that_its_coasts_stay_outside() -> None:
    """The transient at the end of the move leaves a drift towards the target; the enforced plan
    leaves none.
    """
    coast, goal = CoastModel(ORBIT_RAD_S, TWO_ORBITS_S), np.array([0.0, -119.0, 0.0])
    motion = disturbed(np.diag([4e-3] * 3 + [1e-7] * 3))
    start = np.array([0.0, -120.0, 0.0])
    end, free = fly(coast, start, goal, motion, 140, enforced=False)
    bent_end, bent = fly(coast, start, goal, motion, 140, enforced=True)
    assert min(free) < 0.0
    assert min(bent) > SIGMAS
    np.testing.assert_allclose(end, goal, atol=0.15)
    np.testing.assert_allclose(bent_end, goal, atol=0.15)


def test_plan_that_heads_for_the_target_in_free_space_is_bent_aside_or_slowed() -> None:
    coast = CoastModel(0.0, 600.0)
    motion = disturbed(np.diag([1e-6] * 3 + [1e-8] * 3))
    start, goal = np.array([-5.0, 0.02, 0.0]), np.array([-2.0, 0.0, 0.0])
    _, free = fly(coast, start, goal, motion, 60, enforced=False)
    _, bent = fly(coast, start, goal, motion, 60, enforced=True)
    assert max(free[1:]) < 0.0
    assert min(bent[10:]) > SIGMAS


def test_only_plans_that_are_not_safe_without_them_have_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A safe plan is that of the unrestricted problem to the last bit, and its certificate need not
    be computed again.
    """
    coast, motion = CoastModel(0.0, 600.0), disturbed(np.diag([1e-6] * 3 + [1e-8] * 3))
    rows, restricted = coast_term.coast_rows, []

    def counted(safety: CoastSafety, *rest: Any) -> np.ndarray:
        restricted.append(sorted(safety.motions))
        return rows(safety, *rest)

    monkeypatch.setattr(rti, "coast_rows", counted)
    safety = CoastSafety(coast, 0.75, SIGMAS, np.zeros(3), {0: motion, 1: motion})
    starts, aside = (
        np.array([[-5.0, 0.0, 0.0], [0.0, 9.0, 0.0]]),
        np.array([[-5.0, 0.5, 0.0], [0.0, 9.5, 0.0]]),
    )
    states = np.array([at_rest(start) for start in starts])

    def solved(goals: np.ndarray, kept: CoastSafety | None) -> NmpcPlan:
        problem = replace(fixed_problem(states, goals, d_target=0.0), coast_safety=kept)
        return fresh("rti", 2, WITH_COASTS).solve(problem, 0.0)

    safe, free = solved(aside, safety), solved(aside, None)
    assert restricted == []
    np.testing.assert_array_equal(safe.inputs, free.inputs)
    assert safe.coasts[1] == coast.certify(safe.states[1, :, :6], motion, 0.75)
    towards = np.array([[-2.0, 0.0, 0.0], [0.0, 9.5, 0.0]])
    bent, free = solved(towards, safety), solved(towards, None)
    assert restricted == [[0]]
    unbent = coast.certify(free.states[0, :, :6], motion, 0.75)
    assert bent.coasts[0].margin_sigmas > unbent.margin_sigmas + SIGMAS
    np.testing.assert_array_equal(bent.inputs[1], free.inputs[1])


def test_planes_agree_with_the_certificate_at_the_closest_approach() -> None:
    """The distance of a state from a plane, over the deviation that the plane keeps, is the
    certified margin.
    """
    rng = np.random.default_rng(3)
    coast = CoastModel(
        ORBIT_RAD_S, TWO_ORBITS_S, noise=CoastNoise(1e-6, varying_m_s2=4e-8, varying_s=200.0)
    )
    whole = rng.normal(size=(9, 9)) * np.repeat([0.05, 5e-5, 3e-8], 3)[:, None]
    motion = DisturbedMotion(rng.normal(0.0, 1e-7, 3), whole @ whole.T)
    states = np.concatenate(
        [rng.normal(0.0, 60.0, (40, 3)), rng.normal(0.0, 0.05, (40, 3))], axis=1
    )
    planes, wider = (
        coast.tangent_planes(states, motion, 0.75, k, coast_term.COASTS) for k in (0.0, 1.0)
    )
    used = np.abs(planes[..., :6]).max(axis=2) > 0.0
    assert used[:, 0].all()
    room = np.einsum("mcj,mj->mc", planes[..., :6], states) - planes[..., 6]
    margins = np.where(
        used, room / np.where(used, wider[..., 6] - planes[..., 6], 1.0), np.inf
    ).min(axis=1)
    np.testing.assert_allclose(
        margins, coast.closest(states, motion, 0.75).margin_sigmas, rtol=1e-3
    )


def test_chasers_are_restricted_where_safety_is_enforced_once_they_count() -> None:
    two = [{"position_m": [-5.0, y, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]} for y in (0.0, 2.0)]
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "enforce"}, chasers=two))
    assert monitor.restriction((0,), {0}, estimation()) is None
    for k in range(12):
        monitor.update((0,), plan(0.0), estimation(), k * 1_000_000_000)
    both = estimation()
    both = cast(
        Any, SimpleNamespace(at_effect=both.at_effect, chasers=(*both.chasers, ChaserEstimate(1)))
    )
    found = monitor.restriction((1, 0), {0}, both)
    assert found is not None
    assert set(found.motions) == {1}
    np.testing.assert_array_equal(found.target_velocity_m_s, [0.1, 0.0, 0.0])
    assert monitor.restriction((0,), set(), estimation()) is None


def test_enforcing_needs_the_solver_that_keeps_it() -> None:
    with pytest.raises(ScenarioError, match=r"limits\.passive_safety: .*needs controller\.solver"):
        mission({"passive_safety": "enforce"}, controller={"solver": "ipopt"})


@pytest.mark.parametrize("seed", range(3))
def test_no_coast_row_that_a_full_reversal_of_thrust_can_reach_is_dropped(seed: int) -> None:
    """The rollout flies at full thrust, in a turned attitude; the reversed one breaks the rows of
    its velocity by a little.
    """
    rng, force_N = np.random.default_rng(seed), PARAMS.force_max_N
    q = attitude(rng)
    start = at_rest(rng.uniform(4.0, 6.0, 3), q)
    problem = fixed_problem(start[None], start[None, :3], q, d_target=0.0)
    problem = check_input(problem, PARAMS, 1)
    inputs = np.zeros((PARAMS.stages, 6))
    inputs[:, :3] = force_N * rng.choice([-1.0, 1.0], 3)
    x, reversed_x = (np.tile(start, (1, PARAMS.stages + 1, 1)) for _ in range(2))
    for rollout, u in ((x, inputs), (reversed_x, -inputs)):
        kernels.roll(model_of(PARAMS, PARAMS.dt_s), rollout, u[None])
    reach_m = force_N * RtiSolver(PARAMS, 1)._reach
    coasts = np.zeros((1, PARAMS.stages + 1, 1, 7))
    change = x[0, 1:, 3:6] - reversed_x[0, 1:, 3:6]
    coasts[0, 1:, 0, 3:6] = change / np.linalg.norm(change, axis=1)[:, None]
    kept = np.einsum("kj,kj->k", coasts[0, 1:, 0, 3:6], reversed_x[0, 1:, 3:6])
    coasts[0, 1:, 0, 6] = kept + 0.01 * np.linalg.norm(change, axis=1)
    problem = replace(problem, coasts=coasts)
    rows = build_rows(problem, PARAMS, x, reach_m[None])
    of_velocity = np.abs(rows.a[0, : rows.n_rows[0], 3:]).sum(axis=1) > 0.0
    stages = rows.stage[0, : rows.n_rows[0]][of_velocity]
    np.testing.assert_array_equal(stages, np.arange(1, PARAMS.stages + 1))


def pushed(force_N: float, sigma_N: float, mass_kg: float = 30.0) -> TargetEstimation:
    """As ``estimation``, with a force along X: towards the target, 5 m ahead, where positive."""
    found = estimation()
    (chaser,) = found.chasers
    assert chaser.disturbed is not None
    motion = DisturbedMotion(
        np.array([force_N / mass_kg, 0.0, 0.0]),
        disturbed(chaser.disturbed.covariance[:6, :6], sigma_N / mass_kg).covariance,
    )
    values = SimpleNamespace(
        at_effect=found.at_effect, chasers=(structs.replace(chaser, disturbed=motion),)
    )
    return cast(TargetEstimation, values)


def test_chaser_at_rest_is_unsafe_once_the_filter_sees_a_force_towards_the_target() -> None:
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "enforce"}))
    for known, safe in (
        (pushed(0.0, 0.0), True),
        (pushed(3e-3, 1e-4), False),
        (pushed(-3e-3, 1e-4), True),  # away from it
        (pushed(0.0, 2e-3), False),  # of unknown direction
    ):
        monitor.update((0,), plan(0.0), known)
        certificate = monitor.chasers[0].certificate
        assert certificate is not None
        assert certificate.safe is safe


def test_force_that_may_begin_in_a_coast_counts_as_the_filter_assumes() -> None:
    """Without a stated force, 10 mN per axis: no certificate over 600 s near the target."""
    stated, default = (
        PassiveSafetyMonitor(mission({"passive_safety": "monitor"} | limits))
        for limits in ({}, {"passive_safety_force_N": None})
    )
    for monitor, safe in ((stated, True), (default, False)):
        monitor.update((0,), plan(0.0), pushed(0.0, 0.0))
        certificate = monitor.chasers[0].certificate
        assert certificate is not None
        assert certificate.safe is safe


def test_plan_of_a_chaser_that_is_pushed_to_the_target_is_bent_aside() -> None:
    """Its coasts under the known force keep the margin; without the rows they enter."""
    coast, goal = CoastModel(0.0, 300.0), np.array([-5.0, 0.1, 0.0])
    covariance = disturbed(np.diag([1e-6] * 3 + [1e-8] * 3), 1e-7).covariance
    motion = DisturbedMotion(np.array([1.5e-4, 1e-6, 0.0]), covariance)
    _, free = fly(coast, goal, goal, motion, 60, enforced=False)
    _, bent = fly(coast, goal, goal, motion, 60, enforced=True)
    assert max(free[1:]) < 0.0
    assert min(bent[10:]) > SIGMAS
