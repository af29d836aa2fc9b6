"""Default back end: a real-time iteration, one structured QP per chaser and tick, in Numba.

Diehl, Bock and Schloeder, SIAM J. Control Optim. 43 (2005): the shifted inputs are rolled through the nonlinear
dynamics, everything is linearized about that rollout, and one quadratic programme is solved. The vector part
of q (x) q_ref* is linear in q, so the cost is exactly quadratic and needs no convexification. Limited by
iterations, never by time: equal inputs give equal plans.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numba import njit

from chaserdock_controller.nmpc import cost, ipm, riccati
from chaserdock_controller.nmpc.checks import check_ids, check_input, check_shift, warm_start
from chaserdock_controller.nmpc.cost import plan_cost, quadratic_model
from chaserdock_controller.nmpc.ipm import BROKEN, LIMIT, solve_qp
from chaserdock_controller.nmpc.kernels import RK_NODES, RK_WEIGHTS, roll, roll_linearized
from chaserdock_controller.nmpc.planes import REACH_SAFETY, build_rows, plan_violation
from chaserdock_controller.nmpc.problem import SLACK_L2, slack_l1_weight
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


def _make_kernel(source: str):
    """The compiled QP stage. ``source``, a digest of the modules it calls into, is held in the closure because
    Numba's cache key covers closures but not the functions that are called: without it, an edit in
    `riccati` would go on using the old machine code.
    """

    @njit(cache=True, error_model="numpy")
    def optimize(
        x, u, refs, u_ref, limits, c_mats, b_mats, h, weights_p, weights_q, weights_u,
        row_a, row_c, n_rows, prices, w2, codes, iterations, residuals,
    ):  # fmt: skip
        """One QP for each chaser about x (N, D+1, 13), u (N, D, 6); the new inputs replace u.

        Where the QP breaks down, u is left as it was.
        """
        assert len(source) > 0
        stages = u.shape[1]
        q_pos = np.zeros((stages + 1, 3, 3))
        q_att = np.zeros((stages + 1, 3, 3))
        qx = np.zeros((stages + 1, 12))
        r_diag = np.empty((stages, 6))
        r = np.empty((stages, 6))
        w_bar = np.empty((stages, 6))
        dx = np.zeros((stages + 1, 12))
        dw = np.zeros((stages, 6))
        for i in range(len(u)):
            quadratic_model(
                x[i], u[i], refs[i], u_ref[i], limits[i], weights_p, weights_q, weights_u,
                q_pos, q_att, qx, r_diag, r, w_bar,
            )  # fmt: skip
            code, iterations[i], residuals[i, 0], residuals[i, 1], _, _ = solve_qp(
                c_mats[i], b_mats[i], h, q_pos, q_att, qx, r_diag, r, w_bar, row_a[i], row_c[i], n_rows[i],
                prices[i], w2, dx, dw,
            )  # fmt: skip
            for k in range(stages):
                for c in range(6):
                    if not np.isfinite(dw[k, c]):
                        code = BROKEN
            codes[i] = code
            if code != BROKEN:
                for k in range(stages):
                    for c in range(6):
                        u[i, k, c] = min(max(w_bar[k, c] + dw[k, c], -1.0), 1.0) * limits[i, c]

    return optimize


def _source_digest() -> str:
    digest = hashlib.sha256()
    for module in (cost, riccati, ipm):
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()


_optimize = _make_kernel(_source_digest())


class RtiSolver:
    """Real-time iteration for up to ``n_chasers`` chasers; keeps the last plan of each as its warm start.

    Compiles on construction (seconds the first time on a machine, cached beside the source afterwards), so that
    no tick has to. Raises ValueError for n_chasers < 1.
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
        self._nodes, self._weights = RK_NODES[params.integrator], RK_WEIGHTS[params.integrator]
        # Per newton: the farthest that any admissible change of the inputs moves a chaser by stage k.
        times = params.dt_s * np.arange(params.stages + 1)
        self._reach = REACH_SAFETY * np.sqrt(3.0) / params.mass_kg * times**2
        self._plans: dict[int, Array] = {}
        self._compile()

    def _compile(self) -> None:
        d = self._params.stages
        state = np.zeros((1, 13))
        state[0, 6] = 1.0
        reference = np.zeros((1, d + 1, 7))
        reference[..., 3] = 1.0
        zero = np.zeros(1)
        nothing = NmpcInput(
            state,
            reference,
            np.zeros((1, d, 6)),
            np.zeros((d + 1, 3)),
            zero,
            np.zeros((1, 1)),
            np.zeros((1, 6)),
        )
        self.solve(nothing, 0.0)
        self.reset()

    def reset(self) -> None:
        """Forgets every warm start."""
        self._plans = {}

    def solve(self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None) -> NmpcPlan:
        """One tick. ``shift_s``: time since the previous call, s; ``ids``: who the rows are, 0..N-1 if None.

        The warm start follows the id: a chaser whose id was not in the previous call starts from its u_ref.
        Raises ValueError for what `check_input`, `check_ids` and `check_shift` refuse.
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
        c_mats, b_mats = np.empty((n, d, 12, 6)), np.empty((n, d, 12, 6))
        nodes, weights, h = self._nodes, self._weights, params.dt_s
        roll_linearized(
            x, u, limits, h, nodes, weights, params.mass_kg, self._inertia, self._inverse, c_mats, b_mats
        )
        refs, between = checked.references, np.asarray(checked.min_distance_chasers_m)
        row_a, row_c = np.empty((n, d + 1, n + 1, 3)), np.empty((n, d + 1, n + 1))
        n_rows = np.zeros((n, d + 1), dtype=np.int64)
        reach = np.max(limits[:, :3], axis=1)[:, None] * self._reach
        build_rows(
            x, refs, checked.target_positions, checked.min_distance_target_m, between,
            params.max_reference_distance_m, reach, row_a, row_c, n_rows,
        )  # fmt: skip
        codes, iterations = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        cost_, residuals, violation = np.empty(n), np.empty((n, 2)), np.empty(n)
        away = np.sqrt(np.sum((checked.states[:, :3] - refs[:, -1, :3]) ** 2, axis=1))
        prices = np.array([slack_l1_weight(params, float(m)) for m in away])
        _optimize(
            x, u, refs, checked.u_ref, limits, c_mats, b_mats, h, self._weights_p, self._weights_q,
            self._weights_u, row_a, row_c, n_rows, prices, SLACK_L2,
            codes, iterations, residuals,
        )  # fmt: skip
        roll(x, u, h, nodes, weights, params.mass_kg, self._inertia, self._inverse)
        plan_cost(x, u, refs, checked.u_ref, self._weights_p, self._weights_q, self._weights_u, cost_)
        plan_violation(
            x, refs, checked.target_positions, checked.min_distance_target_m, between,
            params.max_reference_distance_m, violation,
        )  # fmt: skip
        self._plans = {name: u[row].copy() for row, name in enumerate(names)}
        return NmpcPlan(
            inputs=u,
            states=x,
            status=tuple(_status(int(c), float(v)) for c, v in zip(codes, violation, strict=True)),
            iterations=iterations,
            cost=cost_,
            max_violation_m=violation,
        )


def _status(code: int, violation_m: float) -> str:
    if code == BROKEN:
        return FAILED
    if violation_m > VIOLATION_TOLERANCE_M:
        return INFEASIBLE_RELAXED
    return ITERATION_LIMIT if code == LIMIT else SOLVED
