# SPDX-License-Identifier: Apache-2.0
"""Figures of a recorded flight, one function each: the paper's figures and diagnostics.

A function raises ``MissingData`` when the log lacks what it needs. Errors refer to the motion that
the flight is judged against, as in ``summary``. A chaser has the same colour in all figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.errors import errors_of_writing
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from .approach import approach_of
from .flight import RecordedFlight, load_flight
from .mass_properties import NAMES, SCALE, stated_values, true_values
from .motion import TARGET, Track
from .plots import (
    AXES_XYZ,
    FAINT,
    GOOD,
    GRID,
    INK,
    LIMIT,
    MissingData,
    colour,
    dashes,
    decimated,
    decimation,
    legend_above,
    limit_line,
    new_figure,
    save,
    styled,
)
from .pose_errors import chi_square_band
from .stack import stack_motion
from .summary import (
    estimate_errors,
    known_estimates,
    relative_errors,
    tracking_components,
    tracking_errors,
)
from .time_series import OUTCOMES, ImageOutcome, ImageOutcomes, Traces, load_traces

Drawing = Callable[[RecordedFlight, Traces], Figure]


@dataclass(frozen=True)
class FigureKind:
    """A figure: file name, title, caption and drawing function."""

    name: str
    title: str
    caption: str
    draw: Drawing


FIGURES: list[FigureKind] = []
"""All figures, in the order of the report."""


def _figure(title: str, caption: str) -> Callable[[Drawing], Drawing]:
    """Register a drawing function, whose name is the file name."""

    def register(draw: Drawing) -> Drawing:
        FIGURES.append(FigureKind(draw.__name__, title, caption, draw))
        return draw

    return register


def flown(flight: RecordedFlight) -> list[int]:
    """Return the chasers whose motion is in the log. Raise MissingData if there are none or the
    target is missing.
    """
    if TARGET not in flight.motion:
        raise MissingData("the log holds neither ground truth nor a reference of the target")
    numbers = flight.shown
    if not numbers:
        raise MissingData("the log holds neither ground truth nor a reference of any chaser")
    return numbers


def _span_s(*times_s: Array) -> tuple[float, float]:
    """Return the limits of a time axis, from zero to the last of all times; not empty."""
    return 0.0, max(1e-3, *(float(times[-1]) for times in times_s if len(times)))


def _path(own: Track, target: Track) -> tuple[Array, Array]:
    """Return the drawn positions of a chaser, up to the last one: in WRF, and relative to the
    target in TRF. Both motions at the same times.
    """
    n = len(own.time_s)
    rows = np.unique(np.append(np.arange(n)[decimated(n)], n - 1))
    position = own.position_m[rows]
    return position, rotations.rotate_inverse(
        target.q_wxyz[rows], position - target.position_m[rows]
    )


@_figure("Trajectories", "Paths of the centres of mass; dot: start, triangle: end.")
def trajectories(flight: RecordedFlight, _: Traces) -> Figure:
    numbers = flown(flight)
    target = flight.motion[TARGET]
    paths = {i: _path(*flight.motion.pair(i)) for i in numbers}
    figure = Figure(figsize=(9.6, 4.8))
    layout: Any = figure.get_layout_engine()
    layout.set(rect=(0.0, 0.0, 0.96, 1.0))  # it does not know the labels of 3-D axes
    for place, title in enumerate(
        ("World frame (WRF)", "Relative to the target, target frame (TRF)")
    ):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="3d")
        if place:
            axes.scatter(0.0, 0.0, 0.0, color=FAINT, marker="s", s=28, label="target")
        else:
            axes.plot(
                *target.position_m[decimated(len(target.time_s))].T,
                color=FAINT,
                linewidth=1.6,
                label="target",
            )
        for i in numbers:
            p = paths[i][place]
            axes.plot(*p.T, color=colour(i), label=f"chaser {i}")
            axes.scatter(*p[0], color=colour(i), marker="o", s=14)
            axes.scatter(*p[-1], color=colour(i), marker="^", s=22)
        axes.set_title(title)
        axes.set(xlabel="x / m", ylabel="y / m", zlabel="z / m")
        axes.xaxis.labelpad = axes.yaxis.labelpad = 7.0
        lengths = _equal_scale(
            axes, [paths[i][place] for i in numbers] + ([] if place else [target.position_m])
        )
        for axis, length in zip((axes.xaxis, axes.yaxis, axes.zaxis), lengths, strict=True):
            axis.pane.set_visible(False)
            axis.set_major_locator(MaxNLocator(5 if length > 0.5 * max(lengths) else 2))
        axes.tick_params(labelsize=7.5)
        if not place:
            axes.legend(loc="upper left", bbox_to_anchor=(-0.12, 1.0))
    return figure


def _equal_scale(axes: Any, paths: list[Array]) -> Array:
    """Give the axes one scale and limits around the paths and the origin; the box is no larger than
    the paths need. Return the lengths (3,) of its sides, m.
    """
    points = np.concatenate([*paths, np.zeros((1, 3))])
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum(high - low, 0.3 * float(np.max(high - low)) + 1e-3) / 2.0 * 1.05
    middle = (low + high) / 2.0
    for set_limits, m, h in zip(
        (axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, half, strict=True
    ):
        set_limits(m - h, m + h)
    axes.set_box_aspect(half, zoom=1.0)
    return 2.0 * half


_STRIP_ROW_IN = 0.17
"""Height (in) of a chaser's row of phases: that of its text and a gap. Smaller: labels touch."""
_LETTER_IN = 0.062
"""Width (in) of a letter of a phase's name. Smaller: names overrun their bars; larger: fewer have a
name.
"""


