# SPDX-License-Identifier: Apache-2.0
"""Values of the tables: means over runs, ratios, requirements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from chaserdock.evaluation.study_cases import StudyResult

from .paper import PAPER_S, ROWS
from .plan import INFERRED, Mission, Plan, table_group
from .runner import Results


@dataclass(frozen=True)
class Errors:
    """Mean square errors of chaser 0 over two minutes and in steady state, averaged over ``runs``.

    m^2 and rad^2. ``failed``: number of runs that failed the scenario's criteria.
    """

    position: float
    orientation: float
    steady_position: float
    steady_orientation: float
    runs: int = 1
    failed: int = 0


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
        failed=int(r.failed_solves > 0),
    )


def floor_of_study(result: StudyResult) -> float:
    """Return the lower bound of the position MSE (m^2) over two minutes. Raise ValueError if it was not computed."""
    if result.floor_m2_s is None:
        raise ValueError(f"{result.case.name}: the lower bound was not computed")
    return result.floor_m2_s / PAPER_S


def errors_of_summary(summary: dict, duration_s: float) -> Errors:
    """Return the errors in a run's ``summary.json``; NaN for missing values."""
    chaser = summary["chasers"]["0"]
    steady = [chaser["steady"][k] for k in ("position_mse_m2", "orientation_mse_rad2")]
    whole = [chaser[k] for k in ("position_mse_m2", "orientation_mse_rad2")]
    known = [math.nan if x is None else float(x) for x in (*whole, *steady)]
    return Errors(
        position=over_two_minutes(known[0], known[2], duration_s),
        orientation=over_two_minutes(known[1], known[3], duration_s),
        steady_position=known[2],
        steady_orientation=known[3],
        failed=int(not summary["success"]),
    )


def mean(errors: Sequence[Errors]) -> Errors:
    """Return the average of several runs. Raise ValueError for none."""
    if not errors:
        raise ValueError("no runs to average")
    n = len(errors)
    return Errors(
        position=sum(e.position for e in errors) / n,
        orientation=sum(e.orientation for e in errors) / n,
        steady_position=sum(e.steady_position for e in errors) / n,
        steady_orientation=sum(e.steady_orientation for e in errors) / n,
        runs=sum(e.runs for e in errors),
        failed=sum(e.failed for e in errors),
    )


def flown(plan: Plan, results: Results, group: str) -> Errors | None:
    """Return the average of a group's runs with images; None without such runs or if one has no result."""
    members: list[Mission] = [m for m in plan.missions if m.group == group]
    if not members or any(m.name not in results.missions for m in members):
        return None
    return mean([errors_of_summary(results.missions[m.name], plan.duration_s) for m in members])


@dataclass(frozen=True)
class Requirement:
    """A requirement, the measured value, and whether it is met."""

    what: str
    measured: str
    met: bool


def _ratio(label: str, ours: float, paper: float, low: float, high: float, how: str) -> Requirement:
    ratio = ours / paper
    return Requirement(label, f"{ratio:.3f} of the paper's, {how}", low <= ratio <= high)


def requirements(plan: Plan, results: Results, start: str) -> list[Requirement] | None:
    """Check the requirements from ``start``, with images where the plan has them, else on perfect knowledge.

    Return None if a result is missing.
    """
    out: list[Requirement] = []
    groups = [table_group(start, "paper", row.name) for row in ROWS]
    groups.append(table_group(start, "default", "baseline"))
    needed = {m.name for m in plan.missions if m.group in groups}
    if not (needed <= results.missions.keys() and set(groups) <= results.studies.keys()):
        return None

    def best(group: str) -> tuple[Errors, str]:
        seen = flown(plan, results, group)
        if seen is not None:
            return seen, "with images"
        return errors_of_study(results.studies[group]), "perfect knowledge"

    for row, group in zip(ROWS, groups, strict=False):
        ours, how = best(group)
        if row.failed:
            measured = f"{ours.failed} of {ours.runs} failed, steady RMS {math.sqrt(ours.steady_position):.3f} m, {how}"
            out.append(Requirement(f"{row.label}: no run fails", measured, ours.failed == 0))
            continue
        base = row is ROWS[0]
        within, low, high = ("within 15 %", 0.85, 1.15) if base else ("at most 35 % above", 0.0, 1.35)
        for label, a, b in (
            ("position", ours.position, row.position_mse_m2),
            ("orientation", ours.orientation, row.orientation_mse_rad2),
        ):
            out.append(_ratio(f"{row.label}: {label} MSE {within}", a, b, low, high, how))
    floor = floor_of_study(results.studies[groups[0]])
    ours, how = best(groups[-1])
    above = ours.position / floor
    what = "our default: position MSE at most 20 % above the lower bound"
    out.append(Requirement(what, f"{100 * (above - 1):.1f} % above, {how}", above <= 1.2))
    return out


def steady_requirements(plan: Plan, results: Results) -> list[Requirement]:
    """Check the steady state of our default on both targets, as far as results exist."""
    out = []
    for group, target, limit in (
        (table_group(INFERRED, "default", "baseline"), "the paper's target", 2e-5),
        ("target/servicer", "servicer", 4e-6),
    ):
        ours = flown(plan, results, group)
        if ours is not None:
            what = f"our default on {target}: steady position MSE at most {limit:g} m^2"
            measured = f"{ours.steady_position:.2e} m^2"
            out.append(Requirement(what, measured, ours.steady_position <= limit))
    return out
