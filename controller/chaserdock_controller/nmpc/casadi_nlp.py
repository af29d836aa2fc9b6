# SPDX-License-Identifier: Apache-2.0
"""Back end `ipopt`, and base classes of back ends that solve `casadi_problem` for all chasers at
once.

ipopt with MUMPS, from CasADi's wheel, converges in tens of milliseconds. It is the reference for
faster back ends, not a real-time controller. Solves are limited by iterations, never by time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from .casadi_problem import Nlp, build_nlp, pack, row_floor
from .problem import NmpcParameters
from .types import Array, NmpcInput, NmpcPlan
from .warm_start import Frame, status_of

MAX_ITERATIONS = 200
"""Iteration limit of a solve. Far starts and swaps in closed loop take at most 89, so that only
failures reach it.
"""


class CoupledSolver:
    """Base of the back ends that solve one problem for all chasers, warm-started from the last
    plans.
    """

    def __init__(
        self, params: NmpcParameters, n_chasers: int, program: Callable[[int], tuple[Nlp, Any]]
    ) -> None:
        self._frame = Frame(params, n_chasers)
        self._programs = {n: program(n) for n in range(1, n_chasers + 1)}

    def reset(self) -> None:
        """Discard all warm starts."""
        self._frame.plans = {}


class SingleShootingSolver(CoupledSolver, ABC):
    """Base of the back ends without states. Variables: the inputs stage by stage, scaled by their
    limits to -1 to 1.
    """

    @abstractmethod
    def _run(
        self, nlp: Nlp, program: Any, parameters: Array, floor: Array, start: Array
    ) -> tuple[Array, bool, bool, int]:
        """Solve the program. Returns the solution, whether it converged, whether the iteration
        limit was reached, and the number of iterations.
        """

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan:
        """Solve one tick; arguments, result and errors as `RtiSolver.solve`. The chasers share one
        status.

        ``iterations`` counts inner iterations.
        """
        frame = self._frame
        task = frame.begin(problem, shift_s, ids)
        u, limits = task.start.copy(), task.problem.input_max
        n, d = len(u), frame.params.stages
        nlp, program = self._programs[n]
        scale = np.where(limits > 0.0, limits, 1.0)[:, None, :]
        parameters = np.concatenate([pack(frame.params, task.problem), limits.ravel()])
        start = (u / scale).transpose(1, 0, 2).ravel()
        floor = row_floor(nlp, frame.params, task.problem).ravel()
        w, converged, late, iterations = self._run(nlp, program, parameters, floor, start)
        usable = (converged or late) and bool(np.isfinite(w).all())
        if usable:
            solution = np.asarray(w).reshape(d, n, 6).transpose(1, 0, 2)
            u = np.ascontiguousarray(np.clip(solution, -1.0, 1.0) * limits[:, None, :])
        return frame.finish(
            task, u, [status_of(usable, late)] * n, np.full(n, iterations, dtype=np.int64)
        )


class MultipleShootingSolver(CoupledSolver, ABC):
    """Base of the back ends with states for up to ``n_chasers`` chasers, warm-started from the last
    plans. ``PLUGIN``: CasADi's name of the solver.

    The constructor builds a program for every number of chasers, so that a change of the number
    delays no tick. ``max_iterations`` bounds a solve, MAX_ITERATIONS if None. Raises ValueError for
    n_chasers < 1.
    """

    PLUGIN: ClassVar[str]
    SOLVED: ClassVar[tuple[str, ...]] = ()
    LIMITED: ClassVar[tuple[str, ...]] = ()
    """Return codes of the solver for a usable solution (SOLVED) and for the iteration limit
    (LIMITED).
    """

    def __init__(
        self, params: NmpcParameters, n_chasers: int, max_iterations: int | None = None
    ) -> None:
        limit = MAX_ITERATIONS if max_iterations is None else max_iterations

        def program(n: int) -> tuple[Nlp, Any]:
            nlp = build_nlp(n, params)
            options = {"print_time": False, "error_on_fail": False, **self._options(nlp, limit)}
            return nlp, ca.nlpsol("nmpc", self.PLUGIN, nlp.problem, options)

        super().__init__(params, n_chasers, program)

    @abstractmethod
    def _options(self, nlp: Nlp, max_iterations: int) -> dict[str, Any]:
        """Return the options of CasADi for this solver."""

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan:
        """Solve one tick; arguments, result and errors as `RtiSolver.solve`. The chasers share one
        status.

        ``iterations`` counts those of the solver. The states are the solution's inputs rolled
        through the model.
        """
        frame = self._frame
        task = frame.begin(problem, shift_s, ids)
        u = task.start.copy()
        n, d = len(u), frame.params.stages

        nlp, program = self._programs[n]
        x, limits = frame.rolled(task, u), task.problem.input_max
        floor = row_floor(nlp, frame.params, task.problem)

        # Start and bounds of the variables and the constraints, in the order of `Nlp`.
        start, low, high, bottom, top = [], [], [], [], []
        input_columns = []
        for k in range(d + 1):
            free = np.full(13 * n, np.inf)
            inputs = limits.ravel() if k < d else np.zeros(0)
            slack = np.zeros(nlp.rows if k > 0 else 0)
            input_columns.append(sum(map(len, start)) + len(free))
            start += [x[:, k].ravel(), u[:, k].ravel() if k < d else inputs, slack]
            low += [-free, -inputs, slack]
            high += [free, inputs, slack + np.inf]
            defects = np.zeros((13 * n if k < d else 0) + (13 * n if k == 0 else 0))
            bottom += [defects, floor[k - 1] if k > 0 else slack]
            top += [defects, slack + np.inf]

        result = program(
            x0=np.concatenate(start),
            p=pack(frame.params, task.problem),
            lbx=np.concatenate(low),
            ubx=np.concatenate(high),
            lbg=np.concatenate(bottom),
            ubg=np.concatenate(top),
        )

        stats = program.stats()
        flat = np.array(result["x"]).ravel()
        solution = np.stack(
            [flat[at : at + 6 * n].reshape(n, 6) for at in input_columns[:d]], axis=1
        )

        code = str(stats.get("return_status", ""))
        solved = bool(stats["success"]) or code in self.SOLVED
        iterations = int(stats.get("iter_count", 0))
        late = not solved and (
            code in self.LIMITED or stats.get("unified_return_status") == "SOLVER_RET_LIMITED"
        )

        usable = (solved or late) and bool(np.isfinite(solution).all())
        if usable:
            u = np.clip(solution, -limits[:, None, :], limits[:, None, :])
        return frame.finish(
            task, u, [status_of(usable, late)] * n, np.full(n, iterations, dtype=np.int64)
        )


class IpoptSolver(MultipleShootingSolver):
    """The interior point method of Waechter and Biegler, Math. Program. 106 (2006)."""

    PLUGIN = "ipopt"
    SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
    LIMITED = ("Maximum_Iterations_Exceeded",)

    def _options(self, nlp: Nlp, max_iterations: int) -> dict[str, Any]:
        # ipopt relaxes bounds by default, which would violate the input box by 1e-8.
        return {
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "max_iter": max_iterations,
                "tol": 1e-6,
                "mu_init": 1e-2,
                "bound_relax_factor": 0.0,
            }
        }
