# SPDX-License-Identifier: Apache-2.0
"""Content of the page: prose and tables, filled in from the results. A missing result is shown as a dash."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from chaserdock.evaluation.study_cases import StudyResult

from .page import PageSection, Table
from .paper import PAPER_S, ROWS, PaperRow
from .plan import (
    ATTITUDE_BOUND_RAD,
    CHAIN,
    DELAYED_HORIZONS_S,
    DELAYS_S,
    DRAWS,
    INFERRED,
    OFFSET_BOUND_M,
    RATE_BOUND,
    ROTATION_BOUND_RAD,
    SOLVERS,
    TIMED_HORIZONS_S,
    ReproductionPlan,
    table_group,
)
from .record import ChainRecord, Provenance
from .runner import ReproductionResults
from .tables import (
    BAND,
    TREND_BAND,
    Errors,
    best_runs,
    errors_of_study,
    floor_of_study,
    own_requirements,
    spread,
    study_errors,
    verdict,
    with_images,
    with_perfect_knowledge,
)
from .trends import explain_spike, spikes, trends

NONE = "-"
_NAMES = {CHAIN: "the paper's chain", "paper": "our chain, paper's settings", "default": "our default"}


def sections(
    plan: ReproductionPlan, results: ReproductionResults, about: Provenance, recorded: ChainRecord | None
) -> list[PageSection]:
    """Return the whole page. ``recorded``: the record that stands in for the paper's chain, if it was not flown."""
    return [
        _method(plan, results, about, recorded),
        _verdicts(plan, results),
        _trends(plan, results),
        _table(plan, results),
        _starts(results),
        _ingredients(results),
        _real_time(results),
        *([] if plan.quick else [_other_runs(plan, results)]),
        _missions(plan, results),
    ]


def _position_text(x: float) -> str:
    """Format a position MSE in the paper's unit, 1e-2 m^2."""
    return f"{x * 1e2:.4g}"


def _orientation_text(x: float) -> str:
    """Format an orientation MSE in the paper's unit, 1e-3 rad^2."""
    return f"{x * 1e3:.4g}"


def _spread_text(values: Sequence[float], form: Callable[[float], str]) -> str:
    """Format least / median / greatest value, one value as itself, none as a dash."""
    if not values:
        return NONE
    s = spread(values)
    return form(s.median) if s.runs == 1 else " / ".join(map(form, (s.least, s.median, s.greatest)))


def _cell(errors: Errors | None, form: Callable[[Errors], str]) -> str:
    """Format errors, or return a dash without any."""
    return NONE if errors is None else form(errors)


