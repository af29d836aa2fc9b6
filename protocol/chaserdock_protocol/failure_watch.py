# SPDX-License-Identifier: Apache-2.0
"""Decide what to report of an installed part that fails in flight. No I/O."""

from __future__ import annotations

from typing import Literal, NamedTuple

FAILURES_TO_ERROR = 10
"""Images or ticks in a row without a usable result after which the event is an error: 0.7 s at 15
Hz, in which a filter that has converged still predicts the pose to centimetres.
"""
LONGEST_TEXT = 400
"""Longest reason, characters, so that a message has room for it and for what failed."""


class Report(NamedTuple):
    """An event about a part that fails."""

    level: Literal["warning", "error"]
    what: str
    detail: str


class FailureWatch:
    """Counts the images or ticks in a row in which the part ``name`` failed, by kind of failure."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._in_a_row: dict[str, int] = {}

    def update(self, what: str, detail: str) -> Report | None:
        """Count one image or tick, in which ``detail`` went wrong, or nothing if it is empty.

        Return what to report: the first of a row, and the row when it is an error.
        """
        count = self._in_a_row[what] = self._in_a_row.get(what, 0) + 1 if detail else 0
        if count == 1:
            return Report("warning", what, f"{self._name!r}: {detail}")
        if count == FAILURES_TO_ERROR:
            return Report("error", what, f"{self._name!r}, {count} in a row: {detail}")
        return None

    def persists(self, what: str) -> bool:
        """Return whether the row of failures ``what`` is an error."""
        return self._in_a_row.get(what, 0) >= FAILURES_TO_ERROR


def text_of(error: Exception) -> str:
    """Return the type and the text of an error in one line of bounded length."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:LONGEST_TEXT]
