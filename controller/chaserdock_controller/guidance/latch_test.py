# SPDX-License-Identifier: Apache-2.0
"""Judge the motion under the pull of a latch test by the covariance of the estimate."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import RelativePose

from .parameters import GUIDANCE


class PullMotion(NamedTuple):
    """Estimated motion since the pull began: ``moved_m``, ``turned_rad``; and the largest that is
    not held against the latch: ``most_m``, ``most_rad``.
    """

    moved_m: float
    turned_rad: float
    most_m: float
    most_rad: float

    def __str__(self) -> str:
        return (
            f"moved {self.moved_m * 1e3:.2f} mm (at most {self.most_m * 1e3:.2f}) and "
            f"{math.degrees(self.turned_rad):.2f} deg (at most {math.degrees(self.most_rad):.2f})"
        )

    @property
    def exceeded(self) -> bool:
        """Return whether the latch gave way."""
        return self.moved_m > self.most_m or self.turned_rad > self.most_rad


def motion_between(before: RelativePose, now: RelativePose, scenario: FlightScenario) -> PullMotion:
    """Return the motion from one estimated pose to another, and what is allowed of it.

    P is the covariance of each given the errors that persist with the view, which does not change
    while a chaser is latched: these cancel. The change d (3,) then has at most the covariance
    S = P(before) + P(now), as errors of a filter fade without oscillation. With u = d / |d|,
    |d| > g sqrt(u' S u) implies d' S^-1 d > g^2 (by Cauchy and Schwarz), which a chi-square law of
    three degrees of freedom gives to at most ``GUIDANCE.pull_sigmas`` = g. Smaller motions than the
    tolerances of the procedure are allowed, too.
    """
    moved = now.position_m - before.position_m
    turned = rotations.log(rotations.multiply(rotations.conjugate(before.q_wxyz), now.q_wxyz))
    covariance, docking = before.covariance + now.covariance, scenario.docking
    return PullMotion(
        float(np.linalg.norm(moved)),
        float(np.linalg.norm(turned)),
        max(docking.verify_position_m, _most(moved, covariance[:3, :3])),
        max(math.radians(docking.verify_angle_deg), _most(turned, covariance[3:, 3:])),
    )


def why_untold(before: RelativePose, now: RelativePose, scenario: FlightScenario) -> str:
    """Return why an open latch could not be told from an error of the estimate; empty if it could.

    Its motion exceeds the tolerance of the procedure in any valid scenario.
    """
    along = rotations.rotate(now.q_wxyz, (1.0, 0.0, 0.0))
    most_m = _most(along, (before.covariance + now.covariance)[:3, :3])
    open_m = scenario.docking.open_latch_motion_m(scenario.chaser.mass_kg)
    if most_m <= open_m:
        return ""
    return (
        f"the estimate may err by {most_m * 1e3:.2f} mm along the pull, which moves an open latch "
        f"by {open_m * 1e3:.2f} mm"
    )


def _most(change: Array, covariance: Array) -> float:
    """Return the largest change (3,) in its direction that may be an error of the estimate."""
    length = float(np.linalg.norm(change))
    if length == 0.0:
        return 0.0
    direction = change / length
    return GUIDANCE.pull_sigmas * math.sqrt(max(0.0, float(direction @ covariance @ direction)))
