"""Figures of a recorded flight, one function each: the paper's figures and what explains them.

A figure is drawn from what the log holds; where that is not enough the function raises ``Nothing`` with the reason.
Errors are measured on ground truth, as in ``summary``. Chasers keep their colour through all figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.errors import ChaserdockError
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .camera_figures import cameras, consistency, estimate, latency, solver
from .flight import Flight, Track, load_flight
from .plots import (
    AXES_XYZ,
    FAINT,
    LIMIT,
    Nothing,
    colour,
    dashes,
    few,
    legend_above,
    limit_line,
    new_figure,
    save,
    step_of,
    styled,
)
from .summary import tracking_errors
from .time_series import Traces, load_traces


def flown(flight: Flight) -> list[int]:
    """Chasers whose motion is in the log; raises Nothing when there are none, or no target."""
    if "target" not in flight.truth:
        raise Nothing("the log holds no ground truth of the target")
    numbers = [i for i in range(len(flight.scenario.chasers)) if f"chaser/{i}" in flight.truth]
    if not numbers:
        raise Nothing("the log holds no ground truth of any chaser")
    return numbers


def _path(own: Track, target: Track) -> tuple[Array, Array]:
    """A chaser's positions as many as are drawn, the last among them: WRF, and in the target's axes from its centre."""
    n = min(len(own.time_s), len(target.time_s))
    rows = np.unique(np.append(np.arange(n)[few(n)], n - 1))
    position = own.position_m[rows]
    return position, rotations.rotate_inverse(target.q_wxyz[rows], position - target.position_m[rows])


def trajectories(flight: Flight, _: Traces) -> Figure:
    numbers = flown(flight)
    target = flight.truth["target"]
    paths = {i: _path(flight.truth[f"chaser/{i}"], target) for i in numbers}
    figure = Figure(figsize=(9.6, 4.6))
    for place, title in enumerate(("In the world (WRF)", "Relative to the target, in its axes (TRF)")):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="3d")
        if place:
            axes.scatter(0.0, 0.0, 0.0, color=FAINT, marker="s", s=28, label="target")
        else:
            axes.plot(
                *target.position_m[few(len(target.time_s))].T, color=FAINT, linewidth=1.6, label="target"
            )
        for i in numbers:
            p = paths[i][place]
            axes.plot(*p.T, color=colour(i), label=f"chaser {i}")
            axes.scatter(*p[0], color=colour(i), marker="o", s=14)
            axes.scatter(*p[-1], color=colour(i), marker="^", s=22)
        axes.set_title(title)
        axes.set(xlabel="x / m", ylabel="y / m", zlabel="z / m")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_box_aspect(None, zoom=0.86)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.pane.set_visible(False)
            axis.set_major_locator(MaxNLocator(5))
        axes.tick_params(labelsize=7.5)
        if not place:
            axes.legend(loc="upper left", bbox_to_anchor=(-0.12, 1.0))
    return figure


def _mark_phases(axes: Axes, flight: Flight, words: bool) -> None:
    """Thin lines where a chaser changes phase, after the first; its name on top, once."""
    told: dict[tuple[float, str], None] = {}
    for what in flight.told.values():
        told |= dict.fromkeys(what.phases[1:])
    for time_s, name in told:
        axes.axvline(time_s, color=FAINT, linewidth=0.7, linestyle=":")
        if words:
            axes.annotate(
                name,
                (time_s, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(2, -9),
                textcoords="offset points",
                fontsize=7.5,
                color=FAINT,
            )


def tracking(flight: Flight, _: Traces) -> Figure:
    numbers = flown(flight)
    figure, (top, bottom) = new_figure(2, sharex=True)
    s = flight.scenario
    for i in numbers:
        time_s, position, angle = tracking_errors(flight, i)
        d = few(len(time_s))
        top.semilogy(time_s[d], np.maximum(position[d], 1e-7), color=colour(i), label=f"chaser {i}")
        bottom.semilogy(time_s[d], np.maximum(np.degrees(angle[d]), 1e-5), color=colour(i))
    for axes, limit, unit in (
        (top, s.success.steady_position_rms_m, "m"),
        (bottom, s.success.steady_orientation_rms_deg, "°"),
    ):
        axes.axvspan(s.settling_s, s.steady_until_s or s.duration_s, color=FAINT, alpha=0.08, linewidth=0)
        _mark_phases(axes, flight, axes is top)
        if limit is not None:
            limit_line(axes, limit, f"RMS allowed in the shaded time: {limit:g} {unit}")
    top.set(ylabel="position error / m", xlim=(0, max(float(flight.truth["target"].time_s[-1]), 1e-3)))
    bottom.set(ylabel="orientation error / °", xlabel="time / s")
    legend_above(top)
    return figure


def docking(flight: Flight, _: Traces) -> Figure:
    numbers = flown(flight)
    figure, (top, bottom) = new_figure(2, sharex=True)
    s, target = flight.scenario, flight.truth["target"]
    nearest = np.inf
    for i in numbers:
        own = flight.truth[f"chaser/{i}"]
        n = min(len(own.time_s), len(target.time_s))
        distance = np.linalg.norm(own.position_m[:n] - target.position_m[:n], axis=1)
        nearest = min(nearest, float(distance.min()))
        d, time_s = few(n), own.time_s[:n]
        top.plot(time_s[d], distance[d], color=colour(i), linestyle=dashes(i), label=f"chaser {i}")
        if n > 2:
            speed = -np.gradient(distance, time_s)
            bottom.plot(time_s[d], speed[d] * 1e3, color=colour(i), linestyle=dashes(i))
    limit_line(top, s.approach.dock_distance_m, f"docking distance {s.approach.dock_distance_m:g} m")
    # The two may be close: this one is named below its line.
    top.axhspan(0.0, s.limits.min_distance_target_m, color=LIMIT, alpha=0.10, linewidth=0)
    top.annotate(
        f"not allowed: below {s.limits.min_distance_target_m:g} m",
        (1.0, s.limits.min_distance_target_m),
        xycoords=("axes fraction", "data"),
        xytext=(-2, -10),
        textcoords="offset points",
        ha="right",
        fontsize=8,
        color=LIMIT,
    )
    top.set(
        ylabel="distance to the target / m", ylim=(min(nearest, s.limits.min_distance_target_m) * 0.5, None)
    )
    limit_line(bottom, s.approach.max_speed_m_s * 1e3, "greatest speed of an approach")
    bottom.set(
        ylabel="closing speed / mm s⁻¹", xlabel="time / s", xlim=(0, max(float(target.time_s[-1]), 1e-3))
    )
    settled = s.approach.max_speed_m_s * 1e3
    bottom.set_ylim(-settled, 2.0 * settled)
    for axes in (top, bottom):
        _mark_phases(axes, flight, axes is top)
    legend_above(top)
    return figure


def separation(flight: Flight, _: Traces) -> Figure:
    numbers = flown(flight)
    if len(numbers) < 2:
        raise Nothing("there is one chaser only")
    figure, (axes,) = new_figure(1, height=2.8)
    for k, (i, j) in enumerate(combinations(numbers, 2)):
        a, b = flight.truth[f"chaser/{i}"], flight.truth[f"chaser/{j}"]
        n = min(len(a.time_s), len(b.time_s))
        distance = np.linalg.norm(a.position_m[:n] - b.position_m[:n], axis=1)
        d = few(n)
        axes.plot(a.time_s[:n][d], distance[d], color=colour(k), linestyle=dashes(k), label=f"{i} and {j}")
    least = flight.scenario.limits.min_distance_chasers_m
    limit_line(axes, least, f"least allowed {least:g} m")
    axes.set(ylabel="distance / m", xlabel="time / s", ylim=(0, None))
    axes.set_xlim(0, max(float(flight.truth["target"].time_s[-1]), 1e-3))
    legend_above(axes)
    return figure


def inputs(flight: Flight, traces: Traces) -> Figure:
    if not traces.inputs:
        raise Nothing("the log holds no two ticks of any chaser")
    body = flight.scenario.chaser
    figure, axes = new_figure(len(traces.inputs), 2, height=1.55, sharex=True, sharey="col")
    for row, (i, given) in enumerate(traces.inputs.items()):
        for column, (values, limit) in enumerate(
            ((given.force_N, body.force_max_N), (given.torque_N_m * 1e3, body.torque_max_N_m * 1e3))
        ):
            a = axes[2 * row + column]
            for k, name in enumerate("xyz"):
                a.stairs(
                    values[:, k], given.edges_s, color=AXES_XYZ[k], label=name, linewidth=0.9, baseline=None
                )
            for sign in (1.0, -1.0):
                a.axhline(sign * limit, color=LIMIT, linestyle=(0, (5, 3)), linewidth=0.9)
            a.set_ylim(-1.15 * limit, 1.15 * limit)
            a.set_ylabel("torque / mN m" if column else f"chaser {i}\nforce / N")
    axes[0].set_xlim(0, max(float(t.edges_s[-1]) for t in traces.inputs.values()))
    for a in axes[-2:]:
        a.set_xlabel("time / s")
    legend_above(axes[1])
    return figure


def thrusters(_: Flight, traces: Traces) -> Figure:
    firing = {i: t for i, t in traces.inputs.items() if t.thruster_duty.shape[1]}
    if not firing:
        raise Nothing("the actuators were ideal: there are no thrusters, or the log does not tell of them")
    figure, axes = new_figure(len(firing), height=1.9, sharex=True)
    for a, (i, given) in zip(axes, firing.items(), strict=True):
        number = given.thruster_duty.shape[1]
        mesh: Any = a.pcolormesh(
            given.edges_s,
            np.arange(number + 1) - 0.5,
            given.thruster_duty.T,
            cmap="cividis_r",
            vmin=0.0,
            vmax=1.0,
            rasterized=True,
        )
        a.set(ylabel=f"chaser {i}\nthruster")
        figure.colorbar(mesh, ax=a, label="share open", pad=0.01)
        a.grid(False)
    axes[-1].set_xlabel("time / s")
    return figure


@dataclass(frozen=True)
class Kind:
    """One figure: its file name, title, what it shows in a sentence, and how it is drawn."""

    name: str
    title: str
    caption: str
    draw: Callable[[Flight, Traces], Figure]


KINDS: tuple[Kind, ...] = (
    Kind(
        "trajectories",
        "Trajectories",
        "Paths of the centres of mass; a dot where each chaser started, a triangle where it ended.",
        trajectories,
    ),
    Kind(
        "tracking",
        "Tracking errors",
        "Distance and angle of each chaser from its reference pose on the true target. Shaded: the time that counts as "
        "steady.",
        tracking,
    ),
    Kind(
        "docking",
        "Docking",
        "Distance of each chaser's centre from the target's, and how fast it shrinks.",
        docking,
    ),
    Kind(
        "separation",
        "Between the chasers",
        "Distance between the centres of each pair of chasers.",
        separation,
    ),
    Kind(
        "inputs",
        "Inputs",
        "Force and torque that the actuators gave, body axes, mean over each tick; dashed: the actuators' limits.",
        inputs,
    ),
    Kind(
        "thrusters", "Thruster firings", "Share of each tick that each thruster's valve was open.", thrusters
    ),
    Kind(
        "estimate",
        "Errors of the target estimate",
        "Truth less estimate by axis, and the filter's own three-sigma bounds (position and velocity WRF, attitude and "
        "rate TRF).",
        estimate,
    ),
    Kind(
        "consistency",
        "Consistency of the target estimate",
        "Normalized estimation error squared over the six pose errors; 95 % of the values of a consistent filter lie in "
        "the band. Above it a filter trusts itself too much, below it too little.",
        consistency,
    ),
    Kind(
        "cameras",
        "What each camera saw",
        "Top: what became of each image. Below: markers that a used pose was computed from.",
        cameras,
    ),
    Kind(
        "solver",
        "Solve times",
        "Wall-clock time of the controller's solve, on the machine that flew this; dashed: the tick's period.",
        solver,
    ),
    Kind(
        "latency",
        "Latency",
        "Wall clock from an image's publication to the actuator command that answers its tick. In lock-step it shows "
        "the machine's load and changes nothing in the flight.",
        latency,
    ),
)


def drawn(flight: Flight, traces: Traces) -> Iterator[tuple[Kind, Figure | str]]:
    """Every figure, or why there is none, one at a time."""
    with styled():
        for kind in KINDS:
            try:
                yield kind, kind.draw(flight, traces)
            except Nothing as reason:
                yield kind, str(reason)


def write_figures(log: Path, out: Path, ending: str) -> tuple[list[Path], dict[str, str]]:
    """Writes all figures of a log (or run folder) to the folder ``out``; the files, and why a figure is missing by name.

    Raises LogError for an unreadable log and ChaserdockError for a folder that cannot be written.
    """
    flight = load_flight(log)
    traces = load_traces(log, range(len(flight.scenario.chasers)), step_of(flight.world.ticks))
    files, missing = [], {}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for kind, figure in drawn(flight, traces):
            if isinstance(figure, str):
                missing[kind.name] = figure
                continue
            files.append(out / f"{kind.name}.{ending}")
            save(figure, files[-1])
    except OSError as error:
        raise ChaserdockError(f"{out}: cannot be written: {error.strerror or error}") from None
    return files, missing
