# SPDX-License-Identifier: Apache-2.0
"""Mapping of a target of unknown shape (docs/unknown-target.md)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from chaserdock_protocol.messages import ONE_PLACE, PortKind, one_place

from .fields import Index, NotNegative, Positive, Section, Vector

WorkSeconds = Annotated[float, Field(ge=0.2, le=60, allow_inf_nan=False)]


class MapLimits(Section):
    """What the mapper must achieve with a target of unknown shape; the last map must have
    distances.
    """

    within_s: Positive = Field(
        default=15.0, description="Time of the images of the first map at the latest, s."
    )
    rate_percent: Positive = Field(
        default=1.0, description="Largest error of the rate vector of the last map, %."
    )


class Mapping(Section):
    """Work of the mapper with `perception.name = "features"`."""

    first_period_s: WorkSeconds = Field(
        default=1.0, description="Interval of attempts at a first map, s, rounded to images."
    )
    period_s: WorkSeconds = Field(
        default=6.0,
        description="Interval of improvements of a map, s, rounded to images. Each takes 0.5 to "
        "3 s of processor time.",
    )
    latency_s: WorkSeconds = Field(
        default=4.0,
        description="Age at which a map begins to count, s: longer than the work on it, so that "
        "in lock-step no tick waits.",
    )


class PortChoice(Section):
    """Where a port is to be on a target of unknown shape: `image` and `pixel`, or `point_m`, or
    `find`.
    """

    image: Index | None = Field(
        default=None, description="Number of the chaser in whose newest image `pixel` is."
    )
    pixel: tuple[NotNegative, NotNegative] | None = Field(
        default=None, description="Column and row of the place in the image, from 0, px."
    )
    point_m: Vector | None = Field(
        default=None, description="The place of the surface nearest to this one (TRF), m."
    )
    find: PortKind | None = Field(
        default=None,
        description="`flat`: the best of all flat places with a free corridor; `ring`: the middle "
        "of the best ring.",
    )
    radii_m: tuple[NotNegative, Positive] | None = Field(
        default=None, description="`ring`: least and greatest radius, m; without it, any."
    )

    @model_validator(mode="after")
    def _check_one(self) -> PortChoice:
        if not one_place(self):
            raise ValueError(ONE_PLACE)
        return self
