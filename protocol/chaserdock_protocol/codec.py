# SPDX-License-Identifier: Apache-2.0
"""Encoding and decoding of messages, with validation of all external data."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import hypot, isfinite, isqrt
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import msgspec
from msgspec import Struct, inspect

from .messages import Message, encoding_of

MAX_BYTES = 17_000_000
"""Largest message: an image of the largest size (`Image.data`, 16 MB) and its other fields."""
UNIT_QUATERNION_TOLERANCE = 1e-6
"""Largest error of a quaternion's length: ten times the rounding of single precision."""
MAX_MAGNITUDE = 1e15
"""Bound of every float (SI units): beyond any mission, and small enough that its powers remain
finite.
"""

T = TypeVar("T", bound=Struct)

_encoder = msgspec.msgpack.Encoder()


class Rejected(Exception):
    """An invalid message. ``reason`` is a short stable identifier for counters."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


@cache
def _decoder(kind: type[Struct]) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(kind)


def encode(message: Struct) -> bytes:
    """Return the payload of a message, a msgpack map."""
    return _encoder.encode(message)


def decode(kind: type[T], payload: bytes, encoding: str | None = None) -> T:
    """Decode and validate a message of type ``kind``.

    Raises Rejected with reason ``encoding`` (another type or version), ``size``, ``format`` (no
    msgpack, wrong type or shape), ``not_finite``, ``range``, ``not_unit_quaternion`` or
    ``not_a_covariance``.
    """
    if encoding is not None and encoding != (expected := encoding_of(kind)):
        raise Rejected("encoding", f"got {encoding!r}, expected {expected!r}")
    if len(payload) > MAX_BYTES:
        raise Rejected("size", f"{len(payload)} bytes, at most {MAX_BYTES}")
    try:
        message = _decoder(kind).decode(payload)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise Rejected("format", str(error)) from None
    check_numbers(message)
    return message


def check_numbers(message: Struct) -> None:
    """Raise Rejected for an invalid number in a message.

    Every float must be finite and within ``MAX_MAGNITUDE``, every ``q_wxyz`` of unit length, no
    variance negative.
    """
    if not _passes_fast_check(message):
        _check_fields(message)


class _FieldGetters(NamedTuple):
    """Getters of a type's fields with floats, grouped by the required check."""

    numbers: Callable[[Any], tuple[float, ...]] | None
    rows: Callable[[Any], tuple[tuple[float, ...], ...]] | None
    quaternions: Callable[[Any], tuple[tuple[float, ...], ...]] | None
    covariances: Callable[[Any], tuple[tuple[float, ...], ...]] | None
    parts: Callable[[Any], tuple[tuple[Struct, ...] | None, ...]] | None
    optional: Callable[[Any], tuple[Struct | None, ...]] | None


def _passes_fast_check(message: Struct) -> bool:
    """Check all numbers of a message by a few calls into C; return True only if they are valid.

    False means that the detailed check must decide. ``hypot`` propagates NaN and infinity, and is
    at least as large as each component.
    """
    getters = _field_getters(type(message))
    if getters is None:
        return False
    numbers, rows, quaternions, covariances, *_ = getters
    if numbers is not None and not hypot(*numbers(message)) <= MAX_MAGNITUDE:
        return False
    if rows is not None:
        for row in rows(message):
            if not hypot(*row) <= MAX_MAGNITUDE:
                return False
    if quaternions is not None:
        for quaternion in quaternions(message):
            if not abs(hypot(*quaternion) - 1.0) <= UNIT_QUATERNION_TOLERANCE:
                return False
    if covariances is not None:
        for covariance in covariances(message):
            if not covariance or min(covariance[:: isqrt(len(covariance)) + 1]) < 0.0:
                return False
    return _parts_pass_fast_check(message, getters)


def _parts_pass_fast_check(message: Struct, getters: _FieldGetters) -> bool:
    if getters.optional is not None:
        for part in getters.optional(message):
            if part is not None and not _passes_fast_check(part):
                return False
    if getters.parts is not None:
        for several in getters.parts(message):
            for part in several or ():
                if not _passes_fast_check(part):
                    return False
    return True


@cache
def _field_getters(kind: type[Struct]) -> _FieldGetters | None:
    """Return the getters of a message type for the fast check.

    None for a type with floats in other kinds of fields, such as optional numbers.
    """
    numbers: list[str] = []
    rows: list[str] = []
    quaternions: list[str] = []
    covariances: list[str] = []
    parts: list[str] = []
    optional: list[str] = []
    info: Any = inspect.type_info(kind)
    for field in info.fields:
        match field.type:
            case inspect.FloatType():
                numbers.append(field.name)
            case (
                inspect.VarTupleType(item_type=inspect.StructType())
                | inspect.UnionType(
                    types=(inspect.VarTupleType(item_type=inspect.StructType()), inspect.NoneType())
                )
            ):
                parts.append(field.name)
            case inspect.UnionType(types=(inspect.StructType(), inspect.NoneType())):
                optional.append(field.name)
            case inspect.TupleType() | inspect.VarTupleType() if _is_row(field.type):
                if field.name == "q_wxyz":
                    quaternions.append(field.name)
                    continue
                rows.append(field.name)
                if "covariance" in field.name:
                    covariances.append(field.name)
            case other if holds_floats(other):
                return None
    return _FieldGetters(*map(_getter, (numbers, rows, quaternions, covariances, parts, optional)))


