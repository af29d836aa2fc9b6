# SPDX-License-Identifier: Apache-2.0
"""Content of the page: prose and tables, filled in from the results. A missing result appears as a
dash.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario.bodies import Target

from chaserdock.experiments.page import PageSection, Table
from chaserdock.experiments.plan import ExperimentPlan

from .curves import curves_section
from .earlier import NO_PAGE, EarlierPage
from .flown import Provenances, flights_section
from .headline import Tables, free_section, result_section
from .paper import BASELINE, PAPER_S, ROWS
from .plan import (
    ATTITUDE_BOUND_RAD,
    CODE,
    COLUMNS,
    DEFAULT,
    DRAWS,
    OFFSET_BOUND_M,
    QUICK_S,
    RATE_BOUND,
    ROTATION_BOUND_RAD,
    STARTS,
    TRACKING,
    WRITTEN,
    floor_name,
    mission_name,
    missions_of,
)
from .tables import (
    LOST_M,
    MIN_DISTANCE_M,
    NONE,
    QUANTITIES,
    Quantity,
    Summaries,
    cell,
    errors_by_label,
    paper_value,
    spread,
    verdict,
    without_partial_rows,
)
from .trends import trend_rows

UNITS: dict[Quantity, tuple[float, str]] = {
    "position": (1e2, "1e-2 m^2"),
    "orientation": (1e3, "1e-3 rad^2"),
}
"""Units of the paper: factor from SI, and name."""


def sections(
    plan: ExperimentPlan,
    results: Summaries,
    flown: Provenances,
    quick: bool,
    earlier: EarlierPage = NO_PAGE,
) -> list[PageSection]:
    """Return the whole page; ``quick``: of the quick plan. Where a row is not flown completely, the
    cells of the ``earlier`` page stand.
    """
    missing = sum(flight.label not in results for flight in plan.flights)
    if earlier is not NO_PAGE:
        results = without_partial_rows(results, tuple(COLUMNS), quick)
    tables: Tables = {quantity: _table(results, quantity, earlier) for quantity in QUANTITIES}
    trends = _trends(results, earlier)
    return [
        result_section(results, tables, trends, (missing, len(plan.flights)), quick, earlier),
        curves_section(tables),
        PageSection("Trends", (_TRENDS_TEXT, trends)),
        free_section(results),
        *(PageSection(f"Table: {q}", (_table_text(), tables[q])) for q in QUANTITIES),
        *([] if quick else [_missions(plan, results, earlier)]),
        _start(results, earlier),
        flights_section(plan, flown),
        _method(quick),
    ]


def _ratios(results: Summaries, column: str, row, quantity: Quantity) -> list[float]:
    paper = paper_value(row, quantity)
    return [e.of(quantity) / paper for e in cell(results, column, row).values()]


def _table(results: Summaries, quantity: Quantity, earlier: EarlierPage) -> Table:
    """Return the nine rows of one error: ratios to the paper's values, with spread and verdict."""
    factor, unit = UNITS[quantity]
    rows = []
    for row in ROWS:
        cells = []
        for column in COLUMNS:
            ratios = _ratios(results, column, row, quantity)
            cells.append(
                f"{_spread_text(ratios)} {verdict(spread(ratios).median)}" if ratios else NONE
            )
        rows.append((row.label, f"{paper_value(row, quantity) * factor:.3g}", *cells))
    header = ("row", f"paper, {unit}", *COLUMNS)
    return earlier.fill(f"Table: {quantity}", Table(header, tuple(rows)))


def _table_text() -> str:
    return (
        "Mean square error over two minutes. Ratio to the paper's: median (least to greatest) "
        f"over the {len(DRAWS)} starts, and the verdict on the median."
    )


def _spread_text(values: Sequence[float]) -> str:
    s = spread(values)
    return (
        f"{s.median:.3g}"
        if s.number == 1
        else f"{s.median:.3g} ({s.least:.3g} to {s.greatest:.3g})"
    )


_TRENDS_TEXT = (
    "Change of the MSE from the baseline row of the same start, position; orientation "
    "(median). yes: it has the paper's direction from every start and half to twice its "
    "size. Controller alone: OpEn on perfect knowledge of the target, from the nominal "
    "start. Spike: attitude error of the target estimate after 20 s."
)