def _method(
    plan: ReproductionPlan, results: ReproductionResults, about: Provenance, recorded: ChainRecord | None
) -> PageSection:
    """Return what was flown, where and when, definitions, and what is missing."""
    command = "chaserdock reproduce --quick" if plan.quick else "chaserdock reproduce"
    missing = sum(m.name not in results.missions for m in plan.missions)
    missing_studies = sum(c.name not in results.studies for c in plan.studies)
    parts: list[str | Table] = [
        f"Written by `{command}` (reproduction.md in its output folder). Flown: {about}. The paper is Fourlas, "
        "Viswanathan, Satpute and Nikolakopoulos, Vision Based Docking of Multiple Satellites with an Uncooperative "
        "Target (IFAC 2023).",
        "Errors. Position: mean over the run of the squared distance between the chaser's centre and its reference pose "
        "on the true target, m^2. Orientation: the same for the angle between the two attitudes, rad^2. Both use ground "
        "truth at every tick, from the first. Steady: the same from 20 s on. The paper states MSE without a definition.",
        f"Length. The paper's runs took {PAPER_S:g} s, and so do ours."
        if not plan.quick
        else f"Length. The paper's runs took {PAPER_S:g} s, the single-chaser runs here {plan.duration_s:g} s: the "
        "remainder is extrapolated with their steady state (20 s to the end). Only some rows are flown with images.",
        "Start. The paper does not state it. The nominal one is inferred from its results: 0.85 m straight back in front of "
        "the target, at rest in the world frame, turned by 33 degrees (rotation vector 0.42, 0, -0.3927 rad; the target is "
        "in the image). Distance, angle and axis are fitted to both errors of the paper's baseline row, so that this row "
        "is no evidence; the others are not fitted.",
        f"Dispersion. Each row is flown from {len(DRAWS)} starts, seeded and equal in all rows, uniform about the nominal "
        f"one: each component of the offset within {OFFSET_BOUND_M:g} m, of the rotation vector within "
        f"{ROTATION_BOUND_RAD:g} rad, of the target's initial rotation within {ATTITUDE_BOUND_RAD:g} rad, of its velocity "
        f"and angular velocity within {100 * RATE_BOUND:.0f} %. Tables show least / median / greatest. The paper gives the "
        "average of three runs and no spread.",
        'Navigation. All runs in the paper\'s settings have `navigation.grade = "exact"`: exact odometry, calibration and '
        "masses, as the paper assumes. So has our default in the single-chaser tables.",
        "Paper's settings: 30 Hz control and images, forward Euler in the prediction, u_ref = 0, no latency; weights, "
        "body, target and camera as in every scenario. Our default: RK4, feed-forward, 15 Hz, 1/30 s from exposure to "
        "actuation.",
        "The paper's chain: its settings, EPnP on all corners (`perception.name = paper`), its moving average of "
        "all estimates (`estimator.name = paper`) and its solver, OpEn, with PANOC (`controller.solver = open`). The paper "
        "leaves window, outlier limits, tolerances and iteration limits open; ours are in the code of these parts. The "
        "distances are a penalty in the cost instead of OpEn's augmented Lagrangian. Our chain: our perception, "
        "estimator and solver (rti).",
        "With images: a world process renders the images, a chaser process detects the markers, a controller process "
        "estimates and plans (`chaserdock run`). Perfect knowledge: the same flight code in one process, with the target's "
        "true state in place of perception and estimator, so that the chains differ in the solver only (`chaserdock study`).",
        "A run counts as failed if it misses a success criterion of the scenario: it does not reach its end, touches "
        "another body or comes closer than d_min to one; on perfect knowledge, if a solve fails. The paper does not define "
        "failure.",
    ]
    if recorded is not None:
        length = "quick " if recorded.quick else ""
        parts.append(
            f"The paper's chain was NOT flown with the rest, because its solver cannot be built on this machine. Its "
            f"figures are those of the last recorded {length}flights: {recorded.provenance}."
        )
    if missing or missing_studies:
        parts.append(
            f"NOT COMPLETE: {missing} of {len(plan.missions)} runs with images and {missing_studies} of "
            f"{len(plan.studies)} on perfect knowledge have no result. Repeat the command to resume."
        )
    return PageSection("Method", tuple(parts))


def _verdicts(plan: ReproductionPlan, results: ReproductionResults) -> PageSection:
    """Return every figure of the paper's table beside ours, judged from both sides."""
    rows = []
    for row in ROWS:
        for quantity, paper in (
            ("position", row.position_mse_m2),
            ("orientation", row.orientation_mse_rad2),
        ):
            cells = [f"{row.label}, {quantity}"]
            for column in (CHAIN, "paper"):
                runs, how = best_runs(plan, results, table_group(column, row.name))
                ratios = [getattr(e, quantity) / paper for e in runs]
                cells.append(_spread_text(ratios, lambda x: f"{x:.3g}"))
                cells.append(f"{verdict(spread(ratios).median)} ({how})" if ratios else NONE)
            rows.append(tuple(cells))
    header = ("MSE over the paper's", "the paper's chain", "verdict", "our chain", "verdict")
    parts: list[str | Table] = [
        f"Ratio of our MSE to the paper's, least / median / greatest over the starts. The median is met between "
        f"{BAND[0]:.2f} and {BAND[1]:.2f}: a smaller error is as much a difference as a larger one.",
        Table(header, tuple(rows)),
    ]
    own = own_requirements(plan, results)
    if own:
        table = tuple((r.what, r.measured, "met" if r.met else "NOT met") for r in own)
        parts += [
            "Our own limits, without counterpart in the paper. Lower bound: the smallest position MSE of any controller "
            "with 2 N along each body axis for a chaser of 30 kg that turns as ours turned (a convex quadratic programme "
            "over the first 15 s, zero error afterwards).",
            Table(("our default", "measured", "verdict"), table),
        ]
    return PageSection("Verdicts", tuple(parts))


