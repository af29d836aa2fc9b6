# SPDX-License-Identifier: Apache-2.0
"""acados on the problem of the NMPC, for comparison: SQP-RTI, HPIPM and compiled code.

"coupled" is one optimal control problem of all chasers; "decoupled" is one for each chaser, solved
in sequence in one thread, with the others' last plans as moving obstacles. Needs acados_template
and its libraries (ACADOS_SOURCE_DIR), and a C compiler at run time. Two constraints that are
inactive in the hard case are omitted, which favours acados: the outer bound and the corridors.
"""

from __future__ import annotations

import importlib
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from chaserdock_controller.nmpc import NmpcInput, NmpcParameters, NmpcPlan
from chaserdock_controller.nmpc.casadi_model import dynamics
from chaserdock_controller.nmpc.casadi_vectors import multiply
from chaserdock_controller.nmpc.slack import SLACK_L2, slack_l1_weight
from chaserdock_controller.nmpc.terms.attitude import AttitudeCost
from chaserdock_controller.nmpc.terms.input import InputCost
from chaserdock_controller.nmpc.terms.position import PositionCost
from chaserdock_controller.nmpc.warm_start import Frame, PreparedProblem, status_of
from chaserdock_models.arrays import Array

KINDS = ("coupled", "decoupled")
# Lateral offset of the initial guess, m: the linearization at an exactly head-on path has no
# descent direction sideways.
SIDESTEP_M = 0.2
# SQP iterations of a cold start: with a single one the first seconds follow a poor plan, which
# costs 4 to 9 %.
COLD_ITERATIONS = 10


@dataclass(frozen=True)
class SolveTime:
    """Times of a solve: acados' own total time (wall clock), and the processor time of the thread
    around the call.
    """

    wall_s: float
    cpu_s: float


def _acados() -> Any:
    return importlib.import_module("acados_template")


def _model(name: str, own: int, others: int, params: NmpcParameters) -> tuple[Any, int]:
    """Return the AcadosModel of ``own`` chasers among ``others`` obstacles, and its number of
    distances.

    Parameters of a stage: target (3), keep-outs (own), distances of own pairs, obstacles (3
    others), distances to them.
    """
    step = dynamics(params)
    pairs = [(i, j) for i in range(own) for j in range(i + 1, own)]
    x, u = ca.SX.sym("x", 13 * own), ca.SX.sym("u", 6 * own)
    target, keep_out, distances = (
        ca.SX.sym("target", 3),
        ca.SX.sym("d", own),
        ca.SX.sym("pairs", len(pairs)),
    )
    obstacles, clear = ca.SX.sym("obstacles", 3, others), ca.SX.sym("clear", own * others)
    at = [x[13 * i : 13 * i + 3] for i in range(own)]
    margins = [ca.norm_2(p - target) - keep_out[i] for i, p in enumerate(at)]
    margins += [ca.norm_2(at[i] - at[j]) - distances[row] for row, (i, j) in enumerate(pairs)]
    margins += [
        ca.norm_2(p - obstacles[:, j]) - clear[i * others + j]
        for i, p in enumerate(at)
        for j in range(others)
    ]
    model = _acados().AcadosModel()
    model.name, model.x, model.u = name, x, u
    model.p = ca.vertcat(target, keep_out, distances, ca.vec(obstacles), clear)
    model.disc_dyn_expr = ca.vertcat(
        *(step(x[13 * i : 13 * i + 13], u[6 * i : 6 * i + 6]) for i in range(own))
    )
    model.con_h_expr = model.con_h_expr_e = ca.vertcat(*margins)
    return model, len(margins)


