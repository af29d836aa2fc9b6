"""Back end `ipopt`: the problem of `problem.build_nlp`, solved to convergence by CasADi and ipopt (MUMPS).

Tens of milliseconds a tick: the yardstick for faster back ends rather than a controller for real time.
Limited by iterations, never by time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from chaserdock_controller.nmpc.checks import check_ids, check_input, check_shift, warm_start
from chaserdock_controller.nmpc.cost import plan_cost
from chaserdock_controller.nmpc.kernels import RK_NODES, RK_WEIGHTS, roll
from chaserdock_controller.nmpc.planes import plan_violation
from chaserdock_controller.nmpc.problem import Nlp, build_nlp, slack_l1_weight
from chaserdock_controller.nmpc.types import (
    FAILED,
    INFEASIBLE_RELAXED,
    ITERATION_LIMIT,
    SOLVED,
    VIOLATION_TOLERANCE_M,
    Array,
    NmpcInput,
    NmpcParameters,
    NmpcPlan,
)

MAX_ITERATIONS = 200
# ipopt's own words for an answer that can be flown, and for the best it had when it ran out of iterations.
_GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
_LIMIT = ("Maximum_Iterations_Exceeded",)


@dataclass(frozen=True)
class _Compiled:
    nlp: Nlp
    solver: Any


class IpoptSolver:
    """ipopt for up to ``n_chasers`` chasers; keeps the last plan of each as its warm start.

    One programme is built for each number of chasers met, the one for ``n_chasers`` at construction.
    Raises ValueError for n_chasers < 1.
    """

    def __init__(self, params: NmpcParameters, n_chasers: int) -> None:
        if n_chasers < 1:
            raise ValueError(f"n_chasers must be at least 1, not {n_chasers}")
        self._params = params
        self._n_max = n_chasers
        self._weights_p, self._weights_q = params.stage_weights()
        self._weights_u = np.array([params.weight_force] * 3 + [params.weight_torque] * 3)
        self._inertia = np.array(params.inertia_kg_m2, dtype=float)
        self._inverse = np.ascontiguousarray(np.linalg.inv(self._inertia))
        self._programmes: dict[int, _Compiled] = {}
        self._plans: dict[int, Array] = {}
        self._programme(n_chasers)

    def reset(self) -> None:
        """Forgets every warm start."""
        self._plans = {}

    def _programme(self, n: int) -> _Compiled:
        if n not in self._programmes:
            nlp = build_nlp(n, self._params)
            options = {
                "print_time": False,
                "error_on_fail": False,
                "ipopt": {
                    "print_level": 0,
                    "sb": "yes",
                    "max_iter": MAX_ITERATIONS,
                    "tol": 1e-6,
                    "mu_init": 1e-2,
                    # Bounds are relaxed by default and the input box would be left by 1e-8.
                    "bound_relax_factor": 0.0,
                },
            }
            self._programmes[n] = _Compiled(nlp, ca.nlpsol("nmpc", "ipopt", nlp.problem, options))
        return self._programmes[n]

    def solve(self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None) -> NmpcPlan:
        """One tick; arguments, answer and errors as `RtiSolver.solve`. The chasers share one status.

        ``iterations`` counts ipopt's. The states are the answer's inputs rolled through the model.
        """
        params = self._params
        checked = check_input(problem, params, self._n_max)
        n, d = len(checked.states), params.stages
        names = check_ids(ids, n)
        shift_s = check_shift(shift_s)
        limits = checked.input_max
        u = warm_start(self._plans, names, checked, shift_s, params.dt_s)
        x = np.empty((n, d + 1, 13))
        x[:, 0] = checked.states
        self._roll(x, u)

        programme = self._programme(n)
        nlp = programme.nlp
        farthest = float(
            np.max(np.linalg.norm(checked.states[:, :3] - checked.references[:, -1, :3], axis=-1))
        )
        between = np.asarray(checked.min_distance_chasers_m)
        upper = between[np.triu_indices(n, 1)]
        parameters: list[Array] = []
        for i in range(n):
            parameters += [checked.states[i], checked.references[i].ravel(), checked.u_ref[i].ravel()]
        parameters += [checked.target_positions.ravel(), checked.min_distance_target_m, upper]
        parameters.append(np.array([slack_l1_weight(params, farthest)]))
        box = np.full((n, d, 19), np.inf)
        box[:, :, :6] = limits[:, None, :]
        slack = np.zeros(nlp.n_slack)
        answer = programme.solver(
            x0=np.concatenate([np.concatenate([u, x[:, 1:]], axis=2).ravel(), slack]),
            p=np.concatenate(parameters),
            lbx=np.concatenate([-box.ravel(), slack]),
            ubx=np.concatenate([box.ravel(), slack + np.inf]),
            lbg=0.0,
            ubg=np.concatenate([np.zeros(nlp.n_equal), np.full(nlp.n_slack, np.inf)]),
        )
        stats = programme.solver.stats()
        solution = np.array(answer["x"]).ravel()[: n * nlp.chaser_size].reshape(n, d, 19)[:, :, :6]
        code = str(stats["return_status"])
        usable = code in _GOOD + _LIMIT and bool(np.isfinite(solution).all())
        if usable:
            u = np.ascontiguousarray(np.clip(solution, -limits[:, None, :], limits[:, None, :]))
            self._roll(x, u)
        cost, violation = np.empty(n), np.empty(n)
        plan_cost(
            x, u, checked.references, checked.u_ref, self._weights_p, self._weights_q, self._weights_u, cost
        )
        plan_violation(
            x, checked.references, checked.target_positions, checked.min_distance_target_m, between,
            params.max_reference_distance_m, violation,
        )  # fmt: skip
        self._plans = {name: u[row].copy() for row, name in enumerate(names)}
        return NmpcPlan(
            inputs=u,
            states=x,
            status=tuple(_status(usable, code, float(v)) for v in violation),
            iterations=np.full(n, int(stats["iter_count"]), dtype=np.int64),
            cost=cost,
            max_violation_m=violation,
        )

    def _roll(self, x: Array, u: Array) -> None:
        name = self._params.integrator
        roll(
            x, u, self._params.dt_s, RK_NODES[name], RK_WEIGHTS[name], self._params.mass_kg,
            self._inertia, self._inverse,
        )  # fmt: skip


def _status(usable: bool, code: str, violation_m: float) -> str:
    if not usable:
        return FAILED
    if violation_m > VIOLATION_TOLERANCE_M:
        return INFEASIBLE_RELAXED
    return ITERATION_LIMIT if code in _LIMIT else SOLVED
