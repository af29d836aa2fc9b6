# SPDX-License-Identifier: Apache-2.0
"""The default estimator against the paper's under sensor errors, in closed loop.

Figures of ``grades`` and ``sources`` are RMS over all chasers in the steady state (from 32 s on in
``grades``, 15 s after the end of a calibration; from 20 s on in ``sources``), mean over the seeds:
the error of each chaser's pose relative to the target, ``estimate``, and of its distance from the
reference on the true target, ``tracking``; ``nees`` of the relative pose (6 expected);
``worst_nees`` of a flight; share of gated sightings. The paper's estimator takes odometry as exact;
its relative pose is that of odometry and target estimate.
"""

from __future__ import annotations

import itertools
import math
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry, Sighting
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.navigation import GRADES
from chaserdock_world.rendering.cameras import States
from common import ROOT, Figures, Group, KeptResults, Options, map_jobs, seeds_of
from flights.measured_poses import measurement_model
from flights.rendezvous import estimate_error

from chaserdock.analysis.pose_errors import normalized_square, pose_error, relative_pose
from chaserdock.experiments.in_process import InProcessMission, TickRecord
from chaserdock.experiments.perception import RenderedImages

SIGHTING_SIGMA_M, SIGHTING_SIGMA_RAD = 2e-4, math.radians(0.25)
"""Statistical sightings: about those of one large marker at 1 m."""
SOURCES = {
    "position": ("position_noise_m",),
    "velocity": ("velocity_noise_m_s",),
    "attitude": ("attitude_noise_deg", "attitude_roll_noise_deg"),
    "rate": ("omega_noise_deg_s",),
    "camera": ("camera_turn_deg", "camera_shift_m", "camera_focal_share"),
}
FACTORS = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Multiples of the grade ``lab``."""
QUICK_ROWS = ("lab_1",)
"""Rows of ``grades`` with ``--quick``: one chaser under the default grade."""
ESTIMATORS = ("joint", "paper")
CALIBRATED_S = 65.0
"""Steady after a calibration from 20 s on, which takes 30 s."""


@dataclass(frozen=True)
class ErrorFlight:
    """A flight to evaluate from ``settled_s`` on."""

    label: str
    scenario: Scenario
    settled_s: float
    images: bool


def scenario_of(
    name: str, estimator: str, seed: int, duration_s: float, *overrides: str
) -> Scenario:
    """Return a shipped scenario with another estimator, seed and length, without its commands and
    criteria.
    """
    fixed = (
        f"seed={seed}",
        f"duration_s={duration_s}",
        f'estimator.name="{estimator}"',
        "timeline=[]",
        "success={}",
    )
    return load_scenario(ROOT / "scenarios" / f"{name}.toml", (*fixed, *overrides))


def relative_error(tick: TickRecord, chaser: int) -> tuple[Array, float]:
    """Return the error (6,) of a chaser's estimated pose relative to the target (TRF, m; CRF, rad)
    and its NEES, NaN without a covariance."""
    assert tick.outputs is not None
    estimate = tick.outputs.target
    found = next((r for r in estimate.relative if r.chaser == chaser), None)
    if found is not None:
        error = estimate_error(found, tick.states)
        return error, float(normalized_square(error, np.reshape(found.covariance, (6, 6))))
    true = tick.states["target"]
    own = tick.states[f"chaser/{chaser}"]
    odometry = tick.odometry[chaser]
    truth = relative_pose(own.position_m, own.q_wxyz, true.position_m, true.q_wxyz)
    own_pose = np.array(odometry.position_m), np.array(odometry.q_wxyz)
    target_pose = np.array(estimate.position_m), np.array(estimate.q_wxyz)
    return pose_error(*truth, *relative_pose(*own_pose, *target_pose)), math.nan


def fly(flight: ErrorFlight) -> Array:
    """Fly a mission; return its figures (7,): estimate m, rad, tracking m, rad, NEES, gated share,
    re-initializations.
    """
    scenario = flight.scenario
    perception = (
        RenderedImages(scenario)
        if flight.images
        else measurement_model(scenario, scenario.seed, SIGHTING_SIGMA_M, SIGHTING_SIGMA_RAD)
    )
    rows, nees, accepted, gated = [], [], 0, 0
    with InProcessMission(scenario, perception) as mission:
        for tick in mission.ticks():
            assert tick.outputs is not None
            accepted += len(tick.outputs.target.accepted)
            gated += len(tick.outputs.target.rejected)
            if tick.time_s < flight.settled_s:
                continue
            for i in mission.chasers:
                error, value = relative_error(tick, i)
                nees.append(value)
                rows.append(
                    [
                        np.sum(error[:3] ** 2),
                        np.sum(error[3:] ** 2),
                        *np.square(tick.tracking_errors[i]),
                    ]
                )
        calibrated = {
            text.split(":")[0] for _, _, text in mission.events if "camera calibrated" in text
        }
        if scenario.timeline and len(calibrated) < len(scenario.chasers):
            raise SystemExit(
                f"{flight.label}: only {sorted(calibrated)} completed the calibration manoeuvre"
            )
        restarts = mission.controller.estimator.reinitialisations
    share = gated / max(1, accepted + gated)
    return np.array([*np.sqrt(np.mean(rows, axis=0)), np.mean(nees), share, restarts])


def fly_all(flights: Sequence[ErrorFlight], jobs: int) -> Figures:
    """Return the mean figures of each label; print a line of each as it comes."""
    figures: Figures = {}
    results = zip(flights, map_jobs(fly, flights, jobs), strict=True)
    for label, group in itertools.groupby(results, key=lambda pair: pair[0].label):
        part = mean_figures(label, [row for _, row in group])
        shown = ", ".join(f"{key.removeprefix(label)[1:]} {v:.3g}" for key, v in part.items())
        print(f"  {label}: {shown}", file=sys.stderr, flush=True)
        figures |= part
    return figures


def mean_figures(label: str, flights: Sequence[Array]) -> Figures:
    """Return the mean over flights, by name, and the largest NEES."""
    units = (
        "estimate_m",
        "estimate_rad",
        "tracking_m",
        "tracking_rad",
        "nees",
        "gated_share",
        "restarts",
    )
    values = {unit: float(v) for unit, v in zip(units, np.mean(flights, axis=0), strict=True)}
    values["worst_nees"] = max(float(row[4]) for row in flights)
    return {f"{label}_{unit}": v for unit, v in values.items() if not math.isnan(v)}


def grades(options: Options) -> Figures:
    """Fly one and four chasers under every grade of ``[navigation]``, also after a calibration, and
    two in harsh light, with rendered images and plant mismatch.
    """
    settled_s, duration_s = 32.0, 44.0
    seeds = seeds_of(options, 20, 1)
    truth = [] if options.nominal else ['truth.preset="mismatch"']
    flights = []
    for estimator in options.estimators:
        for name, number in (("single", 1), ("four-chaser-docking", 4)):
            for grade in GRADES:
                for seed in seeds:
                    overrides = (f'navigation.grade="{grade}"', *truth)
                    scenario = scenario_of(name, estimator, seed, duration_s, *overrides)
                    flights.append(
                        ErrorFlight(f"{grade}_{number}_{estimator}", scenario, settled_s, True)
                    )
            if estimator != "joint":
                continue
            calibrate = (
                f'timeline=[{{at_s=20.0,command="calibrate",chasers={list(range(number))}}}]'
            )
            for seed in seeds:
                overrides = ('navigation.grade="orbit"', *truth, calibrate)
                scenario = scenario_of(name, estimator, seed, CALIBRATED_S + 12.0, *overrides)
                flights.append(
                    ErrorFlight(
                        f"orbit_calibrated_{number}_{estimator}", scenario, CALIBRATED_S, True
                    )
                )
        for seed in seeds:
            overrides = ('navigation.grade="lab"', *truth)
            scenario = scenario_of("harsh-light", estimator, seed, duration_s, *overrides)
            flights.append(ErrorFlight(f"harsh_light_lab_2_{estimator}", scenario, settled_s, True))
    rows = tuple(options.rows or (QUICK_ROWS if options.quick else ("",)))
    return fly_all([f for f in flights if f.label.startswith(rows)], options.jobs)


def sources(options: Options) -> Figures:
    """Fly four chasers with statistical sightings and one error source at a time, from 0 to 10
    times its figure in the grade ``lab``.
    """
    seeds, duration_s = seeds_of(options, 20, 1), 25.0 if options.quick else 40.0
    factors = (1.0, 10.0) if options.quick else FACTORS
    flights = []
    for source, keys in SOURCES.items():
        for factor in factors:
            values = [f"navigation.{key}={factor * GRADES['lab'][key]}" for key in keys]
            for estimator in options.estimators:
                overrides = ('navigation.grade="exact"', *values)
                for seed in seeds:
                    scenario = scenario_of(
                        "four-chaser-docking", estimator, seed, duration_s, *overrides
                    )
                    flights.append(
                        ErrorFlight(f"{source}_{factor:g}_{estimator}", scenario, 20.0, False)
                    )
    figures = fly_all(flights, options.jobs)
    if options.figure is not None:
        draw_sources(figures, factors, options.estimators, options.figure)
    return figures


def draw_sources(
    figures: Figures, factors: Sequence[float], estimators: Sequence[str], path: Path
) -> None:
    """Draw the position error of the estimate over the factor of each source, one panel a source,
    to an image file.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 2.6), layout="constrained")
    panels = figure.subplots(1, len(SOURCES), sharey=True)
    for panel, source in zip(panels, SOURCES, strict=True):
        for estimator, style in zip(estimators, ("o-", "s--"), strict=False):
            errors_mm = [
                figures[f"{source}_{factor:g}_{estimator}_estimate_m"] * 1e3 for factor in factors
            ]
            panel.semilogy(factors, errors_mm, style, markersize=4, label=estimator)
        panel.set_title(source, fontsize=10)
        panel.set_xlabel("times lab", fontsize=9)
        panel.grid(visible=True, which="both", alpha=0.3)
    panels[0].set_ylabel("estimate, RMS, mm", fontsize=9)
    panels[0].legend(fontsize=8)
    figure.savefig(path)


