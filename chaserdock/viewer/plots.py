"""What the page plots: which series, and how many points of them a browser gets. No browser here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array

from .history import History, Quantity

POINTS = 240
"""Most points of one curve: about one for each pixel of its width."""

COLOURS = (
    "#2f7ed8",
    "#e8871e",
    "#2ca05a",
    "#d6455d",
    "#8e6bd1",
    "#a5673f",
    "#d96bb4",
    "#14a3b8",
    "#8a8f1f",
    "#5b7c99",
    "#c0392b",
    "#16a085",
    "#f39c12",
    "#7f8c8d",
    "#3949ab",
    "#6d9b3a",
)
"""One a chaser: told apart on white and on black alike."""
ESTIMATE_COLOUR = "#e0a800"


Curve = tuple[str, str, Quantity, int | None]
"""Label, colour, quantity, and the chaser that it is of, or None."""


@dataclass(frozen=True)
class Plot:
    """One plot and its curves."""

    title: str
    curves: tuple[Curve, ...]


def plots_of(chasers: int, truth: bool) -> tuple[Plot, ...]:
    """The page's plots; the estimate's error only where the truth is known."""

    def each(quantity: Quantity) -> tuple[Curve, ...]:
        return tuple((str(i), COLOURS[i % len(COLOURS)], quantity, i) for i in range(chasers))

    estimate: tuple[Curve, ...] = (
        ("position, mm", ESTIMATE_COLOUR, "estimate_error_mm", None),
        ("attitude, deg", "#7c8aa0", "estimate_error_deg", None),
    )
    return (
        Plot("distance to the target, m", each("distance_m")),
        Plot("position error, mm", each("position_error_mm")),
        Plot("orientation error, deg", each("orientation_error_deg")),
        *((Plot("error of the target's estimate", estimate),) if truth else ()),
        Plot("solve time, ms", (("controller", COLOURS[0], "solve_ms", None),)),
        Plot("image to command, ms of wall time", each("latency_ms")),
    )


def points_of(plot: Plot, history: History, begin_s: float, until_s: float) -> tuple[Array, ...]:
    """Times (K,) and, for each curve, its values (K,), K at most ``POINTS``; two at least, zeros where nothing is known.

    Time is cut into equal bins, and a curve shows the largest value in each, so that no peak is lost. Where a curve has
    no value in a bin in which another has, it goes on as before.
    """
    found = [history.series[quantity, chaser].until(until_s) for _, _, quantity, chaser in plot.curves]
    edges = np.linspace(begin_s, max(until_s, begin_s + 1e-3), POINTS + 1)
    peaks = np.full((len(found), POINTS), np.nan)
    for row, (times, values) in zip(peaks, found, strict=True):
        inside = times >= begin_s
        bins = np.clip(np.searchsorted(edges, times[inside], side="right") - 1, 0, POINTS - 1)
        np.fmax.at(row, bins, values[inside])
    used = np.flatnonzero(~np.isnan(peaks).all(axis=0))
    if used.size == 0:
        return tuple(np.zeros(2) for _ in range(len(found) + 1))
    if used.size == 1:
        used = np.repeat(used, 2)
    centres = (edges[:-1] + edges[1:]) / 2.0
    return (centres[used], *(_carried_on(row[used]) for row in peaks))


def _carried_on(values: Array) -> Array:
    """Without gaps: each takes the value before it, the first ones the first that is there; zeros without any."""
    known = np.flatnonzero(~np.isnan(values))
    if known.size == 0:
        return np.zeros_like(values)
    before = np.searchsorted(known, np.arange(values.size), side="right") - 1
    return values[known[np.maximum(before, 0)]]
