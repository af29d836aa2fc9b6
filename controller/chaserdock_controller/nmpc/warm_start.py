# SPDX-License-Identifier: Apache-2.0
"""Steps common to all back ends: validation, warm start, and evaluation of the plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .checks import check_ids, check_input, check_shift, warm_start
from .kernels import Weights, model_of, plan_cost, plan_violation, roll
from .native import function
from .slack import SLACK_L1
from .types import (
    FAILED,
    INFEASIBLE_RELAXED,
    ITERATION_LIMIT,
    SOLVED,
    VIOLATION_TOLERANCE_M,
    Array,
    IntArray,
    NmpcInput,
    NmpcParameters,
    NmpcPlan,
)


@dataclass(frozen=True)
class PreparedProblem:
    """A checked problem, the ids of its rows, and the initial inputs (N, D, 6) within the box."""

    problem: NmpcInput
    names: tuple[int, ...]
    start: Array

    @property
    def corridors(self) -> Array:
        assert self.problem.corridors is not None  # check_input fills them in
        return self.problem.corridors

    @property
    def between(self) -> Array:
        return np.asarray(self.problem.min_distance_chasers_m)


@dataclass
class Frame:
    """Parameters as arrays, and the last plan of each chaser by id.

    Raises ValueError for n_max < 1 and ImportError if the compiled kernels are not available.
    """

    params: NmpcParameters
    n_max: int
    plans: dict[int, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.n_max < 1:
            raise ValueError(f"n_chasers must be at least 1, not {self.n_max}")
        function("solve_tick")  # load the library before the first tick
        self.model, self.weights = model_of(self.params), Weights(self.params)

    def begin(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None
    ) -> PreparedProblem:
        """Check the problem and compute the warm start. Raises ValueError as the checks in
        `checks`.
        """
        checked = check_input(problem, self.params, self.n_max)
        names = check_ids(ids, len(checked.states))
        start = warm_start(self.plans, names, checked, check_shift(shift_s), self.params.dt_s)
        return PreparedProblem(checked, names, start)

    def rolled(self, task: PreparedProblem, u: Array) -> Array:
        """Return the states (N, D+1, 13) of inputs ``u`` (N, D, 6) through the nonlinear model."""
        x = np.empty((len(u), self.params.stages + 1, 13))
        x[:, 0] = task.problem.states
        roll(self.model, x, u)
        return x

    def evaluate(self, task: PreparedProblem, x: Array, u: Array) -> tuple[Array, Array]:
        """Return the cost (eq. 6) (N,) and the deepest violation, m (N,), of a plan."""
        p = task.problem
        cost = plan_cost(self.weights, x, u, p.references, p.u_ref)
        return cost, plan_violation(p, x, self.params.max_reference_distance_m)

    def finish(
        self, task: PreparedProblem, u: Array, status: Sequence[str], iterations: IntArray
    ) -> NmpcPlan:
        """Return the plan of inputs ``u`` and keep it as the next warm start.

        ``status``: the back end's status of each row. A row at the iteration limit uses the better
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