def _timed_figure(
    flight: RecordedFlight, rows: int, columns: int = 1, height: float = 2.1
) -> tuple[Figure, list[Axes]]:
    """Create a figure over time, with the phases of each chaser above its panels; return it and
    the panels row by row. ``height`` of one row in inches.
    """
    histories = flight.references
    strip_in = 0.12 + _STRIP_ROW_IN * len(histories)
    figure = Figure(figsize=(9.6, 0.5 + strip_in + height * rows))
    axes: Any = figure.subplots(
        rows + 1, columns, squeeze=False, sharex="col", height_ratios=[strip_in] + [height] * rows
    )
    width_in = 8.4 / columns
    for strip in axes[0]:
        strip.set_axis_off()
    for column, strip in enumerate(axes[0]):
        _draw_phases(strip, flight, width_in, named=column == 0)
        for panel in axes[1:, column]:
            for i, history in histories.items():
                for time_s, _ in history.phases[1:]:
                    panel.axvline(time_s, color=colour(i), linewidth=0.6, alpha=0.5, linestyle=":")
        axes[-1, column].set_xlabel("time / s")
    return figure, list(axes[1:].ravel())


def _draw_phases(strip: Axes, flight: RecordedFlight, width_in: float, named: bool) -> None:
    """Draw a row for each chaser, with a bar for each phase, named where the name fits. A name lies
    within its bar, so that no two overlap. ``named``: with the numbers of the chasers.
    """
    end_s = max(flight.flown_s, 1e-3)
    for row, (i, history) in enumerate(flight.references.items()):
        ends = [begin_s for begin_s, _ in history.phases[1:]] + [end_s]
        for k, ((begin_s, name), until_s) in enumerate(zip(history.phases, ends, strict=True)):
            bar = [(begin_s, max(until_s - begin_s, 0.0))]
            strip.broken_barh(bar, (row - 0.44, 0.88), color=colour(i), alpha=(0.3, 0.14)[k % 2])
            if len(name) * _LETTER_IN < (until_s - begin_s) / end_s * width_in:
                strip.text(
                    begin_s + 0.004 * end_s, row, name, va="center", fontsize=7.5, clip_on=True
                )
        if named:
            place = strip.get_yaxis_transform()
            strip.annotate(
                f"chaser {i}",
                (0.0, row),
                xycoords=place,
                xytext=(-4, 0),
                textcoords="offset points",
                ha="right",
                va="center",
                fontsize=8,
                color=colour(i),
            )
    strip.set(ylim=(max(len(flight.references), 1) - 0.5, -0.5), xlim=(0.0, end_s))


def _span_of(errors: Array, time_s: Array, from_s: float) -> float:
    """Return the largest magnitude since ``from_s``, or in the later half of a shorter series: a
    transient before it does not set a scale. Positive.
    """
    late = errors[time_s >= min(from_s, float(time_s[-1]) / 2.0)] if len(time_s) else np.zeros(1)
    return max(float(np.max(np.abs(late))), 1e-3)


def _name_chasers(flight: RecordedFlight, axes: Axes) -> None:
    """Place a legend above the axes of a figure without phases, which name the chasers."""
    if not flight.references:
        legend_above(axes)


@_figure(
    "Approach",
    "Offset from the docking axis and closing speed over the range: of the probe's tip from its "
    "port (0 at contact), without port of the chaser's centre from its docking pose. Time runs to "
    "the right. Red: limits of corridor, last part and contact; crosses: at the touch.",
)
def approach(flight: RecordedFlight, _: Traces) -> Figure:
    found = {i: a for i in flown(flight) if (a := approach_of(flight, i)) is not None}
    if not found:
        raise MissingData("no chaser has approached the target")
    figure, panels = new_figure(1, 2, height=3.0)
    for i, a in found.items():
        for axes, values, limits in (
            (panels[0], a.lateral_m, a.lateral_limits),
            (panels[1], a.closing_m_s, a.closing_limits),
        ):
            axes.plot(
                a.range_m * 1e3,
                values * 1e3,
                color=colour(i),
                linestyle=dashes(i),
                label=f"chaser {i}",
            )
            for limit in limits:
                ends = (limit.from_m * 1e3, limit.to_m * 1e3)
                style = {"marker": "D", "markersize": 4} if ends[0] == ends[1] else {}
                axes.plot(ends, (limit.value * 1e3,) * 2, color=LIMIT, linewidth=1.1, **style)
    for touch in flight.world.touches:
        if touch.chaser in found and touch.latched:
            for axes, value in ((panels[0], touch.lateral_m), (panels[1], touch.closing_m_s)):
                axes.plot(0.0, value * 1e3, "x", color=colour(touch.chaser), markersize=6)
    for axes, kind, label in (
        (panels[0], "lateral_limits", "lateral offset / mm"),
        (panels[1], "closing_limits", "closing speed / mm s⁻¹"),
    ):
        most = max(limit.value for a in found.values() for limit in getattr(a, kind)) * 1e3
        axes.set(xlabel="range / mm", ylabel=label)
        axes.set_ylim(0.0 if axes is panels[0] else -0.5 * most, 1.6 * most)
        axes.xaxis.set_inverted(True)
    legend_above(panels[0])
    return figure


@_figure(
    "Motion of the stack",
    "Rate of the target, angular momentum of the stack (the target with the chasers latched at "
    "that time) about its centre of mass, and speed of that centre; dashed: limits of a stopped "
    "one.",
)
def stack(flight: RecordedFlight, _: Traces) -> Figure:
    if not flight.latched:
        raise MissingData("no chaser is latched to the target at the end")
    times = flight.motion[TARGET].time_s if TARGET in flight.motion else np.zeros(0)
    members = {i: flight.latched_during(i, times) for i in flight.latched}
    motion = stack_motion(flight, members) if len(times) else None
    if motion is None:
        raise MissingData("the log has no motion with rates of target and latched chasers")
    figure, panels = _timed_figure(flight, 3, height=1.6)
    d = decimated(len(motion.time_s))
    limits = flight.scenario.success.detumbled
    for axes, values, label, limit in (
        (
            panels[0],
            np.degrees(motion.rate_rad_s),
            "rate / ° s⁻¹",
            limits and limits.rate_deg_s,
        ),
        (panels[1], motion.angular_momentum_N_m_s, "angular\nmomentum / N m s", None),
        (
            panels[2],
            motion.speed_m_s * 1e3,
            "speed / mm s⁻¹",
            limits and limits.speed_m_s * 1e3,
        ),
    ):
        axes.plot(motion.time_s[d], values[d], color=INK)
        axes.set_ylabel(label)
        if limit is None:
            axes.set_ylim(0.0, None)
        else:  # a limit is a hundredth of what was stopped, and less
            axes.set_yscale("log")
            _plain_numbers(axes.yaxis)
            unit = label.partition(" / ")[2]
            text = f"stopped: {limit:g} {unit}; at the end {values[-1]:.2g}"
            limit_line(axes, limit, text, at="left")  # where the curve is far above
    panels[0].set_xlim(_span_s(motion.time_s))
    return figure


