"""What the page says: the tables filled in, what was measured and how, what explains the differences.

A run that is not finished yet leaves a dash.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from chaserdock_protocol.study import StudyResult

from .page import Section, Table
from .paper import PAPER_S, ROWS, Row
from .plan import DELAYED_HORIZONS_S, DELAYS_S, STARTS, Plan, table_group
from .runner import Results
from .tables import (
    Errors,
    Requirement,
    errors_of_study,
    floor_of_study,
    flown,
    requirements,
    steady_requirements,
)

_NONE = "-"


def sections(plan: Plan, results: Results) -> list[Section]:
    """The whole page."""
    return [
        _how(plan, results),
        _required(plan, results),
        *(_start(plan, results, start) for start in STARTS),
        _starts(results),
        _ingredients(results),
        _real_time(results),
        _others(plan, results),
        _missions(plan, results),
    ]


def _position(x: float) -> str:
    """Position MSE in the paper's unit, 1e-2 m^2."""
    return f"{x * 1e2:.4g}"


def _orientation(x: float) -> str:
    """Orientation MSE in the paper's unit, 1e-3 rad^2."""
    return f"{x * 1e3:.4g}"


def _of(errors: Errors | None, shown: Callable[[Errors], str]) -> str:
    return _NONE if errors is None else shown(errors)


def _study(results: Results, name: str) -> Errors | None:
    found = results.studies.get(name)
    return None if found is None else errors_of_study(found)


def _floor(results: Results, name: str) -> float | None:
    found = results.studies.get(name)
    return None if found is None else floor_of_study(found)


def _how(plan: Plan, results: Results) -> Section:
    how = "chaserdock reproduce --quick" if plan.quick else "chaserdock reproduce"
    missing = sum(m.name not in results.missions for m in plan.missions)
    missing_studies = sum(c.name not in results.studies for c in plan.studies)
    parts: list[str | Table] = [
        f"Written by `{how}`. The paper is Fourlas, Viswanathan, Satpute and Nikolakopoulos, Vision Based Docking of "
        "Multiple Satellites with an Uncooperative Target (IFAC 2023).",
        "Errors. Position: mean over the run of the square of the distance between the chaser's centre and its "
        "reference pose on the true target, m^2. Orientation: the same of the angle between their attitudes, rad^2. Both "
        "are taken on ground truth at every tick, from the first. Steady: the same from "
        "20 s on. The paper says MSE and no more.",
        f"Length. The paper's runs took {PAPER_S:g} s, and so do ours here."
        if not plan.quick
        else f"Length. The paper's runs took {PAPER_S:g} s, the single-chaser runs here {plan.duration_s:g} s: what follows "
        "counts as their steady state (20 s to the end). One seed each.",
        "Start. The paper does not give it. Inferred: 0.85 m straight back from the reference pose, rolled by 0.575 rad "
        "about the body's X, at rest in the world frame. As the target moves, it matters which way: it flies away from "
        "a chaser that waits behind it (receding: reference pose of the paper's chaser 0) and towards one that waits "
        "in front of it (closing: its chaser 3). Both are shown.",
        "With pictures: a world process renders 1280 x 720 pictures, a chaser process sees the markers, a controller "
        "process estimates and plans (`chaserdock run`). Perfect knowledge: the same flight code in one process with "
        "the target's true state in place of the estimate (`chaserdock study`).",
        "Paper's settings: 30 Hz control and pictures, forward Euler in the prediction, u_ref = 0, no latency; weights, "
        "body, target and camera as everywhere. Our default: RK4, feed-forward, 15 Hz, 1/30 s from exposure to "
        "actuation.",
        "Least possible: the smallest position MSE of any controller under 2 N along each body axis for a chaser of 30 kg "
        "that turns as ours turned (a convex quadratic programme over the first 15 s, with zero error from then on).",
        "A run counts as failed if it does not reach its end, touches or comes nearer than d_min to anything, or has a "
        "solve without an answer (perfect knowledge). The paper does not say what it counts.",
    ]
    if missing or missing_studies:
        parts.append(
            f"NOT COMPLETE: {missing} of {len(plan.missions)} runs with pictures and {missing_studies} of "
            f"{len(plan.studies)} on perfect knowledge are not flown yet. The same command goes on with them."
        )
    return Section("What was flown, and how it is measured", tuple(parts))


