"""Figures of what was seen, estimated and computed: cameras, filter, solver, latency. See ``figures``."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from .flight import Flight
from .plots import AXES_XYZ, FAINT, LIMIT, SERIES, Nothing, colour, few, legend_above, limit_line, new_figure
from .summary import estimate_errors, known_estimates
from .time_series import LOOKS, Look, Looks, Traces

_LOOKS: dict[Look, str] = {
    "used": SERIES[2],
    "rejected": SERIES[1],
    "nothing": "#d9dce1",
    "bad image": LIMIT,
    "unanswered": SERIES[3],
}


def component_errors(flight: Flight) -> tuple[Array, Array, Array]:
    """Times (K,) s, errors (K, 12) truth less estimate, and their sigmas (K, 12), where the target was known; of a long
    flight as many as are drawn.

    Order and axes are the covariance's: position and velocity WRF, attitude and rate TRF.
    """
    a, b = (rows[few(len(rows))] for rows in known_estimates(flight))
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
    return e.time_s[a], errors, np.sqrt(np.maximum(flight.variances(a), 0.0))


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
    d = few(len(errors["nees"]))
    axes.semilogy(errors["time_s"][d], np.maximum(errors["nees"][d], 1e-3), color=SERIES[0], linewidth=0.8)
    axes.axhspan(*_NEES_BAND, color=SERIES[2], alpha=0.15, linewidth=0)
    axes.axhline(6.0, color=SERIES[2], linewidth=0.8)
    outside = np.mean((errors["nees"] < _NEES_BAND[0]) | (errors["nees"] > _NEES_BAND[1]))
    axes.set_title(f"mean {np.mean(errors['nees']):.2f} of 6; {100 * outside:.1f} % outside the 95 % band")
    axes.set(ylabel="NEES", xlabel="time / s", xlim=(0, max(float(errors["time_s"][-1]), 1e-3)))
    return figure


def _bars(axes: Axes, looks: Looks, row: float, period_s: float) -> None:
    """One row of the raster: a bar for each stretch of images with the same fate.

    A gap between images (a camera that was out) stays empty.
    """
    spans: dict[Look, list[tuple[float, float]]] = {}
    for first_s, last_s, look in looks.stretches(1.5 * period_s):
        spans.setdefault(look, []).append((first_s, last_s - first_s + period_s))
    for look, bars in spans.items():
        axes.broken_barh(bars, (row - 0.36, 0.72), facecolor=_LOOKS[look], linewidth=0)


def cameras(flight: Flight, traces: Traces) -> Figure:
    if not traces.looks:
        raise Nothing("the log holds no image")
    period_s = 1.0 / flight.scenario.time.image_hz
    figure, (top, bottom) = new_figure(2, sharex=True, height=2.0)
    for row, (i, looks) in enumerate(traces.looks.items()):
        _bars(top, looks, row, period_s)
        seen = flight.sightings.get(i)
        if seen is not None:
            d = few(len(seen.time_s))
            bottom.step(
                seen.time_s[d],
                seen.markers[d],
                where="post",
                color=colour(i),
                label=f"chaser {i}",
                linewidth=0.9,
            )
    found = {LOOKS[code] for looks in traces.looks.values() for code in np.unique(looks.code)}
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
    last_s = max(float(looks.time_s[-1]) for looks in traces.looks.values())
    bottom.set_xlim(0, last_s + period_s)
    return figure


def _share_below(axes: Axes, values: Array, number: int) -> None:
    """The empirical distribution: share of the values below, over milliseconds."""
    ordered = np.sort(values) * 1e3
    share = np.arange(1, len(ordered) + 1) / len(ordered) * 100.0
    d = few(len(ordered))
    axes.plot(ordered[d], share[d], color=colour(number))


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
    solves = flight.solves
    if not len(solves.time_s):
        raise Nothing("the controller has solved nothing in this log")
    values = solves.wall_s
    figure, left, right = _time_and_share("solve time / ms")
    d, bad = few(len(values)), solves.imperfect
    left.plot(solves.time_s[d], np.maximum(values[d], 1e-6) * 1e3, ".", markersize=2.2, color=SERIES[0])
    if np.any(bad):
        words = ", ".join(sorted(set(solves.statuses) - {"solved"}))
        d = few(int(np.sum(bad)))
        left.plot(solves.time_s[bad][d], values[bad][d] * 1e3, "x", markersize=4, color=LIMIT, label=words)
        legend_above(left)
    limit_line(left, 1e3 / flight.scenario.time.rate_hz, "one tick")
    _share_below(right, np.maximum(values, 1e-6), 0)
    p50, p95 = np.percentile(values, (50, 95)) * 1e3
    right.set_title(f"median {p50:.1f} ms, 95 %: {p95:.1f} ms")
    return figure


def latency(_: Flight, traces: Traces) -> Figure:
    if not traces.latency:
        raise Nothing("no image in this log was answered by an actuator command")
    figure, left, right = _time_and_share("latency / ms")
    for i, rows in traces.latency.items():
        values = np.maximum(rows[:, 1], 1e-6)
        d = few(len(values))
        left.plot(rows[d, 0], values[d] * 1e3, ".", markersize=2.2, color=colour(i), label=f"chaser {i}")
        _share_below(right, values, i)
    legend_above(left)
    return figure
