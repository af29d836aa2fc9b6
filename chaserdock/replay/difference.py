# SPDX-License-Identifier: Apache-2.0
"""Compares messages field by field: first and largest differences of two runs, or of a log and the
present code.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any, TypeGuard

import msgspec
from chaserdock_protocol.messages import Message

Side = int
"""0: recorded, or first; 1: current, or second."""


class FieldDifference(msgspec.Struct):
    """Differences of one field. ``largest``: largest absolute difference if it is a number, else
    None.
    """

    name: str
    unequal: int = 0
    first_tick: int = 0
    first_time_s: float = 0.0
    first: tuple[Any, Any] = (None, None)
    largest: float | None = None
    largest_time_s: float | None = None


class TopicDifference(msgspec.Struct):
    """Differences of one key. ``alone``: number of messages that only one side has, for each side.
    ``alone_time_s``: time of the first one.
    """

    key: str
    compared: int = 0
    unequal: int = 0
    alone: list[int] = msgspec.field(default_factory=lambda: [0, 0])
    alone_time_s: float | None = None
    fields: dict[str, FieldDifference] = {}

    @property
    def equal(self) -> bool:
        return not self.unequal and not any(self.alone)

    @property
    def first_time_s(self) -> float | None:
        """Simulated time of the first difference, or None."""
        times = [f.first_time_s for f in self.fields.values()]
        return min(
            [*times, *([self.alone_time_s] if self.alone_time_s is not None else [])], default=None
        )


_NOT_STATED = {"TargetEstimate": ("innovations",)}
"""Fields by type of message that older logs do not state (None): compared only where both sides
state them."""


def field_differences(
    a: Any, b: Any, name: str = ""
) -> Iterator[tuple[str, Any, Any, float | None]]:
    """Yield the fields that differ: name (shared by the items of a list), both values, and the
    difference of numbers.

    Transport and wall-clock fields (``seq``, ``wall_...``) and those that one side does not state
    are ignored.
    """
    if isinstance(a, msgspec.Struct) and type(a) is type(b):
        younger = _NOT_STATED.get(type(a).__name__, ())
        for field in a.__struct_fields__:
            if field != "seq" and not field.startswith("wall_"):
                x, y = getattr(a, field), getattr(b, field)
                if field in younger and (x is None or y is None):
                    continue
                if x != y:
                    yield from field_differences(x, y, f"{name}.{field}" if name else field)
    elif isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        if a and isinstance(a[0], msgspec.Struct):
            for k, (x, y) in enumerate(zip(a, b, strict=True)):
                if x != y:
                    yield from field_differences(x, y, f"{name}[{k}]")
        elif all(_is_number(x) for x in (*a, *b)):
            pairs: Any = zip(a, b, strict=True)
            distances = [abs(x - y) for x, y in pairs]
            k = distances.index(max(distances))
            yield name, a[k], b[k], distances[k]
        else:
            yield name, a, b, None
    elif _is_number(a) and _is_number(b):
        yield name, a, b, abs(a - b)
    else:
        yield name, a, b, None


def _is_number(x: Any) -> TypeGuard[int | float]:
    return isinstance(x, int | float) and not isinstance(x, bool)


# When more messages than the first number wait, those more than the second number of ticks behind
# both sides count as unpaired.
_MANY_WAITING, _BEHIND_TICKS = 20_000, 300


class Comparison:
    """Pairs the messages of two sides by key, tick and order within the tick, and collects their
    differences.

    Numbers that differ by at most ``tolerance`` count as equal. Memory is bounded.
    """

    def __init__(self, tolerance: float = 0.0) -> None:
        self._tolerance = tolerance
        self._topics: dict[str, TopicDifference] = {}
        self._waiting: tuple[dict[tuple[str, int], list[Message]], ...] = (
            defaultdict(list),
            defaultdict(list),
        )
        self._last_tick = [-1, -1]
        self._number = 0

    def add(self, side: Side, key: str, message: Message) -> None:
        """Add a message of one side."""
        self._last_tick[side] = max(self._last_tick[side], message.tick)
        other = self._waiting[1 - side].get((key, message.tick))
        if not other:
            self._waiting[side][key, message.tick].append(message)
            self._number += 1
            if self._number > _MANY_WAITING:
                self._drop_unpaired(min(self._last_tick) - _BEHIND_TICKS)
            return
        partner = other.pop(0)
        if not other:
            del self._waiting[1 - side][key, message.tick]
        self._number -= 1
        self._compare(key, *((message, partner) if side == 0 else (partner, message)))

    def _topic(self, key: str) -> TopicDifference:
        if key not in self._topics:
            self._topics[key] = TopicDifference(key=key, fields={})
        return self._topics[key]

    def _compare(self, key: str, a: Message, b: Message) -> None:
        topic = self._topic(key)
        topic.compared += 1
        unequal = False
        for name, x, y, difference in field_differences(a, b):
            if difference is not None and difference <= self._tolerance:
                continue
            unequal = True
            time_s = a.sim_time_ns / 1e9
            field = topic.fields.get(name)
            if field is None:
                field = topic.fields[name] = FieldDifference(
                    name=name, first_tick=a.tick, first_time_s=time_s, first=(x, y)
                )
            field.unequal += 1
            if difference is not None and difference > (field.largest or 0.0):
                field.largest, field.largest_time_s = difference, time_s
        topic.unequal += unequal

    def _drop_unpaired(self, before_tick: float) -> None:
        for side, waiting in enumerate(self._waiting):
            for key, tick in [k for k in waiting if k[1] < before_tick]:
                for message in waiting.pop((key, tick)):
                    self._number -= 1
                    topic = self._topic(key)
                    topic.alone[side] += 1
                    time_s = message.sim_time_ns / 1e9
                    if topic.alone_time_s is None or time_s < topic.alone_time_s:
                        topic.alone_time_s = time_s

    def finish(self) -> list[TopicDifference]:
        """Return the results by key, including equal keys."""
        self._drop_unpaired(float("inf"))
        return [self._topics[key] for key in sorted(self._topics)]


def first_difference(topics: list[TopicDifference]) -> str | None:
    """Describe topic, field and time of the first difference."""
    unequal = [t for t in topics if not t.equal]
    if not unequal:
        return None
    first = min(unequal, key=lambda t: (t.first_time_s or 0.0, t.key))
    fields = sorted(first.fields.values(), key=lambda f: (f.first_time_s, f.name))
    if fields and fields[0].first_time_s == first.first_time_s:
        when = f"{first.first_time_s:.3f} s (tick {fields[0].first_tick})"
        return f"{first.key}: {fields[0].name} at {when}"
    return f"{first.key}: a message at {first.first_time_s or 0.0:.3f} s present on one side only"


def difference_lines(topics: list[TopicDifference], sides: tuple[str, str]) -> Iterator[str]:
    """Format the differences by topic; equal topics share a line."""
    equal = [t for t in topics if t.equal]
    yield f"equal: {len(equal)} topics, {sum(t.compared for t in equal)} messages"
    for t in topics:
        if t.equal:
            continue
        yield f"{t.key}: {t.unequal} of {t.compared} messages differ"
        for side, number in zip(sides, t.alone, strict=True):
            if number:
                yield f"  {number} only {side}; the first unpaired one is at {t.alone_time_s:.3f} s"
        for f in sorted(t.fields.values(), key=lambda f: (f.first_time_s, f.name)):
            values = ", ".join(
                f"{side} {_format(x)}" for side, x in zip(sides, f.first, strict=True)
            )
            when = f"{f.first_time_s:.3f} s (tick {f.first_tick})"
            yield f"  {f.name}: {f.unequal} times, first at {when}: {values}"
            if f.largest is not None:
                yield f"    largest difference {f.largest:.3g} at {f.largest_time_s:.3f} s"


def _format(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