def _required(plan: Plan, results: Results) -> Section:
    parts: list[str | Table] = []

    def show(title: str, held: list[Requirement] | None) -> None:
        if held:
            rows = tuple((r.what, r.measured, "yes" if r.met else "NO") for r in held)
            parts.append(Table((title, "measured", "met"), rows))
        elif held is None:
            parts.append(f"{title}: not flown yet.")

    for start in STARTS:
        show(f"from the {start} start", requirements(plan, results, start))
    show("steady state", steady_requirements(plan, results))
    receding, closing = (_floor(results, table_group(s, "paper", "baseline")) for s in STARTS)
    if receding is not None and closing is not None:
        best = min(row.position_mse_m2 for row in ROWS)
        parts.append(
            f"The least possible position MSE is {_position(receding)}e-2 m^2 from the receding start and "
            f"{_position(closing)}e-2 m^2 from the closing one; the paper's baseline is "
            f"{_position(ROWS[0].position_mse_m2)}e-2, its best row {_position(best)}e-2. Where the paper's figure is below "
            "the least possible, no controller that turns as ours does can have flown it from that start: the paper started "
            "elsewhere, nearer, or with other limits. The tables on the start and on the ingredients say what each does."
        )
    return Section("What is to hold", tuple(parts))


_ROW_HEADER = (
    "row",
    "paper, 1e-2 m^2",
    "perfect knowledge",
    "with pictures",
    "with pictures / paper",
    "steady, with pictures",
    "paper, 1e-3 rad^2",
    "perfect knowledge",
    "with pictures",
    "with pictures / paper",
    "failed, paper",
    "failed, ours",
)


def _start(plan: Plan, results: Results, start: str) -> Section:
    """The nine rows from one start, in the paper's settings and in ours."""
    ours = tuple(_row(plan, results, start, row) for row in ROWS)
    parts: list[str | Table] = [
        "Paper's settings. Position MSE in 1e-2 m^2, orientation MSE in 1e-3 rad^2.",
        Table(_ROW_HEADER, ours),
    ]
    floor = _floor(results, table_group(start, "paper", "baseline"))
    parts.append(
        "Our default in the same rows, same units. Least possible position MSE: "
        + (_NONE if floor is None else f"{_position(floor)}e-2 m^2.")
    )
    rows = []
    for row in ROWS:
        group = table_group(start, "default", row.name)
        perfect, seen = _study(results, group), flown(plan, results, group)
        above = seen if seen is not None else perfect
        rows.append(
            (
                row.name,
                _of(perfect, lambda e: _position(e.position)),
                _of(seen, lambda e: _position(e.position)),
                _NONE if above is None or floor is None else f"{above.position / floor:.3f}",
                _of(perfect, lambda e: _orientation(e.orientation)),
                _of(seen, lambda e: _orientation(e.orientation)),
                _of(perfect, lambda e: f"{e.steady_position:.2e}"),
                _of(seen, lambda e: f"{e.steady_position:.2e}"),
                _of(seen, lambda e: f"{e.failed} of {e.runs}"),
            )
        )
    header = (
        "row",
        "position, perfect knowledge",
        "position, with pictures",
        "over the least possible",
        "orientation, perfect knowledge",
        "orientation, with pictures",
        "steady, perfect knowledge, m^2",
        "steady, with pictures, m^2",
        "failed",
    )
    parts.append(Table(header, tuple(rows)))
    return Section(f"The single-chaser table, {start} start", tuple(parts))


