"""Seeded mutations of messages, scenarios and logs, and a check of what got through that shares nothing with the codec.

``mutate`` works on bytes (flips, cuts, splices, lying lengths), ``mutate_values`` on the decoded map (other types, huge
and not finite numbers, deep nesting). Equal seed, equal mutations, on any machine.
"""

from __future__ import annotations

import copy
import math
import random
import types
import typing
from collections.abc import Callable
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgpack
import msgspec

GREATEST_INT = 2**53
GREATEST_FLOAT = 1e15
MOST_ITEMS = 16_000
MOST_BYTES = 16_000_000

# Headers of msgpack that claim more than there is, or begin something else (msgpack specification, "Formats").
_HEADERS = (
    b"\xdd\xff\xff\xff\xff",
    b"\xdf\xff\xff\xff\xff",
    b"\xdb\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff",
    b"\xdc\xff\xff",
    b"\xc7\xff\x00",
    b"\xc1",
    b"\xc0",
    b"\xcb\x7f\xf8\x00\x00\x00\x00\x00\x00",
    b"\xcb\x7f\xf0\x00\x00\x00\x00\x00\x00",
    b"\xcb\x7f\xef\xff\xff\xff\xff\xff\xff",
    b"\xcf\xff\xff\xff\xff\xff\xff\xff\xff",
    b"\xd3\x80\x00\x00\x00\x00\x00\x00\x00",
    b"\x91" * 300,
    b"\x81\xa1a" * 300,
)
_ODD_VALUES: tuple[Any, ...] = (
    None,
    True,
    0,
    -1,
    2**31,
    2**53 + 1,
    2**63,
    2**64 - 1,
    -(2**63),
    math.nan,
    math.inf,
    -math.inf,
    1e308,
    -1e16,
    5e-324,
    "",
    "x" * 3000,
    "\u0000",
    b"",
    b"\xff" * 64,
    [],
    [0.0] * 3,
    [1e200] * 4,
    {},
    {"a": 1},
    list(range(20_000)),
)


def mutate(payload: bytes, rng: random.Random) -> bytes:
    """The bytes with one to four small damages."""
    data = bytearray(payload)
    for _ in range(1 + int(rng.random() * 4)):
        kind, n = int(rng.random() * 8), len(data)
        at = int(rng.random() * n) if n else 0
        if kind <= 2 and n:
            data[at] ^= 1 << int(rng.random() * 8)
        elif kind == 3 and n:
            data[at] = int(rng.random() * 256)
        elif kind == 4:
            del data[at:]
        elif kind == 5:
            header = _HEADERS[int(rng.random() * len(_HEADERS))]
            data[at : at + len(header)] = header
        elif kind == 6:
            end = min(n, at + 1 + int(rng.random() * 16))
            data[at:at] = data[at:end]
        else:
            data[at : at + 1 + int(rng.random() * 8)] = b""
    return bytes(data)


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = [(*path, key) for key, _ in items]
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return found + [place for key, item in items for place in _places(item, (*path, key))]


def value_mutator(payload: bytes) -> Callable[[random.Random], bytes]:
    """A function that makes well-formed msgpack of the same map with one or two values changed."""
    places = _places(msgpack.unpackb(payload))

    def mutated(rng: random.Random) -> bytes:
        values = msgpack.unpackb(payload)
        for _ in range(1 + (rng.random() < 0.3)):
            place: Any = values
            path = places[int(rng.random() * len(places))]
            try:
                for key in path[:-1]:
                    place = place[key]
                kind = int(rng.random() * 6)
                if kind == 0 and isinstance(place, dict):
                    place.pop(path[-1], None)
                elif kind == 1 and isinstance(place, list):
                    place.append(copy.deepcopy(place[path[-1]]))
                elif kind == 2 and isinstance(place[path[-1]], float):
                    place[path[-1]] *= 10.0 ** (int(rng.random() * 40) - 20)
                else:
                    place[path[-1]] = copy.copy(_ODD_VALUES[int(rng.random() * len(_ODD_VALUES))])
            except (LookupError, TypeError):
                continue  # the first change took the second's place away
        packed = msgpack.packb(values)
        assert isinstance(packed, bytes)
        return packed

    return mutated