def _trends(results: Summaries, earlier: EarlierPage) -> Table:
    """Return the changes from the baseline row and the spike, with explanations."""
    spike = [_spike_text(results.get(mission_name(TRACKING, column))) for column in (CODE, DEFAULT)]
    written = _spike_text(results.get(mission_name(TRACKING, WRITTEN)))
    why = NONE if written == NONE else _spike_explanation(written)
    rows = [*trend_rows(results), ("two chasers: error at 100 s", "a spike", *spike, NONE, why)]
    header = ("trend", "paper", CODE, DEFAULT, "controller alone", "explanation")
    return earlier.fill("Trends", Table(header, tuple(rows), text=True))


def _spike_text(summary: dict[str, Any] | None) -> str:
    if summary is None:
        return NONE
    estimate = summary["target_estimate"]
    most, rms = estimate["max_orientation_error_rad"], estimate["orientation_rms_rad"]
    if most is None or rms is None:
        return "no estimate"
    at_s = estimate["max_orientation_error_at_s"]
    return f"at most {math.degrees(most):.3g} deg, {most / rms:.1f} times the RMS, at {at_s:.0f} s"


def pitch_rad(time_s: float) -> float:
    """Return the pitch (Z-Y-X Euler angles in WRF) of the paper's target, which starts
    unrotated.
    """
    attitude = rotations.exp(np.multiply(Target().omega_rad_s, time_s))
    return -math.asin(float(rotations.to_matrix(attitude)[2, 0]))


def _spike_explanation(written: str) -> str:
    """Return how close the target's attitude comes to the singularity that the paper blames, and
    what EPnP does there.
    """
    times = np.arange(0.0, PAPER_S + 0.5, 0.5)
    pitch = np.abs([pitch_rad(t) for t in times])
    k = int(np.argmax(pitch))
    return (
        "The paper blames an Euler angle singularity of PnP. From an unrotated start the "
        "target's pitch is "
        f"{math.degrees(pitch[times == 100.0][0]):.0f} deg at 100 s and at most "
        f"{math.degrees(pitch[k]):.0f} deg, so there is none; and no chain here uses Euler "
        f"angles. With EPnP: {written}."
    )


def _missions(plan: ExperimentPlan, results: Summaries, earlier: EarlierPage) -> PageSection:
    """Return the section on the paper's missions of several chasers."""
    rows = []
    for flight in missions_of(plan):
        summary = results.get(flight.label)
        cells = (NONE,) * 5 if summary is None else _mission_cells(summary)
        rows.append((flight.varied["mission"], flight.varied["chain"], *cells))
    header = (
        "mission",
        "chain",
        "steady RMS, mm",
        "steady RMS, deg",
        "closest to the target, m",
        "closest chasers, m",
        "docked or arrived",
    )
    text = (
        "The paper shows plots without numbers and claims: two chasers hold their poses on "
        "shared sightings; chasers 0 and 3 "
        "of four dock after a command at 60 s; chaser 0 passes the target no closer than "
        f"{MIN_DISTANCE_M:g} m on the "
        f'sightings of chaser 1. RMS of the worst chaser. "{DEFAULT}" flies the shipped '
        "scenarios: navigation grade lab, "
        "15 Hz, latency; the paper's chains fly its settings, with exact navigation."
    )
    table = earlier.fill("Missions", Table(header, tuple(rows)), keys=2)
    return PageSection("Missions", (text, table))


def _mission_cells(summary: dict[str, Any]) -> tuple[str, ...]:
    chasers: dict[str, Any] = summary["chasers"]
    events = [f"{i} docked at {c['dock_time_s']:.0f} s" for i, c in chasers.items() if c["docked"]]
    events += [
        f"{i} arrived at {c['reached_time_s']:.0f} s"
        for i, c in chasers.items()
        if c["reached_time_s"] is not None
    ]
    position, angle = (
        _worst([c["steady"][name] for c in chasers.values()])
        for name in ("position_mse_m2", "orientation_mse_rad2")
    )
    least = min(c["min_distance_target_m"] for c in chasers.values())
    between = summary["min_distance_chasers_m"]
    return (
        NONE if position is None else f"{position * 1e3:.3g}",
        NONE if angle is None else f"{math.degrees(angle):.2g}",
        f"{least:.3f}",
        NONE if between is None else f"{between:.3f}",
        ", ".join(events) or NONE,
    )


def _worst(mean_squares: Sequence[float | None]) -> float | None:
    """Return the largest of the roots of mean squares; None if one is missing."""
    known = [math.sqrt(x) for x in mean_squares if x is not None]
    return max(known) if len(known) == len(mean_squares) else None