def _row(plan: Plan, results: Results, start: str, row: Row) -> tuple[str, ...]:
    group = table_group(start, "paper", row.name)
    perfect, seen = _study(results, group), flown(plan, results, group)
    return (
        row.name,
        _position(row.position_mse_m2),
        _of(perfect, lambda e: _position(e.position)),
        _of(seen, lambda e: _position(e.position)),
        _of(seen, lambda e: f"{e.position / row.position_mse_m2:.2f}"),
        _of(seen, lambda e: f"{e.steady_position:.2e} m^2"),
        _orientation(row.orientation_mse_rad2),
        _of(perfect, lambda e: _orientation(e.orientation)),
        _of(seen, lambda e: _orientation(e.orientation)),
        _of(seen, lambda e: f"{e.orientation / row.orientation_mse_rad2:.2f}"),
        f"{row.failed} of 3",
        _of(seen, lambda e: f"{e.failed} of {e.runs}"),
    )


def _starts(results: Results) -> Section:
    rows = []
    names = [table_group(start, "paper", "baseline") for start in STARTS]
    names += [n for n in results.studies if n.startswith("start/")]
    for name in names:
        errors, floor = _study(results, name), _floor(results, name)
        if errors is None or floor is None:
            continue
        rows.append(
            (
                name.removeprefix("start/").removesuffix("/paper/baseline"),
                _position(errors.position),
                _position(floor),
                f"{errors.position / floor:.3f}",
                f"{errors.position / ROWS[0].position_mse_m2:.2f}",
                _orientation(errors.orientation),
                f"{errors.orientation / ROWS[0].orientation_mse_rad2:.2f}",
            )
        )
    header = (
        "start",
        "position, 1e-2 m^2",
        "least possible",
        "ratio",
        "over the paper's",
        "orientation, 1e-3 rad^2",
        "over the paper's",
    )
    text = (
        "Baseline row, paper's settings, perfect knowledge. Every further line differs from the receding start in what it "
        "says. This is the first ten seconds: what follows adds next to nothing."
    )
    return Section("How the figure moves with the start", (text, Table(header, tuple(rows))))


def _ingredients(results: Results) -> Section:
    base = _study(results, table_group("receding", "paper", "baseline"))
    rows = []
    for name in (n for n in results.studies if n.startswith("ingredient/")):
        errors = _study(results, name)
        if errors is None or base is None:
            continue
        rows.append(
            (
                name.removeprefix("ingredient/"),
                _position(errors.position),
                f"{100 * (errors.position / base.position - 1):+.1f} %",
                _orientation(errors.orientation),
                f"{100 * (errors.orientation / base.orientation - 1):+.1f} %",
                f"{errors.steady_position:.2e}",
            )
        )
    header = ("changed", "position, 1e-2 m^2", "change", "orientation, 1e-3 rad^2", "change", "steady, m^2")
    text = "Baseline row from the receding start, perfect knowledge; one thing changed at a time in the paper's settings."
    return Section("How the figure moves with each ingredient", (text, Table(header, tuple(rows))))


def _real_time(results: Results) -> Section:
    rows = []
    for delay_s in DELAYS_S:
        cells = [f"{delay_s:g} s"]
        for horizon_s in DELAYED_HORIZONS_S:
            errors = _study(results, f"delay/{horizon_s:g}/{delay_s:g}")
            cells += [
                _of(errors, lambda e: _position(e.position)),
                _of(errors, lambda e: _orientation(e.orientation)),
            ]
        rows.append(tuple(cells))
    header = ["delay"]
    for horizon_s in DELAYED_HORIZONS_S:
        header += [f"T = {horizon_s:g} s: position, 1e-2 m^2", "orientation, 1e-3 rad^2"]
    measured = []
    for horizon_s in DELAYED_HORIZONS_S:
        for solver in ("rti", "ipopt"):
            found = results.studies.get(f"measured/{horizon_s:g}/{solver}")
            if found is not None:
                measured.append(_measured(f"{solver}, T = {horizon_s:g} s", found))
    columns = ("solver", "median solve, ms", "longest, ms", "position, 1e-2 m^2", "orientation, 1e-3 rad^2")
    return Section(
        "What real time does: T = 10",
        (
            "In simulated time no horizon fails. Here the command acts only when the solver would be done, on a plan for "
            "the state at the beginning; nothing is predicted ahead, and the ticks that pass meanwhile are "
            "missed. Receding start, paper's settings, perfect knowledge.",
            Table(tuple(header), tuple(rows)),
            "With the solve time as measured on this machine in place of a fixed delay (it depends on the machine and on "
            "its load; 30 s flown):",
            Table(columns, tuple(measured)),
        ),
    )


