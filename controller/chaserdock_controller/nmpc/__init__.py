# SPDX-License-Identifier: Apache-2.0
"""Centralized nonlinear MPC: one problem, solved by a back end selected by name.

In the order of a tick: `stage` states the problem, `terms` and `problem` check it, `warm_start`
shifts the last plans, a back end linearizes and solves it (`rti` in C: native/problem.c and
planes.c, then ipm.c), and `plan_monitor` keeps what may be flown.
"""

from __future__ import annotations

from chaserdock_protocol import plugins
from chaserdock_protocol.scenario import SOLVERS

from .problem import NmpcParameters
from .types import NmpcInput, NmpcPlan, NmpcSolver

__all__ = ["BACK_ENDS", "NmpcInput", "NmpcParameters", "NmpcPlan", "NmpcSolver", "make_solver"]

BACK_ENDS = SOLVERS


def make_solver(
    name: str, params: NmpcParameters, n: int, max_iterations: int | None = None
) -> NmpcSolver:
    """Create the back end ``name`` for up to ``n`` chasers; ``max_iterations`` bounds a solve,
    counted by the back end.

    ``name`` is a built-in back end or an installed ``chaserdock.solvers`` entry point: a function
    of (params, n, max_iterations). Raises PluginError for an unknown name, ValueError for n < 1,
    MissingPackageError for a package that is not installed.
    """
    # Imports are local to avoid the start-up time of unused back ends.
    if name == "rti":
        from .rti import RtiSolver

        return RtiSolver(params, n, max_iterations)
    if name == "ipopt":
        from .casadi_nlp import IpoptSolver

        return IpoptSolver(params, n, max_iterations)
    if name == "open":
        from .open_backend import OpenSolver

        return OpenSolver(params, n, max_iterations)
    return plugins.make("solver", name, BACK_ENDS, params, n, max_iterations)