_PASSAGES = 0.02
"""Share of the values below a logarithmic scale: starts on the reference and passages through it.
Larger: the least errors are cut off; smaller: a scale with decades that hold no more than these.
"""


@_figure(
    "Tracking errors",
    "Distance and angle of each chaser from its reference pose on the true target; without ground "
    "truth and reference, of its odometry from its reference pose on the estimated target. Left: "
    "whole flight, logarithmic. Right: linear, with the scale of the part after settling; the "
    "transient is cut off. Shaded: steady-state interval.",
)
def tracking(flight: RecordedFlight, _: Traces) -> Figure:
    errors = {i: table.T for i, table in flight.estimated_errors.items()}
    if flight.shown or not errors:
        errors = {i: tracking_errors(flight, i) for i in flown(flight)}
    _require_led(errors)
    figure, panels = _timed_figure(flight, 2, 2)
    s = flight.scenario
    position_mm, angle_deg = s.success.steady_position_rms_m, s.success.steady_orientation_rms_deg
    for row, (factor, limit, unit, label) in enumerate(
        (
            (1e3, None if position_mm is None else position_mm * 1e3, "mm", "position error / mm"),
            (np.degrees(1.0), angle_deg, "°", "orientation error / °"),
        )
    ):
        whole, late = panels[2 * row : 2 * row + 2]
        reach, least = 0.0, np.inf
        for i, (time_s, *both) in errors.items():
            d = decimated(len(time_s))
            values = both[row] * factor
            for axes, shown in ((whole, np.maximum(values[d], 1e-4)), (late, values[d])):
                axes.plot(time_s[d], shown, color=colour(i), label=f"chaser {i}")
            reach = max(reach, _span_of(values, time_s, s.settling_s))
            if len(values):
                least = min(least, 0.5 * float(np.quantile(values, _PASSAGES)))
        if limit is not None:
            least = min(least, 0.7 * limit)
        whole.set(yscale="log", ylabel=label, ylim=(max(least, 1e-4), None))
        late.set_ylabel(label)
        _plain_numbers(whole.yaxis)
        late.set_ylim(0.0, 1.15 * reach)
        for axes in (whole, late):
            axes.axvspan(
                s.settling_s, s.steady_until_s or s.duration_s, color=FAINT, alpha=0.08, linewidth=0
            )
        if limit is not None:
            limit_line(whole, limit, f"RMS limit {limit:g} {unit}")
            if limit < 1.5 * reach:
                late.set_ylim(0.0, 1.15 * max(reach, limit))
                limit_line(late, limit, f"RMS limit {limit:g} {unit}")
        if flight.motion.source == "reference":
            sigma = flight.motion.sigmas()[row] * factor
            limit_line(whole, max(sigma, 1e-4), "reference, 1 sigma")
    for axes in panels[:2]:
        axes.set_xlim(_span_s(*(time_s for time_s, *_ in errors.values())))
    _name_chasers(flight, panels[0])
    return figure


def _require_led(errors: Mapping[int, Any]) -> None:
    """Raise MissingData if no chaser has times (K,), the first of its values, with an error."""
    if not any(len(time_s) for time_s, *_ in errors.values()):
        raise MissingData("no chaser was led relative to the target")


@_figure(
    "Tracking errors by axis",
    "Pose of each chaser minus its reference pose on the true target: position in target axes, "
    "orientation as a rotation vector in chaser axes. The scale is that after settling.",
)
def tracking_axes(flight: RecordedFlight, _: Traces) -> Figure:
    numbers = flown(flight)
    figure, axes = new_figure(2, 3, height=1.7, sharex=True, sharey="row")
    step = decimation(len(flight.motion[TARGET].time_s))
    errors = {i: tracking_components(flight, i, step) for i in numbers}
    _require_led(errors)
    reach = np.zeros(2)
    for i, (time_s, position, turn) in errors.items():
        for row, values in enumerate((position * 1e3, np.degrees(turn))):
            reach[row] = max(reach[row], 1.2 * _span_of(values, time_s, flight.scenario.settling_s))
            for k in range(3):
                axes[3 * row + k].plot(
                    time_s,
                    values[:, k],
                    color=colour(i),
                    linestyle=dashes(i),
                    linewidth=0.9,
                    label=f"chaser {i}",
                )
    for row, label in enumerate(("position / mm", "orientation / °")):
        axes[3 * row].set_ylabel(label)
        axes[3 * row].set_ylim(-reach[row], reach[row])
    for k, name in enumerate("xyz"):
        axes[k].set_title(name)
        axes[3 + k].set_xlabel("time / s")
    axes[0].set_xlim(_span_s(flight.motion[TARGET].time_s))
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=8, handlelength=1.4
    )
    return figure


def speed_limits(flight: RecordedFlight, chaser: int) -> list[tuple[float, float, float]]:
    """Return begin (s), end (s) and limit (m/s) of each phase of a chaser in which its closing
    speed is limited.
    """
    s, history = flight.scenario, flight.references.get(chaser)
    if history is None:
        return []
    if s.docking.port_of(chaser) is None:
        limits: dict[str, float] = dict.fromkeys(
            ("approach", "retreat", "goto", "abort"), s.approach.max_speed_m_s
        )
    else:
        docking = s.docking
        limits = {
            "approach": docking.corridor.closing_m_s,
            "final": docking.final.closing_m_s,
            "contact": docking.tolerances.closing_m_s,
        }
    ends = [begin_s for begin_s, _ in history.phases[1:]] + [flight.flown_s]
    return [
        (begin_s, end_s, limits[phase])
        for (begin_s, phase), end_s in zip(history.phases, ends, strict=True)
        if phase in limits
    ]


