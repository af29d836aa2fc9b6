# SPDX-License-Identifier: Apache-2.0
"""Raise the cost of thrusters whose plume hits the target or another chaser. No I/O."""

from __future__ import annotations

import math

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plume import REACH_M, angle_to_point, plume_hits
from chaserdock_models.targets import Box
from chaserdock_protocol.messages import Odometry, RelativeEstimate, TargetEstimate
from chaserdock_protocol.scenario import FlightScenario

_COST_FACTOR = 11.0
"""Cost of a thruster whose plume hits, over that of others: large enough that it fires only where
others cannot give the wrench."""


class PlumeAvoidance:
    """Compute the cost factors of one chaser's thrusters from the poses relative to the target."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._nozzles = np.array([t.position_m for t in scenario.chaser.thrusters])
        self._forces = np.array([t.direction for t in scenario.chaser.thrusters])
        self._boxes = scenario.target_model().boxes
        self._size_m = scenario.chaser.size_m
        self._radius_m = math.hypot(*scenario.chaser.size_m) / 2.0
        self._half_angle_rad = math.radians(scenario.detumble.plume_deg)

    def cost_factors(self, own: Odometry | None, target: TargetEstimate) -> Array | None:
        """Return the cost factors (n,); above 1 for thrusters whose plume hits something.

        Hits count on the target and on the bodies of chasers whose pose ``target`` states. None
        without an own state, or with nothing within reach. The states may be those of different
        ticks, a fraction of a second apart.
        """
        if own is None:
            return None
        away = np.subtract(own.position_m, target.position_m)
        at = rotations.rotate_inverse(target.q_wxyz, away)
        boxes = self._boxes if float(np.linalg.norm(away)) <= REACH_M else ()
        others = [
            r
            for r in target.relative
            if r.chaser != own.chaser and float(np.linalg.norm(at - r.position_m)) <= REACH_M
        ]
        if not boxes and not others:
            return None
        nozzles = rotations.rotate_inverse(
            target.q_wxyz, away + rotations.rotate(own.q_wxyz, self._nozzles)
        )
        forces = rotations.rotate_inverse(target.q_wxyz, rotations.rotate(own.q_wxyz, self._forces))
        hits = [
            plume_hits(
                nozzle, force, self._half_angle_rad, (*boxes, *self._near(nozzle, force, others))
            )
            for nozzle, force in zip(nozzles, forces, strict=True)
        ]
        return np.where(hits, _COST_FACTOR, 1.0)

    def _near(self, nozzle: Array, force: Array, others: list[RelativeEstimate]) -> list[Box]:
        """Return the bodies (TRF) of chasers whose bounding sphere the plume of a thruster
        meets.
        """
        near = []
        for r in others:
            centre = np.array(r.position_m)
            distance_m = float(np.linalg.norm(centre - nozzle))
            spread = math.asin(min(1.0, self._radius_m / distance_m)) if distance_m else math.pi
            if angle_to_point(nozzle, -force, centre) - spread < self._half_angle_rad:
                near.append(Box(self._size_m, r.position_m, r.q_wxyz))
        return near
