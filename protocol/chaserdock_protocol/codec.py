"""Messages to bytes and back, with everything from outside checked at this boundary."""

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
UNIT_QUATERNION_TOLERANCE = 1e-6
MAX_MAGNITUDE = 1e15
"""Bounds every float (SI units): far beyond any mission, and its powers stay finite in all that is worked out."""

T = TypeVar("T", bound=Struct)

_encoder = msgspec.msgpack.Encoder()


class Rejected(Exception):
    """A message that must not be used; ``reason`` is a short stable word to count it by."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


@cache
def _decoder(kind: type[Struct]) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(kind)


def encode(message: Struct) -> bytes:
    """Payload of a message: a msgpack map."""
    return _encoder.encode(message)


def decode(kind: type[T], payload: bytes, encoding: str | None = None) -> T:
    """Message of type ``kind`` from a payload, checked.

    Raises Rejected with reason ``encoding`` (another type or version than ``kind``'s), ``size``, ``format``
    (no msgpack, wrong type or shape), ``not_finite``, ``range``, ``not_unit_quaternion`` or ``not_a_covariance``.
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
    """Raises Rejected unless every float is finite and within ``MAX_MAGNITUDE``, every ``q_wxyz`` of unit length and
    no variance negative."""
    if not _surely_good(message):
        _check_one_by_one(message)


class _Plan(NamedTuple):
    """A type's fields with floats by what there is to check of them, each as what gets the values of a message."""

    numbers: Callable[[Any], tuple[float, ...]] | None
    rows: Callable[[Any], tuple[tuple[float, ...], ...]] | None
    quaternions: Callable[[Any], tuple[tuple[float, ...], ...]] | None
    covariances: Callable[[Any], tuple[tuple[float, ...], ...]] | None
    parts: Callable[[Any], tuple[tuple[Struct, ...], ...]] | None


def _surely_good(message: Struct) -> bool:
    """Whether all numbers of a message are good, as they nearly always are: all of it at the speed of C.

    False when it takes a closer look, which may still find nothing. NaN and infinity come through a ``hypot``, and no part
    is greater than the length.
    """
    plan = _plan(type(message))
    if plan is None:
        return False
    numbers, rows, quaternions, covariances, parts = plan
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
    return parts is None or all(_surely_good(part) for several in parts(message) for part in several)


@cache
def _plan(kind: type[Struct]) -> _Plan | None:
    """None for a type with a field of another kind, such as one that may be None."""
    numbers: list[str] = []
    rows: list[str] = []
    quaternions: list[str] = []
    covariances: list[str] = []
    parts: list[str] = []
    info: Any = inspect.type_info(kind)
    for field in info.fields:
        match field.type:
            case inspect.FloatType():
                numbers.append(field.name)
            case inspect.VarTupleType(item_type=inspect.StructType()):
                parts.append(field.name)
            case inspect.TupleType() | inspect.VarTupleType() if _is_row(field.type):
                if field.name == "q_wxyz":
                    quaternions.append(field.name)
                    continue
                rows.append(field.name)
                if field.name == "covariance":
                    covariances.append(field.name)
            case other if holds_floats(other):
                return None
    return _Plan(*map(_values_of, (numbers, rows, quaternions, covariances, parts)))


def _is_row(kind: inspect.TupleType | inspect.VarTupleType) -> bool:
    """Whether it is a tuple of floats and nothing else."""
    items = kind.item_types if isinstance(kind, inspect.TupleType) else (kind.item_type,)
    return all(isinstance(item, inspect.FloatType) for item in items)


def _values_of(names: list[str]) -> Callable[[Any], Any] | None:
    """What gets the fields of these names, as a tuple; None without names."""
    if len(names) > 1:
        return attrgetter(*names)
    return (lambda message: (getattr(message, names[0]),)) if names else None


def _check_one_by_one(message: Struct) -> None:
    """Field by field, so that a refusal names the first that is bad."""
    for name in _fields_with_floats(type(message)):
        value = getattr(message, name)
        if isinstance(value, float):
            if not -MAX_MAGNITUDE <= value <= MAX_MAGNITUDE:
                raise _bad_number(name, value)
        elif value and isinstance(value, tuple):
            if isinstance(value[0], Struct):
                for item in value:
                    _check_one_by_one(item)
                continue
            # Long ones (a plan has hundreds) at the speed of C: NaN and infinity come through, and no part is greater.
            length = hypot(*value)
            if not length <= MAX_MAGNITUDE:
                for item in value:
                    if not -MAX_MAGNITUDE <= item <= MAX_MAGNITUDE:
                        raise _bad_number(name, item)
            if name == "q_wxyz":
                if abs(length - 1.0) > UNIT_QUATERNION_TOLERANCE:
                    raise Rejected("not_unit_quaternion", f"{name} has length {length}")
            elif name == "covariance":
                _check_covariance(value)


@cache
def _fields_with_floats(kind: type[Struct]) -> tuple[str, ...]:
    info: Any = inspect.type_info(kind)
    return tuple(field.name for field in info.fields if holds_floats(field.type))


def holds_floats(kind: inspect.Type) -> bool:
    """Whether a field of this type may hold floats, in itself or in structures. Raises TypeError for one that
    ``check_numbers`` does not go through."""
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
                raise TypeError(f"floats beside others in a tuple: {items}")
            return held == {True}
        case inspect.DictType(value_type=value) if holds_floats(value):
            raise TypeError("floats in a dictionary")
        case _:
            return False


def _bad_number(name: str, value: float) -> Rejected:
    reason = "range" if isfinite(value) else "not_finite"
    return Rejected(reason, f"{name} holds {value}, beyond {MAX_MAGNITUDE:g}")


def _check_covariance(values: tuple[float, ...]) -> None:
    """Variances are not negative. That the whole is positive semi-definite is left to those who invert it."""
    step = isqrt(len(values)) + 1
    if min(values[::step]) < 0.0:
        raise Rejected("not_a_covariance", "covariance has a negative variance")


def vector(array: Any) -> Any:
    """Flat tuple of Python floats, as messages carry numbers (NumPy scalars do not encode).

    Typed Any, as only the caller knows the length that its field wants.
    """
    return tuple(array.ravel().tolist())


def without_wall_time(message: Message) -> dict[str, Any]:
    """The message as a dictionary without its wall-clock fields, and the words that are new at each start of a process:
    what two equal flights must agree in."""
    return {
        name: getattr(message, name)
        for name in message.__struct_fields__
        if not name.startswith("wall_") and name not in ("instance", "standing_by")
    }