def keep_out(flight: RecordedFlight, chaser: int) -> tuple[Array, Array]:
    """Return times (K,) s, and the distance (K,) m from the target that a chaser keeps from each
    on; NaN for none.
    """
    end_s = flight.flown_s
    history = flight.references.get(chaser)
    if history is None:
        return np.array([0.0, end_s]), np.full(2, flight.scenario.limits.min_distance_target_m)
    time_s, limit_m = history.keep_out.T
    values = np.where(limit_m > 0.0, limit_m, np.nan)
    return np.append(time_s, max(end_s, float(time_s[-1]))), np.append(values, values[-1])


@_figure(
    "Docking",
    "Distance between the centres of chaser and target, and the closing speed. Dotted, in the "
    "colour of the chaser: the limits "
    "that hold for it at that time (keep-out distance, none once it is latched; closing speed in "
    "the phases that limit it).",
)
def docking(flight: RecordedFlight, _: Traces) -> Figure:
    numbers = flown(flight)
    figure, (top, bottom) = _timed_figure(flight, 2)
    s, target = flight.scenario, flight.motion[TARGET]
    nearest, fastest = np.inf, 0.0
    for i in numbers:
        time_s, distance = flight.motion[f"chaser/{i}"].distance_to(target)
        n = len(distance)
        limit_s, limit_m = keep_out(flight, i)
        top.step(limit_s, limit_m, where="post", color=colour(i), linestyle=":", linewidth=1.3)
        nearest = min([nearest, float(distance.min()), *limit_m[np.isfinite(limit_m)]])
        d = decimated(n)
        top.plot(time_s[d], distance[d], color=colour(i), linestyle=dashes(i), label=f"chaser {i}")
        if n > 2:
            speed = -np.gradient(distance, time_s)
            bottom.plot(time_s[d], speed[d] * 1e3, color=colour(i), linestyle=dashes(i))
            fastest = max(fastest, 0.55e3 * _span_of(speed, time_s, s.settling_s))
        for begin_s, end_s, limit in speed_limits(flight, i):
            bottom.plot(
                (begin_s, end_s), (limit * 1e3,) * 2, color=colour(i), linestyle=":", linewidth=1.3
            )
            fastest = max(fastest, limit * 1e3)
    if any(_docks_at_distance(flight, i) and not s.chooses_port(i) for i in numbers):
        label = f"docking distance {s.approach.dock_distance_m:g} m"
        limit_line(top, s.approach.dock_distance_m, label, at="left")
    top.set(ylabel="distance to the target / m", ylim=(nearest * 0.5, None))
    bottom.set(ylabel="closing speed / mm s⁻¹", xlim=_span_s(target.time_s))
    fastest = fastest or s.approach.max_speed_m_s * 1e3
    bottom.set_ylim(-fastest, 2.0 * fastest)
    _name_chasers(flight, top)
    return figure


def _docks_at_distance(flight: RecordedFlight, chaser: int) -> bool:
    """Return whether a chaser docks at a distance, not at a port."""
    history = flight.references.get(chaser)
    phases = set() if history is None else {name for _, name in history.phases}
    return flight.scenario.docking.port_of(chaser) is None and not phases.isdisjoint(
        ("approach", "docked")
    )


@_figure(
    "Loads at the ports",
    "Largest force and torque that each latched chaser exerts on its port, over the physics steps "
    "of each tick; thin: the part "
    "of the force across the port's axis. The steps in which a latch closes are left out.",
)
def loads(flight: RecordedFlight, _: Traces) -> Figure:
    if not any(history.of("peak_force_N").any() for history in flight.loads.values()):
        raise MissingData("no chaser has loaded a port")
    figure, (top, bottom) = _timed_figure(flight, 2)
    for i, history in flight.loads.items():
        d = decimated(len(history.time_s))
        time_s, style = history.time_s[d], dashes(i)
        top.plot(
            time_s,
            history.of("peak_force_N")[d],
            color=colour(i),
            linestyle=style,
            label=f"chaser {i}",
        )
        top.plot(
            time_s,
            history.of("peak_shear_N")[d],
            color=colour(i),
            linestyle=style,
            linewidth=0.5,
            alpha=0.7,
        )
        bottom.plot(time_s, history.of("peak_torque_N_m")[d], color=colour(i), linestyle=style)
    end_s = max(float(history.time_s[-1]) for history in flight.loads.values())
    top.set(ylabel="force / N", ylim=(0.0, None))
    bottom.set(ylabel="torque / N m", xlim=(0.0, max(end_s, 1e-3)), ylim=(0.0, None))
    ports = [port for i in flight.loads if (port := flight.scenario.docking.port_of(i)) is not None]
    for axes, limits, unit in (
        (top, {port.force_limit_N for port in ports}, "N"),
        (bottom, {port.torque_limit_N_m for port in ports}, "N m"),
    ):
        for limit in sorted(x for x in limits if x is not None):
            limit_line(axes, limit, f"limit {limit:g} {unit}")
    _name_chasers(flight, top)
    return figure


@_figure(
    "Identified mass properties",
    "Mass, centre of mass and inertia of the target alone, as identified in flight, with a band of "
    "two standard deviations; "
    "dashed: true values; dotted: values stated in the scenario. Products of inertia are thin.",
)
def identification(flight: RecordedFlight, _: Traces) -> Figure:
    found = flight.identified
    if found is None:
        raise MissingData("no mass properties were identified")
    drawn = next((b for b in flight.drawn if b.body == "target"), None)
    known = [(stated_values(flight.scenario), ":")]
    if drawn is not None:
        known.append((true_values(drawn), "--"))
    figure, panels = _timed_figure(flight, 3)
    for axes, rows, label in (
        (panels[0], range(1), "mass / kg"),
        (panels[1], range(1, 4), "centre of mass / mm"),
        (panels[2], range(4, 10), "inertia / kg m²"),
    ):
        for n, k in enumerate(rows):
            shade, width = AXES_XYZ[n % 3], 1.1 if n < 3 else 0.7  # products of inertia: thin
            value, sigma = found.values[:, k] * SCALE[k], found.sigmas[:, k] * SCALE[k]
            axes.plot(found.time_s, value, color=shade, linewidth=width, label=NAMES[k])
            band = (value - 2.0 * sigma, value + 2.0 * sigma)
            axes.fill_between(found.time_s, *band, color=shade, alpha=0.15, linewidth=0.0)
            for values, style in known:
                axes.axhline(values[k] * SCALE[k], color=shade, linestyle=style, linewidth=0.8)
        axes.set(ylabel=label)
    panels[2].set(xlim=_span_s(found.time_s))
    for axes in panels[1:]:
        legend_above(axes)
    return figure


