# SPDX-License-Identifier: Apache-2.0
"""Cost of the inputs (paper, eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array

from chaserdock_controller.nmpc.term import ChaserStage, CostTerm, pointer, require_positive


@dataclass(frozen=True)
class InputCost(CostTerm):
    """Weight (u - u_ref)^2 of each axis: ``weight_force`` in 1/N^2, ``weight_torque`` in 1/(N m)^2.

    Positive, as the QP of a chaser needs a strictly convex cost of the inputs.
    """

    weight_force: float
    weight_torque: float

    MEMBERS = (pointer("input"),)

    def __post_init__(self) -> None:
        require_positive(self, "weight_force", "weight_torque")

    def weights(self, falling: Array) -> Array:
        """Return the weights (D+1, 6); the last stage has no input."""
        axes = [self.weight_force] * 3 + [self.weight_torque] * 3
        return np.array([axes] * (len(falling) - 1) + [[0.0] * 6])

    def cost(self, stage: ChaserStage, weights: Any) -> Any:
        """See `CostTerm.cost`."""
        import casadi as ca

        return ca.dot(weights, (stage.u_ref - stage.u) ** 2)
