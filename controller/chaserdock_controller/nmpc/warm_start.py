"""What every back end has in common: the check before, the warm start, and the account of the plan after."""

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
class Task:
    """A checked problem, who its rows are, and the inputs (N, D, 6) to start from, within the box."""

    problem: NmpcInput
    names: tuple[int, ...]
    start: Array

    @property
    def corridors(self) -> Array:
        assert self.problem.corridors is not None  # check_input wrote them out
        return self.problem.corridors

    @property
    def between(self) -> Array:
        return np.asarray(self.problem.min_distance_chasers_m)


@dataclass
class Frame:
    """The parameters as arrays, and the last plan of each chaser, by identity.

    Raises ValueError for n_max < 1, ImportError where the compiled kernels cannot be had.
    """

    params: NmpcParameters
    n_max: int
    plans: dict[int, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.n_max < 1:
            raise ValueError(f"n_chasers must be at least 1, not {self.n_max}")
        function("solve_tick")  # loaded here rather than at the first tick
        self.model, self.weights = model_of(self.params), Weights(self.params)

    def begin(self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None) -> Task:
        """Checks and prepares. Raises ValueError for what `check_input`, `check_ids` and `check_shift` refuse."""
        checked = check_input(problem, self.params, self.n_max)
        names = check_ids(ids, len(checked.states))
        start = warm_start(self.plans, names, checked, check_shift(shift_s), self.params.dt_s)
        return Task(checked, names, start)

    def rolled(self, task: Task, u: Array) -> Array:
        """States (N, D+1, 13) of inputs ``u`` (N, D, 6) through the nonlinear model."""
        x = np.empty((len(u), self.params.stages + 1, 13))
        x[:, 0] = task.problem.states
        roll(self.model, x, u)
        return x

    def account(self, task: Task, x: Array, u: Array) -> tuple[Array, Array]:
        """Cost by eq. 6 (N,) and deepest violation, m (N,), of a plan."""
        p = task.problem
        cost = plan_cost(self.weights, x, u, p.references, p.u_ref)
        return cost, plan_violation(p, x, self.params.max_reference_distance_m)

    def finish(self, task: Task, u: Array, status: Sequence[str], iterations: IntArray) -> NmpcPlan:
        """The plan of inputs ``u``, kept as the next warm start.

        ``status`` is the back end's own word for each row. A row that ran out of iterations has the better of its
        answer and the start: what it found so far may be worse than the plan it came with.
        """
        x = self.rolled(task, u)
        cost, violation = self.account(task, x, u)
        late = [row for row, word in enumerate(status) if word == ITERATION_LIMIT]
        if late:
            before = self.rolled(task, task.start)
            old_cost, old_violation = self.account(task, before, task.start)
            worse = cost + SLACK_L1 * violation > old_cost + SLACK_L1 * old_violation
            for row in (row for row in late if worse[row]):
                u[row], x[row] = task.start[row], before[row]
            cost, violation = self.account(task, x, u)
        self.plans = {name: u[row].copy() for row, name in enumerate(task.names)}
        relaxed = violation > VIOLATION_TOLERANCE_M
        return NmpcPlan(
            inputs=u,
            states=x,
            status=tuple(
                INFEASIBLE_RELAXED if deep and word in (SOLVED, ITERATION_LIMIT) else word
                for word, deep in zip(status, relaxed, strict=True)
            ),
            iterations=iterations,
            cost=cost,
            max_violation_m=violation,
        )


def status_of(usable: bool, at_limit: bool) -> str:
    """The status before violations are counted."""
    return FAILED if not usable else (ITERATION_LIMIT if at_limit else SOLVED)
