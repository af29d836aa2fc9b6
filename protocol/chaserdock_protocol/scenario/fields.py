"""Kinds of values in a scenario file, each with its check."""

from __future__ import annotations

import math
import sys
from typing import Annotated, Any

from chaserdock_models import rotations
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator


def finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


# What normalizing leaves is off by less (1.5 epsilon, seen). To do it once more may change a last bit, again and again,
# and processes that are told of a scenario load it again.
_UNIT = 4.0 * sys.float_info.epsilon


def unit(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """A quaternion (w, x, y, z) of length 1 from one nearly so; of one that it gave, the same to the bit."""
    length = math.hypot(*q)
    if abs(length - 1.0) > 1e-3:
        raise ValueError(
            f"must be a quaternion (w, x, y, z) of unit length; this one has length {length:.6g}"
        )
    if abs(length - 1.0) <= _UNIT:
        return q
    w, x, y, z = rotations.normalize(q).tolist()
    return (w, x, y, z)


Number = Annotated[float, AfterValidator(finite)]
Positive = Annotated[float, AfterValidator(finite), Field(gt=0)]
NotNegative = Annotated[float, AfterValidator(finite), Field(ge=0)]
Vector = tuple[Number, Number, Number]
PositiveVector = tuple[Positive, Positive, Positive]
UnitQuaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(unit)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


class Section(BaseModel):
    """A table of the scenario file; unknown keys are errors, and so is text, or true, where a number belongs.

    A whole number may stand for any number. Arrays are tuples here, which strictness would not take a list for.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _arrays(cls, values: Any) -> Any:
        return {k: _frozen(v) for k, v in values.items()} if isinstance(values, dict) else values
