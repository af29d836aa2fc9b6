# SPDX-License-Identifier: Apache-2.0
"""Reduce a failing case: fewest faults, shortest duration, simplest values with the same violation.

Greedy delta debugging (A. Zeller, R. Hildebrandt, 2002): each pass proposes simpler cases, coarse ones first, and keeps one
whenever it still fails, until a whole pass changes nothing.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Generator, Iterator
from typing import Any

from .swarm import Case

Fails = Callable[[Case], bool]
_LISTS = (
    ("fault",),
    ("timeline",),
    ("thruster_failure",),
    ("simulation", "partition"),
    ("simulation", "slow"),
    ("simulation", "clock"),
)
_SECTIONS = ("truth", "simulation", "controller")


def shrink(case: Case, fails: Fails, violated_s: float, attempts: int = 200) -> Iterator[Case]:
    """Yield simpler and simpler cases for which ``fails`` holds, as it does for ``case``.

    ``violated_s``: mission time of the violation; what comes later is cut first. ``fails`` is called ``attempts`` times at
    most.
    """
    left = attempts

    def still(candidate: Case) -> bool:
        nonlocal left
        left -= 1
        return left >= 0 and fails(candidate)

    steps = (_without_items, _without_keys, _shorter_faults, _rounder)
    first = (lambda c: _shorter(c, violated_s), _without_halves)
    for simplify in (*first, *steps):
        case = yield from _fixed_point(case, simplify, still)
    before = None
    while before != case and left > 0:
        before = case
        for simplify in steps:
            case = yield from _fixed_point(case, simplify, still)


def _fixed_point(
    case: Case, simplify: Callable[[Case], Iterator[Case]], still: Fails
) -> Generator[Case, None, Case]:
    """Apply simplifications one after the other until none of them fails any more; yield and return the cases."""
    while True:
        for candidate in simplify(case):
            if candidate != case and still(candidate):
                case = candidate
                yield case
                break
        else:
            return case


def _changed(case: Case, path: tuple[Any, ...], value: Any) -> Case:
    """Return a copy with another value at a path; without the key, and without sections left empty, for None."""
    changed = copy.deepcopy(case)
    at: Any = changed
    for key in path[:-1]:
        at = at[key]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    if len(path) > 1 and isinstance(path[1], str) and not changed[path[0]]:
        del changed[path[0]]
    return changed


def _at(case: Case, path: tuple[str, ...]) -> Any:
    value: Any = case
    for key in path:
        value = value.get(key, []) if isinstance(value, dict) else []
    return value


def _shorter(case: Case, violated_s: float) -> Iterator[Case]:
    """Yield the case cut soon after the violation; whether chasers dock is not judged in it."""
    for extra_s in (0.5, 2.0):
        end_s = math.ceil(2.0 * (violated_s + extra_s)) / 2.0
        if end_s < case.get("duration_s", math.inf):
            shorter = {**copy.deepcopy(case), "duration_s": end_s}
            shorter["success"] = {**case.get("success", {}), "docked": [], "latched": []}
            for path in (("fault",), ("timeline",), ("thruster_failure",)):
                kept = [row for row in _at(case, path) if row["at_s"] < end_s]
                if path[0] in case:
                    shorter[path[0]] = kept
            yield shorter


def _without_halves(case: Case) -> Iterator[Case]:
    for path in _LISTS:
        rows = _at(case, path)
        if len(rows) > 1:
            half = len(rows) // 2
            yield _changed(case, path, [])
            yield _changed(case, path, rows[:half])
            yield _changed(case, path, rows[half:])


def _without_items(case: Case) -> Iterator[Case]:
    for path in _LISTS:
        rows = _at(case, path)
        for k in range(len(rows)):
            yield _changed(case, path, rows[:k] + rows[k + 1 :])


def _without_keys(case: Case) -> Iterator[Case]:
    """Yield the case without whole sections, then without single keys of them, and lock-step if it is not."""
    for section in _SECTIONS:
        if section in case:
            yield {k: v for k, v in copy.deepcopy(case).items() if k != section}
    for section in _SECTIONS:
        for key in case.get(section, {}):
            yield _changed(case, (section, key), None)
    for kind, values in case.get("truth", {}).items():
        for key in values:
            yield _changed(case, ("truth", kind, key), None)
    if case.get("seed", 0):
        yield {**case, "seed": 0}


def _shorter_faults(case: Case) -> Iterator[Case]:
    for path in _LISTS:
        for k, row in enumerate(_at(case, path)):
            for key in ("duration_s", "copies", "delay_s"):
                if key in row:
                    shorter = round(row[key] / 2.0, 2) if isinstance(row[key], float) else row[key] // 2
                    if shorter >= 0.1:
                        yield _changed(case, (*path, k, key), shorter)
            if row.get("share", 1.0) < 1.0:
                yield _changed(case, (*path, k, "share"), 1.0)
            for key in ("offset_m", "rotation_deg"):
                if row.get(key) and row.get("offset_m") and row.get("rotation_deg"):
                    yield _changed(case, (*path, k, key), None)


def _rounder(case: Case) -> Iterator[Case]:
    """Yield the case with numbers of fewer digits."""
    for path in _LISTS:
        for k, row in enumerate(_at(case, path)):
            for key, value in row.items():
                if isinstance(value, float):
                    for digits in (0, 1):
                        if (rounded := round(value, digits)) != value and rounded > 0.0:
                            yield _changed(case, (*path, k, key), rounded)
                elif isinstance(value, list) and value and isinstance(value[0], float):
                    yield _changed(case, (*path, k, key), [round(x, 1) for x in value])
