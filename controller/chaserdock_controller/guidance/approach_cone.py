"""The way in to a dock as the NMPC has it: a cone about an axis through the target's centre. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import Scenario
from numpy.typing import ArrayLike

from .docking import dock_of

BESIDE_LINE_M = 0.1
"""How far beside its line an approach to a docking distance may begin, and so how wide its corridor is at the end."""


@dataclass(frozen=True)
class Cone:
    """``axis`` (3,) TRF, unit, outwards; the apex lies ``apex_m`` from the target's centre along it (may be negative)."""

    axis: Array
    half_angle_rad: float
    apex_m: float

    def room_m(self, offset_m: ArrayLike) -> float:
        """Distance of ``offset_m`` (3,), TRF, from the cone's surface, positive inside (beside the apex, of its plane)."""
        offset = np.asarray(offset_m, dtype=float)
        along = float(offset @ self.axis)
        aside = float(np.linalg.norm(offset - along * self.axis))
        return math.sin(self.half_angle_rad) * (along - self.apex_m) - math.cos(self.half_angle_rad) * aside


def cone_about(axis: ArrayLike, innermost_m: float, aside_m: float, half_angle_rad: float) -> Cone:
    """The cone that is ``aside_m`` wide (radius) where a way in along ``axis`` (3,), TRF, ends, ``innermost_m`` from the
    target's centre along it. Raises ValueError for an axis that is no unit vector or an angle that opens no cone."""
    direction = np.asarray(axis, dtype=float)
    if abs(float(np.linalg.norm(direction)) - 1.0) > 1e-6:
        raise ValueError(f"axis must be a unit vector, not {direction.tolist()}")
    if not 0.0 < half_angle_rad < math.pi / 2:
        raise ValueError(f"half_angle_rad must lie between 0 and pi / 2, not {half_angle_rad!r}")
    return Cone(direction, half_angle_rad, innermost_m - aside_m / math.tan(half_angle_rad))


def cone_of(scenario: Scenario, chaser: int) -> Cone:
    """A chaser's corridor: about its port's axis, or about its nominal direction where it docks at a distance; wide
    enough at the inner end for the way in, and for what the chaser may be beside it."""
    docking, dock = scenario.docking, dock_of(scenario, chaser)
    angle = math.radians(docking.corridor_angle_deg)
    if dock is None:
        nominal = np.asarray(scenario.chasers[chaser].position_m)
        return cone_about(
            nominal / np.linalg.norm(nominal), scenario.approach.dock_distance_m, BESIDE_LINE_M, angle
        )
    axis, end = np.asarray(dock.port.axis), dock.offset(-docking.overdrive_m)
    along = float(end @ axis)
    aside = float(np.linalg.norm(end - along * axis)) + 2.0 * docking.corridor.lateral_m
    return cone_about(axis, along, aside, angle)


def corridor_rows(cones: Sequence[Cone | None], q_target_wxyz: Array) -> Array | None:
    """`NmpcInput.corridors` (N, K, 5) along the target's attitudes (K, 4), TRF to WRF; None if nobody has one."""
    if not any(cones):
        return None
    rows = np.zeros((len(cones), len(q_target_wxyz), 5))
    for row, cone in zip(rows, cones, strict=True):
        if cone is not None:
            row[:, :3] = rotations.rotate(q_target_wxyz, cone.axis)
            row[:, 3], row[:, 4] = cone.half_angle_rad, cone.apex_m
    return rows
