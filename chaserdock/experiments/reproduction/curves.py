# SPDX-License-Identifier: Apache-2.0
"""Curves of the paper's table beside ours: mean square error over horizon, step and falloff."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

from chaserdock.analysis.plots import INK, SERIES, styled, to_inline_svg
from chaserdock.experiments.page import PageSection, Picture

from .earlier import row_name
from .headline import Tables
from .paper import BASELINE, ROWS, PaperRow
from .plan import CODE, DEFAULT
from .tables import QUANTITIES, Quantity, paper_value

PATH = "images/reproduction-curves.svg"
"""Place of the picture beside the page."""
_AXES = (("horizon_s", "horizon T / s"), ("dt_s", "step dt / s"), ("falloff", "falloff alpha"))
_UNITS: dict[Quantity, str] = {"position": "position / m²", "orientation": "orientation / rad²"}


def ratios(tables: Tables, quantity: Quantity, column: str) -> dict[str, float]:
    """Return the median ratio to the paper's error by row, of rows that have a result."""
    table = tables[quantity]
    place = table.header.index(column)
    words = {row_name(row, 1): row[place].split()[0] for row in table.rows}
    return {name: float(word) for name, word in words.items() if word[0].isdigit()}


def varied(field: str) -> list[PaperRow]:
    """Return the rows that differ from the baseline in one field only, with the baseline, in its
    order.
    """
    others = [name for name, _ in _AXES if name != field]
    rows = [r for r in ROWS if all(getattr(r, o) == getattr(BASELINE, o) for o in others)]
    return sorted(rows, key=lambda row: getattr(row, field))


def curves(tables: Tables) -> Figure:
    """Draw the errors of the paper, of ours and as in the authors' code."""
    figure = Figure(figsize=(8.6, 4.4), layout="constrained")
    grid = figure.subplots(2, 3, sharey="row", squeeze=False)
    for axes_row, quantity in zip(grid, QUANTITIES, strict=True):
        for axes, (field, label) in zip(axes_row, _AXES, strict=True):
            rows = varied(field)
            x = [getattr(row, field) for row in rows]
            paper = [paper_value(row, quantity) for row in rows]
            axes.plot(x, paper, "o-", color=INK, label="the paper")
            for column, colour, shape in ((DEFAULT, SERIES[0], "s-"), (CODE, SERIES[1], "^:")):
                known = ratios(tables, quantity, column)
                points = [
                    (value, known[row.label] * error)
                    for value, row, error in zip(x, rows, paper, strict=True)
                    if row.label in known
                ]
                axes.plot(*zip(*points, strict=True) if points else ((), ()), shape, color=colour,
                          label=column)  # fmt: skip
            axes.set_yscale("log")
            if field == "horizon_s":
                axes.set_xscale("log")
                axes.set_xticks(x, [f"{value:g}" for value in x])
                axes.minorticks_off()
                axes.set_ylabel(f"MSE, {_UNITS[quantity]}")
            if quantity == QUANTITIES[-1]:
                axes.set_xlabel(label)
    grid[0][1].legend(loc="upper right", fontsize=8)
    return figure


def curves_section(tables: Tables) -> PageSection:
    """Return the section with the picture."""
    with styled("reproduction"):
        figure = curves(tables)
    title = "Errors of the paper and of chaserdock over horizon, step and falloff"
    text = (
        "Rows that differ from the baseline in one setting, by that setting: the medians of the "
        "tables below. The paper has no other numbers; its plots over time are not published as "
        "data."
    )
    picture = Picture(PATH, title, to_inline_svg(figure, "reproduction", title), _file(figure))
    return PageSection("Curves", (text, picture))


def _file(figure: Figure) -> str:
    out = io.StringIO()
    with styled("reproduction"):
        figure.savefig(out, format="svg", facecolor="white", metadata={"Date": None})
    return out.getvalue()
