# SPDX-License-Identifier: Apache-2.0
"""Reduces a failing case to fewest faults, shortest duration and simplest values with the same
violation.

Greedy delta debugging (A. Zeller, R. Hildebrandt, 2002): each pass proposes simpler cases, coarse
ones first, and keeps those that still fail, until a whole pass changes nothing.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from typing import Any

from .swarm import Case

Judge = Callable[[Case], float | None]
_LISTS = (
    ("fault",),
    ("timeline",),
    ("thruster_failure",),
    ("simulation", "partition"),
    ("simulation", "slow"),
    ("simulation", "clock"),
)
_OPTIONAL = {
    ("fault",): ("peer",),
    ("thruster_failure",): ("reported",),
    ("simulation", "clock"): ("offset_s", "drift"),
}
"""Keys that rows of the lists may leave out."""
_SECTIONS = ("truth", "simulation", "controller")


def shrink(
    case: Case, violation_s: Judge, violated_s: float, duration_s: float, attempts: int = 200
) -> Iterator[Case]:
    """Yield ever simpler cases with the violation of ``case``, which occurs at ``violated_s`` of
    ``duration_s``.

    ``violation_s`` returns the mission time of the violation in a case, None without it. It is
    called at most ``attempts`` times.
    """

    def shorter(case: Case) -> Iterator[Case]:
        return _shorter(case, violated_s, duration_s)

    left, before = attempts, None
    while before != case and left > 0:
        before = case
        for simplify in (
            shorter,
            _without_halves,
            _without_items,
            _without_keys,
            _earlier,
            _shorter_faults,
            _rounder,
        ):
            candidates = simplify(case)
            while (candidate := next(candidates, None)) is not None and left > 0:
                if candidate == case:
                    continue
                left -= 1
                if (time_s := violation_s(candidate)) is not None:
                    case, violated_s = candidate, time_s
                    yield case
                    candidates = simplify(case)


def _changed(case: Case, path: tuple[Any, ...], value: Any) -> Case:
    """Return a copy with another value at a path. None removes the key, and sections left empty."""
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


def _shorter(case: Case, violated_s: float, duration_s: float) -> Iterator[Case]:
    """Yield the case cut soon after the violation. It does not judge whether chasers dock."""
    for extra_s in (0.5, 2.0):
        end_s = math.ceil(2.0 * (violated_s + extra_s)) / 2.0
        if end_s < case.get("duration_s", duration_s):
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
    """Yield the case without whole sections, then without single keys of them and of rows, then
    with seed 0.
    """
    for section in _SECTIONS:
        if section in case:
            yield {k: v for k, v in copy.deepcopy(case).items() if k != section}
    for section in _SECTIONS:
        for key in case.get(section, {}):
            yield _changed(case, (section, key), None)
    for kind, values in case.get("truth", {}).items():
        for key in values:
            yield _changed(case, ("truth", kind, key), None)
    for path, optional in _OPTIONAL.items():
        for k, row in enumerate(_at(case, path)):
            for key in optional:
                if key in row:
                    yield _changed(case, (*path, k, key), None)
    if case.get("seed", 0):
        yield {**case, "seed": 0}


def _earlier(case: Case) -> Iterator[Case]:
    """Yield the case with one row moved to half its time."""
    for path in _LISTS:
        for k, row in enumerate(_at(case, path)):
            if (half_s := round(row.get("at_s", 0.0) / 2.0, 2)) >= 0.1:
                yield _changed(case, (*path, k, "at_s"), half_s)


def _shorter_faults(case: Case) -> Iterator[Case]:
    for path in _LISTS:
        for k, row in enumerate(_at(case, path)):
            for key in ("duration_s", "copies", "delay_s", "offset_s"):
                if key in row:
                    shorter = (
                        round(row[key] / 2.0, 2) if isinstance(row[key], float) else row[key] // 2
                    )
                    if abs(shorter) >= 0.1:
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
                        if (rounded := round(value, digits)) != value and rounded:
                            yield _changed(case, (*path, k, key), rounded)
                elif isinstance(value, list) and value and isinstance(value[0], float):
                    yield _changed(case, (*path, k, key), [round(x, 1) for x in value])
