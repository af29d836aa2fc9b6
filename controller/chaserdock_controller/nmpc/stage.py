# SPDX-License-Identifier: Apache-2.0
"""Fourth stage of a tick: build the NMPC problem and solve it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from chaserdock_models.arrays import Array, limited
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.shape_distance import box_table
from chaserdock_protocol.failure_watch import FailureWatch, text_of
from chaserdock_protocol.plugins import PluginError, prepare
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import (
    ChaserEstimate,
    ChaserPlan,
    ChaserPlanning,
    GuidanceResult,
    HorizonReference,
    LogEntry,
    Observation,
    OwnMotion,
    PlanningFailure,
    PlanningHistory,
    PlanResult,
    SolveStatus,
    TargetEstimation,
    TargetState,
)

from . import make_solver
from .budget import Bounded, SolveBudget
from .lost_chasers import with_lost_chasers
from .passive_safety import PassiveSafetyMonitor
from .plan_monitor import PlanMonitor
from .problem import NmpcParameters
from .types import FAILED, NmpcInput, NmpcPlan
from .warm_start import checked_plan

_ATTACHED_FACTOR = 1.2
"""Input limit of an attached chaser, relative to the largest input that follows the target; the
rest is for feedback. It acts where others are planned beside it, as in
`four-chaser-capture`.
"""
_ATTACHED_MARGIN = 1e-3
"""Added to that limit, N and N m, because the solver needs a positive one where the target does not
move.
"""
FAILED_SOLVER = "solver failed"
"""Name of an exception of the solver, or of a result that cannot be used, in counts."""
_CANCELLED_SHARE = 0.5
"""Largest share of an input limit that may cancel a disturbance."""


class PlanHistory(PlanningHistory):
    """Failures and passive safety of earlier plans, for the guidance of the next tick."""

    def __init__(
        self, monitors: Sequence[PlanMonitor], passive_safety: PassiveSafetyMonitor | None
    ) -> None:
        self._monitors, self._passive_safety = monitors, passive_safety

    def failure(self, chaser: int, time_ns: int) -> PlanningFailure | None:
        """Return why a chaser has to retreat at ``time_ns``, or None if planning has not failed."""
        return self._monitors[chaser].failure(time_ns)

    def unsafe(self, chaser: int, time_ns: int) -> str:
        """Return why a chaser's plans are not passively safe at ``time_ns``; empty if they are.
        Guidance decides whether it aborts.
        """
        return "" if self._passive_safety is None else self._passive_safety.unsafe(chaser, time_ns)


class PlanningStage:
    """Runs the solver with its warm starts and, in real time, its budget; keeps the plans of the
    last ticks. ``failed``: names the solver's failure in this tick, as it is counted.

    Raises PluginError for an installed solver that cannot be held to a budget when there is one.
    """

    def __init__(
        self,
        scenario: FlightScenario,
        parameters: NmpcParameters,
        now_s: Callable[[], float],
        realtime: bool,
    ) -> None:
        c = scenario.controller
        self._parameters, self._now_s = parameters, now_s
        self._limits = scenario.limits
        self._shape = None
        if scenario.limits.min_distance_shape_m > 0.0:
            self._shape = box_table(scenario.chaser.boxes())
        self.solver = make_solver(c.solver, parameters, len(scenario.chasers), c.max_iterations)
        prepare("solver", c.solver, self.solver, scenario)
        self.monitors = tuple(PlanMonitor() for _ in scenario.chasers)
        self._passive_safety = None
        if scenario.limits.passive_safety != "off":
            self._passive_safety = PassiveSafetyMonitor(scenario)
        self.history = PlanHistory(self.monitors, self._passive_safety)
        self._last_solve_ns: int | None = None
        self._watch = FailureWatch(c.solver)
        self.failed: tuple[str, ...] = ()
        self._budget: SolveBudget | None = None
        if realtime and c.solve_budget_s is not None:
            self._budget = SolveBudget(c.solve_budget_s, c.max_iterations)
            if not hasattr(self.solver, "max_iterations"):
                raise PluginError(
                    f"controller.solve_budget_s: solver {c.solver!r} has no max_iterations to set"
                )

    def run(
        self, observation: Observation, estimation: TargetEstimation, guidance: GuidanceResult
    ) -> PlanResult:
        """Plan for the chasers of the guidance horizon; where that fails, keep their last plans for
        a while. Lost chasers are obstacles.

        The problem is solved for the input plus the estimated disturbance, which is subtracted
        afterwards. The input cost thus keeps its reference, and the disturbance causes no offset.
        """
        self.failed = ()
        horizon = guidance.horizon
        if horizon is None:
            for monitor in self.monitors:
                monitor.forget()
            return self._result(observation.time_ns, None, (), 0.0, ())

        own = [_own(estimation.chasers[i]) for i in horizon.chasers]
        limits = np.array([observation.chasers[i].input_limits for i in horizon.chasers])
        disturbances = np.array(
            [_bounded(m.disturbance, row) for m, row in zip(own, limits, strict=True)]
        )

        # The solver sees the input plus the disturbance: leave the actuators room to cancel it.
        states = np.array([m.at_effect for m in own])
        problem = self.problem(horizon, states, limits - np.abs(disturbances))
        problem = replace(problem, target=_motion(estimation.at_effect))
        lost = {c.chaser: c.lost for c in observation.chasers if c.lost is not None}
        problem = with_lost_chasers(
            problem, self._parameters, tuple(lost.values()), observation.effective_ns
        )

        enforced = {d.chaser for d in guidance.directives if d.abort_margin is not None}
        if self._passive_safety is not None and enforced:
            safety = self._passive_safety.restriction(horizon.chasers, enforced, estimation)
            problem = replace(problem, coast_safety=safety)

        since_ns = 0 if self._last_solve_ns is None else observation.time_ns - self._last_solve_ns
        if self._budget is not None:
            cast(Bounded, self.solver).max_iterations = self._budget.iterations()

        plan: NmpcPlan | None = None
        events: tuple[LogEntry, ...] = ()
        failure = ""
        start_s = self._now_s()
        try:
            plan = self.solver.solve(problem, since_ns / 1e9, (*horizon.chasers, *lost))
            plan = checked_plan(plan, len(problem.states), self._parameters.stages)
            self._last_solve_ns = observation.time_ns
        except Exception as error:  # an installed solver may raise anything
            plan = None
            failure = text_of(error)
        report = self._watch.update(FAILED_SOLVER, failure)
        if report is not None:  # an error at once: what is flown instead is old or no plan
            events = (("error", f"solver error: {report.detail}"),)
        self.failed = (FAILED_SOLVER,) if failure else ()
        wall_s = self._now_s() - start_s

        if self._budget is not None and plan is not None:
            self._budget.note(wall_s, int(plan.iterations.sum()))
        if plan is not None:
            plan = _without(plan, disturbances)

        self._follow(horizon.chasers, plan, observation)
        if self._passive_safety is not None and plan is not None:
            events += self._passive_safety.update(
                horizon.chasers, plan.states, estimation, observation.time_ns, plan.coasts
            )
        return self._result(observation.time_ns, plan, horizon.chasers, wall_s, events)

    def _follow(
        self, chasers: Sequence[int], plan: NmpcPlan | None, observation: Observation
    ) -> None:
        """Pass the rows of a plan to the monitors of ``chasers``, and reset those of all others."""
        rows = {i: row for row, i in enumerate(chasers)}
        for i, monitor in enumerate(self.monitors):
            if i not in rows:
                monitor.forget()
                continue
            row, status, own = rows[i], FAILED, None
            if plan is not None and plan.status[row] != FAILED:
                status = plan.status[row]
                own = ChaserPlan(observation.effective_ns, plan.states[row], plan.inputs[row])
            monitor.update(status, own, observation.time_ns)

    def _result(
        self,
        time_ns: int,
        plan: NmpcPlan | None,
        chasers: Sequence[int],
        wall_s: float,
        events: tuple[LogEntry, ...],
    ) -> PlanResult:
        """Return the planning results of all chasers. ``chasers``: those of the first rows of
        ``plan``.
        """
        solves = {} if plan is None else {i: _solve(plan, row) for row, i in enumerate(chasers)}
        safety = self._passive_safety
        planned = tuple(
            ChaserPlanning(
                i,
                solves.get(i),
                monitor.flyable(time_ns),
                None if safety is None else safety.chasers[i].certificate,
            )
            for i, monitor in enumerate(self.monitors)
        )
        return PlanResult(planned, wall_s, events)

    def problem(self, horizon: HorizonReference, states: Array, input_limits: Array) -> NmpcInput:
        """Return the problem at the time when the commands take effect, without lost chasers.

        ``states`` (N, 13), ``input_limits`` (N, 6): of the chasers in the horizon.
        """
        limits = input_limits.copy()
        for row, i in enumerate(horizon.chasers):
            if i in horizon.attached:  # it cannot yield: its inputs only follow the target's motion
                following = np.abs(horizon.u_ref[row]).max(axis=0)
                limits[row] = np.minimum(
                    limits[row], _ATTACHED_FACTOR * following + _ATTACHED_MARGIN
                )
        return NmpcInput(
            states=states,
            references=horizon.references,
            u_ref=horizon.u_ref,
            target_positions=horizon.target_positions,
            min_distance_target_m=horizon.min_distance_target_m,
            min_distance_chasers_m=self._limits.min_distance_chasers_m,
            input_max=limits,
            corridors=horizon.corridors,
            boxes=horizon.boxes,
            box_clearance_m=horizon.box_clearance_m,
            docking=horizon.docking,
            chaser_shape=self._shape,
            min_distance_shapes_m=self._between_shapes(horizon.box_clearance_m),
        )

    def _between_shapes(self, box_clearance_m: Array | None) -> Array | None:
        """Return the distances (N, N) that the shapes of chasers keep; zero between two that are in
        their corridors or at their ports.
        """
        if box_clearance_m is None:
            return None
        free = box_clearance_m > 0.0
        return np.where(free[:, None] | free, self._limits.min_distance_shape_m, 0.0)


def _bounded(disturbance: Array, limits: Array) -> Array:
    """Limit a disturbance (6,) so that the actuators can cancel it and keep half of their range."""
    return limited(disturbance, _CANCELLED_SHARE * limits)


def _own(estimate: ChaserEstimate) -> OwnMotion:
    """Return the motion of a chaser that is planned for, which is known."""
    assert estimate.own is not None
    return estimate.own


def _motion(target: TargetState | None) -> BodyState | None:
    """Return the motion of an estimated target."""
    if target is None:
        return None
    return BodyState(target.position_m, target.velocity_m_s, target.q_wxyz, target.omega_rad_s)


def _solve(plan: NmpcPlan, row: int) -> SolveStatus:
    """Return how the solver ended in a row of its plan."""
    cost, violation_m = float(plan.cost[row]), float(plan.max_violation_m[row])
    return SolveStatus(plan.status[row], int(plan.iterations[row]), cost, violation_m)


def _without(plan: NmpcPlan, disturbances: Array) -> NmpcPlan:
    """Return the plan with the actuators' inputs in its first rows: planned ones less the cancelled
    ``disturbances`` (N, 6).
    """
    if not disturbances.any():
        return plan
    inputs = plan.inputs.copy()
    inputs[: len(disturbances)] -= disturbances[:, None, :]
    return replace(plan, inputs=inputs)
