# SPDX-License-Identifier: Apache-2.0
"""Value types of a scenario file, and the base classes of its sections."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from chaserdock_models import rotations
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

MAX_CHASERS = 64
"""Largest number of chasers of a scenario: the largest whose costs and flights are measured
(docs/evidence/scale.md).
"""

LARGEST = 1e12
"""Bound on the magnitude of every number, so that squares and products of values stay finite."""

SMALLEST = 1e-12
"""Least positive number, so that squares, products and inverses of values stay above zero and
finite. Vectors shorter than this are zero.
"""

# Normalization leaves an error of at most 1.5 epsilon. A quaternion within this tolerance is kept
# to the bit: the resolved scenario is validated again by every process, and a second normalization
# could change the last bit.
_UNIT_TOLERANCE = 4.0 * sys.float_info.epsilon


def unit(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Normalize a quaternion (w, x, y, z). Idempotent to the bit. Raises ValueError for a length
    off 1 by over 1e-3.
    """
    length = math.hypot(*q)
    if abs(length - 1.0) > 1e-3:
        raise ValueError(
            f"must be a quaternion (w, x, y, z) of unit length; this one has length {length:.6g}"
        )
    if abs(length - 1.0) <= _UNIT_TOLERANCE:
        return q
    w, x, y, z = rotations.normalize(q).tolist()
    return (w, x, y, z)


def _unit_vector(v: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.hypot(*v)
    if abs(length - 1.0) > 1e-3:
        raise ValueError(f"must be of unit length; this one has length {length:.6g}")
    return (v[0] / length, v[1] / length, v[2] / length)


def is_zero(v: tuple[float, ...]) -> bool:
    """Return whether a vector is zero, and so has no direction."""
    return math.hypot(*v) < SMALLEST


def _not_tiny(value: float) -> float:
    if value < SMALLEST:
        raise ValueError(f"must be at least {SMALLEST:g}")
    return value


Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=LARGEST, allow_inf_nan=False), AfterValidator(_not_tiny)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Index = Annotated[int, Field(ge=0)]
Vector = tuple[Number, Number, Number]
PositiveVector = tuple[Positive, Positive, Positive]
UnitVector = Annotated[Vector, AfterValidator(_unit_vector)]
UnitQuaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(unit)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]


def _to_tuples(value: Any) -> Any:
    return tuple(_to_tuples(item) for item in value) if isinstance(value, list) else value


class Section(BaseModel):
    """A table of the scenario file. Unknown keys are errors; types are strict, but an integer may
    stand for a float.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _arrays_to_tuples(cls, values: Any) -> Any:
        return {k: _to_tuples(v) for k, v in values.items()} if isinstance(values, dict) else values


class EulerAngles(Section):
    """Attitude as intrinsic z-y-x Euler angles: yaw about Z, then pitch about the new Y, then roll
    about the new X.
    """

    roll: Number = Field(default=0.0, description="Rotation about X, degrees; applied last.")
    pitch: Number = Field(default=0.0, description="Rotation about Y, degrees; applied second.")
    yaw: Number = Field(default=0.0, description="Rotation about Z, degrees; applied first.")

    def quaternion(self) -> tuple[float, float, float, float]:
        """Return q_wxyz, body to parent frame."""
        r, p, y = (math.radians(angle) for angle in (self.roll, self.pitch, self.yaw))
        about_zy = rotations.multiply(rotations.exp([0.0, 0.0, y]), rotations.exp([0.0, p, 0.0]))
        w, x, y, z = rotations.multiply(about_zy, rotations.exp([r, 0.0, 0.0])).tolist()
        return (w, x, y, z)


def _half_angle(cosine: float, sine: float) -> tuple[float, float]:
    """Return cosine and sine of half the angle (-pi to pi) whose cosine and sine are given."""
    c, s = math.sqrt(max(0.0, 1.0 + cosine) / 2.0), math.sqrt(max(0.0, 1.0 - cosine) / 2.0)
    # The smaller root loses digits to cancellation; compute it from the larger one.
    if c > 2.0 * s:
        s = abs(sine) / (2.0 * c)
    elif s > 2.0 * c:
        c = abs(sine) / (2.0 * s)
    return c, math.copysign(s, sine) if sine else s


# Relative distance from the Z axis below which the yaw is undefined, and set to 0.
_ON_AXIS = 1e-15


def facing_origin(position_m: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Return the q_wxyz that points +X from ``position_m`` at the origin without roll (yaw, then
    pitch).
    """
    # Scaled, so that subnormal coordinates keep their digits.
    largest = max(map(abs, position_m))
    x, y, z = (v / largest for v in position_m)
    across, distance = math.hypot(x, y), math.hypot(x, y, z)
    yaw_c, yaw_s = _half_angle(-x / across, -y / across) if across > _ON_AXIS else (1.0, 0.0)
    pitch_c, pitch_s = _half_angle(across / distance, z / distance)
    # yaw about Z times pitch about Y; "+ 0.0" turns -0.0 into 0.0.
    return (
        yaw_c * pitch_c + 0.0,
        -yaw_s * pitch_s + 0.0,
        yaw_c * pitch_s + 0.0,
        yaw_s * pitch_c + 0.0,
    )


ATTITUDE_KEYS = ("q_wxyz", "attitude_deg", "look_at")
"""Alternative keys for an attitude. A table may have one of them; an override or a variant of a
scenario replaces the others.
"""
_VECTOR: TypeAdapter[Vector] = TypeAdapter(Vector)


class Oriented(Section):
    """A table whose ``q_wxyz`` may be given as Euler angles instead; the resolved scenario has
    ``q_wxyz`` alone.
    """

    attitude_deg: EulerAngles | None = Field(
        default=None,
        exclude=True,
        description="Alternative to `q_wxyz`: Euler angles `{ roll, pitch, yaw }` in degrees, "
        "intrinsic z-y-x.",
    )

    @model_validator(mode="before")
    @classmethod
    def _resolve_attitude(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        present = [k for k in ATTITUDE_KEYS if k in cls.model_fields and values.get(k) is not None]
        if len(present) > 1:
            raise ValueError(f"{' and '.join(present)} exclude each other; give one of them")
        if present and present[0] != "q_wxyz":
            return _with_quaternion(values, present[0])
        return values


def _with_quaternion(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Replace ``attitude_deg`` or ``look_at`` by ``q_wxyz``. Keys that are not valid remain, and
    are reported later.
    """
    resolved = {**values, "q_wxyz": (1.0, 0.0, 0.0, 0.0)}
    try:
        if key == "attitude_deg":
            resolved["q_wxyz"] = EulerAngles.model_validate(values[key]).quaternion()
        elif values[key] == "target":
            position = _VECTOR.validate_python(_to_tuples(values.get("position_m")), strict=True)
            resolved["q_wxyz"] = facing_origin(position) if any(position) else resolved["q_wxyz"]
    except ValidationError:
        return resolved
    if key == "attitude_deg" or values[key] == "target":
        del resolved[key]
    return resolved


LookAt = Literal["target"]
