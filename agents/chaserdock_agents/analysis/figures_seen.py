"""Figures of what was seen, estimated and computed: cameras, filter, solver, latency. See ``figures``."""

from __future__ import annotations

from itertools import groupby

import numpy as np
from chaserdock_protocol import rotations
from chaserdock_protocol.rotations import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from .flight import Flight
from .plots import AXES_XYZ, FAINT, LIMIT, SERIES, Nothing, colour, legend_above, limit_line, new_figure
from .summary import estimate_errors, known_estimates
from .traces import Look, Traces

_LOOKS: dict[Look, str] = {
    "used": SERIES[2],
    "rejected": SERIES[1],
    "nothing": "#d9dce1",
    "bad picture": LIMIT,
    "unanswered": SERIES[3],
}


def component_errors(flight: Flight) -> tuple[Array, Array, Array]:
    """Times (K,) s, errors (K, 12) truth less estimate, and their sigmas (K, 12), where the target was known.

    Order and axes are the covariance's: position and velocity WRF, attitude and rate TRF.
    """
    a, b = known_estimates(flight)
    if not len(a):
        raise Nothing("the target was never estimated in this log, or its ground truth is missing")
    truth, e = flight.truth["target"], flight.estimate
    turn = rotations.log(rotations.multiply(rotations.conjugate(e.q_wxyz[a]), truth.q_wxyz[b]))
    errors = np.concatenate(
        [
            truth.position_m[b] - e.position_m[a],
            truth.velocity_m_s[b] - e.velocity_m_s[a],
            turn,
            truth.omega_rad_s[b] - e.omega_rad_s[a],
        ],
        axis=1,
    )
    variances = np.diagonal(flight.estimate_covariance[a], axis1=1, axis2=2)
    return e.time_s[a], errors, np.sqrt(np.maximum(variances, 0.0))


def estimate(flight: Flight, _: Traces) -> Figure:
    time_s, errors, sigmas = component_errors(flight)
    figure, axes = new_figure(4, 3, height=1.45, sharex=True, sharey="row")
    kinds = (
        ("position / mm", 1e3),
        ("velocity / mm s⁻¹", 1e3),
        ("attitude / °", np.degrees(1.0)),
        ("rate / ° s⁻¹", np.degrees(1.0)),
    )
    settled = time_s >= min(flight.scenario.settling_s, time_s[-1] / 2.0)
    for row, (label, factor) in enumerate(kinds):
        part = slice(3 * row, 3 * row + 3)
        e, s = errors[:, part] * factor, 3.0 * sigmas[:, part] * factor
        for k, name in enumerate("xyz"):
            a = axes[3 * row + k]
            a.fill_between(time_s, -s[:, k], s[:, k], color=FAINT, alpha=0.18, linewidth=0)
            a.plot(time_s, e[:, k], color=AXES_XYZ[k], linewidth=0.8)
            if row == 0:
                a.set_title(name)
            if row == 3:
                a.set_xlabel("time / s")
        axes[3 * row].set_ylabel(label)
        # The first, wide bounds would flatten all that follows.
        reach = 1.6 * max(float(np.max(s[settled])), float(np.max(np.abs(e[settled]))))
        axes[3 * row].set_ylim(-reach, reach)
    axes[0].set_xlim(0, max(float(time_s[-1]), 1e-3))
    return figure


# 2.5 and 97.5 % points of chi-square with six degrees of freedom (Abramowitz and Stegun, table 26.8).
_NEES_BAND = (1.237, 14.449)


def consistency(flight: Flight, _: Traces) -> Figure:
    component_errors(flight)  # says what is missing
    errors = estimate_errors(flight)
    figure, (axes,) = new_figure(1)
    axes.semilogy(errors["time_s"], np.maximum(errors["nees"], 1e-3), color=SERIES[0], linewidth=0.8)
    axes.axhspan(*_NEES_BAND, color=SERIES[2], alpha=0.15, linewidth=0)
    axes.axhline(6.0, color=SERIES[2], linewidth=0.8)
    outside = np.mean((errors["nees"] < _NEES_BAND[0]) | (errors["nees"] > _NEES_BAND[1]))
    axes.set_title(f"mean {np.mean(errors['nees']):.2f} of 6; {100 * outside:.1f} % outside the 95 % band")
    axes.set(ylabel="NEES", xlabel="time / s", xlim=(0, max(float(errors["time_s"][-1]), 1e-3)))
    return figure


