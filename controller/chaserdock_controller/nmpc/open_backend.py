# SPDX-License-Identifier: Apache-2.0
"""Back end `open`: OpEn (Optimization Engine), the paper's solver, through opengen.

Sopasakis, Fresk and Patrinos, "OpEn: Code generation for embedded nonconvex optimization", IFAC
2020: PANOC over the box of inputs, single shooting.

A quadratic penalty of fixed weight in the cost enforces the distances. OpEn's own constraints
(`with_penalty_constraints`, `with_aug_lagrangian_constraints`) are not used: opengen differentiates
every distance separately and writes tens of megabytes of C for four chasers, too much to compile.

opengen writes Rust code for each number of chasers; cargo compiles it, which takes a minute once.
The library is cached under a digest of the problem in ``$XDG_CACHE_HOME/chaserdock/open``
(``~/.cache``). Solves are limited by iterations, never by time.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from chaserdock_protocol.errors import MissingPackageError, how_to_install

from .casadi_nlp import SingleShootingSolver
from .casadi_problem import Nlp, build_nlp
from .problem import NmpcParameters
from .types import Array

MAX_INNER = 500
"""Iteration limit of PANOC in a solve. Larger: slower solves; smaller: more plans end before they
converge. Half and twice were not tried, as OpEn takes minutes to compile.
"""
TOLERANCE = 1e-3
"""Norm of the fixed-point residual at which PANOC stops, for inputs scaled by their limits. Larger:
faster, less exact plans; smaller: more iterations. Half and twice were not tried.
"""
PENALTY = 1e6
"""Penalty weight: twice the cost of one square metre of violation, 1/m^2. A multiplier of 1e3
violates by 1 mm.
"""
_NEVER_US = 60_000_000
"""OpEn requires a time limit, us; this one is never reached, since iterations limit a solve."""
# Suffixes of shared libraries from cargo, and of Python extension modules.
_LIBRARY_SUFFIXES = (".so", ".dylib", ".dll")
_SUFFIX = {"win32": ".pyd"}


def missing_part() -> str | None:
    """Return, as an error message, what this machine lacks to compile the solver; None if
    nothing.
    """
    if importlib.util.find_spec("opengen") is None:
        return f"solver 'open' needs the package opengen: {how_to_install('open')}"
    if shutil.which("cargo") is None:
        return "solver 'open' needs cargo, Rust's build tool, on the PATH: see https://rustup.rs"
    return None


class OpenSolver(SingleShootingSolver):
    """Solve with OpEn for up to ``n_chasers`` chasers, warm-started from the last plans.

    ``max_iterations`` bounds the iterations of a solve, MAX_INNER if None. Raises ValueError for
    n_chasers < 1, MissingPackageError where opengen or cargo is not installed.
    """

    def __init__(
        self, params: NmpcParameters, n_chasers: int, max_iterations: int | None = None
    ) -> None:
        missing = missing_part()
        if missing is not None:
            raise MissingPackageError(missing)
        inner = MAX_INNER if max_iterations is None else max_iterations

        def program(n: int) -> tuple[Nlp, Any]:
            nlp = build_nlp(n, params, shooting="single", symbol=ca.MX.sym)
            return nlp, _load_solver(nlp, inner)

        super().__init__(params, n_chasers, program)

    def _run(
        self, nlp: Nlp, program: Any, parameters: Array, floor: Array, start: Array
    ) -> tuple[Array, bool, bool, int]:
        answer = program.run(
            p=np.concatenate([parameters, floor]).tolist(), initial_guess=start.tolist()
        )
        if not answer.is_ok():
            return start, False, False, 0
        status = answer.get()
        converged = status.exit_status == "Converged"
        return np.array(status.solution), converged, not converged, int(status.num_inner_iterations)


def _evaluate(nlp: Nlp, x: Any, p: Any) -> tuple[Any, Any]:
    """Return cost and distances of a program of MX symbols at ``x`` and ``p``."""
    symbols = [ca.symvar(nlp.problem["x"]), ca.symvar(nlp.problem["p"])]
    arguments = []
    for values, parts in zip((x, p), symbols, strict=True):
        pieces = ca.vertsplit(values, [0, *np.cumsum([s.numel() for s in parts]).tolist()])
        arguments += [ca.reshape(piece, *s.shape) for piece, s in zip(pieces, parts, strict=True)]
    function = ca.Function("nlp", [*symbols[0], *symbols[1]], [nlp.problem["f"], nlp.problem["g"]])
    cost, distances = function.call(arguments, True, False)
    return cost, distances


def _load_solver(nlp: Nlp, inner: int) -> Any:
    """Return the compiled solver of a problem, from the cache or newly built."""
    import opengen as og  # pyright: ignore[reportMissingImports] (an extra)

    # Inputs scaled by their limits give a well scaled box. Lower bounds of the distances are
    # parameters.
    inputs, distances = 6 * nlp.n * nlp.stages, nlp.stages * nlp.rows
    w, p = ca.MX.sym("w", inputs), ca.MX.sym("p", nlp.problem["p"].numel())
    limits, floor = ca.MX.sym("limits", 6 * nlp.n), ca.MX.sym("floor", distances)
    f, g = _evaluate(nlp, w * ca.repmat(limits, nlp.stages, 1), p)
    violation = ca.fmin(0, g - floor)
    cost = f + 0.5 * PENALTY * ca.dot(violation, violation)
    parameters = ca.MX.sym("parameters", p.numel() + limits.numel() + distances)
    parts = ca.vertsplit(parameters, [0, p.numel(), p.numel() + limits.numel(), parameters.numel()])
    whole = ca.Function("whole", [w, p, limits, floor], [cost])
    cost = whole.call([w, *parts], True, False)[0]
    text = ca.Function("all", [w, parameters], [cost]).serialize()
    name = (
        "open_"
        + hashlib.sha256(f"{text} {inner} {TOLERANCE} {sys.version}".encode()).hexdigest()[:16]
    )
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "chaserdock" / "open"
    library = cache / f"{name}{_SUFFIX.get(sys.platform, '.so')}"
    if not library.exists():
        _build(og, name, cache, og.builder.Problem(w, parameters, cost), inputs, inner, library)
    spec = importlib.util.spec_from_file_location(name, library)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.solver()


def _build(
    og: Any, name: str, cache: Path, problem: Any, size: int, inner: int, library: Path
) -> None:
    """Generate Rust code with opengen and compile it to ``library``. Raises RuntimeError with
    cargo's output.
    """
    problem = problem.with_constraints(og.constraints.Rectangle([-1.0] * size, [1.0] * size))
    solver = (
        og.config.SolverConfiguration()
        .with_tolerance(TOLERANCE)
        .with_initial_tolerance(TOLERANCE)
        .with_lbfgs_memory(30)
        .with_max_inner_iterations(inner)
        .with_max_outer_iterations(1)
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
    # opengen writes temporary files into the current folder.
    with contextlib.chdir(cache):
        builder = og.builder.OpEnOptimizerBuilder(problem, meta, build, solver)
        builder.with_verbosity_level(logging.WARNING).with_generate_not_build_flag(True).build()

    # opengen would compile the solver twice and its dependencies again for each problem.
    target = cache / "target"
    completed = subprocess.run(
        ["cargo", "build", "-q", "--release"],
        cwd=cache / name / f"python_bindings_{name}",
        env=os.environ | {"CARGO_TARGET_DIR": str(target)},
        capture_output=True,
        text=True,
    )
    if completed.returncode:
        raise RuntimeError(f"cargo failed to compile the OpEn solver:\n{completed.stderr}")

    built = next(
        path for path in (target / "release").glob(f"*{name}.*") if path.suffix in _LIBRARY_SUFFIXES
    )
    built.replace(library)
    shutil.rmtree(cache / name)