def jumped(odometry: Odometry) -> Odometry:
    """Return odometry 50 mm and 5 degrees off."""
    q = rotations.multiply(odometry.q_wxyz, rotations.exp([math.radians(5.0), 0.0, 0.0]))
    x, y, z = odometry.position_m
    return msgspec.structs.replace(odometry, position_m=(x, y + 0.05, z), q_wxyz=vector(q))


def with_wrong_velocity(odometry: Odometry) -> Odometry:
    """Return odometry that states 20 mm/s that the chaser does not move."""
    x, y, z = odometry.velocity_m_s
    return msgspec.structs.replace(odometry, velocity_m_s=(x, y + 0.02, z))


def overconfident(odometry: Odometry) -> Odometry:
    """Return odometry that states a hundredth of its covariance of position."""
    covariance = tuple(1e-2 * value for value in odometry.position_covariance_m2)
    return msgspec.structs.replace(odometry, position_covariance_m2=covariance)


ODOMETRY_FAILURES: dict[str, Callable[[Odometry], Odometry]] = {
    "jump": jumped,
    "wrong_velocity": with_wrong_velocity,
    "overconfident": overconfident,
}
FAILED_AT_S, BLIND_S, FAILED_CHASER = 35.0, 20.0, 1
"""The estimate is steady from 20 s on; a blind time of 20 s lets it drift visibly."""