def _measured(name: str, result: StudyResult) -> tuple[str, ...]:
    errors = errors_of_study(result)
    times = f"{result.solve_p50_s * 1e3:.2f}", f"{result.solve_max_s * 1e3:.1f}"
    return name, *times, _position(errors.position), _orientation(errors.orientation)


def _others(plan: Plan, results: Results) -> Section:
    rows = []
    for label, group in (
        ("paper's settings, mekf", table_group("receding", "paper", "baseline")),
        ("paper's settings, the paper's estimator", "estimator/paper"),
        ("our default", table_group("receding", "default", "baseline")),
        ("our default, target servicer", "target/servicer"),
    ):
        e = flown(plan, results, group)
        rows.append(
            (
                label,
                _of(e, lambda e: _position(e.position)),
                _of(e, lambda e: _orientation(e.orientation)),
                _of(e, lambda e: f"{e.steady_position:.2e}"),
                _of(e, lambda e: f"{math.sqrt(e.steady_position) * 1e3:.2f}"),
                _of(e, lambda e: f"{math.degrees(math.sqrt(e.steady_orientation)):.3f}"),
                _of(e, lambda e: f"{e.failed} of {e.runs}"),
            )
        )
    header = (
        "baseline row, receding start",
        "position, 1e-2 m^2",
        "orientation, 1e-3 rad^2",
        "steady position, m^2",
        "steady RMS, mm",
        "steady RMS, deg",
        "failed",
    )
    return Section("Estimators and targets", (Table(header, tuple(rows)),))


def _missions(plan: Plan, results: Results) -> Section:
    rows = []
    for m in plan.missions:
        if not m.group.startswith("mission/"):
            continue
        summary = results.missions.get(m.name)
        _, column, name = m.group.split("/")
        rows.append((name, column, *(_mission(summary) if summary is not None else (_NONE,) * 6)))
    header = (
        "mission",
        "settings",
        "flown, s",
        "result",
        "worst steady RMS, mm; deg",
        "nearest to the target, m",
        "nearest chasers, m",
        "docked or reached",
    )
    text = (
        "The paper shows these as plots, without figures. Its claims: two chasers keep their poses on shared sightings; "
        "chasers 0 and 3 of four dock after a command at 60 s; chaser 0 passes the target no nearer than 0.35 m on what "
        "chaser 1 sees. Settings as above, but in the default ones the camera is the scenario's own."
    )
    return Section("The missions", (text, Table(header, tuple(rows))))


def _mission(summary: dict[str, Any]) -> tuple[str, ...]:
    chasers = summary["chasers"].values()
    steady = [c["steady"] for c in chasers if c["steady"]["position_mse_m2"] is not None]
    worst = _NONE
    if steady:
        position = math.sqrt(max(s["position_mse_m2"] for s in steady)) * 1e3
        worst = (
            f"{position:.2f}; {math.degrees(math.sqrt(max(s['orientation_mse_rad2'] for s in steady))):.3f}"
        )
    told = [f"{i} docked at {c['dock_time_s']:.1f} s" for i, c in summary["chasers"].items() if c["docked"]]
    told += [
        f"{i} there at {c['reached_time_s']:.1f} s"
        for i, c in summary["chasers"].items()
        if c["reached_time_s"] is not None
    ]
    between = summary["min_distance_chasers_m"]
    return (
        f"{summary['sim_time_s']:.0f}",
        "success" if summary["success"] else "FAILED: " + "; ".join(summary["failures"]),
        worst,
        f"{min(c['min_distance_target_m'] for c in chasers):.3f}",
        _NONE if between is None else f"{between:.3f}",
        ", ".join(told) or _NONE,
    )