def _bars(axes: Axes, looks: list[tuple[float, Look]], row: float, period_s: float) -> None:
    """One row of the raster: a bar for each stretch of pictures with the same fate."""
    for _, group in groupby(looks, key=lambda item: item[1]):
        stretch = list(group)
        times, look = [t for t, _ in stretch], stretch[0][1]
        # A gap between pictures (a camera that was out) stays empty.
        for part in np.split(times, np.flatnonzero(np.diff(times) > 1.5 * period_s) + 1):
            axes.broken_barh(
                [(part[0], part[-1] - part[0] + period_s)],
                (row - 0.36, 0.72),
                facecolor=_LOOKS[look],
                linewidth=0,
            )


def cameras(flight: Flight, traces: Traces) -> Figure:
    if not traces.looks:
        raise Nothing("the log holds no picture")
    period_s = 1.0 / flight.scenario.time.picture_hz
    figure, (top, bottom) = new_figure(2, sharex=True, height=2.0)
    for row, (i, looks) in enumerate(traces.looks.items()):
        _bars(top, looks, row, period_s)
        seen = [(m.sim_time_ns / 1e9, len(m.marker_ids)) for m in flight.sightings.get(i, [])]
        if seen:
            bottom.step(*np.array(seen).T, where="post", color=colour(i), label=f"chaser {i}", linewidth=0.9)
    found = {look for looks in traces.looks.values() for _, look in looks}
    for look, shade in _LOOKS.items():
        if look in found:
            top.bar(0, 0, color=shade, label=look)
    top.set_yticks(range(len(traces.looks)), [f"chaser {i}" for i in traces.looks])
    top.invert_yaxis()
    top.grid(False)
    legend_above(top)
    bottom.set(ylabel="markers used", xlabel="time / s", ylim=(-0.2, None))
    bottom.yaxis.set_major_locator(MaxNLocator(integer=True))
    if bottom.get_legend_handles_labels()[0]:
        legend_above(bottom)
    last_s = max(looks[-1][0] for looks in traces.looks.values())
    bottom.set_xlim(0, last_s + period_s)
    return figure


def _share_below(axes: Axes, values: Array, number: int) -> None:
    """The empirical distribution: share of the values below, over milliseconds."""
    ordered = np.sort(values) * 1e3
    axes.plot(ordered, np.arange(1, len(ordered) + 1) / len(ordered) * 100.0, color=colour(number))


def _time_and_share(what: str) -> tuple[Figure, Axes, Axes]:
    figure, (left, right) = new_figure(1, 2, height=2.6, width_ratios=[2.2, 1.0])
    left.set(ylabel=what, xlabel="time / s", yscale="log")
    right.set(xlabel=what, ylabel="share at most that / %", ylim=(0, 101), xscale="log")
    for axis in (left.yaxis, right.xaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    return figure, left, right


def solver(flight: Flight, _: Traces) -> Figure:
    solves = [m for m in flight.solver if m.chasers]
    if not solves:
        raise Nothing("the controller has solved nothing in this log")
    values = np.array([m.wall_solve_s for m in solves])
    figure, left, right = _time_and_share("solve time / ms")
    times = np.array([m.sim_time_ns / 1e9 for m in solves])
    left.plot(times, np.maximum(values, 1e-6) * 1e3, ".", markersize=2.2, color=SERIES[0])
    bad = np.array([any(s != "solved" for s in m.status) for m in solves])
    if np.any(bad):
        words = ", ".join(sorted({s for m in solves for s in m.status} - {"solved"}))
        left.plot(times[bad], values[bad] * 1e3, "x", markersize=4, color=LIMIT, label=words)
        legend_above(left)
    limit_line(left, 1e3 / flight.scenario.time.rate_hz, "one tick")
    _share_below(right, np.maximum(values, 1e-6), 0)
    p50, p95 = np.percentile(values, (50, 95)) * 1e3
    right.set_title(f"median {p50:.1f} ms, 95 %: {p95:.1f} ms")
    return figure


def latency(_: Flight, traces: Traces) -> Figure:
    if not traces.latency:
        raise Nothing("no picture in this log was answered by an actuator command")
    figure, left, right = _time_and_share("latency / ms")
    for i, rows in traces.latency.items():
        values = np.maximum(rows[:, 1], 1e-6)
        left.plot(rows[:, 0], values * 1e3, ".", markersize=2.2, color=colour(i), label=f"chaser {i}")
        _share_below(right, values, i)
    legend_above(left)
    return figure
