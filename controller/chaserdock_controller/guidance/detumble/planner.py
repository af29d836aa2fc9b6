# SPDX-License-Identifier: Apache-2.0
"""Flies a stack by a plan of least propellant, which is renewed from the estimates while it is flown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array

from .planning import StackPlan, StackProblem, plan_stop

_STEP_S = 0.5
_MOST_STEPS = 120
_FEEDBACK_S = 0.6
"""The feedback takes over this long before the end of the plan, where it can push in every direction."""
_REPLAN_S = 0.5
_FIRST_ITERATIONS = 60
_NEXT_ITERATIONS = 6
_FIRST_GUESSES = 4
"""Random guesses of a first plan, beside that of no thrust: the programme has many local minima, the worst 1.4 times as expensive as
the best."""
_OTHER_ITERATIONS = 20
_OTHER_GAIN = 0.05
"""Share of the cost by which a plan from another guess must be cheaper to replace the present one."""
_OTHER_UNTIL = 0.4
"""Share of the planned time that must be left for other guesses to be tried."""
_GUESS_DENSITY = 0.15
"""Share of steps and thrusters that a random guess fires."""
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
        self._rng = np.random.default_rng(0x9A2)

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
        if last is None:
            guesses = [np.zeros((count, len(problem.limits_N)))]
            guesses += [self._random_guess(problem, count) for _ in range(_FIRST_GUESSES)]
            plans = [plan_stop(problem, guess, step_s, _FIRST_ITERATIONS) for guess in guesses]
            plan = min(plans, key=lambda p: p.cost_N_s)
        else:
            times = now_ns + (np.arange(count) + 0.5) * step_s * 1e9
            guess = np.array([last.thrusts_at(int(t)) for t in times])
            plan = plan_stop(problem, guess, step_s, _NEXT_ITERATIONS)
            if duration_s > _OTHER_UNTIL * self._plan_s:
                other = plan_stop(problem, self._random_guess(problem, count), step_s, _OTHER_ITERATIONS)
                if other.cost_N_s < (1.0 - _OTHER_GAIN) * plan.cost_N_s:
                    plan = other
        end_ns = now_ns + round(duration_s * 1e9)
        return ActivePlan(plan, now_ns, end_ns, problem.limits_N.copy())

    def _random_guess(self, problem: StackProblem, count: int) -> Array:
        fires = self._rng.random((count, len(problem.limits_N))) < _GUESS_DENSITY
        return np.where(fires, problem.limits_N, 0.0)
