# SPDX-License-Identifier: Apache-2.0
"""What the comparison shows: trends first, beside what a constant and free starts would score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from chaserdock.experiments.page import PageSection, Table

from .earlier import EarlierPage, unmarked
from .free_starts import TOLERANCE
from .paper import BASELINE, ROWS
from .plan import CODE, COLUMNS, DEFAULT, FREE_STARTS, RATE_BOUND, WRITTEN, free_name
from .tables import (
    BAND,
    NONE,
    QUANTITIES,
    Quantity,
    Summaries,
    cell,
    comes_out,
    free_changes,
    free_errors,
    paper_change,
    paper_value,
    spread,
    verdict,
)
from .trends import change_text

FAILED = "failed flights"
_TRENDS = ROWS[1:]
_CONSTANT = "a constant, the paper's baseline row"
_FREE = "free starts, controller alone"
Tables = Mapping[Quantity, Table]


def result_section(
    results: Summaries,
    tables: Tables,
    trends: Table,
    missing: tuple[int, int],
    quick: bool,
    earlier: EarlierPage,
) -> PageSection:
    """Return the headline and its table. ``missing``: number of flights without result, of all."""
    rows = [_chain_row(results, tables, trends, column) for column in COLUMNS]
    rows += [_free_row(results), _constant_row(), _paper_row()]
    header = (
        "chain",
        *(f"trends that come out, {q}" for q in QUANTITIES),
        *(f"rows met, {q}" for q in QUANTITIES),
        FAILED,
    )
    table = earlier.fill("Result", Table(header, tuple(rows)))
    command = "chaserdock reproduce --quick" if quick else "chaserdock reproduce"
    parts: list[str | Table] = [
        _verdict(table),
        table,
        "The paper is Fourlas, Viswanathan, Satpute and Nikolakopoulos, Vision Based Docking of "
        "Multiple Satellites with an Uncooperative Target (IFAC 2023). This page is the output of "
        f"`{command}`; the section Flights says what was flown when and at which commit. A cell "
        "with date and commit in brackets is that of an earlier page, as its row was not flown "
        "again since; the headline and the counts of this table include such cells.",
        f'Three chains fly the nine rows of its table, with images. "{WRITTEN}": the paper\'s '
        "perception (EPnP), its moving average of all estimates and its solver OpEn, in its "
        f"settings. \"{CODE}\": the same with OpenCV's iterative PnP, which the authors' public "
        f'code calls in place of EPnP. "{DEFAULT}": the default settings of chaserdock. OpenCV\'s '
        "EPnP has gross errors for coplanar points, as on the single face of the target that a "
        "chaser sees most of the time (tests/agents/test_perception.py).",
        "A trend is the change of a row from the baseline row; it comes out if it has the paper's "
        "direction from every start and half to twice its size. A row is met if the median ratio "
        f"of our error to the paper's is between {BAND[0]:.2f} and {BAND[1]:.2f}: a smaller error "
        "is as much a difference as a larger one.",
    ]
    if missing[0]:
        parts.insert(
            0,
            f"NOT COMPLETE: {missing[0]} of {missing[1]} flights have no result here (a dash, or "
            "an earlier cell); the same command resumes them.",
        )
    return PageSection("Result", tuple(parts))


def _count(cells: Sequence[str], word: str) -> str:
    """Return how many of the cells that have a result end with a verdict."""
    known = [cell for cell in cells if cell != NONE]
    return f"{sum(cell.split()[-1] == word for cell in known)} of {len(known)}" if known else NONE


def _chain_row(results: Summaries, tables: Tables, trends: Table, column: str) -> tuple[str, ...]:
    """Count a chain's verdicts in the tables of the page, earlier cells included."""
    outs = [NONE, NONE]
    if column in trends.header:
        at = trends.header.index(column)
        labels = {row.label for row in _TRENDS}
        pairs = [
            unmarked(r[at]).split("; ") for r in trends.rows if r[0] in labels and r[at] != NONE
        ]
        outs = [_count([pair[k] for pair in pairs], "yes") for k in range(len(QUANTITIES))]
    met = []
    for quantity in QUANTITIES:
        table = tables[quantity]
        met.append(_count([unmarked(r[table.header.index(column)]) for r in table.rows], "met"))
    runs = [errors for row in ROWS for errors in cell(results, column, row).values()]
    failed = f"{sum(e.failed for e in runs)} of {len(runs)}" if runs else NONE
    return (column, *outs, *met, failed)


def _free_row(results: Summaries) -> tuple[str, ...]:
    """Judge the free starts as a chain, each of them a start."""
    flown = free_errors(results)
    if not flown:
        return (_FREE, *(NONE,) * 5)
    outs, met = [], []
    for q in QUANTITIES:
        answers = [
            comes_out(free_changes(results, row, q), paper_change(row, q)) for row in _TRENDS
        ]
        outs.append(f"{sum(answers)} of {len(answers)}")
        medians = [spread([rows[r.name][q] for rows in flown]).median for r in ROWS]
        met.append(_rows_met(medians, q))
    return (_FREE, *outs, *met, NONE)