@_figure(
    "Passive safety",
    "Margin of the coasts after a loss of all thrust at any state of the newest plan, in standard "
    "deviations; dashed: the margin "
    "of a plan that counts as passively safe.",
)
def passive_safety(flight: RecordedFlight, _: Traces) -> Figure:
    if not flight.safety:
        raise MissingData("passive safety was not monitored")
    figure, (axes,) = new_figure(1)
    for i, history in flight.safety.items():
        d = decimated(len(history.time_s))
        axes.plot(
            history.time_s[d],
            history.margin_sigmas[d],
            color=colour(i),
            linestyle=dashes(i),
            label=f"chaser {i}",
        )
    least = flight.scenario.limits.estimate_margin_sigmas
    limit_line(axes, least, f"limit {least:g}")
    axes.set(xlabel="time / s", ylabel="margin / sigmas", yscale="symlog")
    axes.set_xlim(_span_s(*(history.time_s for history in flight.safety.values())))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    legend_above(axes)
    return figure


@_figure(
    "Assurance",
    "Least room to what must not be crossed (keep-out, other chasers, corridor), with its margins; "
    "below, the commands that were changed, and thick, those replaced by the backup.",
)
def assurance(flight: RecordedFlight, _: Traces) -> Figure:
    if not flight.assurance:
        raise MissingData("commands were not assured")
    figure, (top, bottom) = new_figure(2, height=2.0, height_ratios=(3, 1), sharex=True)
    for i, history in sorted(flight.assurance.items()):
        d = decimated(len(history.time_s))
        label = f"chaser {i}"
        top.plot(history.time_s[d], history.room_m[d], color=colour(i), linestyle=dashes(i),
                 label=label)  # fmt: skip
        for flags, thickness in ((history.changed, 3.0), (history.backup, 8.0)):
            times = history.time_s[flags]
            bottom.plot(times, np.full(len(times), i), "|", color=colour(i), markersize=thickness)
    limit_line(top, 0.0, "limit")
    top.set(ylabel="room / m")
    numbers = sorted(flight.assurance)
    bottom.set(xlabel="time / s", ylabel="chaser", yticks=numbers)
    bottom.set_ylim(numbers[-1] + 0.6, numbers[0] - 0.6)
    bottom.set_xlim(_span_s(*(history.time_s for history in flight.assurance.values())))
    legend_above(top)
    return figure


@_figure(
    "Separation of the chasers",
    "Distance between the centres of each pair of chasers, in the colours of both.",
)
def separation(flight: RecordedFlight, _: Traces) -> Figure:
    numbers = flown(flight)
    if len(numbers) < 2:
        raise MissingData("the mission has only one chaser")
    figure, (axes,) = new_figure(1, height=2.8)
    pairs: dict[str, Any] = {}
    for i, j in combinations(numbers, 2):
        time_s, distance = flight.motion[f"chaser/{i}"].distance_to(flight.motion[f"chaser/{j}"])
        d = decimated(len(distance))
        (one,) = axes.plot(time_s[d], distance[d], color=colour(i))
        (other,) = axes.plot(time_s[d], distance[d], color=colour(j), linestyle=(0, (5, 5)))
        pairs[f"{i}, {j}"] = (one, other)
    least = flight.scenario.limits.min_distance_chasers_m
    limit_line(axes, least, f"limit {least:g} m")
    axes.set(ylabel="distance / m", xlabel="time / s", ylim=(0, None))
    axes.set_xlim(_span_s(flight.motion[TARGET].time_s))
    if len(pairs) <= 6:  # more do not fit into a row
        legend_above(axes, handles=list(pairs.values()), labels=list(pairs))
    return figure


@_figure(
    "Actuator forces and torques",
    "Applied force and torque (without ground truth: as commanded), body axes, mean over each "
    "tick. The scale is that after settling; dashed: limits of the planned force and torque, "
    "dotted: all thrusters of an axis open, where they are within the scale.",
)
def inputs(flight: RecordedFlight, traces: Traces) -> Figure:
    if not traces.inputs:
        raise MissingData("the log holds fewer than two ticks of every chaser")
    body = flight.scenario.chaser
    attainable = np.zeros(6)
    if body.actuation == "thrusters":
        thrusts_N = [thruster.thrust_N for thruster in body.thrusters]
        attainable = np.maximum(wrench_matrix(body.thrusters) * thrusts_N, 0.0).sum(axis=1)
    figure, axes = new_figure(len(traces.inputs), 2, height=1.55, sharex=True, sharey="col")
    kinds = (
        ("force / N", 1.0, body.force_max_N, attainable[:3]),
        ("torque / mN m", 1e3, body.torque_max_N_m, attainable[3:]),
    )
    reach = [0.0, 0.0]
    for row, (i, applied) in enumerate(traces.inputs.items()):
        for column, (label, factor, limit, most) in enumerate(kinds):
            values = (applied.torque_N_m if column else applied.force_N) * factor
            a = axes[2 * row + column]
            for k, name in enumerate("xyz"):
                a.stairs(
                    values[:, k],
                    applied.edges_s,
                    color=AXES_XYZ[k],
                    label=name,
                    linewidth=0.9,
                    baseline=None,
                )
            span = _span_of(values, applied.edges_s[1:], flight.scenario.settling_s)
            reach[column] = max(reach[column], 1.25 * span)
            for sign in (1.0, -1.0):
                a.axhline(sign * limit * factor, color=LIMIT, linestyle=(0, (5, 3)), linewidth=0.9)
                for value in np.unique(most[most > 0.0]):
                    a.axhline(sign * value * factor, color=LIMIT, linestyle=":", linewidth=0.9)
            a.set_ylabel(label if column else f"chaser {i}\n{label}")
    for column, (label, factor, limit, _) in enumerate(kinds):
        axes[column].set_ylim(-reach[column], reach[column])
        axes[column].set_title(f"limit {limit * factor:g} {label.partition(' / ')[2]}")
    axes[0].set_xlim(_span_s(*(t.edges_s for t in traces.inputs.values())))
    for a in axes[-2:]:
        a.set_xlabel("time / s")
    legend_above(axes[1])
    return figure


