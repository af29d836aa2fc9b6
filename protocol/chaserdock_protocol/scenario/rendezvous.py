# SPDX-License-Identifier: Apache-2.0
"""Success criteria of published rendezvous and docking tasks: speed by distance, cone, arrival, and
clearance after an abort.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from .fields import Index, NotNegative, Positive, Section, Vector, is_zero


class SpeedLimit(Section):
    """Largest speed of every chaser relative to the target (WRF) until its first abort: `speed_m_s`
    + `per_s` x (distance of the centres - `from_m`).
    """

    speed_m_s: Positive = Field(description="Speed at the distance `from_m`, m/s.")
    per_s: NotNegative = Field(default=0.0, description="Increase with the distance, 1/s.")
    from_m: NotNegative = Field(
        default=0.0, description="Distance at which the limit is `speed_m_s`, m."
    )
    within_m: Positive | None = Field(
        default=None,
        description="Distance up to which the limit applies, m. Without it: everywhere.",
    )


class ConeLimit(Section):
    """A cone with its apex at the target's centre that no chaser within `within_m` leaves until its
    first abort.
    """

    half_angle_deg: Annotated[float, Field(gt=0, lt=90, allow_inf_nan=False)] = Field(
        description="Half angle, degrees."
    )
    axis: Vector = Field(description="Axis (TRF), from the apex, any length but 0.")
    within_m: Positive = Field(description="Distance up to which the cone applies, m.")

    @model_validator(mode="after")
    def _check_axis(self) -> ConeLimit:
        if is_zero(self.axis):
            raise ValueError("axis: must not be 0")
        return self


class Arrival(Section):
    """Chasers that must come near the target, before any abort."""

    chasers: tuple[Index, ...] = Field(min_length=1, description="Numbers of the chasers, from 0.")
    distance_m: Positive = Field(description="Distance of the centres, m.")
    speed_m_s: Positive | None = Field(
        default=None,
        description="Largest speed relative to the target (WRF) on arrival, m/s. Without it: any.",
    )
    within_s: Positive | None = Field(
        default=None,
        description="Latest arrival, s of mission time. Without it: the end of the mission.",
    )
