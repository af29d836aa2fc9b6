"""Centralized nonlinear MPC: one problem (`problem`), solved by a back end chosen by name."""

from __future__ import annotations

from chaserdock_controller.nmpc.types import NmpcInput, NmpcParameters, NmpcPlan, NmpcSolver

__all__ = ["BACK_ENDS", "NmpcInput", "NmpcParameters", "NmpcPlan", "NmpcSolver", "make_solver"]

BACK_ENDS = ("rti", "ipopt")


def make_solver(name: str, params: NmpcParameters, n: int) -> NmpcSolver:
    """The back end ``name`` for up to ``n`` chasers. Raises ValueError for an unknown name or n < 1."""
    # Imported here so that the one does not cost the start-up time of the other.
    if name == "rti":
        from chaserdock_controller.nmpc.rti import RtiSolver

        return RtiSolver(params, n)
    if name == "ipopt":
        from chaserdock_controller.nmpc.ipopt import IpoptSolver

        return IpoptSolver(params, n)
    raise ValueError(f"unknown NMPC back end {name!r}; known: {', '.join(BACK_ENDS)}")
