# SPDX-License-Identifier: Apache-2.0
"""Values of the tables: errors of a flight, spread over the starts, two-sided verdicts, changes
from the baseline.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from chaserdock.experiments.plan import ExperimentPlan
from chaserdock.experiments.worker import FlightOutcome

from .paper import BASELINE, PAPER_S, ROWS, PaperRow
from .plan import DRAWS, FREE_STARTS, NOMINAL_OFFSET_M, draws_of, free_name, table_name

Summaries = dict[str, dict[str, Any]]
"""Summaries of flights by their label."""

NONE = "-"
"""Cell without a result."""
BAND = (1.0 / 1.35, 1.35)
"""Ratios of a measured to the paper's value that count as met."""
TREND_BAND = (0.5, 2.0)
"""The same for changes from the baseline row."""
MIN_DISTANCE_M = 0.35
"""The paper's d_min."""
LOST_M = math.hypot(*NOMINAL_OFFSET_M)
"""Steady RMS distance of a chaser from its reference pose above which it has not come closer: that
of the start.
"""
Quantity = Literal["position", "orientation"]
QUANTITIES: tuple[Quantity, Quantity] = ("position", "orientation")


@dataclass(frozen=True)
class Errors:
    """Mean square errors of a flight over two minutes and in steady state: m^2 and rad^2."""

    position: float
    orientation: float
    steady_position: float
    failed: bool

    def of(self, quantity: Quantity) -> float:
        """Return the error over two minutes."""
        return self.position if quantity == "position" else self.orientation


@dataclass(frozen=True)
class Spread:
    """Least, median and greatest of ``number`` values."""

    least: float
    median: float
    greatest: float
    number: int


def spread(values: Sequence[float]) -> Spread:
    """Return the spread of values. Raise ValueError for none."""
    if not values:
        raise ValueError("no values")
    return Spread(min(values), float(np.median(values)), max(values), len(values))


def verdict(ratio: float, band: tuple[float, float] = BAND) -> str:
    """Judge a measured value by its ratio to the paper's: "met" within ``band``, else "smaller" or
    "larger".

    A negative ratio is a change in the opposite direction. Raise ValueError unless 0 < band[0] <= 1
    <= band[1].
    """
    low, high = band
    if not 0.0 < low <= 1.0 <= high:
        raise ValueError(f"the band must contain 1 and be positive, not {band}")
    if math.isnan(ratio):
        return "not measured"
    if ratio < 0.0:
        return "opposite"
    if ratio < low:
        return "smaller"
    return "met" if ratio <= high else "larger"


def over_two_minutes(whole: float, steady: float, flown_s: float) -> float:
    """Return the mean over the paper's two minutes of a flight of ``flown_s``, extrapolated with
    its steady state.

    Raise ValueError unless 0 < flown_s <= two minutes.
    """
    if not 0.0 < flown_s <= PAPER_S:
        raise ValueError(f"flown_s must be above 0 and at most {PAPER_S:g}, not {flown_s}")
    return (whole * flown_s + steady * (PAPER_S - flown_s)) / PAPER_S


def results_by_label(plan: ExperimentPlan, outcomes: Mapping[str, FlightOutcome]) -> Summaries:
    """Return the summaries of the flights that have one."""
    ended = ((f.label, outcomes[f.name].summary) for f in plan.flights if f.name in outcomes)
    return {label: summary for label, summary in ended if summary is not None}


def errors_of(summary: Mapping[str, Any]) -> Errors:
    """Return the errors of chaser 0 from a flight's summary. The flight failed if the chaser came
    closer than d_min or did not approach its reference.
    """
    own, flown_s = summary["chasers"]["0"], summary["sim_time_s"]
    steady = {name: math.inf if v is None else v for name, v in own["steady"].items()}
    steady_position = steady["position_mse_m2"]
    return Errors(
        position=over_two_minutes(own["position_mse_m2"], steady_position, flown_s),
        orientation=over_two_minutes(
            own["orientation_mse_rad2"], steady["orientation_mse_rad2"], flown_s
        ),
        steady_position=steady_position,
        failed=own["min_distance_target_m"] < MIN_DISTANCE_M or not steady_position <= LOST_M**2,
    )


def errors_by_label(results: Summaries, label: str) -> Errors | None:
    """Return the errors of a flight; None without a result."""
    return errors_of(results[label]) if label in results else None


def cell(results: Summaries, column: str, row: PaperRow) -> dict[int, Errors]:
    """Return the errors of a table cell by draw, as far as flown."""
    found = {draw: errors_by_label(results, table_name(column, row, draw)) for draw in DRAWS}
    return {draw: errors for draw, errors in found.items() if errors is not None}


def without_partial_rows(results: Summaries, column_names: Sequence[str], quick: bool) -> Summaries:
    """Return the results without those of table rows of which not all starts are flown."""
    partial = {
        table_name(column, row, draw)
        for column in column_names
        for row in ROWS
        if set(cell(results, column, row)) != set(draws_of(quick, column, row))
        for draw in DRAWS
    }
    return {label: summary for label, summary in results.items() if label not in partial}


def free_errors(results: Summaries) -> list[Mapping[str, Mapping[str, float]]]:
    """Return the errors by row and quantity of the free starts that meet the baseline row."""
    found = (results[name]["free"] for k in FREE_STARTS if (name := free_name(k)) in results)
    return [free["rows"] for free in found if free["met"]]


def free_changes(results: Summaries, row: PaperRow, quantity: Quantity) -> list[float]:
    """Return the changes of a row from the baseline row, as shares, from every free start."""
    return [
        rows[row.name][quantity] / rows[BASELINE.name][quantity] - 1.0
        for rows in free_errors(results)
    ]


def paper_value(row: PaperRow, quantity: Quantity) -> float:
    """Return the paper's error of a row."""
    return row.position_mse_m2 if quantity == "position" else row.orientation_mse_rad2


def paper_change(row: PaperRow, quantity: Quantity) -> float:
    """Return the paper's change of a row from its baseline, as a share."""
    return paper_value(row, quantity) / paper_value(BASELINE, quantity) - 1.0


def changes(results: Summaries, column: str, row: PaperRow, quantity: Quantity) -> list[float]:
    """Return the changes of a row from the baseline row of the same start, as shares."""
    runs, base = cell(results, column, row), cell(results, column, BASELINE)
    return [runs[d].of(quantity) / base[d].of(quantity) - 1.0 for d in runs if d in base]


def comes_out(values: Sequence[float], paper: float) -> bool:
    """Return whether changes have the paper's sign from every start, and roughly its size in the
    median.
    """
    same = min(values) * max(values) > 0.0
    return same and verdict(spread(values).median / paper, TREND_BAND) == "met"
