# SPDX-License-Identifier: Apache-2.0
"""Table of a plan's results, and its statistics."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from chaserdock_protocol.output_files import replaced

from chaserdock.verdict import Verdict, verdict_of

from .plan import ExperimentPlan, PlannedFlight
from .worker import FlightOutcome

ResultRow = dict[str, Any]
_FIXED = (
    "run",
    "index",
    "seed",
    "success",
    "cause",
    "failures",
    "ended",
    "not_judged",
    "doubts",
    "digest",
    "log",
)

_OF_CHASERS: tuple[tuple[str, tuple[str, ...], Callable[[list[float]], float]], ...] = (
    ("steady_position_mse_m2", ("steady", "position_mse_m2"), max),
    ("steady_orientation_mse_rad2", ("steady", "orientation_mse_rad2"), max),
    ("position_mse_m2", ("position_mse_m2",), max),
    ("orientation_mse_rad2", ("orientation_mse_rad2",), max),
    ("relative_estimate_position_rms_m", ("relative_estimate", "position_rms_m"), max),
    ("relative_estimate_orientation_rms_rad", ("relative_estimate", "orientation_rms_rad"), max),
    ("relative_estimate_nees", ("relative_estimate", "nees_mean"), fmean),
    ("min_distance_target_m", ("min_distance_target_m",), min),
    ("impulse_N_s", ("impulse_N_s",), sum),
)
"""Columns of results by chaser: name, key path in a chaser's summary, and how the values of chasers
are combined.
"""


def verdict_of_flight(outcome: FlightOutcome) -> Verdict:
    """Return the verdict on a flight of a plan. Without criteria that are not met, the last words
    of a flight that failed are its cause.
    """
    verdict = verdict_of(outcome.summary or {})
    last_words = () if outcome.status == 0 else (outcome.last_words or "ended without output",)
    return replace(verdict, success=outcome.status == 0, not_met=verdict.not_met or last_words)


def row_of(index: int, flight: PlannedFlight, outcome: FlightOutcome) -> ResultRow:
    """Return a flight as a row of plain values: varied values (``vary.NAME``), outcome, results in
    SI units.

    No value depends on the speed of the machine: equal plans give equal tables.
    """
    s = outcome.summary or {}
    verdict = verdict_of_flight(outcome)
    failures = list(verdict.not_met)

    row: ResultRow = {
        "run": flight.name,
        "index": index,
        "seed": flight.seed,
        "success": verdict.success,
        "cause": cause_of(failures[0]) if failures else "",
        "failures": json.dumps(failures),
        "ended": verdict.ended,
        "not_judged": json.dumps(verdict.not_judged),
        "doubts": json.dumps(verdict.doubts),
        "digest": s.get("digest", ""),
        "log": outcome.log or "",
    }

    row |= {
        f"vary.{k}": v if isinstance(v, int | float | str | bool) else json.dumps(v)
        for k, v in flight.varied.items()
    }

    chasers = s.get("chasers", {}).values()
    for name, path, combine in _OF_CHASERS:
        values = [v for c in chasers if (v := _value_at(c, path)) is not None]
        row[name] = float(combine(values)) if values else math.nan
    row["docked"] = sum(bool(c.get("docked")) for c in chasers)

    row["collisions"] = int(s.get("collisions") or 0)  # None: a log without ground truth
    row["min_distance_chasers_m"] = _number(s.get("min_distance_chasers_m"))

    for key, value in s.get("target_estimate", {}).items():
        row[f"estimate_{key}"] = _number(value)
    if flight.alone is not None and flight.alone.floor:
        row["floor_m2_s"] = _number(s.get("floor_m2_s"))
    return row


def _value_at(values: Any, path: tuple[str, ...]) -> float | None:
    for key in path:
        values = values.get(key) if isinstance(values, dict) else None
    return values if isinstance(values, int | float) else None


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def cause_of(failure: str) -> str:
    """Replace the numbers in a failure by ``#``, so that failures of one kind count as one
    cause.
    """
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", failure)


def rows_of(plan: ExperimentPlan, outcomes: Mapping[str, FlightOutcome]) -> list[ResultRow]:
    """Return the table of the flights flown so far, in the plan's order. All rows have the same
    columns.
    """
    rows = [
        row_of(index, flight, outcomes[flight.name])
        for index, flight in enumerate(plan.flights)
        if flight.name in outcomes
    ]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return [{c: row.get(c, math.nan) for c in columns} for row in rows]


def metrics_of(rows: list[ResultRow]) -> list[str]:
    """Return the names of the columns with numerical results."""
    names = [c for c in (rows[0] if rows else {}) if c not in _FIXED and not c.startswith("vary.")]
    return [
        c for c in names if any(isinstance(r[c], int | float) and math.isfinite(r[c]) for r in rows)
    ]


def wilson(passed: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the Wilson score interval (low, high) of a pass rate. Raise ValueError for impossible
    counts.
    """
    from scipy.stats import binomtest

    if total < 1 or not 0 <= passed <= total:
        raise ValueError(f"{passed} of {total} is not a pass rate")
    interval = binomtest(passed, total).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def share_text(passed: int, total: int) -> str:
    """Return a share in percent with its Wilson interval. Raise ValueError as `wilson`."""
    low, high = wilson(passed, total)
    return f"{100 * passed / total:.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"


