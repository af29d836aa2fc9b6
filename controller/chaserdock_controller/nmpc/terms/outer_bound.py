# SPDX-License-Identifier: Apache-2.0
"""The ball about its reference that a chaser stays in (paper, 4d)."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double
from dataclasses import dataclass
from typing import Any

from chaserdock_controller.nmpc.term import ChaserConstraint, ChaserStage, require_positive
from chaserdock_controller.nmpc.types import NmpcInput


@dataclass(frozen=True)
class OuterBound(ChaserConstraint):
    """|p - p_ref| <= max_reference_distance_m. In C: the plane that touches the ball ahead of the
    chaser, `outer_and_corridor_rows` in native/planes.c.
    """

    max_reference_distance_m: float

    MEMBERS = (("outer", c_double),)
    DATA = 0

    def __post_init__(self) -> None:
        require_positive(self, "max_reference_distance_m")

    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the distance."""
        return (self.max_reference_distance_m,)

    def margin(self, stage: ChaserStage, data: Any) -> Any:
        """See `ChaserConstraint.margin`."""
        from chaserdock_controller.nmpc.casadi_vectors import norm

        return self.max_reference_distance_m - norm(stage.x[0:3] - stage.reference[0:3])