class FailureMission(InProcessMission):
    """A mission with a failure from ``FAILED_AT_S`` on: of all cameras for ``BLIND_S``, or of the
    odometry of one chaser.
    """

    def __init__(self, scenario: Scenario, failure: str) -> None:
        see = RenderedImages(scenario)

        def blind(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
            sighting = see(chaser, tick, time_ns, states)
            if FAILED_AT_S <= time_ns / 1e9 < FAILED_AT_S + BLIND_S:
                return msgspec.structs.replace(
                    sighting, status="nothing", solutions=(), marker_ids=(), corners_px=()
                )
            return sighting

        super().__init__(scenario, blind if failure == "blind" else see)
        self._change = ODOMETRY_FAILURES.get(failure)

    def measure(self, chaser: int, time_ns: int, states: States) -> Odometry:
        odometry = super().measure(chaser, time_ns, states)
        failed = (
            self._change is not None and chaser == FAILED_CHASER and time_ns / 1e9 >= FAILED_AT_S
        )
        return self._change(odometry) if self._change is not None and failed else odometry


def fly_failure(failure: str, seed: int) -> list[float]:
    """Return RMS tracking error (m) of the failed chaser before and after the failure, the largest
    tracking error of all chasers after it (m), and the time until a warning names the failed
    odometry (s)."""
    overrides = (
        'navigation.grade="lab"',
        'truth.preset="mismatch"',
        'perception.name="statistical"',
    )
    scenario = scenario_of(
        "four-chaser-docking", "joint", seed, FAILED_AT_S + BLIND_S + 10.0, *overrides
    )
    before, after, largest = [], [], 0.0
    with FailureMission(scenario, failure) as mission:
        for tick in mission.ticks():
            if tick.time_s < 20.0:
                continue
            own_m, _ = tick.tracking_errors[FAILED_CHASER]
            (before if tick.time_s < FAILED_AT_S else after).append(own_m**2)
            if tick.time_s >= FAILED_AT_S:
                largest = max(
                    largest, *(distance_m for distance_m, _ in tick.tracking_errors.values())
                )
        reports = [
            time_s - FAILED_AT_S
            for time_s, level, text in mission.events
            if level == "warning"
            and time_s >= FAILED_AT_S
            and text.startswith(f"chaser {FAILED_CHASER}: odometry")
        ]
    reported_s = min(reports, default=math.nan)
    return [math.sqrt(np.mean(before)), math.sqrt(np.mean(after)), largest, reported_s]


def failures(options: Options) -> Figures:
    """Fly four chasers under ``lab`` with plant mismatch and statistical perception: no sight for
    20 s, and odometry of one chaser that jumps by 50 mm and 5 degrees, states 20 mm/s too much, or
    a tenth of its sigma of position.
    """
    figures: Figures = {}
    for kind in ("blind", *ODOMETRY_FAILURES):
        results = KeptResults(options.results, {"failure": kind}, list[float])
        flown = results.of(seeds_of(options, 20, 1), partial(fly_failure, kind), jobs=options.jobs)
        rows = np.array(flown)
        figures |= {
            f"{kind}_tracking_before_m": float(np.mean(rows[:, 0])),
            f"{kind}_tracking_after_m": float(np.mean(rows[:, 1])),
            f"{kind}_largest_tracking_m": float(np.max(rows[:, 2])),
        }
        if kind != "blind":
            figures[f"{kind}_reported_max_s"] = float(np.max(rows[:, 3]))
    return figures


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--nominal", action="store_true", help="of grades: no plant mismatch")
    parser.add_argument(
        "--estimators", nargs="+", choices=ESTIMATORS, default=ESTIMATORS, help="default: both"
    )
    parser.add_argument(
        "--rows",
        nargs="+",
        metavar="TEXT",
        help="of grades: rows whose name begins so, such as orbit_calibrated_4 (default: all; "
        "with --quick: lab_1)",
    )
    parser.add_argument(
        "--figure", type=Path, metavar="FILE", help="of sources: draw the curves (SVG, PNG)"
    )


GROUP = Group(
    {"grades": grades, "sources": sources, "failures": failures},
    ("flights", "first", "jobs", "results"),
    add_options,
)