# -- what may get through -----------------------------------------------------------------------------------


def garbage_in(message: msgspec.Struct) -> str | None:
    """What is wrong with a message that passed the decoder, by its type annotations alone; None if nothing is."""
    hints = _hints(type(message))
    for name, kind in hints.items():
        value = getattr(message, name)
        wrong = _wrong(value, kind)
        if wrong is not None:
            return f"{type(message).__name__}.{name}: {wrong}"
        if name == "q_wxyz" and abs(math.hypot(*value) - 1.0) > 1e-6:
            return f"{type(message).__name__}.{name}: not of unit length"
        if name == "covariance" and any(
            value[k] < 0.0 for k in range(0, len(value), math.isqrt(len(value)) + 1)
        ):
            return f"{type(message).__name__}.{name}: a negative variance"
    return None


_HINTS: dict[type, dict[str, Any]] = {}


def _hints(kind: type) -> dict[str, Any]:
    if kind not in _HINTS:
        _HINTS[kind] = get_type_hints(kind, include_extras=True)
    return _HINTS[kind]


def _wrong(value: Any, kind: Any) -> str | None:
    origin = get_origin(kind)
    if origin is Annotated:
        inner, *metas = get_args(kind)
        return _wrong(value, inner) or _out_of_bounds(
            value, [m for m in metas if isinstance(m, msgspec.Meta)]
        )
    if origin is Literal:
        return None if value in get_args(kind) else f"{value!r} is none of {get_args(kind)}"
    if origin in (types.UnionType, typing.Union):
        wrongs = [_wrong(value, k) for k in get_args(kind)]
        return None if None in wrongs else str(wrongs[0])
    if kind is type(None):
        return None if value is None else "not None"
    if origin is tuple:
        return _wrong_tuple(value, get_args(kind))
    if origin is dict:
        return _wrong_dict(value, get_args(kind))
    if type(value) is not kind:
        return f"{type(value).__name__} in place of {kind}"
    if kind is float and not abs(value) <= GREATEST_FLOAT:
        return f"{value}"
    if kind is int and abs(value) > GREATEST_INT:
        return f"{value}"
    if isinstance(value, msgspec.Struct):
        return garbage_in(value)
    if isinstance(value, str | bytes) and len(value) > MOST_BYTES:
        return f"{len(value)} long"
    return None


def _wrong_tuple(value: Any, kinds: tuple[Any, ...]) -> str | None:
    if type(value) is not tuple:
        return f"{type(value).__name__} in place of a tuple"
    if len(value) > MOST_ITEMS:
        return f"{len(value)} items"
    each = [kinds[0]] * len(value) if len(kinds) == 2 and kinds[1] is Ellipsis else list(kinds)
    if len(each) != len(value):
        return f"{len(value)} items in place of {len(each)}"
    return next((w for v, k in zip(value, each, strict=True) if (w := _wrong(v, k)) is not None), None)


def _wrong_dict(value: Any, kinds: tuple[Any, ...]) -> str | None:
    if type(value) is not dict or len(value) > MOST_ITEMS:
        return "no dictionary, or a huge one"
    return next(
        (w for k, v in value.items() if (w := _wrong(k, kinds[0]) or _wrong(v, kinds[1])) is not None), None
    )


def _out_of_bounds(value: Any, metas: list[msgspec.Meta]) -> str | None:
    for meta in metas:
        if meta.ge is not None and value < meta.ge:
            return f"{value} is below {meta.ge}"
        if meta.le is not None and value > meta.le:
            return f"{value} is above {meta.le}"
        if meta.max_length is not None and len(value) > meta.max_length:
            return f"{len(value)} long, at most {meta.max_length}"
        if meta.min_length is not None and len(value) < meta.min_length:
            return f"{len(value)} long, at least {meta.min_length}"
    return None