def _trends(plan: ReproductionPlan, results: ReproductionResults) -> PageSection:
    """Return the changes from the baseline row, and the spike, with explanations."""

    def percent(x: float) -> str:
        return f"{100 * x:+.3g} %"

    rows = []
    for t in trends(plan, results):
        cells = [t.name, percent(t.paper)]
        for column in (CHAIN, "paper"):
            s, text = t.ours.get(column, (None, NONE))
            cells.append(NONE if s is None else " / ".join(map(percent, (s.least, s.median, s.greatest))))
            cells.append(text)
        rows.append((*cells, t.explanation))
    for row in (r for r in ROWS if r.failed):
        cells = [f"{row.label}, failed runs", f"{row.failed} of 3"]
        for column in (CHAIN, "paper"):
            runs = best_runs(plan, results, table_group(column, row.name))[0]
            failed = sum(e.failed for e in runs)
            same = "met" if failed * 3 == row.failed * len(runs) else "differs from the paper"
            cells += [f"{failed} of {len(runs)}", same] if runs else [NONE, NONE]
        rows.append((*cells, "The paper does not define failure; see the error of the same row."))
    found = spikes(results)
    measured = [
        (NONE, NONE) if c not in found else (found[c].text, found[c].verdict) for c in (CHAIN, "paper")
    ]
    spike = (
        "two chasers, orientation error at 100 s",
        "a spike",
        *measured[0],
        *measured[1],
        explain_spike(),
    )
    rows.append(spike)
    header = ("trend", "paper", "the paper's chain", "verdict", "our chain", "verdict", "explanation")
    text = (
        "Change of a row's MSE from the baseline row of the same start, least / median / greatest; with images where all "
        "starts of both rows are flown so, else on perfect knowledge. A trend is met if the ratio of the median change to "
        f"the paper's is between {TREND_BAND[0]:g} and {TREND_BAND[1]:g}. The spike: attitude error of the target estimate "
        "from 20 s to 120 s."
    )
    return PageSection("Trends", (text, Table(header, tuple(rows))))


def _table(plan: ReproductionPlan, results: ReproductionResults) -> PageSection:
    """Return the nine rows in all columns, position, orientation and steady state."""
    columns = [
        (f"{_NAMES[column]}, {how}", column, how == "images")
        for column in (CHAIN, "paper", "default")
        for how in ("images", "perfect knowledge")
    ]

    def cells(row: PaperRow, value: Callable[[Errors], float], form: Callable[[float], str]) -> list[str]:
        out = []
        for _, column, images in columns:
            group = table_group(column, row.name)
            runs = with_images(plan, results, group) if images else with_perfect_knowledge(results, group)
            out.append(_spread_text([value(e) for e in runs], form))
        return out

    names = tuple(name for name, _, _ in columns)
    parts: list[str | Table] = []
    for text, paper, value, form in (
        ("Position MSE, 1e-2 m^2.", lambda r: r.position_mse_m2, lambda e: e.position, _position_text),
        (
            "Orientation MSE, 1e-3 rad^2.",
            lambda r: r.orientation_mse_rad2,
            lambda e: e.orientation,
            _orientation_text,
        ),
        ("Steady position MSE, m^2.", None, lambda e: e.steady_position, lambda x: f"{x:.2e}"),
    ):
        header = ("row", *(("paper",) if paper else ()), *names)
        rows = [(r.label, *((form(paper(r)),) if paper else ()), *cells(r, value, form)) for r in ROWS]
        parts += [text, Table(header, tuple(rows))]
    failed = [
        (r.label, f"{r.failed} of 3", *(_failed_text(plan, results, c, i, r) for _, c, i in columns))
        for r in ROWS
    ]
    parts += ["Failed runs.", Table(("row", "paper", *names), tuple(failed))]
    return PageSection("The single-chaser table", tuple(parts))


def _failed_text(
    plan: ReproductionPlan, results: ReproductionResults, column: str, images: bool, row: PaperRow
) -> str:
    group = table_group(column, row.name)
    runs = with_images(plan, results, group) if images else with_perfect_knowledge(results, group)
    return f"{sum(e.failed for e in runs)} of {len(runs)}" if runs else NONE


