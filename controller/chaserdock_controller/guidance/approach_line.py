# SPDX-License-Identifier: Apache-2.0
"""Line along which a chaser docks at a distance: through the target's centre, or from a port that
was chosen on the map of an unknown target. Pure functions; TRF, SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import ChosenPort
from chaserdock_protocol.scenario import FlightScenario

from .approach_cone import BESIDE_LINE_M, Cone, cone_about

_ENTRY_MARGIN_M = 0.1
"""Distance of a port's entry, and of the way to it, beyond `limits.min_distance_target_m`, m: as
much as an uncertain estimate adds to that at most."""


@dataclass(frozen=True, eq=False)
class ApproachLine:
    """Line from ``base_m`` (3,) outwards along ``axis`` (3,), and the place ``docked_m`` (3,) on it
    where a chaser is docked. ``entry_m`` (3,): where the way along a port's line begins; without a
    port the docked place.
    """

    base_m: Array
    axis: Array
    docked_m: Array
    entry_m: Array

    def aside_m(self, offset_m: Array) -> float:
        """Return the distance of a place (3,) from the line; infinite behind its base."""
        off = offset_m - self.base_m
        along = float(off @ self.axis)
        if along <= 0.0:
            return math.inf
        return math.sqrt(max(0.0, float(off @ off) - along * along))

    def cone(self, half_angle_rad: float) -> Cone:
        """Return the corridor: about the axis, through the target's centre, and wide enough for the
        line and the lateral error that is permitted.
        """
        along = float(self.docked_m @ self.axis)
        aside = float(np.linalg.norm(self.docked_m - along * self.axis))
        return cone_about(self.axis, along, aside + BESIDE_LINE_M, half_angle_rad)


def approach_line(
    scenario: FlightScenario, chaser: int, port: ChosenPort | None = None
) -> ApproachLine:
    """Return the line of a chaser: from its port, or through its reference position."""
    distance_m = scenario.approach.dock_distance_m
    if port is None:
        nominal = np.asarray(scenario.chasers[chaser].position_m)
        axis = nominal / np.linalg.norm(nominal)
        return ApproachLine(np.zeros(3), axis, axis * distance_m, axis * distance_m)
    base, axis = np.array(port.position_m), np.array(port.axis)
    docked = base + distance_m * axis
    clear_m = scenario.limits.min_distance_target_m + _ENTRY_MARGIN_M
    along = float(base @ axis)
    aside = float(base @ base) - along * along
    entry = base + (math.sqrt(max(0.0, clear_m**2 - aside)) - along) * axis
    if float((entry - docked) @ axis) < 0.0:
        entry = docked
    return ApproachLine(base, axis, docked, entry)


def why_not_past(scenario: FlightScenario, here_m: Array, there_m: Array) -> str:
    """Return why the straight way between two places (3,) is too near to the target; empty if it is
    not.
    """
    way = there_m - here_m
    share = float(-here_m @ way) / max(float(way @ way), 1e-12)
    nearest_m = float(np.linalg.norm(here_m + min(max(share, 0.0), 1.0) * way))
    limit_m = scenario.limits.min_distance_target_m + 0.5 * _ENTRY_MARGIN_M
    if nearest_m >= limit_m:
        return ""
    return (
        f"the way to the port leads within {nearest_m:.2f} m of the middle of the target, at least "
        f"{limit_m:.2f} m: wait until it has turned, or goto another place first"
    )
