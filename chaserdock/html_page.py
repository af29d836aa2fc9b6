# SPDX-License-Identifier: Apache-2.0
"""HTML pages of all reports: self-contained; their Content-Security-Policy forbids requests."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from importlib.resources import files
from string import Template

PAGE_FILES = files("chaserdock.analysis") / "page"


class Markup(str):
    """Text that is HTML already and is not escaped."""

    __slots__ = ()


def html_page(title: str, body: Iterable[str], script: str = "") -> str:
    """Return a page; ``title`` is plain text, the parts of ``body`` and ``script`` are HTML."""
    return Template((PAGE_FILES / "report.html").read_text(encoding="utf-8")).substitute(
        title=escape(title),
        style=(PAGE_FILES / "report.css").read_text(encoding="utf-8"),
        body="\n".join(part for part in body if part),
        script=script,
    )


def table(head: Iterable[str], rows: Iterable[Iterable[str]], text: bool = False) -> str:
    """Return a table as HTML; the first cell of each row is its header.

    Cells are plain text or ``Markup``. ``text``: the other columns are text, which is left-aligned,
    instead of numbers.
    """
    kind = ' class="text"' if text else ""
    top = "".join(f'<th scope="col"{kind}>{_html(cell)}</th>' for cell in head)
    lines = []
    for first, *rest in rows:
        cells = "".join(f"<td{kind}>{_html(cell)}</td>" for cell in rest)
        lines.append(f'<tr><th scope="row">{_html(first)}</th>{cells}</tr>')
    content = f"<thead><tr>{top}</tr></thead><tbody>{''.join(lines)}</tbody>"
    return f'<div class="wide"><table>{content}</table></div>'


def _html(cell: str) -> str:
    return cell if isinstance(cell, Markup) else escape(cell)
