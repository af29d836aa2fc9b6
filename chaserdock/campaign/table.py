"""A campaign's results as one table, and what it says. Pure functions."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from typing import Any

import numpy as np

from .plan import Campaign, Run
from .worker import Result

Row = dict[str, Any]
_FIXED = ("run", "index", "seed", "success", "cause", "failures", "digest", "log")


def row_of(run: Run, result: Result) -> Row:
    """One run as one row of plain values: what varied (``vary.…``), how it ended, and its figures in SI units.

    Nothing that depends on the machine's speed is in it: equal campaigns give equal tables.
    """
    s = result.summary or {}
    failures = list(s.get("failures", [])) or (
        [result.last_words or "ended without a word"] if result.status else []
    )
    row: Row = {
        "run": run.name,
        "index": run.index,
        "seed": run.seed,
        "success": result.status == 0,
        "cause": cause_of(failures[0]) if failures else "",
        "failures": json.dumps(failures),
        "digest": s.get("digest", ""),
        "log": result.log or "",
    }
    row |= {
        f"vary.{k}": v if isinstance(v, int | float | str | bool) else json.dumps(v)
        for k, v in run.varied.items()
    }
    chasers = s.get("chasers", {}).values()
    for name, path, worst in (
        ("steady_position_mse_m2", ("steady", "position_mse_m2"), max),
        ("steady_orientation_mse_rad2", ("steady", "orientation_mse_rad2"), max),
        ("position_mse_m2", ("position_mse_m2",), max),
        ("orientation_mse_rad2", ("orientation_mse_rad2",), max),
        ("min_distance_target_m", ("min_distance_target_m",), min),
        ("impulse_N_s", ("impulse_N_s",), sum),
    ):
        values = [v for c in chasers if (v := _at(c, path)) is not None]
        row[name] = float(worst(values)) if values else math.nan
    row["docked"] = sum(bool(c.get("docked")) for c in chasers)
    row["collisions"] = int(s.get("collisions", 0))
    row["min_distance_chasers_m"] = _number(s.get("min_distance_chasers_m"))
    for key, value in s.get("target_estimate", {}).items():
        row[f"estimate_{key}"] = _number(value)
    return row


def _at(values: Any, path: tuple[str, ...]) -> float | None:
    for key in path:
        values = values.get(key) if isinstance(values, dict) else None
    return values if isinstance(values, int | float) else None


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def cause_of(failure: str) -> str:
    """What a failure is, without its figures: ``chaser 2: steady RMS: 9.1 mm`` and ``… 8.2 mm`` are one cause."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", failure)


def rows_of(flown: list[tuple[Run, Result]]) -> list[Row]:
    """The table, in the campaign's order; every row with the same columns."""
    rows = [row_of(run, result) for run, result in flown]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return [{c: row.get(c, math.nan) for c in columns} for row in rows]


def metrics_of(rows: list[Row]) -> list[str]:
    """Columns that hold figures of the flight."""
    names = [c for c in (rows[0] if rows else {}) if c not in _FIXED and not c.startswith("vary.")]
    return [c for c in names if any(isinstance(r[c], int | float) and math.isfinite(r[c]) for r in rows)]


def wilson(passed: int, of: int, z: float = 1.959964) -> tuple[float, float]:
    """Score interval (low, high) of a pass rate, 95 % by default (E. B. Wilson, 1927). Raises ValueError for none."""
    if of < 1 or not 0 <= passed <= of:
        raise ValueError(f"{passed} of {of} is no pass rate")
    p, n = passed / of, float(of)
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)


def causes(rows: list[Row]) -> list[tuple[str, int]]:
    """How many runs failed by what, most frequent first."""
    return sorted(
        Counter(r["cause"] for r in rows if not r["success"]).items(), key=lambda item: (-item[1], item[0])
    )


def rank_correlation(x: list[float], y: list[float]) -> float:
    """Spearman's rank correlation of two columns, ties by mean rank; NaN where one of them does not vary."""
    pairs = [(a, b) for a, b in zip(x, y, strict=True) if math.isfinite(a) and math.isfinite(b)]
    if len(pairs) < 3:
        return math.nan
    a, b = (_ranks(np.array(column, dtype=float)) for column in zip(*pairs, strict=True))
    if a.std() == 0.0 or b.std() == 0.0:
        return math.nan
    return float(np.corrcoef(a, b)[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts - 1) / 2.0)[inverse]


def numbers_of(rows: list[Row], column: str) -> list[float] | None:
    """A column as numbers, or None when it holds something else."""
    values = [r[column] for r in rows]
    if any(isinstance(v, str) for v in values):
        return None
    return [float(v) for v in values]


def again(campaign: Campaign, run: Run) -> str:
    """The command that flies one run of the campaign again, alone."""
    sets = " ".join(f"--set '{o}'" for o in run.overrides)
    return f"chaserdock run {campaign.scenario} {sets}"
