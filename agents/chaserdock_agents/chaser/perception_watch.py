# SPDX-License-Identifier: Apache-2.0
"""Decide what to report of a perception that fails or is late. No I/O."""

from __future__ import annotations

from typing import Literal, NamedTuple

FAILURES_TO_ERROR = 10
"""Images in a row without a usable result after which the event is an error: 0.7 s at 15 Hz, in
which a filter that has converged still predicts the pose to centimetres.
"""

Trouble = Literal["perception failed", "perception late"]


class Report(NamedTuple):
    """An event about perception."""

    level: Literal["warning", "error"]
    what: Trouble
    detail: str


class PerceptionWatch:
    """Counts the images in a row in which a chaser's perception ``name`` failed, or came late."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._in_a_row: dict[Trouble, int] = {}

    def update(self, what: Trouble, detail: str) -> Report | None:
        """Count one image, in which ``detail`` went wrong, or nothing if it is empty.

        Return what to report: the first of a row, and the row when it is an error.
        """
        count = self._in_a_row[what] = self._in_a_row.get(what, 0) + 1 if detail else 0
        if count == 1:
            return Report("warning", what, f"{self._name!r}: {detail}")
        if count == FAILURES_TO_ERROR:
            return Report("error", what, f"{self._name!r}, {count} images in a row: {detail}")
        return None