@_figure(
    "Impulse and velocity change",
    "Time integral of the absolute force components of each chaser since the start; right: the "
    "velocity change that it is worth, divided by the stated mass.",
)
def effort(flight: RecordedFlight, traces: Traces) -> Figure:
    if not traces.inputs:
        raise MissingData("the log holds fewer than two ticks of every chaser")
    figure, (axes,) = _timed_figure(flight, 1)
    mass_kg = flight.scenario.chaser.mass_kg
    for i, applied in traces.inputs.items():
        given = np.abs(applied.force_N).sum(axis=1) * np.diff(applied.edges_s)
        total = np.concatenate([[0.0], np.cumsum(given)])
        axes.plot(applied.edges_s, total, color=colour(i), label=f"chaser {i}")
    axes.set(ylabel="impulse / N s", ylim=(0.0, None))
    scale = (lambda v: v / mass_kg, lambda v: v * mass_kg)
    right = axes.secondary_yaxis("right", functions=scale)
    right.set_ylabel("velocity change / m s⁻¹")
    axes.set_xlim(_span_s(*(t.edges_s for t in traces.inputs.values())))
    _name_chasers(flight, axes)
    return figure


_DUTY = LinearSegmentedColormap.from_list(
    "duty", [to_rgba(AXES_XYZ[1], 0.0), to_rgba(AXES_XYZ[1], 1.0)]
)
"""Transparent for closed valves, so that it suits light and dark pages."""


@_figure("Thruster firings", "Share of each tick during which each valve was open; blank: closed.")
def thrusters(_: RecordedFlight, traces: Traces) -> Figure:
    firing = {i: t for i, t in traces.inputs.items() if t.thruster_duty.shape[1]}
    if not firing:
        raise MissingData(
            "the actuators were ideal, or the log holds no thruster data: no thrusters to draw"
        )
    figure, axes = new_figure(len(firing), height=1.9, sharex=True)
    for a, (i, applied) in zip(axes, firing.items(), strict=True):
        number = applied.thruster_duty.shape[1]
        mesh: Any = a.pcolormesh(
            applied.edges_s,
            np.arange(number + 1) - 0.5,
            applied.thruster_duty.T,
            cmap=_DUTY,
            norm=PowerNorm(0.5, 0.0, 1.0),
            rasterized=True,
        )
        a.set(ylabel=f"chaser {i}\nthruster")
        figure.colorbar(mesh, ax=a, label="duty cycle", pad=0.01)
        a.grid(False)
    axes[-1].set_xlabel("time / s")
    return figure


_OUTCOME_COLOURS: dict[ImageOutcome, str] = {
    "used": GOOD,
    "rejected": AXES_XYZ[2],
    "not seen": GRID,
    "bad image": LIMIT,
    "not processed": INK,
}


def component_errors(flight: RecordedFlight) -> tuple[Array, Array, Array]:
    """Return times (K,) s, errors (K, 12) of the estimate (true or measured minus estimated) and
    their sigmas (K, 12), with those of a measured pose, decimated for drawing.

    Order and axes as in the covariance: position and velocity in WRF, attitude and rate in TRF.
    """
    a, target = known_estimates(flight)
    if not len(a):
        raise MissingData(
            "the target was never estimated in this log, or neither its ground truth nor a "
            "reference is in it"
        )
    part = decimated(len(a))
    a, target, e = a[part], target.rows(part), flight.estimate
    turn = rotations.log(rotations.multiply(rotations.conjugate(e.q_wxyz[a]), target.q_wxyz))
    errors = np.concatenate(
        [
            target.position_m - e.position_m[a],
            target.velocity_m_s - e.velocity_m_s[a],
            turn,
            target.omega_rad_s - e.omega_rad_s[a],
        ],
        axis=1,
    )
    variances = np.maximum(flight.variances(a), 0.0)
    variances[:, 0:3] += np.square(target.sigma_m)[:, None]
    variances[:, 6:9] += np.square(target.sigma_rad)[:, None]
    return e.time_s[a], errors, np.sqrt(variances)


@_figure(
    "Errors of the target estimate",
    "True (or measured) minus estimated by axis, with three-sigma bounds of the filter and of the "
    "measurement (position and velocity WRF, attitude and rate TRF).",
)
def estimate(flight: RecordedFlight, _: Traces) -> Figure:
    time_s, errors, sigmas = component_errors(flight)
    figure, axes = new_figure(4, 3, height=1.45, sharex=True, sharey="row")
    kinds = (
        ("position / mm", 1e3),
        ("velocity / mm s⁻¹", 1e3),
        ("attitude / °", np.degrees(1.0)),
        ("rate / ° s⁻¹", np.degrees(1.0)),
    )
    settled = time_s >= min(flight.scenario.settling_s, time_s[-1] / 2.0)
    if np.isnan(errors).any():  # a reference may measure no velocities: the bounds alone
        errors = np.nan_to_num(errors, nan=0.0)
    for row, (label, factor) in enumerate(kinds):
        part = slice(3 * row, 3 * row + 3)
        e, s = errors[:, part] * factor, 3.0 * sigmas[:, part] * factor
        for k, name in enumerate("xyz"):
            a = axes[3 * row + k]
            a.fill_between(time_s, -s[:, k], s[:, k], color=FAINT, alpha=0.18, linewidth=0)
            a.plot(time_s, e[:, k], color=INK, linewidth=0.8)
            if row == 0:
                a.set_title(name)
            if row == 3:
                a.set_xlabel("time / s")
        axes[3 * row].set_ylabel(label)
        # The initial bounds are wide and do not set the scale.
        reach = 1.6 * max(float(np.max(s[settled])), float(np.max(np.abs(e[settled]))))
        axes[3 * row].set_ylim(-reach, reach)
    axes[0].set_xlim(_span_s(time_s))
    return figure