def _constant_row() -> tuple[str, ...]:
    """Judge the paper's baseline row in place of every row: it has no change."""
    outs = [sum(comes_out([0.0], paper_change(row, q)) for row in _TRENDS) for q in QUANTITIES]
    met = [_rows_met([paper_value(BASELINE, q)] * len(ROWS), q) for q in QUANTITIES]
    return (_CONSTANT, *(f"{n} of {len(_TRENDS)}" for n in outs), *met, NONE)


def _paper_row() -> tuple[str, ...]:
    outs, met = f"{len(_TRENDS)} of {len(_TRENDS)}", f"{len(ROWS)} of {len(ROWS)}"
    return ("the paper", outs, outs, met, met, f"{sum(r.failed for r in ROWS)} of {3 * len(ROWS)}")


def _rows_met(values: Sequence[float], quantity: Quantity) -> str:
    """Return how many rows are met by these errors, in the order of the rows."""
    ratios = [v / paper_value(row, quantity) for v, row in zip(values, ROWS, strict=True)]
    return f"{sum(verdict(x) == 'met' for x in ratios)} of {len(ROWS)}"


def _constant_misses() -> float:
    """Return the greatest share by which the paper's baseline row misses a row that it meets."""
    ratios = [paper_value(BASELINE, q) / paper_value(row, q) for q in QUANTITIES for row in ROWS]
    return max(abs(x - 1.0) for x in ratios if verdict(x) == "met")


def _verdict(table: Table) -> str:
    """Return the headline by the table of results."""
    by_chain = {name: [unmarked(text) for text in cells] for name, *cells in table.rows}
    ours, code, written = (by_chain[c] for c in (DEFAULT, CODE, WRITTEN))
    if ours[0] == NONE or code[0] == NONE:
        return "Not judged: the trends of the table are not flown."
    full = [f"{len(_TRENDS)} of {len(_TRENDS)}"] * 2
    named = [name for name in (CODE, DEFAULT) if by_chain[name][:2] == full]
    said = (
        f'The paper\'s trends are reproduced with "{named[0]}".'
        if named
        else "The paper's results are not reproduced."
    )
    constant = by_chain[_CONSTANT]
    return (
        f"{said} Of the trends, {ours[0]} come out in position and {ours[1]} in orientation with "
        f'"{DEFAULT}", {code[0]} and {code[1]} with "{CODE}". The paper\'s own chain fails in '
        f'{code[4]} flights "{CODE}" and {written[4]} "{WRITTEN}". What "{DEFAULT}" shows is '
        f"agreement of tracking error, not reproduction: it meets {ours[2]} position rows and "
        f"{ours[3]} orientation rows, but a constant equal to the paper's baseline row meets "
        f"{constant[2]} and {constant[3]}, as those rows lie within "
        f"{100 * _constant_misses():.0f} % of it and the start is fitted to that row."
    )


def free_section(results: Summaries) -> PageSection:
    """Return the changes of the rows from free starts, which are fitted to the baseline row."""
    rows = []
    for row in _TRENDS:
        cells = []
        for q in QUANTITIES:
            values, paper = free_changes(results, row, q), paper_change(row, q)
            cells += [change_text(paper), *_free_cells(values, paper)]
        rows.append((row.label, *cells))
    header = ["trend"]
    for q in QUANTITIES:
        header += [f"{q}, paper", "median (least to greatest)", "comes out from"]
    text = (
        "Can a start explain the table? Each of these is drawn at random: the direction of the "
        "offset on the half sphere away from the target, the axis of the rotation, the target's "
        f"attitude, its rates within {100 * RATE_BOUND:.0f} %, the chaser's velocity. Distance "
        "and angle are then fitted so that both errors of the baseline row are within "
        f"{100 * TOLERANCE:.0f} % of the paper's. The other rows are not fitted: the controller "
        "alone flies them from the same start (40 s, and T=0.5 120 s, extrapolated with the steady "
        "state). Change from the baseline row of the same start, over all starts; and from how "
        "many starts it has the paper's direction and half to twice its size."
    )
    return PageSection(
        "Free starts", (text, Table(tuple(header), tuple(rows)), _free_conclusion(results))
    )


def _free_cells(values: Sequence[float], paper: float) -> tuple[str, str]:
    if not values:
        return NONE, NONE
    s = spread(values)
    least, median, greatest = (change_text(x) for x in (s.least, s.median, s.greatest))
    number = sum(comes_out([value], paper) for value in values)
    return f"{median} ({least} to {greatest})", f"{number} of {len(values)}"


def _free_conclusion(results: Summaries) -> str:
    """Return in one sentence what came out of the free starts."""
    flown = [k for k in FREE_STARTS if free_name(k) in results]
    met = len(free_errors(results))
    if not met:
        return f"No conclusion: {len(flown)} free starts are flown, none meets the baseline row."
    answers = {
        (row.label, q): [
            comes_out([value], paper_change(row, q)) for value in free_changes(results, row, q)
        ]
        for row in _TRENDS
        for q in QUANTITIES
    }
    best = max(sum(column) for column in zip(*answers.values(), strict=True))
    some = [f"{label} ({q})" for (label, q), found in answers.items() if any(found)]
    names = ", ".join(some) if some else "none"
    explains = "explains" if best == len(answers) else "does not explain"
    return (
        f"Of {len(flown)} starts, {met} meet the baseline row; the best of them brings out "
        f"{best} of the {len(answers)} trends, and those that come out from any start are {names}: "
        f"a start {explains} the paper's table."
    )
