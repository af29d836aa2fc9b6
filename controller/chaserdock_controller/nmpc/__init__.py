# SPDX-License-Identifier: Apache-2.0
"""Centralized nonlinear MPC: one problem (`problem`), solved by a back end selected by name."""

from __future__ import annotations

from chaserdock_protocol import plugins
from chaserdock_protocol.scenario import SOLVERS

from .types import NmpcInput, NmpcParameters, NmpcPlan, NmpcSolver

__all__ = ["BACK_ENDS", "NmpcInput", "NmpcParameters", "NmpcPlan", "NmpcSolver", "make_solver"]

BACK_ENDS = SOLVERS


def make_solver(
    name: str, params: NmpcParameters, n: int, max_iterations: int | None = None
) -> NmpcSolver:
    """Create the back end ``name`` for up to ``n`` chasers; ``max_iterations`` bounds a solve,
    counted by the back end.

    ``name`` is a built-in back end or an installed ``chaserdock.solvers`` entry point: a function
    of (params, n, max_iterations). Raises PluginError for an unknown name, ValueError for n < 1 or
    a package that is not installed.
    """
    # Imports are local to avoid the start-up time of unused back ends.
    if name == "rti":
        from .rti import RtiSolver

        return RtiSolver(params, n, max_iterations)
    if name in ("ipopt", "fatrop"):
        from .casadi_nlp import NlpSolver

        return NlpSolver(name, params, n, max_iterations)
    if name == "alpaqa":
        from .alpaqa_backend import AlpaqaSolver

        return AlpaqaSolver(params, n, max_iterations)
    if name == "open":
        from .open_backend import OpenSolver

        return OpenSolver(params, n, max_iterations)
    return plugins.load("solver", name, BACK_ENDS)(params, n, max_iterations)