def _starts(results: ReproductionResults) -> PageSection:
    rows = []
    for name in (n for n in results.studies if n.startswith("start/")):
        errors, result = study_errors(results, name), results.studies[name]
        floor = None if result.floor_m2_s is None else floor_of_study(result)
        if errors is None or floor is None:
            continue
        rows.append(
            (
                name.removeprefix("start/"),
                _position_text(errors.position),
                _position_text(floor),
                f"{errors.position / floor:.3f}",
                f"{errors.position / ROWS[0].position_mse_m2:.2f}",
                _orientation_text(errors.orientation),
                f"{errors.orientation / ROWS[0].orientation_mse_rad2:.2f}",
            )
        )
    header = (
        "start",
        "position, 1e-2 m^2",
        "lower bound",
        "ratio",
        "ratio to the paper",
        "orientation, 1e-3 rad^2",
        "ratio to the paper",
    )
    best = min(row.position_mse_m2 for row in ROWS)
    text = (
        "Baseline row, our chain in the paper's settings, perfect knowledge. The labels state the difference from the "
        "inferred (nominal) start. The target moves away from a chaser behind it (receding: the paper's chaser 0) and towards "
        "one in front of it (closing: its chaser 3). The first ten seconds dominate the error. The paper's baseline is "
        f"{_position_text(ROWS[0].position_mse_m2)}e-2 m^2, its best row {_position_text(best)}e-2: where that is below the "
        "lower bound, no controller that turns as ours does can have flown it from that start."
    )
    return PageSection("Effect of the start", (text, Table(header, tuple(rows))))


def _ingredients(results: ReproductionResults) -> PageSection:
    base = study_errors(results, f"start/{INFERRED}")
    rows = []
    for name in (n for n in results.studies if n.startswith("ingredient/")):
        errors = study_errors(results, name)
        if errors is None or base is None:
            continue
        rows.append(
            (
                name.removeprefix("ingredient/"),
                _position_text(errors.position),
                f"{100 * (errors.position / base.position - 1):+.1f} %",
                _orientation_text(errors.orientation),
                f"{100 * (errors.orientation / base.orientation - 1):+.1f} %",
                f"{errors.steady_position:.2e}",
            )
        )
    header = ("changed", "position, 1e-2 m^2", "change", "orientation, 1e-3 rad^2", "change", "steady, m^2")
    text = (
        "Baseline row from the nominal start, our chain in the paper's settings, perfect knowledge; one change at a time. "
        "With u_ref = 0 the input cost opposes the constant force that a tumbling reference needs: the steady error."
    )
    return PageSection("Effect of each ingredient", (text, Table(header, tuple(rows))))


def _real_time(results: ReproductionResults) -> PageSection:
    rows = []
    for delay_s in DELAYS_S:
        cells = [f"{delay_s:g} s"]
        for horizon_s in DELAYED_HORIZONS_S:
            errors = study_errors(results, f"delay/{horizon_s:g}/{delay_s:g}")
            cells += [
                _cell(errors, lambda e: _position_text(e.position)),
                _cell(errors, lambda e: _orientation_text(e.orientation)),
            ]
        rows.append(tuple(cells))
    header = ["delay"]
    for horizon_s in DELAYED_HORIZONS_S:
        header += [f"T = {horizon_s:g} s: position, 1e-2 m^2", "orientation, 1e-3 rad^2"]
    measured = [
        _measured(f"{solver}, T = {horizon_s:g} s", results.studies[name])
        for horizon_s in TIMED_HORIZONS_S
        for solver in SOLVERS
        if (name := f"measured/{horizon_s:g}/{solver}") in results.studies
    ]
    columns = ("solver", "median solve, ms", "longest, ms", "position, 1e-2 m^2", "orientation, 1e-3 rad^2")
    return PageSection(
        "Effect of the solve time",
        (
            "The runs above are in simulated time: a plan is never late. Here the command takes effect only after the given "
            "delay, computed for the state at its beginning without latency compensation; the ticks in between are skipped. "
            "Nominal start, our chain in the paper's settings, perfect knowledge.",
            Table(tuple(header), tuple(rows)),
            "With the solve time measured on this machine instead of a fixed delay (depends on the machine and its load; "
            "30 s flown). rti is our solver, ipopt iterates to convergence, open is OpEn, the paper's.",
            Table(columns, tuple(measured)),
        ),
    )


