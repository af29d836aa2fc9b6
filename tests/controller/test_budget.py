# SPDX-License-Identifier: Apache-2.0
"""A solve's budget: seconds in real time, iterations anywhere, and the word for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import TickOutputs
from chaserdock_controller.nmpc import NmpcInput, NmpcPlan, make_solver
from chaserdock_controller.nmpc import stage as planning
from chaserdock_controller.nmpc.budget import SolveBudget
from chaserdock_protocol.plugins import PluginError
from chaserdock_protocol.scenario import Scenario, ScenarioError
from flight_cases import odometry, scenario, tick_inputs
from nmpc_cases import PARAMS, far_start, swap

from chaserdock.experiments.perfect_knowledge import PerfectEstimator

SLOW_S = 0.01


def test_as_many_iterations_as_fit_by_what_they_took() -> None:
    budget = SolveBudget(0.010, most=40)
    assert budget.iterations() == 40
    budget.note(0.001, 0)
    budget.note(0.019, 20)
    assert budget.iterations() == 10  # 1 ms, and 0.9 ms an iteration
    budget.note(0.050, 7)
    assert budget.iterations() == 1
    budget.note(0.020, 0)
    assert budget.iterations() == 0


def test_solver_recovers_from_a_disturbed_solve() -> None:
    budget = SolveBudget(0.010)
    budget.note(1.0, 1)
    counts = []
    for _ in range(200):
        counts.append(budget.iterations())
        budget.note(0.0005 * 10, 10)
    assert counts[0] == 0
    assert counts == sorted(counts)
    assert counts[-1] >= 15


@pytest.mark.parametrize("budget_s", [0.0, -1.0, float("nan")])
def test_a_budget_of_nothing_is_refused(budget_s: float) -> None:
    with pytest.raises(ValueError, match="budget_s must be positive"):
        SolveBudget(budget_s)


def test_solve_out_of_iterations_reports_budget_and_keeps_input_limits() -> None:
    problem_at, states = swap(0.2, 0.4)
    problem = problem_at(states, 0.0)
    chosen = make_solver("rti", PARAMS, 2)
    whole = chosen.solve(problem, 0.0)
    assert whole.iterations.sum() > 4
    assert "budget" not in whole.status
    chosen.reset()
    chosen.max_iterations = 4  # type: ignore[attr-defined]
    short = chosen.solve(problem, 0.0)
    assert "budget" in short.status
    assert short.iterations.sum() <= 4
    assert np.all(np.abs(short.inputs) <= problem.input_max[:, None, :])
    np.testing.assert_array_equal(
        short.inputs, make_solver("rti", PARAMS, 2, 4).solve(problem, 0.0).inputs
    )


def test_problem_without_active_constraints_needs_no_iteration() -> None:
    problem_at, states = far_start(1)
    states[:, :3] = problem_at(states, 0.0).references[:, 0, :3]
    states[:, 6:10] = problem_at(states, 0.0).references[:, 0, 3:]
    assert make_solver("rti", PARAMS, 1, 0).solve(problem_at(states, 0.0), 0.0).status == (
        "solved",
    )


@dataclass
class Slow:
    """A solver, and a clock by which each of its iterations takes SLOW_S."""

    inner: Any
    max_iterations: int | None = None
    time_s: float = 0.0

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan:
        self.inner.max_iterations = self.max_iterations
        plan = self.inner.solve(problem, shift_s, ids)
        self.time_s += SLOW_S * int(plan.iterations.sum())
        return plan


def far(mission: Scenario, flight: ControllerCore, tick: int) -> TickOutputs:
    """Both chasers metres from where they are to be, at rest: their thrust is at its limit."""
    now_ns = mission.timing.tick_time_ns(tick)
    still = {"velocity_m_s": (0.0,) * 3, "omega_rad_s": (0.0,) * 3, "q_wxyz": (1.0, 0.0, 0.0, 0.0)}
    here = {i: odometry(i, tick, now_ns, position_m=(-3.0, 2.0 * i, 0.5), **still) for i in (0, 1)}
    return flight.step(tick_inputs(tick, now_ns, here, ()))


@pytest.mark.parametrize("realtime", [True, False])
def test_in_real_time_a_slow_solver_is_held_to_its_seconds_and_in_lock_step_never(
    realtime: bool,
) -> None:
    mission = scenario(controller={"solve_budget_s": 3 * SLOW_S})
    slow = Slow(None)
    flight = ControllerCore(
        mission, lambda: slow.time_s, PerfectEstimator(mission.target), realtime
    )
    slow.inner = flight.planning.solver
    flight.planning.solver = slow  # type: ignore[assignment]
    reports = [far(mission, flight, tick).solver for tick in range(4)]
    used = [sum(s.iterations) for s in reports if s is not None]
    assert used[0] > 3
    if realtime:
        assert all(n <= 3 for n in used[1:])
        assert all("budget" in s.status for s in reports[1:] if s is not None)
        assert all(s.wall_solve_s <= 3 * SLOW_S + 1e-9 for s in reports[1:] if s is not None)
    else:
        assert all(n > 3 for n in used)
        assert slow.max_iterations is None


def test_seconds_go_with_a_solver_that_can_be_held_to_them(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        ScenarioError, match=r"controller: solve_budget_s goes with the solver rti; ipopt"
    ):
        scenario(controller={"solver": "ipopt", "solve_budget_s": 0.01})
    monkeypatch.setattr(planning, "make_solver", lambda *_: object())
    mission = scenario(controller={"solve_budget_s": 0.01})
    with pytest.raises(PluginError, match="has no max_iterations to set"):
        ControllerCore(mission, lambda: 0.0, realtime=True)
    ControllerCore(mission, lambda: 0.0)
