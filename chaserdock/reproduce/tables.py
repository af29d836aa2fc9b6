# SPDX-License-Identifier: Apache-2.0
"""Values of the tables: errors of a run, spread over runs, verdicts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from chaserdock.evaluation.study_cases import StudyResult

from .paper import PAPER_S
from .plan import DRAWS, ReproductionPlan
from .runner import ReproductionResults

BAND = (1.0 / 1.35, 1.35)
"""Ratios of a measured value to the paper's that count as met."""
TREND_BAND = (0.5, 2.0)
"""The same for changes from the baseline row."""


@dataclass(frozen=True)
class Errors:
    """Mean square errors of chaser 0 in one run, over two minutes and in steady state: m^2 and rad^2."""

    position: float
    orientation: float
    steady_position: float
    steady_orientation: float
    failed: bool = False


@dataclass(frozen=True)
class Spread:
    """Least, median and greatest value over ``runs`` runs."""

    least: float
    median: float
    greatest: float
    runs: int


def spread(values: Sequence[float]) -> Spread:
    """Return the spread of values. Raise ValueError for none."""
    if not values:
        raise ValueError("no runs")
    return Spread(min(values), float(np.median(values)), max(values), len(values))


def verdict(ratio: float, band: tuple[float, float] = BAND) -> str:
    """Judge a measured value by its ratio to the paper's, two-sided: met within ``band``, else smaller or larger.

    A negative ratio is a change in the opposite direction. Raise ValueError unless 0 < band[0] <= 1 <= band[1].
    """
    low, high = band
    if not 0.0 < low <= 1.0 <= high:
        raise ValueError(f"the band must contain 1 and be positive, not {band}")
    if math.isnan(ratio):
        return "not measured"
    if ratio < 0.0:
        return "opposite to the paper"
    if ratio == 0.0:
        return "zero, unlike the paper"
    if ratio < low:
        return f"smaller than the paper by {1.0 / ratio:.3g} times"
    return "met" if ratio <= high else f"larger than the paper by {ratio:.3g} times"


def over_two_minutes(whole: float, steady: float, flown_s: float) -> float:
    """Return the mean over the paper's two minutes of a run of ``flown_s``, extrapolated with its steady state.

    Raise ValueError unless 0 < flown_s <= two minutes.
    """
    if not 0.0 < flown_s <= PAPER_S:
        raise ValueError(f"flown_s must be above 0 and at most {PAPER_S:g}, not {flown_s}")
    return (whole * flown_s + steady * (PAPER_S - flown_s)) / PAPER_S


def errors_of_study(result: StudyResult) -> Errors:
    """Return the errors of a study; a failed solve makes it a failed run."""
    r = result
    return Errors(
        position=over_two_minutes(r.position_mse_m2, r.steady_position_mse_m2, r.duration_s),
        orientation=over_two_minutes(r.orientation_mse_rad2, r.steady_orientation_mse_rad2, r.duration_s),
        steady_position=r.steady_position_mse_m2,
        steady_orientation=r.steady_orientation_mse_rad2,
        failed=r.failed_solves > 0,
    )


def study_errors(results: ReproductionResults, name: str) -> Errors | None:
    """Return the errors of a study by name; None without a result."""
    result = results.studies.get(name)
    return None if result is None else errors_of_study(result)


def floor_of_study(result: StudyResult) -> float:
    """Return the lower bound of the position MSE (m^2) over two minutes. Raise ValueError if it was not computed."""
    if result.floor_m2_s is None:
        raise ValueError(f"{result.case.name}: the lower bound was not computed")
    return result.floor_m2_s / PAPER_S


def errors_of_summary(summary: dict[str, Any]) -> Errors:
    """Return the errors in a run's ``summary.json``; NaN for missing values."""
    chaser = summary["chasers"]["0"]
    steady = [chaser["steady"][k] for k in ("position_mse_m2", "orientation_mse_rad2")]
    whole = [chaser[k] for k in ("position_mse_m2", "orientation_mse_rad2")]
    known = [math.nan if x is None else float(x) for x in (*whole, *steady)]
    flown_s = summary["sim_time_s"]
    return Errors(
        position=over_two_minutes(known[0], known[2], flown_s),
        orientation=over_two_minutes(known[1], known[3], flown_s),
        steady_position=known[2],
        steady_orientation=known[3],
        failed=not summary["success"],
    )


def with_images(plan: ReproductionPlan, results: ReproductionResults, group: str) -> list[Errors]:
    """Return the errors of a group's runs with images; empty without such runs or if one has no result."""
    members = [m for m in plan.missions if m.group == group]
    if any(m.name not in results.missions for m in members):
        return []
    return [errors_of_summary(results.missions[m.name]) for m in members]


def with_perfect_knowledge(results: ReproductionResults, group: str) -> list[Errors]:
    """Return the errors of a group's studies, one per draw; empty if one has no result."""
    names = [f"{group}/{draw}" for draw in DRAWS]
    if any(name not in results.studies for name in names):
        return []
    return [errors_of_study(results.studies[name]) for name in names]


def best_runs(plan: ReproductionPlan, results: ReproductionResults, group: str) -> tuple[list[Errors], str]:
    """Return the errors of a table cell and how they were flown: all draws with images, else with perfect knowledge."""
    seen = with_images(plan, results, group)
    if len(seen) == len(DRAWS):
        return seen, "images"
    return with_perfect_knowledge(results, group), "perfect knowledge"


@dataclass(frozen=True)
class Requirement:
    """A requirement on our default, the measured value, and whether it is met."""

    what: str
    measured: str
    met: bool


def own_requirements(plan: ReproductionPlan, results: ReproductionResults) -> list[Requirement]:
    """Check what we require of our default settings, as far as results exist: the median over the starts."""
    out: list[Requirement] = []
    ours, how = best_runs(plan, results, "table/default/baseline")
    floors = [results.studies.get(f"table/paper/baseline/{draw}") for draw in DRAWS]
    if ours and all(floors):
        above = [e.position / floor_of_study(f) for e, f in zip(ours, floors, strict=True) if f is not None]
        median = spread(above).median
        what = "position MSE at most 20 % above the lower bound"
        out.append(Requirement(what, f"{100 * (median - 1):.1f} % above, {how}", median <= 1.2))
    for group, target, limit in (
        ("table/default/baseline", "the paper's target", 2e-5),
        ("target/servicer", "servicer", 4e-6),
    ):
        seen = with_images(plan, results, group)
        if seen:
            value = spread([e.steady_position for e in seen]).median
            what = f"steady position MSE on {target} at most {limit:g} m^2, with images"
            out.append(Requirement(what, f"{value:.2e} m^2", value <= limit))
    return out
