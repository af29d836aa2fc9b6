# SPDX-License-Identifier: Apache-2.0
"""The verdict on a flight: one object, which terminal, report, film, viewer, notebook and campaign
pages render.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from html import escape
from typing import Any, Literal

import msgspec

from .criterion import Criterion, html_table

NEES_BAND = (3.0, 12.0)
"""Mean NEES of a pose (6 expected) that is not remarked on: half to twice the expectation. Wider:
wrong covariances pass; narrower: a short flight, whose errors are correlated, is remarked on.
"""


@dataclass(frozen=True)
class Verdict:
    """Verdict on a flight, with all that qualifies it.

    ``ended``: why the flight ended; empty if that is not known. ``not_met``, ``not_judged``:
    criteria of the scenario. ``doubts``: estimates whose errors do not fit their covariance.
    ``lacking``: what the log lacks of its mission. ``criteria``: all of them, as rows of a table;
    empty for a flight without, or of an earlier version.
    """

    success: bool
    ended: str = ""
    not_met: tuple[str, ...] = ()
    not_judged: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    lacking: tuple[str, ...] = ()
    criteria: tuple[Criterion, ...] = ()

    @property
    def level(self) -> Literal["good", "partial", "bad"]:
        """Return ``good`` only for a success to which nothing is to be added."""
        if not self.success:
            return "bad"
        return "partial" if self.not_judged or self.doubts or self.lacking else "good"

    @property
    def headline(self) -> str:
        """Return the verdict in one line."""
        if not self.success:
            return "FAILED"
        n = len(self.not_judged)
        limits = [f"{n} {'criterion' if n == 1 else 'criteria'} not judged"] if n else []
        limits += ["NEES out of range"] if self.doubts else []
        limits += ["log incomplete"] if self.lacking else []
        return f"success, but {' and '.join(limits)}" if limits else "success"

    def remarks(self) -> Iterator[tuple[str, str]]:
        """Yield what qualifies the verdict, each with its kind."""
        yield from (("not met", text) for text in self.not_met)
        yield from (("not judged", text) for text in self.not_judged)
        yield from (("doubtful", text) for text in self.doubts)
        yield from (("the log", text) for text in self.lacking)

    def lines(self) -> list[str]:
        """Return the reason of the end, if known, and the remarks as lines of text."""
        ended = [f"ended: {self.ended}"] if self.ended else []
        return [*ended, *(f"{kind}: {text}" for kind, text in self.remarks())]

    def lines_beside_table(self) -> list[str]:
        """Return the lines that the table of the criteria does not show."""
        return replace(self, not_met=(), not_judged=()).lines() if self.criteria else self.lines()

    def badge(self) -> str:
        """Return the headline as an HTML element of class ``verdict`` and the level."""
        return f'<span class="verdict {self.level}">{escape(self.headline)}</span>'

    def html(self, table: bool = False) -> str:
        """Return the lines as an HTML list of class ``verdict-lines``; empty without any.
        ``table``: with the table of the criteria.
        """
        lines = self.lines_beside_table() if table else self.lines()
        items = "".join(f"<li>{escape(line)}</li>" for line in lines)
        text = f'<ul class="verdict-lines">{items}</ul>' if items else ""
        return text + html_table(self.criteria) if table else text


def verdict_of(summary: Mapping[str, Any]) -> Verdict:
    """Return the verdict in a flight's summary (plain values, as in summary.json).

    Keys that a campaign's flight of the controller alone, or an earlier version, does not have
    count as empty.
    """
    not_met = tuple(summary.get("failures", ()))
    return Verdict(
        success=summary.get("success", not not_met),
        ended=summary.get("ended", ""),
        not_met=not_met,
        not_judged=tuple(summary.get("not_judged", ())),
        doubts=tuple(summary.get("doubts", ())),
        lacking=tuple(summary.get("log_lacks", ())),
        criteria=msgspec.convert(summary.get("criteria", ()), tuple[Criterion, ...]),
    )


def estimate_doubts(summary: Mapping[str, Any]) -> list[str]:
    """Return a line for each estimate in a summary whose mean NEES is outside ``NEES_BAND``."""
    estimates = {"target estimate": summary["target_estimate"]} | {
        f"chaser {i}, pose relative to the target": c["relative_estimate"]
        for i, c in summary["chasers"].items()
        if "relative_estimate" in c
    }
    low, high = NEES_BAND
    out = []
    for what, estimate in estimates.items():
        nees = estimate["nees_mean"]
        if nees is not None and not low <= nees <= high:
            side = "larger" if nees > high else "smaller"
            out.append(
                f"{what}: mean NEES {nees:.3g} of 6, outside {low:g} to {high:g}: errors are "
                f"{side} than the covariance states"
            )
    return out
