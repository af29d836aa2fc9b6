# SPDX-License-Identifier: Apache-2.0
"""Criteria of success as rows of a table: measured value, limit, margin, outcome. Terminal, pages
and viewer show the same rows.
"""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

from msgspec import Struct

from .terminal import COLUMNS

Outcome = Literal["met", "not met", "not judged"]
LEVELS: dict[Outcome, str] = {"met": "good", "not met": "bad", "not judged": "partial"}
"""Levels of a verdict, by which pages colour an outcome."""
_DASH = "–"  # noqa: RUF001


def quantity(value: float | None, unit: str, factor: float = 1.0, digits: int = 3) -> str:
    """Return a value with ``digits`` significant digits and its unit; a dash for None."""
    if value is None:
        return _DASH
    scaled = value * factor
    # "#" keeps trailing zeros; a trailing decimal point is removed. Large numbers without exponent.
    text = (
        f"{scaled:.0f}" if 10**digits <= abs(scaled) < 1e9 else f"{scaled:#.{digits}g}".rstrip(".")
    )
    return f"{text} {unit}".rstrip()


class Criterion(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A criterion of success, and what the flight showed of it.

    ``key``: its key in the scenario. ``chaser``: the one judged; None for the whole flight.
    ``measured``, ``limit``: in ``unit``; None where there is none. ``side``: whether the limit is
    the largest or the smallest value allowed. ``note``: why it was not judged, or an explanation.
    """

    key: str
    name: str
    outcome: Outcome
    chaser: int | None = None
    measured: float | None = None
    limit: float | None = None
    unit: str = ""
    side: Literal["at most", "at least"] = "at most"
    note: str = ""

    @property
    def margin(self) -> float | None:
        """Return the distance from the limit, negative beyond it; None without both values."""
        if self.measured is None or self.limit is None:
            return None
        least, most = self.limit, self.measured
        return most - least if self.side == "at least" else least - most

    @property
    def failure(self) -> str:
        """Return the violation in one line."""
        what = self.name if self.chaser is None else f"{self.name}, chaser {self.chaser}"
        allowed = "" if self.limit is None else f", {self.side} {self._limit}"
        note = f"; {self.note}" if self.note else ""
        absent = "never" if self.unit == "s" else "not known"
        value = absent if self.measured is None else self.value(self.measured)
        return f"{what}: {value}{allowed}{note}"

    @property
    def _limit(self) -> str:
        limit = self.limit or 0.0
        return f"{limit:.{4 if abs(limit) < 1e4 else 9}g} {self.unit}".rstrip()

    def value(self, number: float | None) -> str:
        """Return a number of this criterion with its unit: times to 0.01 s, counts whole."""
        if number is None:
            return _DASH
        if self.unit in ("", "s"):
            return f"{number:z.{2 if self.unit else 0}f} {self.unit}".rstrip()
        return quantity(number, self.unit)

    @property
    def cells(self) -> tuple[str, str, str]:
        """Return measured value, limit and margin as text."""
        sign = "≥" if self.side == "at least" else "≤"
        limit = _DASH if self.limit is None else f"{sign} {self._limit}"
        return self.value(self.measured), limit, self.value(self.margin)


def criterion(
    key: str,
    name: str,
    measured: float | None,
    limit: float,
    unit: str,
    chaser: int | None = None,
    side: Literal["at most", "at least"] = "at most",
    *,
    note: str = "",
    unseen: bool = False,
    met: bool | None = None,
) -> Criterion:
    """Judge a measured value by its limit, or as ``met`` states. ``unseen``: a value that the
    flight does not have meets the limit.
    """
    if met is None and measured is not None:
        met = measured >= limit if side == "at least" else measured <= limit
    good = unseen if met is None else met
    return Criterion(
        key=key,
        name=name,
        outcome="met" if good else "not met",
        chaser=chaser,
        measured=measured,
        limit=limit,
        unit=unit,
        side=side,
        note=note,
    )


@dataclass(frozen=True)
class TableRow:
    """A row of the table: the criterion, and the chasers for which it stands."""

    criterion: Criterion
    chasers: tuple[int, ...]

    @property
    def who(self) -> str:
        """Return the chasers as text: the worst one where several were judged."""
        if len(self.chasers) < 2:
            return "".join(map(str, self.chasers))
        if self.criterion.margin is None:
            return ", ".join(map(str, self.chasers))
        return f"{self.criterion.chaser}, worst of {len(self.chasers)}"


def table_rows(criteria: Sequence[Criterion]) -> list[TableRow]:
    """Return a row for each criterion: of chasers with the same outcome, the one with the least
    margin. Each violation has its own row.
    """
    groups: dict[tuple[object, ...], list[Criterion]] = defaultdict(list)
    for k, c in enumerate(criteria):
        alone = k if c.outcome == "not met" else None
        groups[c.key, c.name, c.outcome, c.note if c.outcome == "not judged" else "", alone].append(
            c
        )
    rows = []
    for group in groups.values():
        worst = min(group, key=lambda c: float("inf") if c.margin is None else c.margin)
        rows.append(TableRow(worst, tuple(c.chaser for c in group if c.chaser is not None)))
    return rows


def text_table(criteria: Sequence[Criterion]) -> list[str]:
    """Return the table as lines of at most ``COLUMNS`` characters, without margins if these do not
    fit.
    """
    rows = table_rows(criteria)
    shown = [(r.criterion.outcome, r.criterion.name, r.who, *r.criterion.cells) for r in rows]
    grid = [("", "criterion", "chaser", "measured", "limit", "margin"), *shown]
    widths = [max(len(row[k]) for row in grid) for k in range(6)]
    gap = "  " if sum(widths) + 2 + 2 * 5 <= COLUMNS else " "
    if sum(widths) + 2 + 5 > COLUMNS:
        widths = widths[:-1]
    lines: list[str] = []
    for k, row in enumerate(grid):
        cells = (
            cell.ljust(width) if n < 3 else cell.rjust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=False))
        )
        lines.append("  " + gap.join(cells).rstrip())
        if k and (note := rows[k - 1].criterion.note):
            indent = " " * (4 + widths[0])
            lines += textwrap.wrap(note, COLUMNS, initial_indent=indent, subsequent_indent=indent)
    return lines


def html_table(criteria: Sequence[Criterion]) -> str:
    """Return the table as HTML, outcomes in the colours of verdicts; empty without criteria."""
    return _html(table_rows(criteria)) if criteria else ""


def html_of_all(criteria: Iterable[Criterion]) -> str:
    """Return an HTML table with a row for each chaser and criterion."""
    return _html([TableRow(c, () if c.chaser is None else (c.chaser,)) for c in criteria])


def _html(rows: Sequence[TableRow]) -> str:
    noted = any(row.criterion.note for row in rows)
    # The outcome comes first: a phone shows the left part of a wide table.
    head = ("criterion", "outcome", "measured", "limit", "margin", "chaser", *[""] * noted)
    top = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    lines = []
    for row in rows:
        c = row.criterion
        numbers = "".join(f"<td>{escape(cell)}</td>" for cell in (*c.cells, row.who))
        lines.append(
            f'<tr><th scope="row">{escape(c.name)}</th>'
            f'<td class="{LEVELS[c.outcome]}">{c.outcome}</td>{numbers}'
            + (f'<td class="text">{escape(c.note)}</td>' if noted else "")
            + "</tr>"
        )
    content = f"<thead><tr>{top}</tr></thead><tbody>{''.join(lines)}</tbody>"
    return f'<div class="wide"><table class="criteria">{content}</table></div>'


def markdown_table(criteria: Sequence[Criterion]) -> str:
    """Return the table as Markdown for a narrow panel; empty without criteria."""
    if not criteria:
        return ""
    marks = {"met": "✓", "not met": "✗", "not judged": "⚠"}
    lines = ["| | criterion | measured | limit | margin |", "| --- | --- | --- | --- | --- |"]
    for row in table_rows(criteria):
        c = row.criterion
        name = f"{c.name}, chaser {row.who}" if row.who else c.name
        if c.outcome == "not judged":
            name += f": not judged: {c.note}"
        numbers = (cell.replace(" ", "\N{NO-BREAK SPACE}") for cell in c.cells)
        lines.append(f"| {marks[c.outcome]} | {name} | " + " | ".join(numbers) + " |")
    return "\n".join(lines)
