# SPDX-License-Identifier: Apache-2.0
"""Flies a stack by a plan of least propellant, which is renewed from the estimates while it is flown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array

from .planning import StackPlan, StackProblem, plan_stop

_STEP_S = 0.5
_MOST_STEPS = 120
_FEEDBACK_S = 1.5
"""The feedback takes over this long before the end of the plan, where it can push in every direction."""
_REPLAN_S = 0.5
_FIRST_ITERATIONS = 60
_NEXT_ITERATIONS = 6
_LONGER = 0.6
"""Share of the planned time that a plan is prolonged by when thrusters are lost, or the stack still moves at its end."""


@dataclass(frozen=True, eq=False)
class ActivePlan:
    """A plan made at ``begin_ns`` from there on, which is to end at ``end_ns``; ``limits_N`` (n,): of the thrusters it was made
    for."""

    plan: StackPlan
    begin_ns: int
    end_ns: int
    limits_N: Array

    def thrusts_at(self, time_ns: int) -> Array:
        """Return the thrusts (n,) at a time."""
        step = int((time_ns - self.begin_ns) / 1e9 / self.plan.step_s + 1e-9)
        return self.plan.thrusts_N[min(max(step, 0), len(self.plan.thrusts_N) - 1)]


class StackPlanner:
    """Keeps the plan of the stack, if it is ``enabled`` by a time to stop it in.

    ``active`` is None before the first plan and after the last.
    """

    def __init__(self, plan_s: float | None) -> None:
        self.enabled, self._plan_s = plan_s is not None, plan_s or 0.0
        self.active: ActivePlan | None = None

    def reset(self) -> None:
        """Forget the plan."""
        self.active = None

    def trial(self, problem: StackProblem) -> StackPlan:
        """Return a first plan over the whole time."""
        return self._plan(problem, 0, self._plan_s).plan

    def thrusts(self, problem: StackProblem, now_ns: int, feedback_can: bool) -> Array | None:
        """Return the thrusts (n,) of the plan now; None if the feedback is to take over. ``feedback_can``: whether it can."""
        active = self.active
        if active is None or len(active.limits_N) != len(problem.limits_N):
            active = self._plan(problem, now_ns, self._plan_s)
        elif np.any(active.limits_N > problem.limits_N + 1e-9):
            left_s = max((active.end_ns - now_ns) / 1e9, _LONGER * self._plan_s)
            active = self._plan(problem, now_ns, left_s)
        left_s = (active.end_ns - now_ns) / 1e9
        if feedback_can and left_s < _FEEDBACK_S:
            return None
        if left_s <= 0.5 * active.plan.step_s:
            active = self._plan(problem, now_ns, _LONGER * self._plan_s)
        elif now_ns - active.begin_ns >= _REPLAN_S * 1e9:
            active = self._plan(problem, now_ns, left_s, active)
        self.active = active
        return np.minimum(active.thrusts_at(now_ns), problem.limits_N)

    def _plan(
        self, problem: StackProblem, now_ns: int, duration_s: float, last: ActivePlan | None = None
    ) -> ActivePlan:
        """Return a plan from the present state; its first guess is the rest of the ``last`` plan, which ends at the same time."""
        step_s = max(_STEP_S, duration_s / _MOST_STEPS) if last is None else last.plan.step_s
        count = max(1, round(duration_s / step_s))
        step_s = duration_s / count
        guess, iterations = np.zeros((count, len(problem.limits_N))), _FIRST_ITERATIONS
        if last is not None:
            times = now_ns + (np.arange(count) + 0.5) * step_s * 1e9
            guess, iterations = np.array([last.thrusts_at(int(t)) for t in times]), _NEXT_ITERATIONS
        plan = plan_stop(problem, guess, step_s, iterations)
        end_ns = now_ns + round(duration_s * 1e9)
        return ActivePlan(plan, now_ns, end_ns, problem.limits_N.copy())
