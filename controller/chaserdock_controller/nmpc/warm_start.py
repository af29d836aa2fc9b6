# SPDX-License-Identifier: Apache-2.0
"""Steps common to all back ends: checks of a call, warm start, and evaluation of the plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models.passive_safety import CoastCertificate

from .kernels import plan_cost, plan_violation, roll, shifted
from .native import function
from .problem import NativeProblem, NmpcParameters, check_input, model_of, native_problem
from .slack import SLACK_L1
from .term import checked_array
from .types import (
    FAILED,
    INFEASIBLE_RELAXED,
    ITERATION_LIMIT,
    SOLVED,
    STATUSES,
    VIOLATION_TOLERANCE_M,
    Array,
    IntArray,
    NmpcInput,
    NmpcPlan,
)


@dataclass(frozen=True)
class PreparedProblem:
    """A checked problem, also in the form for C, with the ids of its rows and the initial inputs
    (N, D, 6) within the box.
    """

    problem: NmpcInput
    native: NativeProblem
    names: tuple[int, ...]
    start: Array


@dataclass
class Frame:
    """Steps of a solve that all back ends share. Keeps the parameters as arrays and the last plan
    of each chaser by id.

    Raises ValueError for n_max < 1 and ImportError if the compiled kernels are not available.
    """

    params: NmpcParameters
    n_max: int
    plans: dict[int, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.n_max < 1:
            raise ValueError(f"n_chasers must be at least 1, not {self.n_max}")
        function("solve_tick")  # load the library before the first tick
        self.model = model_of(self.params)

    def begin(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None
    ) -> PreparedProblem:
        """Check the problem and compute the warm start. Raises ValueError as `check_input`,
        `check_ids` and `check_shift`.
        """
        checked = check_input(problem, self.params, self.n_max)
        names = check_ids(ids, len(checked.states))
        start = warm_start(self.plans, names, checked, check_shift(shift_s), self.params.dt_s)
        return PreparedProblem(checked, native_problem(checked, self.params), names, start)

    def rolled(self, task: PreparedProblem, u: Array) -> Array:
        """Return the states (N, D+1, 13) that inputs ``u`` (N, D, 6) give through the nonlinear
        model.
        """
        x = np.empty((len(u), self.params.stages + 1, 13))
        x[:, 0] = task.problem.states
        roll(self.model, x, u)
        return x

    def evaluate(self, task: PreparedProblem, x: Array, u: Array) -> tuple[Array, Array]:
        """Return cost (eq. 6) and deepest violation, m, of a plan, each (N,)."""
        return plan_cost(task.native, x, u), plan_violation(task.native, x)

    def finish(
        self, task: PreparedProblem, u: Array, status: Sequence[str], iterations: IntArray
    ) -> NmpcPlan:
        """Return the plan of inputs ``u`` and keep it as the next warm start.

        ``status``: the back end's status of each row. A row at the iteration limit takes the better
        of its solution and its start, since an unconverged solution may be worse than the warm
        start.
        """
        x = self.rolled(task, u)
        cost, violation = self.evaluate(task, x, u)
        late = [row for row, code in enumerate(status) if code == ITERATION_LIMIT]
        if late:
            before = self.rolled(task, task.start)
            old_cost, old_violation = self.evaluate(task, before, task.start)
            worse = cost + SLACK_L1 * violation > old_cost + SLACK_L1 * old_violation
            for row in (row for row in late if worse[row]):
                u[row], x[row] = task.start[row], before[row]
            cost, violation = self.evaluate(task, x, u)
        self.plans = {name: u[row].copy() for row, name in enumerate(task.names)}
        relaxed = violation > VIOLATION_TOLERANCE_M
        return NmpcPlan(
            inputs=u,
            states=x,
            status=tuple(
                INFEASIBLE_RELAXED if deep and code in (SOLVED, ITERATION_LIMIT) else code
                for code, deep in zip(status, relaxed, strict=True)
            ),
            iterations=iterations,
            cost=cost,
            max_violation_m=violation,
        )


def status_of(usable: bool, at_limit: bool) -> str:
    """Return the status before violations are considered."""
    return FAILED if not usable else (ITERATION_LIMIT if at_limit else SOLVED)


def checked_plan(plan: NmpcPlan, n: int, d: int) -> NmpcPlan:
    """Return a plan of ``n`` chasers and ``d`` stages with its values as arrays. Raises ValueError
    for another shape, an unknown status, or a value that is not finite.
    """
    if not isinstance(plan, NmpcPlan):
        raise ValueError(f"solve() returned {type(plan).__name__}, not an NmpcPlan")
    if len(plan.status) != n or not set(plan.status) <= set(STATUSES):
        raise ValueError(f"status must be {n} of {STATUSES}, not {plan.status}")
    if not all(isinstance(coast, CoastCertificate) for coast in plan.coasts.values()):
        raise ValueError("coasts must be certificates")
    return replace(
        plan,
        inputs=checked_array("inputs", plan.inputs, (n, d, 6), negative=True),
        states=checked_array("states", plan.states, (n, d + 1, 13), negative=True),
        iterations=checked_array("iterations", plan.iterations, (n,)).astype(np.int64),
        cost=checked_array("cost", plan.cost, (n,), negative=True),
        max_violation_m=checked_array("max_violation_m", plan.max_violation_m, (n,), negative=True),
    )


def check_ids(ids: Sequence[int] | None, n: int) -> tuple[int, ...]:
    """Return the chasers' ids, 0..N-1 by default. Raises ValueError for a wrong number of them or
    duplicates.
    """
    chosen = tuple(range(n)) if ids is None else tuple(int(i) for i in ids)
    if len(chosen) != n or len(set(chosen)) != n:
        raise ValueError(f"ids must be {n} different numbers, not {chosen}")
    return chosen


def check_shift(shift_s: float) -> float:
    """Return the time since the previous solve, s. Raises ValueError if it is negative or not
    finite.
    """
    if not (math.isfinite(shift_s) and shift_s >= 0.0):
        raise ValueError(f"shift_s must be finite and not negative, not {shift_s!r}")
    return float(shift_s)


def shift_inputs(inputs: Array, shift_s: float, dt_s: float) -> Array:
    """Shift piecewise constant inputs (..., D, 6) by ``shift_s`` on the same grid.

    Each new value is the mean of the old plan over its interval, which preserves the impulse. The
    last value is held beyond the old horizon.
    """
    whole, part = divmod(shift_s / dt_s, 1.0)
    return shifted(inputs, int(min(whole, inputs.shape[-2])), part)


def warm_start(
    plans: dict[int, Array], names: tuple[int, ...], problem: NmpcInput, shift_s: float, dt_s: float
) -> Array:
    """Return the initial inputs (N, D, 6) within the box: the shifted plan of each chaser, or its
    u_ref if it has none.
    """
    start = problem.u_ref.copy()
    known = [row for row, name in enumerate(names) if name in plans]
    if known:
        start[known] = shift_inputs(np.array([plans[names[row]] for row in known]), shift_s, dt_s)
    limits = problem.input_max[:, None, :]
    return np.minimum(np.maximum(start, -limits), limits)
