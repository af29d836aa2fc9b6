# SPDX-License-Identifier: Apache-2.0
"""Approach corridor of the NMPC: a cone about an axis through the target's centre. Pure
functions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, length
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import ArrayLike

from .docking import dock_of

BESIDE_LINE_M = 0.1
"""Greatest distance from its line at which an approach to a docking distance may begin. Also the
radius of its corridor's inner end.
"""


@dataclass(frozen=True)
class Cone:
    """Cone about an axis through the target's centre.

    ``axis`` (3,): TRF, unit length, outwards. ``apex_m``: distance of the apex from the centre
    along the axis; may be negative.
    """

    axis: Array
    half_angle_rad: float
    apex_m: float

    def room_m(self, offset_m: ArrayLike) -> float:
        """Return the distance (m) of a point ``offset_m`` (3,), TRF, from the cone's surface,
        positive inside. Behind the apex the surface counts as extended.
        """
        offset = np.asarray(offset_m, dtype=float)
        along = float(offset @ self.axis)
        aside = length(offset - along * self.axis)
        return (
            math.sin(self.half_angle_rad) * (along - self.apex_m)
            - math.cos(self.half_angle_rad) * aside
        )


def cone_about(axis: ArrayLike, innermost_m: float, aside_m: float, half_angle_rad: float) -> Cone:
    """Return the cone about ``axis`` (3,), TRF, with radius ``aside_m`` at the distance
    ``innermost_m`` from the target's centre.

    Raises ValueError for an axis that is not a unit vector or an angle outside 0 to pi / 2.
    """
    direction = np.asarray(axis, dtype=float)
    if abs(float(np.linalg.norm(direction)) - 1.0) > 1e-6:
        raise ValueError(f"axis must be a unit vector, not {direction.tolist()}")
    if not 0.0 < half_angle_rad < math.pi / 2:
        raise ValueError(f"half_angle_rad must lie between 0 and pi / 2, not {half_angle_rad!r}")
    return Cone(direction, half_angle_rad, innermost_m - aside_m / math.tan(half_angle_rad))


def cone_of(scenario: FlightScenario, chaser: int) -> Cone:
    """Return a chaser's corridor: about its port's axis, or about its nominal direction if it docks
    at a distance.

    The inner end is wide enough for the path and the permitted lateral error.
    """
    docking, dock = scenario.docking, dock_of(scenario, chaser)
    angle = math.radians(docking.corridor_angle_deg)
    if dock is None:
        nominal = np.asarray(scenario.chasers[chaser].position_m)
        return cone_about(
            nominal / np.linalg.norm(nominal),
            scenario.approach.dock_distance_m,
            BESIDE_LINE_M,
            angle,
        )
    axis, end = np.asarray(dock.port.axis), dock.offset(-docking.overdrive_m)
    along = float(end @ axis)
    aside = float(np.linalg.norm(end - along * axis)) + 2.0 * docking.corridor.lateral_m
    return cone_about(axis, along, aside, angle)


def corridor_rows(cones: Sequence[Cone | None], q_target_wxyz: Array) -> Array | None:
    """Return `NmpcInput.corridors` (N, K, 5) for target attitudes (K, 4), TRF to WRF; None without
    any cone.
    """
    if not any(cones):
        return None
    rows = np.zeros((len(cones), len(q_target_wxyz), 5))
    for row, cone in zip(rows, cones, strict=True):
        if cone is not None:
            row[:, :3] = rotations.rotate(q_target_wxyz, cone.axis)
            row[:, 3], row[:, 4] = cone.half_angle_rad, cone.apex_m
    return rows
