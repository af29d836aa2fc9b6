# SPDX-License-Identifier: Apache-2.0
"""A page of sections as Markdown and as one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape


@dataclass(frozen=True)
class Table:
    """A table. The first column is text, the others are numbers. Raise ValueError for a row of another length."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"a row of {len(row)} cells under {len(self.header)} headings: {row}")


@dataclass(frozen=True)
class PageSection:
    """A heading, followed by paragraphs (plain text) and tables."""

    title: str
    parts: tuple[str | Table, ...]


_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; margin: 0.5rem 0 1rem; }
th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid #8886; text-align: right;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
th { border-bottom: 2px solid #888; vertical-align: bottom; white-space: normal; }
h2 { margin-top: 2rem; }
"""


def markdown(title: str, sections: Sequence[PageSection]) -> str:
    """Return the page as Markdown."""
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for part in section.parts:
            if isinstance(part, Table):
                lines += _markdown_table(part)
            else:
                lines += [part, ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def _markdown_table(table: Table) -> list[str]:
    def line(cells: tuple[str, ...]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    rule = "| --- |" + " ---: |" * (len(table.header) - 1)
    return [line(table.header), rule, *map(line, table.rows), ""]


def html(title: str, sections: Sequence[PageSection]) -> str:
    """Return the page as HTML without external resources."""
    out = [
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>",
    ]
    for section in sections:
        out.append(f"<h2>{escape(section.title)}</h2>")
        out += [_html_table(p) if isinstance(p, Table) else f"<p>{escape(p)}</p>" for p in section.parts]
    return "\n".join([*out, "</body>", "</html>", ""])


def _html_table(table: Table) -> str:
    def line(kind: str, cells: tuple[str, ...]) -> str:
        return "<tr>" + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in cells) + "</tr>"

    body = "\n".join(line("td", row) for row in table.rows)
    head = line("th", table.header)
    return f'<div class="wide"><table>\n<thead>{head}</thead>\n<tbody>\n{body}\n</tbody></table></div>'
