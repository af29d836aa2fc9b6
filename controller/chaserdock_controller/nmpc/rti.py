# SPDX-License-Identifier: Apache-2.0
"""Default back end: a real-time iteration with one structured QP per chaser and tick
(native/tick.c).

Diehl, Bock and Schloeder, SIAM J. Control Optim. 43 (2005): the shifted inputs are rolled through
the nonlinear dynamics, everything is linearized about that rollout, and one quadratic programme is
solved. The vector part of q (x) q_ref* is linear in q, so the cost is exactly quadratic and needs
no convexification. Limited by iterations, never by time, so equal inputs give equal plans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .kernels import BROKEN, LIMIT, MAX_ITERATIONS, solve_tick, tick_workspace
from .problem import NativeProblem, NmpcParameters, native_problem
from .slack import SLACK_L2, slack_l1_weight
from .terms.coast import certify, coast_rows, unsafe_rows
from .types import BUDGET, Array, IntArray, NmpcInput, NmpcPlan
from .warm_start import Frame, status_of

REACH_SAFETY = 1.5
"""Safety factor of the bound by which rows out of reach of admissible inputs are omitted. The bound
holds for the nonlinear model, rows are linear. 0.75 and 3 keep the same distances.
"""


class RtiSolver:
    """Real-time iteration for up to ``n_chasers`` chasers, warm-started from the last plan of each.

    ``max_iterations`` bounds the interior point's iterations of all chasers together in one solve.
    Each chaser may use an even share of the remaining ones, at most `MAX_ITERATIONS`. The bound may
    change between solves; a chaser stopped by it has the status "budget". Solvers share no memory,
    so that each may run in its own thread. Raises ValueError for n_chasers < 1 or a negative
    budget.
    """

    def __init__(
        self, params: NmpcParameters, n_chasers: int, max_iterations: int | None = None
    ) -> None:
        self._frame = Frame(params, n_chasers)
        if max_iterations is not None and max_iterations < 0:
            raise ValueError(f"max_iterations must not be negative, not {max_iterations}")
        self.max_iterations = max_iterations
        self._extra = 0
        self._workspace = tick_workspace(n_chasers, params.stages, self._extra)
        # Largest displacement of a chaser by stage k per 1 N of change of its inputs.
        times = params.dt_s * np.arange(params.stages + 1)
        self._horizon_s = params.stages * params.dt_s
        self._reach = REACH_SAFETY * np.sqrt(3.0) / params.mass_kg * times**2

    def reset(self) -> None:
        """Discard all warm starts."""
        self._frame.plans = {}

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan:
        """Solve one tick.

        ``shift_s``: time since the previous call, s. ``ids``: chasers of the rows, 0..N-1 if None.
        The warm start follows the id; a chaser whose id was not in the previous call starts from
        its u_ref. Raises ValueError as `check_input`, `check_ids` and `check_shift`.
        """
        frame = self._frame
        task = frame.begin(problem, shift_s, ids)
        budget = (
            self.max_iterations
            if self.max_iterations is not None
            else len(task.start) * MAX_ITERATIONS
        )
        u, code, iterations = self._iterate(task.problem, task.native, task.start, budget)
        safety, certificates = task.problem.coast_safety, {}
        if safety is not None:
            targets = task.problem.target_positions
            certificates = certify(safety, frame.rolled(task, u), targets)
            if (unsafe := unsafe_rows(safety, certificates)) is not None:
                rows = coast_rows(unsafe, frame.rolled(task, task.start), targets, self._horizon_s)
                bent = replace(task.problem, coasts=rows)
                u, code, more = self._iterate(
                    bent,
                    native_problem(bent, frame.params),
                    task.start,
                    budget - int(iterations.sum()),
                )
                iterations = iterations + more
                certificates |= certify(unsafe, frame.rolled(task, u), targets)
        plan = frame.finish(task, u, [status_of(c != BROKEN, c == LIMIT) for c in code], iterations)
        cut_short = (code == LIMIT) & (iterations < MAX_ITERATIONS)
        status = [BUDGET if cut else code for cut, code in zip(cut_short, plan.status, strict=True)]
        return replace(plan, status=tuple(status), coasts=certificates)

    def _iterate(
        self, problem: NmpcInput, native: NativeProblem, start: Array, budget: int
    ) -> tuple[Array, IntArray, IntArray]:
        """Run one iteration from ``start`` (N, D, 6). Returns inputs (N, D, 6), codes and
        iterations (N,).
        """
        frame, u = self._frame, start.copy()
        extra = native.n_boxes + native.n_coasts
        if extra > self._extra:
            self._extra = extra
            self._workspace = tick_workspace(frame.n_max, frame.params.stages, extra)
        away = problem.states[:, :3] - problem.references[:, -1, :3]
        w1 = slack_l1_weight(frame.params, np.sqrt((away * away).sum(axis=1)))
        code, iterations = solve_tick(
            frame.model,
            native,
            problem.states,
            u,
            self._reach,
            w1,
            SLACK_L2,
            budget,
            self._workspace,
        )
        return u, code, iterations
