# SPDX-License-Identifier: Apache-2.0
"""Cost of the attitude error (paper, eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from chaserdock_models.arrays import Array

from chaserdock_controller.nmpc.term import ChaserStage, CostTerm, pointer, require_not_negative


@dataclass(frozen=True)
class AttitudeCost(CostTerm):
    """Weight |vec(q (x) q_ref*)|^2 at every stage, 1 (the vector part has no unit).

    The paper weights all four components, whose norm is always one. The vector part vanishes on
    the reference, and both signs of a quaternion cost the same. ``weight_final_orientation`` is
    added at the last stage.
    """

    weight_orientation: float
    weight_final_orientation: float

    MEMBERS = (pointer("attitude"),)

    def __post_init__(self) -> None:
        require_not_negative(self, "weight_orientation", "weight_final_orientation")

    def weights(self, falling: Array) -> Array:
        """Return the weights (D+1,), 1, which fall off along the horizon."""
        weights = self.weight_orientation * falling
        weights[-1] += self.weight_final_orientation
        return weights

    def cost(self, stage: ChaserStage, weights: Any) -> Any:
        """See `CostTerm.cost`; the gradient vanishes at 180 degrees, where C tilts it."""
        import casadi as ca

        from chaserdock_controller.nmpc.casadi_vectors import conjugate, multiply

        error = multiply(stage.x[6:10], conjugate(stage.reference[3:7]))[1:4]
        return weights * ca.sumsqr(error)
