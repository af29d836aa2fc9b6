"""What the page says: the tables filled in."""

from __future__ import annotations

from chaserdock_protocol.study import StudyResult

from .cells import NONE, cell, orientation_text, position_text, study_errors, study_floor
from .missions import other_runs, whole_missions
from .page import Section, Table
from .paper import ROWS, Row
from .plan import (
    DELAYED_HORIZONS_S,
    DELAYS_S,
    INFERRED,
    STARTS,
    Plan,
    has_alpaqa,
    measured_solvers,
    table_group,
)
from .runner import Results
from .tables import Requirement, errors_of_study, flown, requirements, steady_requirements
from .text import explained, how_measured


def sections(plan: Plan, results: Results) -> list[Section]:
    """The whole page."""
    return [
        how_measured(plan, results),
        _required(plan, results),
        *(_start(plan, results, start) for start in STARTS),
        explained(),
        _starts(results),
        _ingredients(results),
        _real_time(results),
        other_runs(plan, results),
        whole_missions(plan, results),
    ]


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
    floors = {s: study_floor(results, table_group(s, "paper", "baseline")) for s in STARTS}
    told = [f"{position_text(f)}e-2 m^2 from the {s} start" for s, f in floors.items() if f is not None]
    if told:
        best = min(row.position_mse_m2 for row in ROWS)
        parts.append(
            f"The least possible position MSE is {', '.join(told)}; the paper's baseline is "
            f"{position_text(ROWS[0].position_mse_m2)}e-2, its best row {position_text(best)}e-2. Where the paper's "
            "figure is below the least possible, no controller that turns as ours does can have flown it from that start: "
            "the paper started elsewhere, nearer, or with other limits. The tables on the start and on the ingredients say "
            "what each does."
        )
    return Section("What is to hold", tuple(parts))


