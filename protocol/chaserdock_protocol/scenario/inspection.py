# SPDX-License-Identifier: Apache-2.0
"""Inspection of the target: the flight around it during which its geometry is estimated
(docs/markerless.md).
"""

from __future__ import annotations

from pydantic import Field, model_validator

from .fields import Positive, Section, Vector, is_zero


class Inspection(Section):
    """Flight around the target by the command `inspect`. During it, panel angles and scale of a
    known mesh are estimated.
    """

    distance_m: Positive = Field(default=1.4, description="Distance from the target's centre, m.")
    speed_m_s: Positive = Field(
        default=0.08, description="Largest speed of the reference relative to the target, m/s."
    )
    axis: Vector = Field(
        default=(1.0, 1.0, 1.0),
        description="Axis of the turn (TRF), any length but 0. Chasers that are commanded "
        "together keep their angles to each other.",
    )

    @model_validator(mode="after")
    def _check_axis(self) -> Inspection:
        if is_zero(self.axis):
            raise ValueError("axis must not be zero")
        return self
