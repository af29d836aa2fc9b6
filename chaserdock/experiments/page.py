# SPDX-License-Identifier: Apache-2.0
"""Page of an experiment: sections, written as Markdown or as one self-contained HTML file."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from chaserdock.html_page import Markup, html_page, table

_COLUMNS = 120
"""Longest line of a paragraph in Markdown, characters, as in all pages of the repository."""


@dataclass(frozen=True)
class Table:
    """A table whose first column is text. The others are numbers, or text if ``text``. Raise
    ValueError for a row of another length.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text: bool = False

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(
                    f"a row of {len(row)} cells under {len(self.header)} headings: {row}"
                )


@dataclass(frozen=True)
class Picture:
    """A figure: ``inline`` as an element of an HTML page, and ``file``, the content of the file at
    ``path`` beside the page, to which Markdown links.
    """

    path: str
    title: str
    inline: str
    file: str


@dataclass(frozen=True)
class PageSection:
    """A heading ("" for none), followed by paragraphs (text, with code in backticks), tables,
    pictures, and HTML (``Markup``), which Markdown omits.
    """

    title: str
    parts: tuple[str | Table | Picture, ...]


def markdown(title: str, sections: Sequence[PageSection]) -> str:
    """Return the page as Markdown."""
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""] if section.title else []
        for part in section.parts:
            if isinstance(part, Table):
                lines += _markdown_table(part)
            elif isinstance(part, Picture):
                lines += [f"![{part.title}]({part.path})", ""]
            elif not isinstance(part, Markup):
                lines += [*_wrapped(part), ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def _wrapped(text: str) -> list[str]:
    """Return a paragraph in lines of the repository's length."""
    return textwrap.wrap(text, _COLUMNS, break_long_words=False, break_on_hyphens=False)


def _markdown_table(table: Table) -> list[str]:
    def line(cells: tuple[str, ...]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    rule = "| --- |" + (" --- |" if table.text else " ---: |") * (len(table.header) - 1)
    return [line(table.header), rule, *map(line, table.rows), ""]


def html(title: str, sections: Sequence[PageSection]) -> str:
    """Return the page as HTML without external resources."""
    body = [f"<h1>{escape(title)}</h1>"]
    for section in sections:
        if section.title:
            body.append(f"<h2>{escape(section.title)}</h2>")
        body += [_html_part(part) for part in section.parts]
    return html_page(title, body)


def _html_part(part: str | Table | Picture) -> str:
    if isinstance(part, Table):
        return table(part.header, part.rows, part.text)
    return (
        f'<figure class="wide">{part.inline}</figure>'
        if isinstance(part, Picture)
        else _paragraph(part)
    )


def _paragraph(text: str) -> str:
    if isinstance(text, Markup):
        return text
    return "<p>" + re.sub("`([^`]+)`", r"<code>\1</code>", escape(text)) + "</p>"
