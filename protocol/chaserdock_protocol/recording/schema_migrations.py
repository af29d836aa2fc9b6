"""Messages of older versions in logs: what turns their fields into those of the next version.

On the wire only the present version is taken. When a message's meaning changes, its number in ``messages.VERSION``
goes up by one, and the function that makes the new fields of the old ones is entered here; a log then reads as if it
had been recorded today. A new field with a default needs none of this.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
from msgspec import Struct

from chaserdock_protocol.codec import MAX_BYTES, Rejected, check_numbers, decode
from chaserdock_protocol.messages import VERSION, encoding_of

T = TypeVar("T", bound=Struct)
Upgrade = Callable[[dict[str, Any]], dict[str, Any]]

UPGRADES: dict[tuple[str, int], Upgrade] = {}
"""(type, version) -> function from that version's fields, as plain values, to the next version's."""

_ENCODING = re.compile(r"application/msgpack;chaserdock\.(\w+)\.v(\d{1,6})")


def decode_logged(kind: type[T], payload: bytes, encoding: str) -> T:
    """Message of type ``kind`` from a log, upgraded if it is of an older version, and checked.

    Raises Rejected as ``codec.decode``; with reason ``encoding`` also when no upgrade leads to the present version.
    """
    if encoding == encoding_of(kind):
        return decode(kind, payload, encoding)
    found = _ENCODING.fullmatch(encoding)
    if found is None or found[1] != kind.__name__ or int(found[2]) > VERSION[kind]:
        raise Rejected("encoding", f"got {encoding!r}, expected {encoding_of(kind)!r} or an older version")
    if len(payload) > MAX_BYTES:
        raise Rejected("size", f"{len(payload)} bytes, at most {MAX_BYTES}")
    try:
        fields = msgspec.msgpack.decode(payload, type=dict[str, Any])
        for version in range(int(found[2]), VERSION[kind]):
            upgrade = UPGRADES.get((kind.__name__, version))
            if upgrade is None:
                raise Rejected(
                    "encoding", f"{kind.__name__}: nothing leads from version {version} to the next"
                )
            fields = upgrade(fields)
        message = msgspec.convert(fields, kind)
    except (
        msgspec.DecodeError,
        RecursionError,
        UnicodeDecodeError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:
        raise Rejected("format", str(error)) from None
    check_numbers(message)
    return message