def _start(results: Summaries, earlier: EarlierPage) -> PageSection:
    """Return how much the start contributes: other starts, and the lower bound."""
    nominal = errors_by_label(results, f"alone/{BASELINE.name}")
    rows = []
    for name in ("nominal", *STARTS):
        errors = nominal if name == "nominal" else errors_by_label(results, f"start/{name}")
        ratios = [errors.of(q) / paper_value(BASELINE, q) for q in QUANTITIES] if errors else []
        rows.append((name, *(f"{x:.2f}" for x in ratios)) if ratios else (name, NONE, NONE))
    header = ("baseline row, controller alone", "position / paper", "orientation / paper")
    names = [f"alone/{BASELINE.name}", *map(floor_name, DRAWS)]
    floors = [(name, results[name]["floor_m2_s"] / PAPER_S) for name in names if name in results]
    parts: list[str | Table] = [
        "The paper does not state the start. The nominal one is inferred from its baseline row: "
        "0.85 m straight back in front of the target, at rest in the world frame, turned by "
        "0.575 rad. Distance, angle and axis are fitted to both errors of that row, which is "
        "therefore no evidence; the other rows are not fitted. Each row is flown from "
        f"{len(DRAWS)} starts, seeded and equal in all rows, uniform about the nominal one: each "
        f"component of the offset within {OFFSET_BOUND_M:g} m, of the rotation vector within "
        f"{ROTATION_BOUND_RAD:g} rad, of the target's initial rotation within "
        f"{ATTITUDE_BOUND_RAD:g} rad, of its velocities within {100 * RATE_BOUND:.0f} %.",
        earlier.fill("Start", Table(header, tuple(rows))),
    ]
    if names[0] in results:
        least = min(value for _, value in floors)
        best = min(ROWS, key=lambda row: row.position_mse_m2)
        compared = "below" if best.position_mse_m2 < floors[0][1] else "above"
        parts.append(
            "Lower bound of the position MSE for any controller with 2 N along each body axis "
            "that turns as ours turned (a convex "
            f"quadratic programme over the first 15 s): {floors[0][1] * 1e2:.3g}e-2 m^2 from the "
            f"nominal start, least {least * 1e2:.3g}e-2 over all starts. The paper's row "
            f"{best.label} ({best.position_mse_m2 * 1e2:.3g}e-2) is {compared} that of the "
            "nominal start."
        )
    return PageSection("Start", tuple(parts))


def _method(quick: bool) -> PageSection:
    """Return definitions and settings."""
    length = (
        f"Flights take {PAPER_S:g} s, as the paper's."
        if not quick
        else f"Quick: one start in place of {len(DRAWS)}, flights of {QUICK_S:g} s, extrapolated "
        f"to the paper's {PAPER_S:g} s with their steady state (20 s to the end), no "
        "missions."
    )
    return PageSection(
        "Method",
        (
            "Errors: mean over the flight of the squared distance of the chaser's centre from "
            "its reference pose on the true target, and of the squared angle between the two "
            "attitudes, from the first tick. The paper states MSE without a "
            f"definition. {length}",
            f"A flight failed if the chaser came closer than {MIN_DISTANCE_M:g} m to the target, "
            f"or if its RMS distance from the reference pose after 20 s exceeds {LOST_M:g} m, "
            "the distance at the start. The paper does not define failure.",
            "The paper's settings: 30 Hz control and images of 1280 x 720 pixels, forward Euler "
            "in the prediction, u_ref = 0, no latency; its weights, body, target and camera. "
            "Ours: RK4, feed-forward, 15 Hz, 1/30 s from exposure to actuation; "
            'joint estimator, rti solver. All table flights have `navigation.grade = "exact"`, '
            "as the paper assumes.",
            "The paper leaves the combiner's window and outlier limits, and OpEn's tolerances "
            "and iteration limits open; ours are in the code. Distances are a penalty in the "
            "cost in place of OpEn's augmented Lagrangian.",
            f'"{WRITTEN}" is flown in the baseline row only, because it does not depend on the '
            f'controller whether EPnP works; "{DEFAULT}" from one start in the other rows.',
            "All flights run in simulated time, so that a plan is never late unless a delay is "
            "stated: the missions as `chaserdock run` flies them, all others in one process "
            "without a recorder, which flies the same (`tests/missions/test_in_process.py`).",
        ),
    )
