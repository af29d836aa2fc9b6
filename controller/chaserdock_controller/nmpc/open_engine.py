"""Back end `open`: OpEn (Optimization Engine), the paper's own solver, through opengen.

Sopasakis, Fresk and Patrinos, "OpEn: Code generation for embedded nonconvex optimization", IFAC 2020: PANOC over the
box of inputs, single shooting, distances by augmented Lagrangian. opengen writes Rust and has cargo compile
it, minutes for each problem; the result is kept in ``$XDG_CACHE_HOME/chaserdock/open`` (``~/.cache``), under a
digest of the problem. Limited by iterations, never by time.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from chaserdock_controller.nmpc.frame import Frame, worded
from chaserdock_controller.nmpc.nlp import pack, row_floor
from chaserdock_controller.nmpc.problem import Nlp, build_nlp
from chaserdock_controller.nmpc.types import NmpcInput, NmpcParameters, NmpcPlan

MAX_OUTER, MAX_INNER = 20, 500
TOLERANCE, ROOM_TOLERANCE = 1e-3, 1e-4
# Far beyond any solve: OpEn wants a time, and ours are limited by iterations.
_NEVER_US = 60_000_000


class OpenSolver:
    """OpEn for up to ``n_chasers`` chasers; keeps each one's plan as its warm start.

    ``max_iterations`` bounds the inner iterations of one outer step, MAX_INNER if None. Raises ValueError for
    n_chasers < 1 or where opengen or cargo is not installed.
    """

    def __init__(self, params: NmpcParameters, n_chasers: int, max_iterations: int | None = None) -> None:
        self._frame = Frame(params, n_chasers)
        if importlib.util.find_spec("opengen") is None:
            raise ValueError("solver 'open' needs the package opengen: pip install 'chaserdock[open]'")
        if shutil.which("cargo") is None:
            raise ValueError(
                "solver 'open' needs cargo, Rust's build tool, on the PATH: see https://rustup.rs"
            )
        inner = MAX_INNER if max_iterations is None else max_iterations
        self._programmes: dict[int, tuple[Nlp, Any]] = {}
        for n in range(1, n_chasers + 1):
            nlp = build_nlp(n, params, shooting="single")
            self._programmes[n] = nlp, _built(nlp, inner)

    def reset(self) -> None:
        """Forgets every warm start."""
        self._frame.plans = {}

    def solve(self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None) -> NmpcPlan:
        """One tick; arguments, answer and errors as `RtiSolver.solve`. The chasers share one status.

        ``iterations`` counts the inner ones.
        """
        frame = self._frame
        task = frame.begin(problem, shift_s, ids)
        u, limits = task.start.copy(), task.problem.input_max
        n, d = len(u), frame.params.stages
        nlp, programme = self._programmes[n]
        scale = np.where(limits > 0.0, limits, 1.0)[:, None, :]
        answer = programme.run(
            p=[*pack(frame.params, task), *limits.ravel(), *row_floor(nlp, task).ravel()],
            initial_guess=(u / scale).transpose(1, 0, 2).ravel().tolist(),
        )
        usable, late, iterations = False, False, 0
        if answer.is_ok():
            status = answer.get()
            solution = np.array(status.solution).reshape(d, n, 6).transpose(1, 0, 2)
            late = status.exit_status != "Converged"
            usable = bool(np.isfinite(solution).all())
            iterations = int(status.num_inner_iterations)
            if usable:
                u = np.ascontiguousarray(np.clip(solution, -1.0, 1.0) * limits[:, None, :])
        return frame.finish(task, u, [worded(usable, late)] * n, np.full(n, iterations, dtype=np.int64))


def _built(nlp: Nlp, inner: int) -> Any:
    """The compiled solver of a problem, from the cache or fresh."""
    import opengen as og

    x, p, rooms = nlp.problem["x"], nlp.problem["p"], nlp.stages * nlp.rows
    # Inputs as shares of their limits, a well-scaled box. OpEn's set for the distances cannot change from solve
    # to solve, so their lower bounds are parameters.
    w, limits, floor = (
        ca.SX.sym(name, size) for name, size in (("w", x.numel()), ("m", 6 * nlp.n), ("g", rooms))
    )
    f, g = ca.Function("nlp", [x, p], [nlp.problem["f"], nlp.problem["g"]])(
        w * ca.repmat(limits, nlp.stages, 1), p
    )
    parameters = ca.vertcat(p, limits, floor)
    text = ca.Function("all", [w, parameters], [f, g - floor]).serialize()
    settings = f"{inner} {MAX_OUTER} {TOLERANCE} {ROOM_TOLERANCE} {sys.version} {og.__file__}"
    name = "open_" + hashlib.sha256((text + settings).encode()).hexdigest()[:16]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "chaserdock" / "open"
    folder = cache / name
    if not (folder / "done").exists():
        _build(og, name, cache, og.builder.Problem(w, parameters, f), w.numel(), g - floor, inner)
        (folder / "done").touch()
    found = next(folder.glob(f"{name}*.so"), None) or next(folder.glob(f"{name}*.pyd"))
    spec = importlib.util.spec_from_file_location(name, found)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.solver()


def _build(og: Any, name: str, cache: Path, problem: Any, size: int, rooms: Any, inner: int) -> None:
    above = og.constraints.Rectangle([0.0] * rooms.numel(), None)
    problem = problem.with_constraints(og.constraints.Rectangle([-1.0] * size, [1.0] * size))
    problem = problem.with_aug_lagrangian_constraints(rooms, above)
    solver = (
        og.config.SolverConfiguration()
        .with_tolerance(TOLERANCE)
        .with_initial_tolerance(1e-2)
        .with_delta_tolerance(ROOM_TOLERANCE)
        .with_lbfgs_memory(30)
        .with_max_inner_iterations(inner)
        .with_max_outer_iterations(MAX_OUTER)
        .with_initial_penalty(1e3)
        .with_penalty_weight_update_factor(10.0)
        .with_max_duration_micros(_NEVER_US)
    )
    build = (
        og.config.BuildConfiguration()
        .with_build_directory(str(cache))
        .with_build_mode("release")
        .with_build_python_bindings()
    )
    meta = og.config.OptimizerMeta().with_optimizer_name(name)
    cache.mkdir(parents=True, exist_ok=True)
    og.builder.OpEnOptimizerBuilder(problem, meta, build, solver).build()
