# SPDX-License-Identifier: Apache-2.0
"""What the controller flies when the solver fails, or finds only degraded plans, next to a drifting
target.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.nmpc.plan_monitor import DEGRADED_S, FAILED_S
from chaserdock_controller.nmpc.types import NmpcInput, NmpcPlan, NmpcSolver
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import Scenario, parse_scenario

from chaserdock.experiments.in_process import InProcessMission, TickRecord

DRIFT_M_S = (-0.034, 0.0, 0.0)
"""Towards chaser 0."""
FAILS_AT_S = 6.0
Disturbed = Callable[[NmpcPlan], NmpcPlan]


class FailingSolver:
    """A solver whose plans pass through ``change`` while ``active``."""

    def __init__(self, inner: NmpcSolver, change: Disturbed) -> None:
        self.inner, self.change, self.active = inner, change, False

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan:
        plan = self.inner.solve(problem, shift_s, ids)
        return self.change(plan) if self.active else plan

    def reset(self) -> None:
        self.inner.reset()


def breaks(plan: NmpcPlan) -> NmpcPlan:
    raise RuntimeError("singular")


def lacks_a_key(plan: NmpcPlan) -> NmpcPlan:
    raise KeyError("x")


def input_not_finite(plan: NmpcPlan) -> NmpcPlan:
    inputs = plan.inputs.copy()
    inputs[0, 0, 0] = np.nan
    return replace(plan, inputs=inputs)


def state_not_finite(plan: NmpcPlan) -> NmpcPlan:
    states = plan.states.copy()
    states[0, -1, 0] = np.inf
    return replace(plan, states=states)


def of_one_chaser(plan: NmpcPlan) -> NmpcPlan:
    return replace(plan, status=plan.status[:1])


def with_status(status: str, rows: tuple[int, ...] = (0, 1)) -> Disturbed:
    """Change the status of these rows; the inputs of a failed row are worthless."""

    def change(plan: NmpcPlan) -> NmpcPlan:
        statuses, inputs = list(plan.status), plan.inputs.copy()
        for row in rows:
            statuses[row] = status
            if status == "failed":
                inputs[row] = 9.0
        return replace(plan, status=tuple(statuses), inputs=inputs)

    return change


def mission(overrides: Sequence[str] = ()) -> Scenario:
    turned = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    return parse_scenario(
        {
            "name": "test",
            "duration_s": 34.0,
            "settling_s": 1.0,
            "navigation": {"grade": "exact"},
            "target": {"model": "servicer", "motion": "constant_rates", "velocity_m_s": DRIFT_M_S},
            "approach": {"dock_distance_m": 0.4, "max_speed_m_s": 0.06},
            "chasers": [
                {"position_m": [-0.8, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
                {"position_m": [0.0, -1.2, 0.0], "q_wxyz": turned},
            ],
            "timeline": [{"at_s": 0.0, "command": "approach", "chasers": [0]}],
        },
        "test",
        overrides,
    )


@pytest.fixture
def flight():
    with InProcessMission(mission()) as made:
        yield made


def install(flight: InProcessMission, change: Disturbed) -> FailingSolver:
    solver = FailingSolver(flight.controller.planning.solver, change)
    flight.controller.planning.solver = solver  # type: ignore[assignment]
    return solver


def fly_until(flight: InProcessMission, time_s: float) -> list[TickRecord]:
    records = []
    while flight.time_s < time_s:
        records.append(flight.step())
    return records


def distances_m(records: list[TickRecord], chaser: int = 0) -> np.ndarray:
    return np.array(
        [
            np.linalg.norm(r.states[f"chaser/{chaser}"].position_m - r.states["target"].position_m)
            for r in records
        ]
    )


def modes(record: TickRecord) -> tuple[str, ...]:
    assert record.outputs is not None
    return tuple(record.outputs.wrenches[i].mode for i in (0, 1))


def replies_to(flight: InProcessMission, *commands: OperatorCommand) -> list[tuple[bool, str]]:
    record = flight.step(commands)
    assert record.outputs is not None
    return [(r.accepted, r.reason) for r in record.outputs.replies]


def warnings(flight: InProcessMission) -> list[str]:
    return [text for _, level, text in flight.events if level != "info"]


@pytest.mark.parametrize(
    "change",
    [breaks, lacks_a_key, with_status("failed"), input_not_finite, state_not_finite, of_one_chaser],
)
def test_a_failed_solve_flies_the_shifted_plan(flight: InProcessMission, change: Disturbed) -> None:
    solver = install(flight, change)
    before = fly_until(flight, FAILS_AT_S)[-1]
    solver.active = True
    after = flight.step()
    assert before.outputs is not None
    assert after.outputs is not None
    plan, wrench = before.outputs.plans[0], after.outputs.wrenches[0]
    stage = int((wrench.effective_time_ns - plan.sim_time_ns) / 1e9 / plan.step_s + 1e-9)
    expected = np.reshape(plan.inputs, (-1, 6))[stage]
    np.testing.assert_allclose([*wrench.force_N, *wrench.torque_N_m], expected, atol=1e-5)
    assert modes(after) == ("nmpc", "nmpc")
    assert (after.outputs.plans[0].tick, after.outputs.plans[0].inputs) == (
        wrench.tick,
        plan.inputs,
    )
    assert "chaser 0: no plan, flying its last plan" in warnings(flight)
    solver.active = False
    flight.step()
    assert "chaser 0: planned again" in [text for _, _, text in flight.events]


@pytest.mark.slow
def test_a_chaser_without_plans_retreats_with_a_drifting_target(flight: InProcessMission) -> None:
    solver = install(flight, breaks)
    fly_until(flight, FAILS_AT_S)
    assert flight.phase(0) == "approach"
    solver.active = True
    records = fly_until(flight, FAILS_AT_S + FAILED_S)
    assert {modes(r) for r in records} == {("nmpc", "nmpc")}
    records += fly_until(flight, 34.0)
    assert modes(records[-1]) == ("track", "track")
    assert "chaser 0: retreat (from approach: no usable plan for 1 s)" in warnings(flight)
    assert distances_m(records).min() > flight.scenario.limits.min_distance_target_m
    for i, nominal_m in ((0, 0.8), (1, 1.2)):
        assert distances_m(records, i)[-1] == pytest.approx(nominal_m, abs=0.02)


def test_a_failed_row_leaves_the_others_planned(flight: InProcessMission) -> None:
    solver = install(flight, with_status("failed", (0,)))
    fly_until(flight, FAILS_AT_S)
    solver.active = True
    record = fly_until(flight, FAILS_AT_S + 2.0 * FAILED_S)[-1]
    assert modes(record) == ("track", "nmpc")
    assert (flight.phase(0), flight.phase(1)) == ("retreat", "hold")


@pytest.mark.slow
@pytest.mark.parametrize("status", ["infeasible_relaxed", "budget"])
def test_lasting_degraded_plans_make_a_chaser_retreat(
    flight: InProcessMission, status: str
) -> None:
    solver = install(flight, with_status(status, (0,)))
    fly_until(flight, 2.0)
    solver.active = True
    fly_until(flight, 2.0 + DEGRADED_S)
    assert flight.phase(0) == "approach"
    record = fly_until(flight, 2.2 + DEGRADED_S)[-1]
    assert modes(record) == ("nmpc", "nmpc")
    assert (flight.phase(0), flight.phase(1)) == ("retreat", "hold")
    assert warnings(flight) == [
        "chaser 0: retreat (from approach: plans infeasible or over budget for 5 s)"
    ]
    flight.step((OperatorCommand(command="approach", chaser=0),))
    assert flight.phase(0) == "retreat"
    fly_until(flight, flight.time_s + 3.0)
    solver.active = False
    fly_until(flight, flight.time_s + DEGRADED_S - 0.2)
    reason = "plans infeasible or over budget for 5 s"
    assert replies_to(flight, OperatorCommand(command="approach", chaser=0)) == [(False, reason)]
    fly_until(flight, flight.time_s + 0.4)
    flight.step((OperatorCommand(command="approach", chaser=0),))
    assert flight.phase(0) == "approach"


@pytest.mark.parametrize(
    ("change", "sound_each", "retreats"),
    [
        (breaks, 15, ["from approach: plans infeasible or over budget for 5 s"]),
        (
            with_status("infeasible_relaxed"),
            60,
            ["from approach: plans infeasible or over budget for 5 s"],
        ),
        (with_status("infeasible_relaxed"), 2, []),
    ],
)
def test_a_chaser_retreats_if_most_plans_are_degraded(
    flight: InProcessMission, change: Disturbed, sound_each: int, retreats: list[str]
) -> None:
    solves = itertools.count(1)
    solver = install(flight, lambda plan: change(plan) if next(solves) % sound_each else plan)
    fly_until(flight, 2.0)
    solver.active = True
    fly_until(flight, 2.0 + 1.2 * DEGRADED_S)
    assert flight.retreats(0) == retreats


def test_commands_without_a_plan_are_refused_with_the_reason(flight: InProcessMission) -> None:
    solver = install(flight, breaks)
    fly_until(flight, 1.0)
    solver.active = True
    fly_until(flight, 1.0 + 1.2 * FAILED_S)
    goto = OperatorCommand(command="goto", chaser=0, offset_m=(-1.5, 0.0, 0.0))
    refused, aborted = replies_to(flight, goto, OperatorCommand(command="abort", chaser=1))
    assert refused == (False, "no usable plan for 1 s")
    assert aborted[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (breaks, "no usable plan for 1 s"),
        (with_status("infeasible_relaxed"), "plans infeasible or over budget for 5 s"),
    ],
    ids=["without a plan", "degraded"],
)
def test_an_inspection_is_refused_while_planning_fails(change: Disturbed, reason: str) -> None:
    with InProcessMission(
        mission(["timeline=[]", "chasers.1.position_m=[0.0, -3.5, 0.0]"])
    ) as flight:
        solver = install(flight, change)
        fly_until(flight, 1.0)
        assert replies_to(flight, OperatorCommand(command="inspect", chaser=0)) == [
            (True, "phase inspect")
        ]
        solver.active = True
        fly_until(flight, 25.0)
        assert f"chaser 0: retreat (from inspect: {reason})" in warnings(flight)
        assert flight.phase(0) == "hold"
        assert replies_to(flight, OperatorCommand(command="inspect", chaser=0)) == [(False, reason)]


def test_a_chaser_led_by_degraded_plans_retreats_once_they_fail(flight: InProcessMission) -> None:
    solver = install(flight, with_status("infeasible_relaxed", (0,)))
    fly_until(flight, 2.0)
    solver.active = True
    fly_until(flight, 2.2 + DEGRADED_S)
    out = OperatorCommand(command="goto", chaser=0, offset_m=(-2.2, 0.0, 0.0))
    assert replies_to(flight, out) == [(True, "phase goto")]
    solver.change = with_status("failed", (0,))
    fly_until(flight, flight.time_s + 1.2 * FAILED_S)
    assert flight.retreats(0) == [
        "from approach: plans infeasible or over budget for 5 s",
        "from goto: no usable plan for 1 s",
    ]