@_figure(
    "Error and uncertainty of the pose relative to the target",
    "Distance and angle between estimated and true pose of each chaser relative to the target "
    "(solid), and the standard deviation that the estimator states for them (dashed).",
)
def relative_estimate(flight: RecordedFlight, _: Traces) -> Figure:
    errors = {i: relative_errors(flight, i) for i in flight.relative}
    errors = {i: e for i, e in errors.items() if len(e["time_s"])}
    if not errors:
        raise MissingData("the estimator states no relative poses, or their true motion is unknown")
    figure, panels = _timed_figure(flight, 2)
    for i, e in errors.items():
        history = flight.relative[i]
        variances = history.upper[:, [0, 6, 11, 15, 18, 20]]
        d, known = decimated(len(e["time_s"])), decimated(len(history.time_s))
        for axes, name, part, factor in (
            (panels[0], "position_m", variances[:, :3], 1e3),
            (panels[1], "orientation_rad", variances[:, 3:], np.degrees(1.0)),
        ):
            sigma = np.sqrt(np.maximum(part.sum(axis=1), 0.0)) * factor
            error = np.maximum(e[name][d] * factor, 1e-4)
            axes.semilogy(e["time_s"][d], error, color=colour(i), label=f"chaser {i}")
            axes.semilogy(
                history.time_s[known],
                np.maximum(sigma[known], 1e-4),
                color=colour(i),
                linestyle=(0, (4, 2)),
                linewidth=0.9,
            )
    _plain_numbers(panels[0].yaxis, panels[1].yaxis)
    panels[0].set(ylabel="position / mm")
    panels[1].set(ylabel="orientation / °", xlim=(0.0, max(flight.flown_s, 1e-3)))
    _name_chasers(flight, panels[0])
    return figure


_TAIL_SHARE = 0.05
"""Share of values beyond one side of the band above which a filter is not called consistent: twice
the expected share.
"""


def consistency_text(nees: Array, low: float, high: float) -> str:
    """Judge NEES values (K,) by the band from ``low`` to ``high``; of a consistent filter 2.5 % lie
    beyond each side.
    """
    above, below = float(np.mean(nees > high)), float(np.mean(nees < low))
    verdict = "consistent"
    if above > _TAIL_SHARE:
        verdict = "overconfident"
    elif below > _TAIL_SHARE:
        verdict = "conservative"
    return (
        f"{verdict}: mean {np.mean(nees):.2f} (6 expected); {100 * above:.1f} % above the band, "
        f"{100 * below:.1f} % below (2.5 % each expected)"
    )


@_figure(
    "Consistency of the target estimate",
    "Normalized estimation error squared (NEES) of the pose, six degrees of freedom. A consistent "
    "filter "
    "has 95 % of its values within the band; values above it indicate an overconfident filter, "
    "values "
    "below it a conservative one.",
)
def consistency(flight: RecordedFlight, _: Traces) -> Figure:
    component_errors(flight)  # raises MissingData without estimates
    errors = estimate_errors(flight)
    low, high = map(float, chi_square_band(6))
    figure, (axes,) = new_figure(1)
    d = decimated(len(errors["nees"]))
    axes.semilogy(
        errors["time_s"][d], np.maximum(errors["nees"][d], 1e-3), color=INK, linewidth=0.8
    )
    axes.axhspan(low, high, color=GOOD, alpha=0.15, linewidth=0)
    axes.axhline(6.0, color=GOOD, linewidth=0.8)
    _plain_numbers(axes.yaxis)
    axes.set_title(consistency_text(errors["nees"], low, high))
    axes.set(ylabel="NEES", xlabel="time / s", xlim=_span_s(errors["time_s"]))
    return figure


@_figure(
    "Innovations of the sightings",
    "Squared difference of each sighting from what the estimator expected, normalized by its "
    "covariance (NIS), per degree of freedom. Crosses: rejected sightings. Shaded: where 95 % lie "
    "if errors are white and as stated. Errors that persist, as of markers, are stated larger than "
    "they scatter and lie lower.",
)
def innovations(flight: RecordedFlight, _: Traces) -> Figure:
    if not flight.innovations:
        raise MissingData("the estimator states no innovations")
    figure, (axes,) = new_figure(1)
    for i, history in flight.innovations.items():
        per_freedom = np.maximum(history.squared / history.freedoms, 1e-3)
        for used, marker in ((True, "."), (False, "x")):
            rows = np.flatnonzero(history.used == used)
            rows = rows[decimated(len(rows))]
            axes.semilogy(
                history.time_s[rows],
                per_freedom[rows],
                color=colour(i),
                linestyle="none",
                marker=marker,
                markersize=3.0 if used else 5.0,
                label=f"chaser {i}" if used else None,
            )
    freedoms = np.concatenate([h.freedoms for h in flight.innovations.values()]).max()
    low, high = (float(bound) / freedoms for bound in chi_square_band(freedoms))
    axes.axhspan(low, high, color=GOOD, alpha=0.15, linewidth=0)
    axes.axhline(1.0, color=GOOD, linewidth=0.8)
    _plain_numbers(axes.yaxis)
    axes.set(ylabel="NIS per degree of freedom", xlabel="time / s")
    axes.set_xlim(_span_s(*(history.time_s for history in flight.innovations.values())))
    legend_above(axes)
    return figure


def _bars(axes: Axes, outcomes: ImageOutcomes, row: float, period_s: float) -> None:
    """Draw one row of the raster: a bar per run of images with the same outcome; gaps stay
    empty.
    """
    spans: dict[ImageOutcome, list[tuple[float, float]]] = {}
    for first_s, last_s, outcome in outcomes.intervals(1.5 * period_s):
        spans.setdefault(outcome, []).append((first_s, last_s - first_s + period_s))
    for outcome, bars in spans.items():
        axes.broken_barh(bars, (row - 0.36, 0.72), facecolor=_OUTCOME_COLOURS[outcome], linewidth=0)


