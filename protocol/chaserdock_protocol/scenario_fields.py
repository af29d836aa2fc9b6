"""Kinds of values in a scenario file, each with its check."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from . import rotations


def finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


def unit(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    length = math.hypot(*q)
    if abs(length - 1.0) > 1e-3:
        raise ValueError(
            f"must be a quaternion (w, x, y, z) of unit length; this one has length {length:.6g}"
        )
    w, x, y, z = rotations.normalize(q).tolist()
    return (w, x, y, z)


Number = Annotated[float, AfterValidator(finite)]
Positive = Annotated[float, AfterValidator(finite), Field(gt=0)]
NotNegative = Annotated[float, AfterValidator(finite), Field(ge=0)]
Vector = tuple[Number, Number, Number]
PositiveVector = tuple[Positive, Positive, Positive]
UnitQuaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(unit)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]


class Section(BaseModel):
    """A table of the scenario file; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)
