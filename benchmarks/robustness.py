# SPDX-License-Identifier: Apache-2.0
"""Default estimator against the paper's under sensor errors: ``python benchmarks/robustness.py [--only PART ...] [--quick]``.

Parts: ``grades`` (rendered images; the grades of ``[navigation]``, with ``--mismatch`` also ``truth.preset = "mismatch"``),
``sources`` (statistical sightings; each error source alone, from 0 to 10 times its figure in the grade ``lab``). Figures are
RMS over all chasers from 20 s on, mean over the seeds, in closed loop: the error of each chaser's pose relative to the target,
``estimate``, and of its distance from the reference on the true target, ``tracking``; ``nees`` of the relative pose (6 expected).
The paper's estimator takes odometry as exact; its relative pose is that of odometry and target estimate.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.navigation import GRADES
from common import ROOT, Figures, make_parser, run_parts

from chaserdock.evaluation.in_process import InProcessMission, TickRecord
from chaserdock.evaluation.perception import RenderedImages, measurement_model

SETTLED_S = 20.0
SIGHTING_SIGMA_M, SIGHTING_SIGMA_RAD = 2e-4, math.radians(0.25)
"""Statistical sightings: about those of one large marker at 1 m."""
SOURCES = {
    "position": ("position_noise_m",),
    "velocity": ("velocity_noise_m_s",),
    "attitude": ("attitude_noise_deg", "attitude_roll_noise_deg"),
    "rate": ("omega_noise_deg_s",),
    "camera": ("camera_turn_deg", "camera_shift_m", "camera_focal_share"),
}
ESTIMATORS = ("joint", "paper")


def scenario_of(name: str, estimator: str, seed: int, duration_s: float, *overrides: str) -> Scenario:
    """Return a shipped scenario with another estimator, seed and length, without its approach."""
    fixed = (
        f"seed={seed}",
        f"duration_s={duration_s}",
        f'estimator.name="{estimator}"',
        "timeline=[]",
        "success={}",
    )
    return load_scenario(ROOT / "scenarios" / f"{name}.toml", (*fixed, *overrides))


def relative_error(tick: TickRecord, chaser: int) -> tuple[Array, float]:
    """Return the error (6,) of a chaser's estimated pose relative to the target (TRF, m; CRF, rad) and its NEES, NaN without
    a covariance."""
    assert tick.outputs is not None
    estimate, true, own = tick.outputs.target, tick.states["target"], tick.states[f"chaser/{chaser}"]
    place = rotations.rotate_inverse(true.q_wxyz, own.position_m - true.position_m)
    attitude = rotations.multiply(rotations.conjugate(true.q_wxyz), own.q_wxyz)
    found = next((r for r in estimate.relative if r.chaser == chaser), None)
    if found is not None:
        position, q = np.array(found.position_m), np.array(found.q_wxyz)
    else:
        odometry = tick.odometry[chaser]
        position = rotations.rotate_inverse(
            estimate.q_wxyz, np.array(odometry.position_m) - estimate.position_m
        )
        q = rotations.multiply(rotations.conjugate(estimate.q_wxyz), odometry.q_wxyz)
    error = np.concatenate(
        [place - position, rotations.log(rotations.multiply(rotations.conjugate(q), attitude))]
    )
    if found is None:
        return error, math.nan
    return error, float(error @ np.linalg.solve(np.reshape(found.covariance, (6, 6)), error))


def fly(scenario: Scenario, images: bool) -> Array:
    """Fly a mission; return its figures (7,): estimate m, rad, tracking m, rad, NEES, gated share, re-initializations."""
    model = measurement_model(scenario, scenario.seed, SIGHTING_SIGMA_M, SIGHTING_SIGMA_RAD)
    rows, nees, accepted, gated = [], [], 0, 0
    with InProcessMission(scenario, RenderedImages(scenario) if images else model) as mission:
        for tick in mission.ticks():
            assert tick.outputs is not None
            accepted, gated = (
                accepted + len(tick.outputs.target.accepted),
                gated + len(tick.outputs.target.rejected),
            )
            if tick.time_s < SETTLED_S:
                continue
            for i in mission.chasers:
                error, value = relative_error(tick, i)
                nees.append(value)
                rows.append(
                    [np.sum(error[:3] ** 2), np.sum(error[3:] ** 2), *np.square(tick.tracking_errors[i])]
                )
        restarts = mission.controller.estimator.reinitialisations
    share = gated / max(1, accepted + gated)
    return np.array([*np.sqrt(np.mean(rows, axis=0)), np.mean(nees), share, restarts])


def mean_figures(label: str, flights: Sequence[Array]) -> Figures:
    """Return the mean over flights, by name."""
    units = ("estimate_m", "estimate_rad", "tracking_m", "tracking_rad", "nees", "gated_share", "restarts")
    values = np.mean(flights, axis=0)
    return {f"{label}_{unit}": float(v) for unit, v in zip(units, values, strict=True) if not math.isnan(v)}


def grades(options: argparse.Namespace) -> Figures:
    """Fly one and four chasers under every grade, with rendered images."""
    seeds, duration_s = (2, 35.0) if options.quick else (options.seeds, 60.0)
    truth = ['truth.preset="mismatch"'] if options.mismatch else []
    figures: Figures = {}
    for grade in GRADES:
        for name, number in (("single", 1), ("four-chaser-docking", 4)):
            for estimator in ESTIMATORS:
                overrides = (f'navigation.grade="{grade}"', *truth)
                flights = [
                    fly(scenario_of(name, estimator, s, duration_s, *overrides), True) for s in range(seeds)
                ]
                figures |= mean_figures(f"{grade}_{number}_{estimator}", flights)
    return figures


def sources(options: argparse.Namespace) -> Figures:
    """Fly four chasers with one error source at a time, in multiples of the grade ``lab``."""
    seeds, duration_s = (1, 30.0) if options.quick else (5, 40.0)
    factors = (0.0, 1.0, 10.0) if options.quick else (0.0, 0.5, 1.0, 2.0, 5.0, 10.0)
    figures: Figures = {}
    for source, keys in SOURCES.items():
        for factor in factors:
            values = [f"navigation.{key}={factor * GRADES['lab'][key]}" for key in keys]
            for estimator in ESTIMATORS:
                overrides = ('navigation.grade="exact"', *values)
                scenarios = [
                    scenario_of("four-chaser-docking", estimator, s, duration_s, *overrides)
                    for s in range(seeds)
                ]
                flights = [fly(scenario, False) for scenario in scenarios]
                figures |= mean_figures(f"{source}_{factor:g}_{estimator}", flights)
    return figures


PARTS = {"grades": grades, "sources": sources}


def main() -> None:
    """Run the parts."""
    parser = make_parser(__doc__, PARTS)
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="flights per row of grades (default: 20)"
    )
    parser.add_argument("--mismatch", action="store_true", help="with plant mismatch ([truth] preset)")
    options = parser.parse_args()
    run_parts(options, {name: partial(part, options) for name, part in PARTS.items()})


if __name__ == "__main__":
    main()