def _is_row(kind: inspect.TupleType | inspect.VarTupleType) -> bool:
    """Return whether a type is a tuple of floats only."""
    items = kind.item_types if isinstance(kind, inspect.TupleType) else (kind.item_type,)
    return all(isinstance(item, inspect.FloatType) for item in items)


def _getter(names: list[str]) -> Callable[[Any], Any] | None:
    """Return a function that returns these fields as a tuple, or None without names."""
    if len(names) > 1:
        return attrgetter(*names)
    return (lambda message: (getattr(message, names[0]),)) if names else None


def _check_fields(message: Struct) -> None:
    """Check field by field, so that the error names the first invalid one."""
    for name in _fields_with_floats(type(message)):
        value = getattr(message, name)
        if isinstance(value, float):
            if not -MAX_MAGNITUDE <= value <= MAX_MAGNITUDE:
                raise _bad_number(name, value)
        elif isinstance(value, Struct):
            _check_fields(value)
        elif value and isinstance(value, tuple):
            if isinstance(value[0], Struct):
                for item in value:
                    _check_fields(item)
            else:
                _check_tuple(name, value)


def _check_tuple(name: str, values: tuple[float, ...]) -> None:
    # One call into C for long tuples (a plan has hundreds of floats), as in _passes_fast_check.
    length = hypot(*values)
    if not length <= MAX_MAGNITUDE:
        for value in values:
            if not -MAX_MAGNITUDE <= value <= MAX_MAGNITUDE:
                raise _bad_number(name, value)
    if name == "q_wxyz":
        if abs(length - 1.0) > UNIT_QUATERNION_TOLERANCE:
            raise Rejected("not_unit_quaternion", f"{name} has length {length}")
    elif "covariance" in name:
        _check_covariance(name, values)


@cache
def _fields_with_floats(kind: type[Struct]) -> tuple[str, ...]:
    info: Any = inspect.type_info(kind)
    return tuple(field.name for field in info.fields if holds_floats(field.type))


def holds_floats(kind: inspect.Type) -> bool:
    """Return whether a field of this type may hold floats, directly or in structures. Raises
    TypeError for a type that ``check_numbers`` does not support."""
    match kind:
        case inspect.FloatType() | inspect.StructType():
            return True
        case inspect.UnionType(types=parts):
            return any(holds_floats(part) for part in parts)
        case inspect.VarTupleType(item_type=item):
            return holds_floats(item)
        case inspect.TupleType(item_types=items):
            held = {holds_floats(item) for item in items}
            if len(held) > 1:
                raise TypeError(f"floats and other types in one tuple: {items}")
            return held == {True}
        case inspect.DictType(value_type=value) if holds_floats(value):
            raise TypeError("floats in a dictionary")
        case _:
            return False


def _bad_number(name: str, value: float) -> Rejected:
    reason = "range" if isfinite(value) else "not_finite"
    return Rejected(reason, f"{name} holds {value}, beyond {MAX_MAGNITUDE:g}")


def _check_covariance(name: str, values: tuple[float, ...]) -> None:
    """Reject negative variances. Users that invert the matrix check that it is positive
    semi-definite.
    """
    step = isqrt(len(values)) + 1
    if min(values[::step]) < 0.0:
        raise Rejected("not_a_covariance", f"{name} has a negative variance")


def vector(array: Any) -> Any:
    """Return a flat tuple of Python floats, as messages hold them (NumPy scalars do not encode).

    Typed Any, as the type checker cannot know the length.
    """
    return tuple((array if array.ndim == 1 else array.ravel()).tolist())


_LATER_FIELDS = frozenset(
    {"given_thrusters_N_s", "geometry", "ranging", "expected", "acquiring", "commanded"}
)


def without_wall_time(message: Message) -> dict[str, Any]:
    """Return the fields of a message that are equal in two equal flights.

    Leaves out wall-clock times and process instances. Fields that came later are left out while
    they are empty, so that flights without them keep their digest.
    """
    return {
        name: value
        for name in message.__struct_fields__
        if not name.startswith("wall_")
        and name not in ("instance", "controllers", "chaser_instances", "mapper")
        if (value := getattr(message, name)) or name not in _LATER_FIELDS
    }
