# SPDX-License-Identifier: Apache-2.0
"""Flies a stack by a plan of least propellant and renews the plan from the estimates on the way.

A plan's programme has many local minima. Plans from several guesses are therefore improved by a few
linear programmes in every tick, for the predicted state in which the next plan begins. Before the
first plan the stack coasts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models.arrays import Array

from .planning import StackPlan, StackProblem, flown, improve, predicted

_STEP_S = 0.5
"""Step of a plan, s, rounded to whole ticks. The plan is renewed after every step."""
_FEEDBACK_S = 0.6
"""Time, s, before the end of a plan at which the feedback takes over."""
_RENEWAL_PROGRAMMES = 6
"""Linear programmes that improve a plan at its renewal: as many as a new guess gets before it is
compared.
"""
_SEARCH_S, _SEARCH_SHARE = 0.5, 0.1
"""Until a first plan begins, the stack coasts for this long (s), but at most for this share of the
planned time.
"""
_PROGRAMMES_PER_S = 90.0
"""Linear programmes per second that a search solves, spread over the ticks; one takes about 6
ms.
"""
_FIRST_PROGRAMMES = 6
"""Linear programmes after which plans from different guesses are compared. After fewer it is not
clear which becomes the cheapest.
"""
_FIRST_GUESSES = 5
"""Guesses of a first plan: no thrust, and random ones. The worst local minimum costs 1.4 times the
best.
"""
_NEXT_GUESSES = 2
"""Additional guesses at a renewal; each takes `_FIRST_PROGRAMMES` programmes."""
_OTHER_GAIN = 0.05
"""A plan from another guess replaces the present one if it is cheaper by this share of the cost."""
_OTHER_UNTIL = 0.4
"""Other guesses are tried while at least this share of the planned time is left."""
_GUESS_DENSITY = 0.15
"""Share of steps and thrusters that fire in a random guess."""
_LONGER = 0.6
"""Least share of the planned time that a plan lasts after thrusters are lost."""


@dataclass(frozen=True, eq=False)
class ActivePlan:
    """A plan that began at ``begin_ns``, with steps of ``step_ns``; it is renewed at
    ``renewal_ns``.

    ``limits_N`` (n,): limits of the thrusters for which it was made.
    """

    plan: StackPlan
    begin_ns: int
    step_ns: int
    renewal_ns: int
    limits_N: Array

    @property
    def end_ns(self) -> int:
        return self.begin_ns + len(self.plan.thrusts_N) * self.step_ns

    def thrusts_at(self, time_ns: int) -> Array:
        """Return the thrusts (n,) at a time."""
        return self.plan.thrusts_N[min(self._step(time_ns), len(self.plan.thrusts_N) - 1)]

    def rest(self, from_ns: int) -> Array:
        """Return the thrusts (K, n) that remain from a time on."""
        return self.plan.thrusts_N[self._step(from_ns) :]

    def _step(self, time_ns: int) -> int:
        return max(0, round((time_ns - self.begin_ns) / self.step_ns - 0.5 + 1e-6))


@dataclass(frozen=True, eq=False)
class PlanSearch:
    """Plans from several guesses for the state in which the stack is expected at ``begin_ns``.

    ``tried``: number of improvements so far.
    """

    problem: StackProblem
    begin_ns: int
    plans: tuple[StackPlan, ...]
    tried: int = 0

    def improved(self, programmes: int) -> PlanSearch:
        """Return the search with one plan improved: each guess in turn, then the cheapest that can
        still be improved.
        """
        k, tried = self.tried // math.ceil(_FIRST_PROGRAMMES / programmes), self.tried + 1
        if k >= len(self.plans):
            open_plans = [k for k, plan in enumerate(self.plans) if plan.radius > 0.0]
            if not open_plans:
                return self
            k = min(open_plans, key=lambda k: self.plans[k].cost_N_s)
        plans = list(self.plans)
        plans[k] = improve(self.problem, plans[k], programmes)
        return replace(self, plans=tuple(plans), tried=tried)

    def best(self) -> StackPlan | None:
        """Return the cheapest plan."""
        return min(self.plans, key=lambda p: p.cost_N_s, default=None)


class StackPlanner:
    """Keeps the stack's plan and searches for the next one. ``enabled``: the scenario sets a time
    to stop in.

    ``active``: None before the first plan and after the last. ``search``: for the next renewal of
    the plan.
    """

    def __init__(self, plan_s: float | None, rate_hz: float) -> None:
        self.enabled, self._plan_s = plan_s is not None, plan_s or 0.0
        self._programmes = max(1, round(_PROGRAMMES_PER_S / rate_hz))
        self._step_ns = round(max(1, round(_STEP_S * rate_hz)) / rate_hz * 1e9)
        self.active: ActivePlan | None = None
        self.search: PlanSearch | None = None
        if self.enabled:
            import scipy.optimize  # noqa: F401  # loaded now: importing takes longer than a tick

    def reset(self) -> None:
        """Discard the plan and the search."""
        self.active = self.search = None

    def thrusts(self, problem: StackProblem, now_ns: int) -> Array | None:
        """Return the planned thrusts (n,) now; None when the feedback has to take over."""
        active = self.active
        if active is None or len(active.limits_N) != len(problem.limits_N):
            active = self._begin(problem, now_ns, self._plan_s)
        elif np.any(active.limits_N > problem.limits_N + 1e-9):
            left_s = max((active.end_ns - now_ns) / 1e9, _LONGER * self._plan_s)
            active = self._begin(problem, now_ns, left_s)
        if (active.end_ns - now_ns) / 1e9 < _FEEDBACK_S:
            return None
        if now_ns >= active.renewal_ns:
            active = self._renew(problem, now_ns, active)
        elif self.search is not None:
            self.search = self.search.improved(self._programmes)
        self.active = active
        return np.minimum(active.thrusts_at(now_ns), problem.limits_N)

    def _begin(self, problem: StackProblem, now_ns: int, duration_s: float) -> ActivePlan:
        """Return a plan that coasts. Start the search for one that stops the stack at the same
        time.
        """
        step_s = self._step_ns / 1e9
        coasting = max(1, round(min(_SEARCH_S, _SEARCH_SHARE * duration_s) / step_s))
        count = max(coasting + 1, round(duration_s / step_s))
        coast = flown(problem, np.zeros((count, len(problem.limits_N))), step_s)
        renewal_ns = now_ns + coasting * self._step_ns
        active = ActivePlan(coast, now_ns, self._step_ns, renewal_ns, problem.limits_N.copy())
        self.search = self._search(problem, active, _FIRST_GUESSES - 1, with_rest=True)
        return active

    def _renew(self, problem: StackProblem, now_ns: int, last: ActivePlan) -> ActivePlan:
        """Return a plan from the present state that ends with the ``last`` one. Start the search
        for the next.

        It starts from the rest of the last plan, or from the result of the search if that is
        cheaper.
        """
        thrusts_N, step_s, search = last.rest(now_ns), self._step_ns / 1e9, self.search
        found = None if search is None else search.best()
        if search is not None and found is not None:
            rest = flown(search.problem, last.rest(search.begin_ns), step_s)
            if found.cost_N_s < (1.0 - _OTHER_GAIN) * rest.cost_N_s:
                thrusts_N = found.thrusts_N[len(found.thrusts_N) - len(thrusts_N) :]
        plan = improve(problem, flown(problem, thrusts_N, step_s), _RENEWAL_PROGRAMMES)
        active = ActivePlan(
            plan, now_ns, self._step_ns, now_ns + self._step_ns, problem.limits_N.copy()
        )
        goes_on = active.end_ns - active.renewal_ns > _OTHER_UNTIL * self._plan_s * 1e9
        self.search = (
            self._search(problem, active, _NEXT_GUESSES, with_rest=False) if goes_on else None
        )
        return active

    def _search(
        self, problem: StackProblem, active: ActivePlan, guesses: int, with_rest: bool
    ) -> PlanSearch:
        """Return a search for the plan that follows the active one, from random guesses and, if
        ``with_rest``, the rest of the active one.

        Guesses are seeded by the time for which they are made, so that every controller draws the
        same.
        """
        begin_ns, step_s = active.renewal_ns, self._step_ns / 1e9
        ahead_N = active.plan.thrusts_N[: len(active.plan.thrusts_N) - len(active.rest(begin_ns))]
        problem, rest_N = predicted(problem, ahead_N, step_s), active.rest(begin_ns)
        rng = np.random.default_rng([0x9A2, begin_ns])
        fires = rng.random((guesses, *rest_N.shape)) < _GUESS_DENSITY
        starts = [*([rest_N] if with_rest else []), *np.where(fires, problem.limits_N, 0.0)]
        return PlanSearch(
            problem, begin_ns, tuple(flown(problem, start, step_s) for start in starts)
        )
