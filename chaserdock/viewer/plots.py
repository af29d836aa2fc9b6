# SPDX-License-Identifier: Apache-2.0
"""Plots of the page: their series, decimated for the browser."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array

from chaserdock.analysis.plots import AXES_XYZ, SERIES

from .history import ChartQuantity, History

POINTS = 240
"""Largest number of points of a curve: about one per pixel."""

COLOURS = SERIES
"""Colours of the chasers, as in figures and video. Beyond the last one they repeat with dashed
curves.
"""
ESTIMATE_COLOUR = "#e0a800"
QUANTITIES = (ESTIMATE_COLOUR, *AXES_XYZ[1:])
"""Colours of curves that belong to no chaser, on a light or dark panel."""


_LEAST_ERROR = 0.01
"""Smallest error (mm or deg) shown: a tenth of what the estimator reaches. Smaller: a single tick
without error compresses the scale.
"""

Curve = tuple[str, str, ChartQuantity, int | None]
"""Label, colour, quantity, and chaser or None."""


@dataclass(frozen=True)
class Plot:
    """A plot and its curves. ``least``: with a logarithmic scale, the smallest value shown."""

    title: str
    curves: tuple[Curve, ...]
    least: float | None = None


def plots_of(
    chasers: int, truth: bool, ports: Sequence[int] = (), identified: bool = False
) -> tuple[Plot, ...]:
    """Return the plots of the page.

    ``truth``: with estimation error and loads at the ports of the chasers ``ports``.
    ``identified``: with uncertainty of the target's mass properties.
    """

    def each(quantity: ChartQuantity, numbers: Iterable[int] = range(chasers)) -> tuple[Curve, ...]:
        return tuple((f"chaser {i}", COLOURS[i % len(COLOURS)], quantity, i) for i in numbers)

    estimate: tuple[Curve, ...] = (
        ("position, mm", QUANTITIES[0], "estimate_error_mm", None),
        ("attitude, deg", QUANTITIES[1], "estimate_error_deg", None),
    )
    uncertainty: tuple[Curve, ...] = (
        ("mass, %", QUANTITIES[0], "mass_sigma_percent", None),
        ("centre, mm", QUANTITIES[1], "centre_sigma_mm", None),
        ("inertia, %", QUANTITIES[2], "inertia_sigma_percent", None),
    )
    return (
        Plot("distance to the target, m", each("distance_m")),
        Plot("position error, mm", each("position_error_mm"), _LEAST_ERROR),
        Plot("orientation error, deg", each("orientation_error_deg"), _LEAST_ERROR),
        *((Plot("error of the target estimate", estimate, _LEAST_ERROR),) if truth else ()),
        *((Plot("load at the port, N", each("port_load_N", ports)),) if truth and ports else ()),
        *((Plot("identified target, 1 sigma", uncertainty),) if identified else ()),
        Plot("solve time, ms", (("controller", QUANTITIES[0], "solve_ms", None),)),
        Plot("image to command, ms wall time", each("latency_ms")),
    )


def points_of(plot: Plot, history: History, begin_s: float, until_s: float) -> tuple[Array, ...]:
    """Return times (K,) and the values (K,) of each curve, 2 <= K <= ``POINTS``; zeros, or
    ``plot.least``, without data.

    Each value is the maximum of an equal time bin, so that peaks stay visible. A curve without a
    value in a bin of another curve keeps its previous value.
    """
    series = [
        history.series[quantity, chaser].until(until_s) for _, _, quantity, chaser in plot.curves
    ]
    edges = np.linspace(begin_s, max(until_s, begin_s + 1e-3), POINTS + 1)
    peaks = np.full((len(series), POINTS), np.nan)
    for row, (times, values) in zip(peaks, series, strict=True):
        inside = times >= begin_s
        bins = np.clip(np.searchsorted(edges, times[inside], side="right") - 1, 0, POINTS - 1)
        np.fmax.at(row, bins, values[inside])
    used = np.flatnonzero(~np.isnan(peaks).all(axis=0))
    if used.size == 0:
        nothing = np.full(2, plot.least or 0.0)
        return (np.zeros(2), *(nothing for _ in series))
    if used.size == 1:
        used = np.repeat(used, 2)
    centres = (edges[:-1] + edges[1:]) / 2.0
    curves = (_filled(row[used]) for row in peaks)
    if plot.least is not None:
        curves = (np.maximum(curve, plot.least) for curve in curves)
    return (centres[used], *curves)


def _filled(values: Array) -> Array:
    """Fill gaps with the previous value, the start with the first one; return zeros without any."""
    known = np.flatnonzero(~np.isnan(values))
    if known.size == 0:
        return np.zeros_like(values)
    before = np.searchsorted(known, np.arange(values.size), side="right") - 1
    return values[known[np.maximum(before, 0)]]
