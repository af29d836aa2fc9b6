# SPDX-License-Identifier: Apache-2.0
"""Solvers that the benchmark `nmpc.py` compares with the product's, each on the same problem."""

from __future__ import annotations

from chaserdock_controller.nmpc import NmpcParameters, NmpcSolver

PEERS = ("fatrop", "alpaqa", "acados_coupled", "acados_decoupled")


def make_peer(name: str, params: NmpcParameters, n: int) -> NmpcSolver:
    """Create the peer ``name`` for ``n`` chasers. Raises ValueError where it is not installed."""
    if name == "fatrop":
        from .fatrop_solver import FatropSolver

        return FatropSolver(params, n)
    if name == "alpaqa":
        from .alpaqa_solver import AlpaqaSolver

        return AlpaqaSolver(params, n)
    from .acados_solver import AcadosSolver

    try:
        return AcadosSolver(name.removeprefix("acados_"), params, n)
    except (ImportError, OSError, RuntimeError) as error:
        raise ValueError(str(error)) from error