def _measured(name: str, result: StudyResult) -> tuple[str, ...]:
    errors = errors_of_study(result)
    times = f"{result.solve_p50_s * 1e3:.2f}", f"{result.solve_max_s * 1e3:.1f}"
    return name, *times, _position_text(errors.position), _orientation_text(errors.orientation)


def _other_runs(plan: ReproductionPlan, results: ReproductionResults) -> PageSection:
    """Return the baseline row with the paper's combiner alone, and our default on both targets."""
    rows = []
    for label, group in (
        ("paper's settings, our chain", table_group("paper", "baseline")),
        ("the same with the paper's combiner", "estimator/paper"),
        ("our default", table_group("default", "baseline")),
        ("our default, target servicer", "target/servicer"),
    ):
        runs = with_images(plan, results, group)
        rows.append(
            (
                label,
                _spread_text([e.position for e in runs], _position_text),
                _spread_text([e.orientation for e in runs], _orientation_text),
                _spread_text([math.sqrt(e.steady_position) * 1e3 for e in runs], lambda x: f"{x:.2f}"),
                _spread_text(
                    [math.degrees(math.sqrt(e.steady_orientation)) for e in runs], lambda x: f"{x:.3f}"
                ),
                f"{sum(e.failed for e in runs)} of {len(runs)}" if runs else NONE,
            )
        )
    header = (
        "baseline row, with images",
        "position, 1e-2 m^2",
        "orientation, 1e-3 rad^2",
        "steady RMS, mm",
        "steady RMS, deg",
        "failed",
    )
    return PageSection("Estimators and targets", (Table(header, tuple(rows)),))


def _missions(plan: ReproductionPlan, results: ReproductionResults) -> PageSection:
    """The paper's missions of several chasers."""
    rows = []
    for m in plan.missions:
        if not m.group.startswith("mission/"):
            continue
        summary = results.missions.get(m.name)
        _, column, name, _ = m.name.split("/")
        cells = _mission_cells(summary) if summary is not None else (NONE,) * 6
        rows.append((name, _NAMES[column], *cells))
    header = (
        "mission",
        "settings",
        "flown, s",
        "result",
        "worst steady RMS, mm; deg",
        "closest to the target, m",
        "closest chasers, m",
        "docked or reached",
    )
    text = (
        "The paper shows these as plots, without numbers. Its claims: two chasers hold their poses with shared sightings; "
        "chasers 0 and 3 of four dock after a command at 60 s; chaser 0, on the sightings of chaser 1, passes the target "
        "no closer than 0.35 m. Our default is the shipped scenario with its navigation grade (lab) and camera; the others "
        'have `navigation.grade = "exact"`, no latency, forward Euler and u_ref = 0'
        + (", at the scenario's rate and image size." if plan.quick else ", 30 Hz and 1280 x 720 pixels.")
    )
    return PageSection("Missions", (text, Table(header, tuple(rows))))


def _mission_cells(summary: dict[str, Any]) -> tuple[str, ...]:
    chasers = summary["chasers"].values()
    steady = [c["steady"] for c in chasers if c["steady"]["position_mse_m2"] is not None]
    worst = NONE
    if steady:
        position = math.sqrt(max(s["position_mse_m2"] for s in steady)) * 1e3
        worst = (
            f"{position:.2f}; {math.degrees(math.sqrt(max(s['orientation_mse_rad2'] for s in steady))):.3f}"
        )
    outcomes = [
        f"{i} docked at {c['dock_time_s']:.1f} s" for i, c in summary["chasers"].items() if c["docked"]
    ]
    outcomes += [
        f"{i} reached its goal at {c['reached_time_s']:.1f} s"
        for i, c in summary["chasers"].items()
        if c["reached_time_s"] is not None
    ]
    between = summary["min_distance_chasers_m"]
    return (
        f"{summary['sim_time_s']:.0f}",
        "success" if summary["success"] else "FAILED: " + "; ".join(summary["failures"]),
        worst,
        f"{min(c['min_distance_target_m'] for c in chasers):.3f}",
        NONE if between is None else f"{between:.3f}",
        ", ".join(outcomes) or NONE,
    )