@_figure(
    "Camera images", "Top: outcome of each image. Bottom: number of markers used for the pose."
)
def cameras(flight: RecordedFlight, traces: Traces) -> Figure:
    if not traces.image_outcomes:
        raise MissingData("the log holds no image")
    period_s = 1.0 / flight.scenario.time.image_hz
    figure, (top, bottom) = new_figure(2, sharex=True, height=2.0)
    for row, (i, outcomes) in enumerate(traces.image_outcomes.items()):
        _bars(top, outcomes, row, period_s)
        sightings = flight.sightings.get(i)
        if sightings is not None:
            d = decimated(len(sightings.time_s))
            bottom.step(
                sightings.time_s[d],
                sightings.markers[d],
                where="post",
                color=colour(i),
                label=f"chaser {i}",
                linewidth=0.9,
            )
    present = {OUTCOMES[code] for o in traces.image_outcomes.values() for code in np.unique(o.code)}
    for outcome, shade in _OUTCOME_COLOURS.items():
        if outcome in present:
            top.bar(0, 0, color=shade, label=outcome)
    top.set_yticks(
        range(len(traces.image_outcomes)), [f"chaser {i}" for i in traces.image_outcomes]
    )
    top.invert_yaxis()
    top.grid(False)
    legend_above(top)
    most = max((int(s.markers.max()) for s in flight.sightings.values()), default=0)
    bottom.set(ylabel="markers used", xlabel="time / s", ylim=(-0.2, 1.1 * max(most, 1)))
    bottom.yaxis.set_major_locator(MaxNLocator(integer=True))
    if bottom.get_legend_handles_labels()[0]:
        legend_above(bottom)
    last_s = max(float(o.time_s[-1]) for o in traces.image_outcomes.values())
    bottom.set_xlim(0, last_s + period_s)
    return figure


def _distribution(axes: Axes, values: Array, shade: str) -> None:
    """Draw the empirical distribution function over milliseconds."""
    ordered = np.sort(values) * 1e3
    share = np.arange(1, len(ordered) + 1) / len(ordered) * 100.0
    d = decimated(len(ordered))
    axes.plot(ordered[d], share[d], color=shade)


class _FewTicks(LogLocator):
    """Ticks of a logarithmic axis: at 1, 2 and 5 of each decade. An axis of more than two decades
    has them at 1 only, so that labels do not touch.
    """

    def tick_values(self, vmin: float, vmax: float) -> Any:
        wide = vmin > 0.0 and vmax / vmin > 100.0
        self.set_params(subs=(1.0,) if wide else (1.0, 2.0, 5.0))
        return super().tick_values(vmin, vmax)


def _plain_numbers(*axes: Axis) -> None:
    """Label logarithmic axes by few numbers without exponents."""
    for axis in axes:
        axis.set_major_locator(_FewTicks(numticks=12))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _time_and_distribution(quantity: str) -> tuple[Figure, Axes, Axes]:
    figure, (left, right) = new_figure(1, 2, height=2.6, width_ratios=[2.2, 1.0])
    left.set(ylabel=quantity, xlabel="time / s", yscale="log")
    right.set(xlabel=quantity, ylabel="cumulative share / %", ylim=(0, 101), xscale="log")
    _plain_numbers(left.yaxis, right.xaxis)
    return figure, left, right


_NO_WALL_TIME = "the flight was simulated in virtual time, which no computation takes"


@_figure(
    "Solve times",
    "Wall-clock time of the controller's solve on the machine of this flight; dashed: tick period.",
)
def solver(flight: RecordedFlight, _: Traces) -> Figure:
    solves = flight.solves
    if not len(solves.time_s):
        raise MissingData("the log holds no solve of the controller")
    values = solves.wall_s
    if not values.any():
        raise MissingData(_NO_WALL_TIME)
    figure, left, right = _time_and_distribution("solve time / ms")
    d, bad = decimated(len(values)), solves.imperfect
    left.plot(solves.time_s[d], np.maximum(values[d], 1e-6) * 1e3, ".", markersize=2.2, color=INK)
    if np.any(bad):
        statuses = ", ".join(sorted(set(solves.statuses) - {"solved"}))
        d = decimated(int(np.sum(bad)))
        left.plot(
            solves.time_s[bad][d],
            values[bad][d] * 1e3,
            "x",
            markersize=4,
            color=LIMIT,
            label=statuses,
        )
        legend_above(left)
    limit_line(left, 1e3 / flight.scenario.time.rate_hz, "tick period")
    _distribution(right, np.maximum(values, 1e-6), INK)
    p50, p95 = np.percentile(values, (50, 95)) * 1e3
    right.set_title(f"median {p50:.1f} ms, 95th percentile {p95:.1f} ms")
    return figure


@_figure(
    "Latency",
    "Wall-clock time from the publication of an image to the actuator command of its tick. In "
    "lock-step "
    "it reflects the load of the machine and does not affect the flight.",
)
def latency(_: RecordedFlight, traces: Traces) -> Figure:
    if not traces.latency:
        raise MissingData("no image in the log led to an actuator command")
    if not any(rows[:, 1].any() for rows in traces.latency.values()):
        raise MissingData(_NO_WALL_TIME)
    figure, left, right = _time_and_distribution("latency / ms")
    for i, rows in traces.latency.items():
        values = np.maximum(rows[:, 1], 1e-6)
        d = decimated(len(values))
        left.plot(
            rows[d, 0], values[d] * 1e3, ".", markersize=2.2, color=colour(i), label=f"chaser {i}"
        )
        _distribution(right, values, colour(i))
    legend_above(left)
    return figure


def draw_figures(
    flight: RecordedFlight, traces: Traces
) -> Iterator[tuple[FigureKind, Figure | str]]:
    """Yield every figure, or the reason why it is missing."""
    with styled():
        for kind in FIGURES:
            try:
                yield kind, kind.draw(flight, traces)
            except MissingData as reason:
                yield kind, str(reason)


def write_figures(log: Path, out: Path, ending: str) -> tuple[list[Path], dict[str, str]]:
    """Write all figures of a log (or run folder) to ``out``; return the files, and the reason of
    each missing figure.

    Raise LogError for an unreadable log and ChaserdockError for a folder that is not writable.
    """
    flight = load_flight(log)
    traces = load_traces(log, flight.scenario, decimation(flight.ticks))
    files, missing = [], {}
    with errors_of_writing(out):
        out.mkdir(parents=True, exist_ok=True)
        for kind, figure in draw_figures(flight, traces):
            if isinstance(figure, str):
                missing[kind.name] = figure
                continue
            files.append(out / f"{kind.name}.{ending}")
            save(figure, files[-1])
    return files, missing
