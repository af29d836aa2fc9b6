# SPDX-License-Identifier: Apache-2.0
"""Lines of text that fit a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator

COLUMNS = 80
"""Largest width of a line in the terminal, characters."""


def wrapped(lines: Iterable[str], columns: int = COLUMNS) -> Iterator[str]:
    """Yield lines of at most ``columns`` characters; long words stay whole, so that a path can be
    copied.
    """
    for line in lines:
        indent = " " * (len(line) - len(line.lstrip()) + 4)
        yield from textwrap.wrap(
            line, columns, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )


def labelled(label: str, text: str) -> str:
    """Return ``label: text`` for a path or command, which is copied as a whole: on a line of its
    own if both do not fit one.
    """
    line = f"{label}: {text}"
    return line if len(line) <= COLUMNS else f"{label}:\n  {text}"