def in_part(row: ResultRow) -> bool:
    """Return whether a run met what was judged, but not all of its criteria were."""
    return bool(row["success"]) and row["not_judged"] != "[]"


def rate(rows: list[ResultRow]) -> str:
    """Return the pass rate of the runs that failed or met all criteria."""
    judged = [r for r in rows if not in_part(r)]
    if not judged:
        return f"{len(rows)} flown"
    passed = sum(bool(r["success"]) for r in judged)
    low, high = wilson(passed, len(judged))
    return (
        f"{passed} of {len(judged)} passed, {100 * passed / len(judged):.1f} % "
        f"(95 %: {100 * low:.1f} to {100 * high:.1f} %)"
    )


def qualification(rows: list[ResultRow]) -> list[str]:
    """Return the numbers of runs whose success is qualified; none without any."""
    counts = (
        (sum(in_part(r) for r in rows), "not judged in full"),
        (sum(bool(r["success"]) and r["doubts"] != "[]" for r in rows), "with a NEES out of range"),
    )
    return [f"{n} {what}" for n, what in counts if n]


def causes(rows: list[ResultRow]) -> list[tuple[str, int]]:
    """Return the causes of failures and their numbers of flights, most frequent first."""
    return sorted(
        Counter(r["cause"] for r in rows if not r["success"]).items(),
        key=lambda item: (-item[1], item[0]),
    )


def remarks(rows: list[ResultRow], kind: str) -> list[tuple[str, int]]:
    """Return what qualifies the flights' verdicts (column ``kind``), numbers replaced by ``#``,
    with the numbers of flights, most frequent first.
    """
    counted = Counter(text for r in rows for text in {cause_of(t) for t in json.loads(r[kind])})
    return sorted(counted.items(), key=lambda item: (-item[1], item[0]))


def rank_correlation(x: list[float], y: list[float]) -> float:
    """Return Spearman's rank correlation of the finite pairs; NaN for fewer than three or a
    constant column.
    """
    from scipy.stats import spearmanr

    pairs = [(a, b) for a, b in zip(x, y, strict=True) if math.isfinite(a) and math.isfinite(b)]
    if len(pairs) < 3:
        return math.nan
    a, b = zip(*pairs, strict=True)
    if len(set(a)) == 1 or len(set(b)) == 1:
        return math.nan
    result: Any = spearmanr(a, b)
    return float(result.statistic)


def numbers_of(rows: list[ResultRow], column: str) -> list[float] | None:
    """Return a column as numbers, or None when it contains text."""
    values = [r[column] for r in rows]
    if any(isinstance(v, str) for v in values):
        return None
    return [float(v) for v in values]


def campaign_command(file: Path, out: Path | None) -> str:
    """Return the command that continues a campaign. ``out``: its folder, if given."""
    folder = [] if out is None else ["--out", str(out)]
    return shlex.join(["chaserdock", "campaign", str(file), *folder])


def repeat_command(campaign: str, run: int) -> str:
    """Return the command that flies one run again, with its log and report. ``campaign``: see
    ``campaign_command``.
    """
    return f"{campaign} --only {run}"


def run_command(flight: PlannedFlight) -> str:
    """Return the command that flies one run again without its campaign; "" where none does."""
    if flight.module:
        return ""
    sets = [item for o in flight.overrides for item in ("--set", o)]
    return shlex.join(["chaserdock", "run", flight.scenario, *sets])


def write_table(rows: list[ResultRow], path: Path) -> None:
    """Write the table as Parquet; column names include units."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with replaced(path) as new:
        pq.write_table(pa.Table.from_pylist(rows), new)
