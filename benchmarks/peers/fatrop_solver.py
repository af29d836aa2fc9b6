# SPDX-License-Identifier: Apache-2.0
"""fatrop on the problem of the NMPC, for comparison: an interior-point method with a Riccati
recursion over the stages, from CasADi's wheel. Limited by iterations, never by time.
"""

from __future__ import annotations

from typing import Any

from chaserdock_controller.nmpc.casadi_nlp import MultipleShootingSolver
from chaserdock_controller.nmpc.casadi_problem import Nlp


class FatropSolver(MultipleShootingSolver):
    """fatrop for up to ``n_chasers`` chasers, warm-started from the last plans."""

    PLUGIN = "fatrop"
    LIMITED = ("1",)

    def _options(self, nlp: Nlp, max_iterations: int) -> dict[str, Any]:
        states, inputs, rows = zip(*nlp.stage_sizes, strict=True)
        equality: list[bool] = []
        for k in range(nlp.stages + 1):
            following = states[k + 1] if k < nlp.stages else 0
            equality += [True] * following + [k == 0] * rows[k]
        return {
            "structure_detection": "manual",
            "N": nlp.stages,
            "nx": list(states),
            "nu": list(inputs),
            "ng": list(rows),
            "equality": equality,
            "fatrop": {"print_level": 0, "max_iter": max_iterations, "tol": 1e-6, "mu_init": 1e-2},
        }
