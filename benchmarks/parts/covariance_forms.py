# SPDX-License-Identifier: Apache-2.0
"""The joint filter with each form of its covariance on the same measurements."""

from __future__ import annotations

import math
import statistics
import sys
from dataclasses import replace

import numpy as np
from chaserdock_controller.estimation.joint import JointEstimator
from common import ROOT, Figures, Group, Options

sys.path.insert(0, str(ROOT / "tests"))

from flight_cases import scenario
from joint_cases import PERIOD_S, WHITE, SyntheticFlight, navigation, parameters

CASES = (("lab", 4, 6), ("lab", 16, 3), ("orbit", 4, 6))
"""Grade of the sensors' errors, number of chasers, number of seeds."""
FLOWN_S, SETTLED_S = 40.0, 10.0
"""Length of a flight, and of its begin without judgement."""
FORMS = {"dense": 64, "star": 0}
"""Forms, with the number of chasers up to which the covariance is dense."""


def relative_errors(grade: str, chasers: int, seed: int, most_dense: int) -> tuple[float, ...]:
    """Return RMS errors of the chasers' relative poses (m, rad), and the mean NEES (of 6)."""
    stated, errors = scenario(), navigation(grade)
    flight = SyntheticFlight(stated, errors, chasers, seed)
    known = parameters(stated, errors, several_markers=WHITE)
    estimator = JointEstimator(replace(known, most_dense_chasers=most_dense), chasers)
    found: list[tuple[float, float, float]] = []
    for tick in range(round(FLOWN_S / PERIOD_S)):
        estimator.update(flight.inputs())
        if tick * PERIOD_S > SETTLED_S and tick % round(1.0 / PERIOD_S) == 0:
            found += [flight.relative_error(estimator, i) for i in range(chasers)]
        flight.step()
    position_m, turn_rad, nees = np.array(found).T
    return float(np.sqrt(np.mean(position_m**2))), float(np.sqrt(np.mean(turn_rad**2))), nees.mean()


def forms(options: Options) -> Figures:
    """Compare the forms of the joint filter's covariance: errors and NEES on equal measurements."""
    out: Figures = {}
    for grade, chasers, seeds in CASES[:1] if options.quick else CASES:
        seeds = 2 if options.quick else options.flights or seeds
        found = {
            form: [relative_errors(grade, chasers, seed, most) for seed in range(seeds)]
            for form, most in FORMS.items()
        }
        key = f"{grade}_{chasers}"
        for form, flights in found.items():
            out[f"{key}_{form}_position_rms_m"] = math.sqrt(
                statistics.fmean(p**2 for p, _, _ in flights)
            )
            out[f"{key}_{form}_rotation_rms_rad"] = math.sqrt(
                statistics.fmean(r**2 for _, r, _ in flights)
            )
            out[f"{key}_{form}_nees"] = statistics.fmean(nees for _, _, nees in flights)
        less = [a[2] - b[2] for a, b in zip(found["dense"], found["star"], strict=True)]
        out[f"{key}_star_nees_less"] = statistics.fmean(less)
        out[f"{key}_star_nees_less_sigma"] = statistics.stdev(less) / math.sqrt(len(less))
    return out


GROUP = Group({"forms": forms}, ("flights",))
