"""Messages to bytes and back, with everything from outside checked at this boundary."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, TypeVar

import msgspec
from msgspec import Struct, inspect

from .messages import Message, encoding_of

MAX_BYTES = 17_000_000
UNIT_QUATERNION_TOLERANCE = 1e-6
GREATEST_NUMBER = 1e15
"""Bounds every float (SI units): far beyond any mission, and its powers stay finite in all that is worked out."""

T = TypeVar("T", bound=Struct)

_encoder = msgspec.msgpack.Encoder()


class Rejected(Exception):
    """A message that must not be used; ``reason`` is a short stable word to count it by."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


@lru_cache
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
    if encoding is not None and encoding != encoding_of(kind):
        raise Rejected("encoding", f"got {encoding!r}, expected {encoding_of(kind)!r}")
    if len(payload) > MAX_BYTES:
        raise Rejected("size", f"{len(payload)} bytes, at most {MAX_BYTES}")
    try:
        message = _decoder(kind).decode(payload)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise Rejected("format", str(error)) from None
    check_numbers(message)
    return message


def check_numbers(message: Struct) -> None:
    """Raises Rejected unless every float is finite and within ``GREATEST_NUMBER``, every ``q_wxyz`` of unit length and
    no variance negative."""
    for name in _fields_with_floats(type(message)):
        value = getattr(message, name)
        if isinstance(value, float):
            if not -GREATEST_NUMBER <= value <= GREATEST_NUMBER:
                raise _bad_number(name, value)
        elif value and isinstance(value, tuple):
            if isinstance(value[0], Struct):
                for item in value:
                    check_numbers(item)
                continue
            # Long ones (a plan has hundreds) at the speed of C: NaN and infinity come through, and no part is greater.
            length = math.hypot(*value)
            if not length <= GREATEST_NUMBER:
                for item in value:
                    if not -GREATEST_NUMBER <= item <= GREATEST_NUMBER:
                        raise _bad_number(name, item)
            if name == "q_wxyz":
                if abs(length - 1.0) > UNIT_QUATERNION_TOLERANCE:
                    raise Rejected("not_unit_quaternion", f"{name} has length {length}")
            elif name == "covariance":
                _check_covariance(value)


@lru_cache
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
    reason = "range" if math.isfinite(value) else "not_finite"
    return Rejected(reason, f"{name} holds {value}, beyond {GREATEST_NUMBER:g}")


def _check_covariance(values: tuple[float, ...]) -> None:
    """Variances are not negative. That the whole is positive semi-definite is left to those who invert it."""
    step = math.isqrt(len(values)) + 1
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
