"""Default back end: a real-time iteration, one structured QP per chaser and tick, in Numba.

Diehl, Bock and Schloeder, SIAM J. Control Optim. 43 (2005): the shifted inputs are rolled through the nonlinear
dynamics, everything is linearized about that rollout, and one quadratic programme is solved. The vector part
of q (x) q_ref* is linear in q, so the cost is exactly quadratic and needs no convexification. Limited by
iterations, never by time: equal inputs give equal plans.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from chaserdock_controller.nmpc.cost import quadratic_model
from chaserdock_controller.nmpc.frame import Frame, Task, worded
from chaserdock_controller.nmpc.ipm import BROKEN, LIMIT, MAX_ITERATIONS, solve_qp
from chaserdock_controller.nmpc.kernels import roll_linearized
from chaserdock_controller.nmpc.planes import REACH_SAFETY, build_rows
from chaserdock_controller.nmpc.slack import SLACK_L2, slack_l1_weight
from chaserdock_controller.nmpc.types import Array, IntArray, NmpcInput, NmpcParameters, NmpcPlan


class RtiSolver:
    """Real-time iteration for up to ``n_chasers`` chasers; keeps the last plan of each as its warm start.

    ``max_iterations`` bounds the interior point's iterations of all chasers together in one solve; each
    chaser may take what is left, shared evenly over those to come, and at most `ipm.MAX_ITERATIONS`.
    Compiles on construction (seconds the first time on a machine, cached beside the source afterwards), so that
    no tick has to. Raises ValueError for n_chasers < 1 or a negative budget.
    """

    def __init__(self, params: NmpcParameters, n_chasers: int, max_iterations: int | None = None) -> None:
        self._frame = Frame(params, n_chasers)
        if max_iterations is not None and max_iterations < 0:
            raise ValueError(f"max_iterations must not be negative, not {max_iterations}")
        self._budget = max_iterations
        # Per newton: the farthest that any admissible change of the inputs moves a chaser by stage k.
        times = params.dt_s * np.arange(params.stages + 1)
        self._reach = REACH_SAFETY * np.sqrt(3.0) / params.mass_kg * times**2
        self._compile()

    def _compile(self) -> None:
        """Solves a problem of which every kernel has its part."""
        d = self._frame.params.stages
        state = np.zeros((1, 13))
        state[0, 6] = 1.0
        reference = np.zeros((1, d + 1, 7))
        reference[..., 3] = 1.0
        target = np.zeros((d + 1, 3))
        zero = np.zeros(1)
        self.solve(NmpcInput(state, reference, np.zeros((1, d, 6)), target, zero, 0.0, np.zeros((1, 6))), 0.0)
        self.reset()

    def reset(self) -> None:
        """Forgets every warm start."""
        self._frame.plans = {}

    def solve(self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None) -> NmpcPlan:
        """One tick. ``shift_s``: time since the previous call, s; ``ids``: who the rows are, 0..N-1 if None.

        The warm start follows the id: a chaser whose id was not in the previous call starts from its u_ref.
        Raises ValueError for what `check_input`, `check_ids` and `check_shift` refuse.
        """
        frame = self._frame
        task = frame.begin(problem, shift_s, ids)
        checked, u = task.problem, task.start.copy()
        n, d = len(u), frame.params.stages
        x, mats = np.empty((n, d + 1, 13)), np.empty((n, d, 12, 12))
        x[:, 0] = checked.states
        h, *model = frame.model
        roll_linearized(x, u, checked.input_max, h, *model, mats)
        width = d * (n + 2)
        stage, n_rows = np.empty((n, width), dtype=np.int64), np.zeros(n, dtype=np.int64)
        row_a, row_c = np.empty((n, width, 3)), np.empty((n, width))
        reach = np.max(checked.input_max[:, :3], axis=1)[:, None] * self._reach
        build_rows(
            x, checked.references, checked.target_positions, checked.min_distance_target_m, task.between,
            frame.params.max_reference_distance_m, task.corridors, reach, stage, row_a, row_c, n_rows,
        )  # fmt: skip
        rows = (stage, row_a, row_c, n_rows)
        status, iterations = self._optimize(task, x, u, mats, rows)
        return frame.finish(task, u, status, iterations)

    def _optimize(
        self, task: Task, x: Array, u: Array, mats: Array, rows: tuple[IntArray, Array, Array, IntArray]
    ) -> tuple[list[str], IntArray]:
        """One QP for each chaser about x (N, D+1, 13), u (N, D, 6); the new inputs replace u.

        Where the QP breaks down, u is left as it was. Returns the status and the iterations of each.
        """
        p, frame = task.problem, self._frame
        stage, row_a, row_c, n_rows = rows
        n, d = len(u), frame.params.stages
        q_pos, q_att, qx = np.empty((d + 1, 3, 3)), np.empty((d + 1, 3, 3)), np.empty((d + 1, 12))
        r_diag, r, w_bar = np.empty((d, 6)), np.empty((d, 6)), np.empty((d, 6))
        dx, dw = np.empty((d + 1, 12)), np.empty((d, 6))
        mul = np.empty(2 * stage.shape[1] + 12 * d)
        status, iterations = [], np.zeros(n, dtype=np.int64)
        left = self._budget if self._budget is not None else n * MAX_ITERATIONS
        for i in range(n):
            away_m = float(np.linalg.norm(p.states[i, :3] - p.references[i, -1, :3]))
            quadratic_model(
                x[i], u[i], p.references[i], p.u_ref[i], p.input_max[i], frame.weights_p, frame.weights_q,
                frame.weights_u, q_pos, q_att, qx, r_diag, r, w_bar,
            )  # fmt: skip
            code, iterations[i], _, _ = solve_qp(
                mats[i], frame.params.dt_s, q_pos, q_att, qx, r_diag, r, w_bar, stage[i], row_a[i], row_c[i],
                n_rows[i], slack_l1_weight(frame.params, away_m), SLACK_L2,
                min(MAX_ITERATIONS, -(-left // (n - i))), dx, dw, mul,
            )  # fmt: skip
            left -= int(iterations[i])
            usable = code != BROKEN and bool(np.isfinite(dw).all())
            if usable:
                u[i] = np.clip(w_bar + dw, -1.0, 1.0) * p.input_max[i]
            status.append(worded(usable, code == LIMIT))
        return status, iterations