_ROW_HEADER = (
    "row",
    "paper, 1e-2 m^2",
    "perfect knowledge",
    "with images",
    "with images / paper",
    "steady, with images",
    "paper, 1e-3 rad^2",
    "perfect knowledge",
    "with images",
    "with images / paper",
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
    floor = study_floor(results, table_group(start, "paper", "baseline"))
    parts.append(
        "Our default in the same rows, same units. Least possible position MSE: "
        + (NONE if floor is None else f"{position_text(floor)}e-2 m^2.")
    )
    rows = []
    for row in ROWS:
        group = table_group(start, "default", row.name)
        perfect, seen = study_errors(results, group), flown(plan, results, group)
        above = seen if seen is not None else perfect
        rows.append(
            (
                row.label,
                cell(perfect, lambda e: position_text(e.position)),
                cell(seen, lambda e: position_text(e.position)),
                NONE if above is None or floor is None else f"{above.position / floor:.3f}",
                cell(perfect, lambda e: orientation_text(e.orientation)),
                cell(seen, lambda e: orientation_text(e.orientation)),
                cell(perfect, lambda e: f"{e.steady_position:.2e}"),
                cell(seen, lambda e: f"{e.steady_position:.2e}"),
                cell(seen, lambda e: f"{e.failed} of {e.runs}"),
            )
        )
    header = (
        "row",
        "position, perfect knowledge",
        "position, with images",
        "over the least possible",
        "orientation, perfect knowledge",
        "orientation, with images",
        "steady, perfect knowledge, m^2",
        "steady, with images, m^2",
        "failed",
    )
    parts.append(Table(header, tuple(rows)))
    return Section(f"The single-chaser table, {start} start", tuple(parts))


def _row(plan: Plan, results: Results, start: str, row: Row) -> tuple[str, ...]:
    group = table_group(start, "paper", row.name)
    perfect, seen = study_errors(results, group), flown(plan, results, group)
    return (
        row.label,
        position_text(row.position_mse_m2),
        cell(perfect, lambda e: position_text(e.position)),
        cell(seen, lambda e: position_text(e.position)),
        cell(seen, lambda e: f"{e.position / row.position_mse_m2:.2f}"),
        cell(seen, lambda e: f"{e.steady_position:.2e} m^2"),
        orientation_text(row.orientation_mse_rad2),
        cell(perfect, lambda e: orientation_text(e.orientation)),
        cell(seen, lambda e: orientation_text(e.orientation)),
        cell(seen, lambda e: f"{e.orientation / row.orientation_mse_rad2:.2f}"),
        f"{row.failed} of 3",
        cell(seen, lambda e: f"{e.failed} of {e.runs}"),
    )


def _starts(results: Results) -> Section:
    rows = []
    names = [table_group(start, "paper", "baseline") for start in STARTS]
    names += [n for n in results.studies if n.startswith("start/")]
    for name in names:
        errors, floor = study_errors(results, name), study_floor(results, name)
        if errors is None or floor is None:
            continue
        rows.append(
            (
                name.removeprefix("start/").removesuffix("/paper/baseline"),
                position_text(errors.position),
                position_text(floor),
                f"{errors.position / floor:.3f}",
                f"{errors.position / ROWS[0].position_mse_m2:.2f}",
                orientation_text(errors.orientation),
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
        "Baseline row, paper's settings, perfect knowledge. Lines from the fourth on differ from the inferred start in what "
        "they say. This is the first ten seconds: what follows adds next to nothing."
    )
    return Section("How the figure moves with the start", (text, Table(header, tuple(rows))))


def _ingredients(results: Results) -> Section:
    base = study_errors(results, table_group(INFERRED, "paper", "baseline"))
    rows = []
    for name in (n for n in results.studies if n.startswith("ingredient/")):
        errors = study_errors(results, name)
        if errors is None or base is None:
            continue
        rows.append(
            (
                name.removeprefix("ingredient/"),
                position_text(errors.position),
                f"{100 * (errors.position / base.position - 1):+.1f} %",
                orientation_text(errors.orientation),
                f"{100 * (errors.orientation / base.orientation - 1):+.1f} %",
                f"{errors.steady_position:.2e}",
            )
        )
    header = ("changed", "position, 1e-2 m^2", "change", "orientation, 1e-3 rad^2", "change", "steady, m^2")
    text = "Baseline row from the inferred start, perfect knowledge; one thing changed at a time in the paper's settings."
    return Section("How the figure moves with each ingredient", (text, Table(header, tuple(rows))))


def _real_time(results: Results) -> Section:
    rows = []
    for delay_s in DELAYS_S:
        cells = [f"{delay_s:g} s"]
        for horizon_s in DELAYED_HORIZONS_S:
            errors = study_errors(results, f"delay/{horizon_s:g}/{delay_s:g}")
            cells += [
                cell(errors, lambda e: position_text(e.position)),
                cell(errors, lambda e: orientation_text(e.orientation)),
            ]
        rows.append(tuple(cells))
    header = ["delay"]
    for horizon_s in DELAYED_HORIZONS_S:
        header += [f"T = {horizon_s:g} s: position, 1e-2 m^2", "orientation, 1e-3 rad^2"]
    measured = []
    for horizon_s in DELAYED_HORIZONS_S:
        for solver in measured_solvers():
            found = results.studies.get(f"measured/{horizon_s:g}/{solver}")
            if found is not None:
                measured.append(_measured(f"{solver}, T = {horizon_s:g} s", found))
    columns = ("solver", "median solve, ms", "longest, ms", "position, 1e-2 m^2", "orientation, 1e-3 rad^2")
    return Section(
        "What real time does: T = 10",
        (
            "In simulated time no horizon fails. Here the command acts only when the solver would be done, on a plan for "
            "the state at the beginning; nothing is predicted ahead, and the ticks that pass meanwhile are "
            "missed. Inferred start, paper's settings, perfect knowledge.",
            Table(tuple(header), tuple(rows)),
            "With the solve time as measured on this machine in place of a fixed delay (it depends on the machine and on "
            "its load; 30 s flown). rti is ours, ipopt converges, alpaqa is PANOC with an augmented Lagrangian in single "
            "shooting, as the paper's OpEn"
            + (":" if has_alpaqa() else " (the extra `alpaqa` is not installed here: left out):"),
            Table(columns, tuple(measured)),
        ),
    )


def _measured(name: str, result: StudyResult) -> tuple[str, ...]:
    errors = errors_of_study(result)
    times = f"{result.solve_p50_s * 1e3:.2f}", f"{result.solve_max_s * 1e3:.1f}"
    return name, *times, position_text(errors.position), orientation_text(errors.orientation)
