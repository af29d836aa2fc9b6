# SPDX-License-Identifier: Apache-2.0
"""Seeded mutations of messages, scenarios and logs at their decoders, and an independent check of
what is accepted.

``mutate`` works on bytes (bit flips, cuts, splices, wrong lengths), ``value_mutator`` on the
decoded map (other types, huge and non-finite numbers, deep nesting). Equal seeds make equal
mutations. ``garbage_in`` checks accepted messages by their type annotations alone and shares no
code with the codec.
"""

from __future__ import annotations

import copy
import math
import random
import tempfile
import types
import typing
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgpack
import msgspec
from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import JoinReply, JoinRequest
from chaserdock_protocol.recording.log import LogError, read_log, read_scenario
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.errors import ScenarioError
from message_samples import BY_TYPE

ROOT = Path(__file__).resolve().parents[1]
GREATEST_INT = 2**53
GREATEST_FLOAT = 1e15
MOST_ITEMS = 16_000
MOST_BYTES = 16_000_000

# msgpack headers with too large lengths, or of other formats (msgpack specification, "Formats").
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
    """Return the bytes with one to four small changes."""
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
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    places = [(*path, key) for key, _ in items]
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return places + [place for key, item in items for place in _places(item, (*path, key))]


def value_mutator(payload: bytes) -> Callable[[random.Random], bytes]:
    """Return a function that makes well-formed msgpack of the same map with one or two values
    changed.
    """
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
                continue  # the first change removed the second's place
        packed = msgpack.packb(values)
        assert isinstance(packed, bytes)
        return packed

    return mutated


# -- check of accepted messages --------------------------------------------------------------------


def garbage_in(message: msgspec.Struct) -> str | None:
    """Return what is wrong with an accepted message by its type annotations; None if it is
    valid.
    """
    hints = _hints(type(message))
    for name, kind in hints.items():
        value = getattr(message, name)
        wrong = _wrong(value, kind)
        if wrong is not None:
            return f"{type(message).__name__}.{name}: {wrong}"
        if name == "q_wxyz" and abs(math.hypot(*value) - 1.0) > 1e-6:
            return f"{type(message).__name__}.{name}: not of unit length"
        if "covariance" in name and any(
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
        return None if value in get_args(kind) else f"{value!r} is not in {get_args(kind)}"
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
    return next(
        (w for v, k in zip(value, each, strict=True) if (w := _wrong(v, k)) is not None), None
    )


def _wrong_dict(value: Any, kinds: tuple[Any, ...]) -> str | None:
    if type(value) is not dict or len(value) > MOST_ITEMS:
        return "no dictionary, or too large"
    return next(
        (
            w
            for k, v in value.items()
            if (w := _wrong(k, kinds[0]) or _wrong(v, kinds[1])) is not None
        ),
        None,
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


# -- the boundaries --------------------------------------------------------------------------------


@dataclass
class Outcome:
    """Counts of mutated inputs; every crash and every accepted invalid message (``garbage``) with
    its input.
    """

    total: int = 0
    accepted: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    crashes: list[str] = field(default_factory=list)
    garbage: list[str] = field(default_factory=list)


def boundaries() -> dict[str, type[msgspec.Struct]]:
    """Return every key that carries messages, and its type."""
    keys = {topic.key: topic.kind for topic in topics.TOPICS}
    return keys | {
        f"{topics.JOIN_KEY} (query)": JoinRequest,
        f"{topics.JOIN_KEY} (reply)": JoinReply,
    }


def fuzz_messages(kind: type[msgspec.Struct], number: int, seed: int) -> Outcome:
    """Decode ``number`` mutated messages of ``kind``."""
    out = Outcome(total=number)
    rng = random.Random(f"{seed}/{kind.__name__}")
    sample = codec.encode(BY_TYPE[kind])
    by_value = value_mutator(sample)
    for _ in range(number):
        payload = by_value(rng) if rng.random() < 0.3 else mutate(sample, rng)
        try:
            message = codec.decode(kind, payload)
        except Rejected as refusal:
            out.refused[refusal.reason] += 1
            continue
        except Exception as error:
            out.crashes.append(f"{type(error).__name__}: {error}: {payload[:200].hex()}")
            continue
        out.accepted += 1
        wrong = garbage_in(message)
        if wrong is not None:
            out.garbage.append(f"{wrong}: {payload[:200].hex()}")
    return out


def fuzz_scenarios(number: int, seed: int) -> Outcome:
    """Load ``number`` mutated scenario files; accepted ones must survive a JSON round trip."""
    out, rng = Outcome(total=number), random.Random(f"{seed}/scenarios")
    texts = [path.read_bytes() for path in sorted((ROOT / "scenarios").glob("*.toml"))]
    values = (
        b"nan",
        b"inf",
        b"-1",
        b"0",
        b"1e308",
        b"[]",
        b'""',
        b"{}",
        b"true",
        b"99999999999999999999",
        b"[" * 2000,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutated.toml"
        for _ in range(number):
            text = texts[int(rng.random() * len(texts))]
            if rng.random() < 0.7:  # replace a whole value, so that it stays TOML
                lines = text.split(b"\n")
                places = [k for k, line in enumerate(lines) if b" = " in line]
                at = places[int(rng.random() * len(places))]
                key = lines[at].partition(b" = ")[0]
                lines[at] = key + b" = " + values[int(rng.random() * len(values))]
                text = b"\n".join(lines)
            else:
                text = mutate(text, rng)
            path.write_bytes(text)
            try:
                scenario = load_scenario(path)
                text_of = scenario.model_dump_json()
                if type(scenario).model_validate_json(text_of).model_dump_json() != text_of:
                    out.garbage.append(f"not the same after a round trip: {text[:200]!r}")
                out.accepted += 1
            except ScenarioError as refusal:
                out.refused["ScenarioError"] += 1
                if len(str(refusal)) > 20_000:
                    out.garbage.append(f"an error of {len(str(refusal))} characters")
            except Exception as error:
                out.crashes.append(f"{type(error).__name__}: {error}: {text[:200]!r}")
    return out


def fuzz_logs(number: int, seed: int) -> Outcome:
    """Read ``number`` mutated logs; every message of a readable one is checked."""
    out, rng = Outcome(total=number), random.Random(f"{seed}/logs")
    good = (ROOT / "tests" / "golden" / "two-chasers.mcap").read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutated.mcap"
        for _ in range(number):
            data = mutate(good, rng)
            path.write_bytes(data)
            try:
                rejected: Counter[str] = Counter()
                for record in read_log(path, rejected=rejected):
                    wrong = garbage_in(record.message)
                    if wrong is not None:
                        out.garbage.append(wrong)
                read_scenario(path)
                out.accepted += 1
            except LogError:
                out.refused["LogError"] += 1
            except Exception as error:
                out.crashes.append(f"{type(error).__name__}: {error}")
    return out
