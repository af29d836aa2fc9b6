"""Values as plain msgpack and back: numbers, texts, containers, arrays, and objects of named classes. No code travels.

Whoever decodes says which classes there may be; anything else is refused, and so is a float that is not finite.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

_ARRAYS = {"f": np.float64, "i": np.int64, "b": np.bool_}
_DEEPEST = 40


class NotPlain(ValueError):
    """A value that cannot be told, or is not what it should be; the text says what."""


def names_of(kind: type) -> list[str]:
    """Fields of a dataclass or message type."""
    if issubclass(kind, Struct):
        return list(kind.__struct_fields__)
    if issubclass(kind, tuple):
        return list(kind._fields)  # type: ignore[attr-defined]
    return [f.name for f in dataclasses.fields(kind)]


def told(value: Any, classes: Iterable[type]) -> Any:
    """``value`` as lists that msgpack carries: a word for the kind, then the content. Raises NotPlain."""
    known = tuple(classes)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        kind = value.dtype.kind
        if kind not in _ARRAYS:
            raise NotPlain(f"an array of {value.dtype}")
        content = np.ascontiguousarray(value, dtype=_ARRAYS[kind]).tobytes()
        return ["array", kind, list(value.shape), content]
    if isinstance(value, np.floating | np.integer | np.bool_):
        return value.item()
    if isinstance(value, Mapping):
        return ["dict", [[told(k, known), told(v, known)] for k, v in value.items()]]
    for word, kind in (("list", list), ("tuple", tuple), ("deque", deque)):
        if type(value) is kind:
            return [word, [told(v, known) for v in value]]
    if isinstance(value, set | frozenset):
        members = sorted((told(v, known) for v in value), key=msgspec.msgpack.encode)
        return ["set" if isinstance(value, set) else "frozenset", members]
    if type(value) in known:
        fields = {name: told(getattr(value, name), known) for name in names_of(type(value))}
        return ["object", type(value).__name__, fields]
    raise NotPlain(f"a {type(value).__name__}")


def understood(value: Any, classes: Iterable[type], depth: int = 0) -> Any:
    """The value that ``told`` made a list of. Raises NotPlain for anything that it does not make."""
    known = tuple(classes)
    if depth > _DEEPEST:
        raise NotPlain("nested too deeply")

    def inner(part: Any) -> Any:
        return understood(part, known, depth + 1)

    match value:
        case None | bool() | int() | str():
            return value
        case float():
            if not np.isfinite(value) and not np.isinf(value):
                raise NotPlain("a float that is no number")
            return value
        case ["array", str(kind), list(shape), bytes(content)]:
            return _array(kind, shape, content)
        case ["dict", list(pairs)]:
            return {_key(inner(k)): inner(v) for k, v in map(_pair, pairs)}
        case ["list", list(parts)]:
            return [inner(p) for p in parts]
        case ["tuple", list(parts)]:
            return tuple(inner(p) for p in parts)
        case ["deque", list(parts)]:
            return deque(inner(p) for p in parts)
        case ["set", list(parts)]:
            return {_key(inner(p)) for p in parts}
        case ["frozenset", list(parts)]:
            return frozenset(_key(inner(p)) for p in parts)
        case ["object", str(name), dict(fields)]:
            found = next((k for k in known if k.__name__ == name), None)
            if found is None or set(fields) != set(names_of(found)):
                raise NotPlain(f"an object {name!r} with fields {', '.join(map(str, fields))}")
            return found(**{str(k): inner(v) for k, v in fields.items()})
    raise NotPlain(f"{type(value).__name__} {str(value)[:40]!r}")


def _array(kind: str, shape: list[Any], content: bytes) -> np.ndarray[Any, Any]:
    if kind not in _ARRAYS or not all(isinstance(n, int) and 0 <= n <= 10_000 for n in shape):
        raise NotPlain(f"an array of kind {kind!r} and shape {shape}")
    flat = np.frombuffer(content, dtype=np.uint8)
    if flat.size != int(np.prod(shape, dtype=np.int64)) * np.dtype(_ARRAYS[kind]).itemsize:
        raise NotPlain(f"{flat.size} bytes for an array of shape {shape}")
    array = np.frombuffer(content, dtype=_ARRAYS[kind]).reshape(shape).copy()
    if kind == "f" and not np.isfinite(array).all():
        raise NotPlain("an array with a value that is not finite")
    return array


def _key(value: Any) -> Any:
    try:
        hash(value)
    except TypeError:
        raise NotPlain(f"{type(value).__name__} as a key") from None
    return value


def _pair(pair: Any) -> tuple[Any, Any]:
    if not isinstance(pair, list) or len(pair) != 2:
        raise NotPlain("a dictionary's entry that is no pair")
    return pair[0], pair[1]
