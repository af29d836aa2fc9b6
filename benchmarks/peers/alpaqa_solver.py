# SPDX-License-Identifier: Apache-2.0
"""alpaqa on the problem of the NMPC, for comparison: PANOC with an augmented Lagrangian, the solver
family of the paper.

Single shooting of `build_nlp`: states are eliminated, and the augmented Lagrangian handles the
distances; its largest penalty corresponds to the slack. CasADi's alpaqa plugin has fixed settings
(tolerance 1e-10, L-BFGS memory 2) and prints at each call, so the wheel `alpaqa` is used (``pip
install alpaqa``). Limited by iterations, never by time.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from chaserdock_controller.nmpc import NmpcParameters
from chaserdock_controller.nmpc.casadi_nlp import SingleShootingSolver
from chaserdock_controller.nmpc.casadi_problem import Nlp, build_nlp
from chaserdock_models.arrays import Array

MAX_OUTER, MAX_INNER = 10, 100
# For inputs scaled by their limits: gradient in units of cost (initially about 1e3), and metres.
TOLERANCE, DISTANCE_TOLERANCE = 0.5, 1e-3


class AlpaqaSolver(SingleShootingSolver):
    """Solve with alpaqa for up to ``n_chasers`` chasers, warm-started from the last plans.

    ``max_iterations`` bounds the inner iterations of one outer step, MAX_INNER if None. Raises
    ValueError for n_chasers < 1 or where alpaqa is not installed.
    """

    def __init__(
        self, params: NmpcParameters, n_chasers: int, max_iterations: int | None = None
    ) -> None:
        try:
            import alpaqa  # pyright: ignore[reportMissingImports] (not a dependency)
        except ImportError:
            raise ValueError("'alpaqa' needs the package alpaqa: pip install alpaqa") from None
        inner = MAX_INNER if max_iterations is None else max_iterations
        inner_solver: Any = alpaqa.PANOCSolver({"max_iter": inner}, {"memory": 30})
        self._solver: Any = alpaqa.ALMSolver(
            alm_params={
                "tolerance": TOLERANCE,
                "dual_tolerance": DISTANCE_TOLERANCE,
                "max_iter": MAX_OUTER,
                "initial_penalty": 1e3,
                "max_penalty": 1e7,
                "penalty_update_factor": 10.0,
            },
            inner_solver=inner_solver,
        )
        self._alpaqa = alpaqa
        self._converged, self._late = (
            alpaqa.SolverStatus.Converged,
            (alpaqa.SolverStatus.MaxIter, alpaqa.SolverStatus.NoProgress),
        )

        def program(n: int) -> tuple[Nlp, Any]:
            nlp = build_nlp(n, params, shooting="single")
            return nlp, _callbacks(alpaqa, nlp)

        super().__init__(params, n_chasers, program)

    def _run(
        self, nlp: Nlp, program: Any, parameters: Array, floor: Array, start: Array
    ) -> tuple[Array, bool, bool, int]:
        program.parameters, program.general_bounds.lower = parameters, floor
        w, _, stats = self._solver(
            self._alpaqa.Problem(program), x=start, y=np.zeros(len(floor)), asynchronous=False
        )
        converged, late = stats["status"] == self._converged, stats["status"] in self._late
        return w, converged, late, int(stats["inner"]["iterations"])


def _callbacks(alpaqa: Any, nlp: Nlp) -> Any:
    """Wrap the problem in alpaqa's callback interface, evaluated by CasADi's virtual machine.

    alpaqa's CasADi loader needs a C compiler or a compatible CasADi file format (1.1.0a2 cannot
    read files of 3.8).
    """
    n = nlp.n
    x, p = nlp.problem["x"], nlp.problem["p"]
    # Inputs are scaled by their limits, which are the last parameters, so that the box is well
    # scaled.
    w, limits = ca.SX.sym("w", x.numel()), ca.SX.sym("limits", 6 * n)
    f, g = ca.Function("nlp", [x, p], [nlp.problem["f"], nlp.problem["g"]])(
        w * ca.repmat(limits, nlp.stages, 1), p
    )
    y, parameters = ca.SX.sym("y", g.numel()), ca.vertcat(p, limits)
    cost = ca.Function("f", [w, parameters], [f])
    gradient = ca.Function("grad_f", [w, parameters], [ca.gradient(f, w)])
    distances = ca.Function("g", [w, parameters], [g])
    gradient_product = ca.Function("grad_g_prod", [w, y, parameters], [ca.jtimes(g, w, y, True)])

    class Callbacks(alpaqa.BoxConstrProblem):
        def __init__(self) -> None:
            super().__init__(w.numel(), g.numel())
            self.variable_bounds.lower, self.variable_bounds.upper = np.full(
                (2, w.numel()), [[-1.0], [1.0]]
            )
            self.general_bounds.upper = np.full(g.numel(), np.inf)
            self.parameters = np.zeros(parameters.numel())

        def eval_objective(self, at: Array) -> float:
            return float(cost(at, self.parameters))

        def eval_objective_gradient(self, at: Array, out: Array) -> None:
            out[:] = gradient(at, self.parameters).full().ravel()

        def eval_constraints(self, at: Array, out: Array) -> None:
            out[:] = distances(at, self.parameters).full().ravel()

        def eval_constraints_gradient_product(
            self, at: Array, multipliers: Array, out: Array
        ) -> None:
            out[:] = gradient_product(at, multipliers, self.parameters).full().ravel()

    return Callbacks()
