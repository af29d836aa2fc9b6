# SPDX-License-Identifier: Apache-2.0
"""Cells of an earlier page, which stand in the tables of a new one where flights have no result.

Each is marked by the date and commit of its flights: ``1.07 met [2026-11-25 eae501599ed9]``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from chaserdock.experiments.page import Table
from chaserdock.experiments.plan import ExperimentError

from .tables import NONE

_FLOWN = re.compile(r"flown on (\d{4}-\d\d-\d\d),\s+commit\s+([0-9a-f]{12}(?:-dirty)?)")
_MARK = re.compile(r" \[\d{4}-\d\d-\d\d [0-9a-f]{12}(?:-dirty)?\]$")
_CELL = re.compile(r"(?<!\\)\|")


@dataclass(frozen=True)
class EarlierPage:
    """Cells of the first table of each section, by section title, row and column. A row is named by
    its first cell, in Missions by its first two. A cell of unknown date is left out.
    """

    cells: Mapping[tuple[str, str, str], str]

    def fill(self, title: str, table: Table, keys: int = 1) -> Table:
        """Return a table with the earlier cells in place of missing ones; ``keys``: columns that
        name a row.
        """
        rows = []
        for row in table.rows:
            name = row_name(row, keys)
            filled = (
                self.cells.get((title, name, column), NONE) if cell == NONE else cell
                for column, cell in zip(table.header[keys:], row[keys:], strict=True)
            )
            rows.append((*row[:keys], *filled))
        return Table(table.header, tuple(rows), table.text)


NO_PAGE = EarlierPage({})


def row_name(row: tuple[str, ...], keys: int) -> str:
    """Return the name of a row by its first cells."""
    return ", ".join(row[:keys])


def read_earlier(text: str) -> EarlierPage:
    """Read a page of ``chaserdock reproduce`` (Markdown). Cells without a mark of their own get
    that of the page. Raise ExperimentError for another text.
    """
    found = _FLOWN.search(text)
    page = None if found is None else f"{found[1]} {found[2]}"
    cells: dict[tuple[str, str, str], str] = {}
    for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        title, _, body = part.partition("\n")
        lines = [x for x in body.splitlines() if x.startswith("| ")]
        if len(lines) < 2:
            continue
        header, _, *rows = (_cells(line) for line in lines[: _table_length(body)])
        keys = 2 if title == "Missions" else 1
        for row in rows:
            for column, cell in zip(header[keys:], row[keys:], strict=True):
                marked = cell if _MARK.search(cell) or page is None else f"{cell} [{page}]"
                if cell != NONE and _MARK.search(marked):
                    cells[title, row_name(row, keys), column] = marked
    if not cells:
        raise ExperimentError("not a page of `chaserdock reproduce`: no table with date and commit")
    return EarlierPage(cells)


def _table_length(body: str) -> int:
    """Return the number of lines of the first table."""
    lines = body.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("| "))
    rest = lines[first:]
    return next((k for k, line in enumerate(rest) if not line.startswith("| ")), len(rest))


def _cells(line: str) -> tuple[str, ...]:
    return tuple(cell.strip().replace("\\|", "|") for cell in _CELL.split(line)[1:-1])


def unmarked(cell: str) -> str:
    """Return a cell without its mark."""
    return _MARK.sub("", cell)
