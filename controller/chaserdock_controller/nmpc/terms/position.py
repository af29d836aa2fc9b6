# SPDX-License-Identifier: Apache-2.0
"""Cost of the position error (paper, eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from chaserdock_models.arrays import Array

from chaserdock_controller.nmpc.term import ChaserStage, CostTerm, pointer, require_not_negative


@dataclass(frozen=True)
class PositionCost(CostTerm):
    """Weight (1/m^2) |p - p_ref|^2 at every stage; ``weight_final_position`` is added at the
    last.
    """

    weight_position: float
    weight_final_position: float

    MEMBERS = (pointer("position"),)

    def __post_init__(self) -> None:
        require_not_negative(self, "weight_position", "weight_final_position")

    def weights(self, falling: Array) -> Array:
        """Return the weights (D+1,), 1/m^2, which fall off along the horizon."""
        weights = self.weight_position * falling
        weights[-1] += self.weight_final_position
        return weights

    def cost(self, stage: ChaserStage, weights: Any) -> Any:
        """See `CostTerm.cost`."""
        import casadi as ca

        return weights * ca.sumsqr(stage.reference[0:3] - stage.x[0:3])

    def final_slope(self, distance_m: Array) -> Array:
        """Return the slope (1/m) of the cost of the last stage at distances from the reference."""
        return 2.0 * (self.weight_final_position + self.weight_position) * distance_m