def _ocp(name: str, own: int, others: int, params: NmpcParameters, folder: str) -> Any:
    """Return the AcadosOcp of that model, whose code is generated in ``folder``."""
    d, nx, nu = params.stages, 13 * own, 6 * own
    ocp = _acados().AcadosOcp()
    ocp.model, rows = _model(name, own, others, params)
    ocp.parameter_values = np.ones(ocp.model.p.numel())

    # Every residual is linear in x and u once q_ref is known; Vx is set with it.
    position, orientation, inputs = (
        params.weights[term]
        for kind in (PositionCost, AttitudeCost, InputCost)
        for term in params.of_kind(kind)
    )
    ocp.cost.cost_type = ocp.cost.cost_type_0 = ocp.cost.cost_type_e = "LINEAR_LS"
    squares = [position[0]] * 3 * own + [orientation[0]] * 3 * own + [*inputs[0]] * own
    ocp.cost.W = 2.0 * np.diag(squares)
    ocp.cost.W_e = 2.0 * np.diag([position[-1]] * 3 * own + [orientation[-1]] * 3 * own)
    ocp.cost.Vx, ocp.cost.Vx_e = np.zeros((12 * own, nx)), np.zeros((6 * own, nx))
    ocp.cost.Vu = np.vstack([np.zeros((nu, nu)), np.eye(nu)])
    ocp.cost.yref, ocp.cost.yref_e = np.zeros(12 * own), np.zeros(6 * own)
    ocp.cost.W_0, ocp.cost.Vx_0, ocp.cost.Vu_0 = ocp.cost.W, ocp.cost.Vx, ocp.cost.Vu
    ocp.cost.yref_0 = ocp.cost.yref

    box = np.ones(nu)
    ocp.constraints.idxbu, ocp.constraints.lbu, ocp.constraints.ubu = np.arange(nu), -box, box
    ocp.constraints.x0 = np.zeros(nx)
    for end in ("", "_e"):
        setattr(ocp.constraints, f"lh{end}", np.zeros(rows))
        setattr(ocp.constraints, f"uh{end}", np.full(rows, _acados().ACADOS_INFTY))
        setattr(ocp.constraints, f"idxsh{end}", np.arange(rows))
        for side in "lu":
            setattr(ocp.cost, f"z{side}{end}", np.ones(rows))
            setattr(ocp.cost, f"Z{side}{end}", np.full(rows, SLACK_L2))

    options = ocp.solver_options
    options.N_horizon, options.tf = d, d * params.dt_s
    options.cost_scaling = np.ones(d + 1)
    options.nlp_solver_type, options.integrator_type = "SQP_RTI", "DISCRETE"
    options.hessian_approx, options.qp_solver = "GAUSS_NEWTON", "PARTIAL_CONDENSING_HPIPM"
    options.qp_tol, options.qp_solver_iter_max = 1e-6, 100
    # The fastest of the options tried: BALANCE takes 1.3 to 1.7 times as long; condensing helps
    # small stages only.
    options.hpipm_mode = "SPEED"
    options.qp_solver_cond_N = d if own > 1 else max(1, d // 5)
    ocp.code_gen_options.ext_fun_compile_flags = "-O3 -march=native"
    ocp.code_gen_options.code_export_directory = folder
    ocp.code_gen_options.json_file = f"{name}.json"
    return ocp


def _orientation_map(q_ref: Array) -> Array:
    """Return M (3, 4) with M q = vec(q (x) q_ref*)."""
    q = ca.SX.sym("q", 4)
    w, v = q_ref[0], q_ref[1:]
    return np.array(ca.evalf(ca.jacobian(multiply(q, ca.vertcat(w, *(-v)))[1:4], q)))


class AcadosSolver:
    """acados with the interface of `NmpcSolver`, ``kind`` "coupled" or "decoupled", for exactly
    ``n`` chasers.

    ``solve_time`` is the time of the last solve inside acados, without the transfer of the problem
    by Python; of a cold start, that of its last SQP iteration. Code is generated and compiled at
    construction. Raise ValueError for another kind or a falloff.
    """

    def __init__(self, kind: str, params: NmpcParameters, n: int) -> None:
        if kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
        if params.falloff:
            raise ValueError("acados is set up for weights that do not fall off")
        self._frame, self.solve_time = Frame(params, n), SolveTime(0.0, 0.0)
        self._groups = [list(range(n))] if kind == "coupled" else [[i] for i in range(n)]
        self._q_refs: list[Array] = [np.zeros(0)] * len(self._groups)
        own = len(self._groups[0])
        self._solvers: list[Any] = []
        with tempfile.TemporaryDirectory(prefix="acados_") as folder:
            ocp = _ocp(f"{kind}_{n}", own, n - own, params, folder)
            for group in self._groups:
                first = group[0] == 0
                make = _acados().AcadosOcpSolver
                self._solvers.append(
                    make(
                        ocp, generate=first, build=first, check_reuse_possible=False, verbose=False
                    )
                )

    def reset(self) -> None:
        """Discard all warm starts."""
        self._frame.plans = {}

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan:
        """Solve one tick; arguments, result and errors as `RtiSolver.solve`; ValueError for
        corridors or another number of chasers.

        ``iterations`` are those of HPIPM. The states are the rollout of the inputs through the
        model.
        """
        frame = self._frame
        cold = not frame.plans
        task = frame.begin(problem, shift_s, ids)
        if np.any(task.problem.corridors) or len(task.names) != frame.n_max:
            raise ValueError(f"acados is set up for {frame.n_max} chasers without corridors")
        guess = frame.rolled(task, task.start)
        if cold:
            guess[:, :, :3] += sidestep(task)
        u, statuses = task.start.copy(), [""] * len(task.start)
        wall_s, cpu_s, iterations = 0.0, 0.0, np.zeros(len(u), dtype=np.int64)
        for row, (group, solver) in enumerate(zip(self._groups, self._solvers, strict=True)):
            self._set_problem(row, task, guess)
            for _ in range(COLD_ITERATIONS - 1 if cold else 0):
                solver.solve()
            begin_s = time.thread_time()
            status = solver.solve()
            cpu_s += time.thread_time() - begin_s
            wall_s += float(solver.get_stats("time_tot"))
            inputs = np.array([solver.get(k, "u") for k in range(frame.params.stages)])
            usable = status == 0 and bool(np.isfinite(inputs).all())
            late = bool(np.any(solver.get_stats("qp_stat")))
            if usable:
                limits = task.problem.input_max[group, None, :]
                u[group] = np.clip(
                    inputs.reshape(-1, len(group), 6).swapaxes(0, 1), -limits, limits
                )
            for i in group:
                statuses[i], iterations[i] = (
                    status_of(usable, late),
                    int(np.sum(solver.get_stats("qp_iter"))),
                )
        self.solve_time = SolveTime(wall_s, cpu_s)
        return frame.finish(task, u, statuses, iterations)

    def _set_problem(self, row: int, task: PreparedProblem, guess: Array) -> None:
        """Pass the tick's problem and the initial guess (N, D+1, 13) to the solver of group
        ``row``.
        """
        solver, group, params = self._solvers[row], self._groups[row], self._frame.params
        p, d, own = task.problem, params.stages, len(group)
        others = [i for i in range(len(p.states)) if i not in group]
        q_refs = p.references[group, :, 3:]
        if not np.array_equal(
            self._q_refs[row], q_refs
        ):  # setting it makes acados factorize the cost again
            self._q_refs[row] = q_refs.copy()
            for k in range(d + 1):
                vx = np.zeros((12 * own if k < d else 6 * own, 13 * own))
                for i in range(own):
                    vx[3 * i : 3 * i + 3, 13 * i : 13 * i + 3] = np.eye(3)
                    at = 3 * own + 3 * i
                    vx[at : at + 3, 13 * i + 6 : 13 * i + 10] = _orientation_map(q_refs[i, k])
                solver.cost_set(k, "Vx", vx, api="new")
        away_m = np.linalg.norm(p.states[group, :3] - p.references[group, -1, :3], axis=-1)
        slack_weight = slack_l1_weight(params, away_m.max(keepdims=True))
        distances = np.asarray(p.min_distance_chasers_m)
        between = distances[np.ix_(group, group)][np.triu_indices(own, 1)]
        clear = distances[np.ix_(group, others)].ravel()
        limits = p.input_max[group].ravel()
        start = p.states[group].ravel()
        solver.set(0, "lbx", start)
        solver.set(0, "ubx", start)
        for k in range(d + 1):
            y = [p.references[group, k, :3].ravel(), np.zeros(3 * own)]
            obstacles = guess[others, k, :3].ravel()
            values = [
                p.target_positions[k],
                p.min_distance_target_m[group, k],
                between,
                obstacles,
                clear,
            ]
            solver.set(k, "p", np.concatenate(values))
            solver.set(k, "x", guess[group, k].ravel())
            if k > 0:
                solver.cost_set(
                    k, "zl", np.full(own + len(between) + len(clear), float(slack_weight[0]))
                )
            if k < d:
                y.append(p.u_ref[group, k].ravel())
                solver.set(k, "u", task.start[group, k].ravel())
                solver.constraints_set(k, "lbu", -limits)
                solver.constraints_set(k, "ubu", limits)
            solver.set(k, "yref", np.concatenate(y))


def sidestep(task: PreparedProblem) -> Array:
    """Return the offsets (N, D+1, 3), m, of an initial guess at rest: a path to the reference, bent
    to its right.
    """
    p = task.problem
    path = p.references[:, -1, :3] - p.states[:, :3]
    right = np.cross(path, [0.0, 0.0, 1.0])
    right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-9)
    along = np.linspace(0.0, 1.0, p.references.shape[1])[None, :, None]
    return along * path[:, None] + SIDESTEP_M * np.sin(np.pi * along) * right[:, None] * (
        np.linalg.norm(path, axis=-1)[:, None, None] > SIDESTEP_M
    )
