# SPDX-License-Identifier: Apache-2.0
"""Encodes and decodes controller state as msgpack. Only values of the declared types are decoded;
no code travels.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import msgspec
import numpy as np
from msgspec import Struct

Decoded = TypeVar("Decoded")

_DTYPES = {"f": np.float64, "i": np.int64, "b": np.bool_}
_WORDS = {"f": "numbers", "i": "integers", "b": "booleans"}


class EncodedArray(Struct, array_like=True, forbid_unknown_fields=True):
    """An array in a message: kind of its numbers, shape, content in row-major order."""

    kind: str
    shape: tuple[int, ...]
    content: bytes


def encode(state: Any) -> bytes:
    """Return ``state`` as msgpack. Raises TypeError for a value that is not data."""
    return _ENCODER.encode(state)


def decode(data: bytes, kind: type[Decoded]) -> Decoded:
    """Return the object of type ``kind`` whose ``encode`` result is ``data``.

    Raises ValueError (as msgspec's errors are) for anything else, and for a NaN.
    """
    _reject_nan(msgspec.msgpack.decode(data))
    return msgspec.msgpack.decode(data, type=kind, dec_hook=_decode_array)


def _encode_array(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.kind in _DTYPES:
        kind = value.dtype.kind
        content = np.ascontiguousarray(value, dtype=_DTYPES[kind]).tobytes()
        return EncodedArray(kind, value.shape, content)
    raise TypeError(f"cannot be encoded: {type(value).__name__}")


def _decode_array(kind: Any, value: Any) -> Any:
    if getattr(kind, "__origin__", kind) is not np.ndarray:
        raise ValueError(f"cannot be decoded: {kind}")
    encoded = msgspec.convert(value, EncodedArray)
    dtype = _DTYPES.get(encoded.kind)
    if dtype is None or min(encoded.shape, default=0) < 0:
        raise ValueError(f"an array of kind {encoded.kind!r} and shape {encoded.shape}")
    array = np.frombuffer(encoded.content, dtype=dtype).reshape(encoded.shape)
    if not np.isfinite(array).all():
        raise ValueError("an array with a value that is not finite")
    declared = np.dtype(kind.__args__[1].__args__[0])
    if not np.can_cast(array.dtype, declared):
        raise ValueError(f"an array of {_WORDS[encoded.kind]}, not {_WORDS[declared.kind]}")
    return array.astype(declared)


def _reject_nan(value: Any) -> None:
    match value:
        case float() if math.isnan(value):
            raise ValueError("a number that is NaN")
        case dict():
            for item in value.items():
                _reject_nan(item)
        case list() | tuple():
            for item in value:
                _reject_nan(item)
        case _:
            pass


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode_array)
