# SPDX-License-Identifier: Apache-2.0
"""Cost of thrusters whose plume hits the target. No I/O."""

from __future__ import annotations

import math

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plume import plume_hits
from chaserdock_protocol.messages import Odometry, TargetEstimate
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.plume import PlumeSection


class PlumeAvoidance:
    """Cost factors of the thrusters of one chaser, from its pose relative to the target."""

    def __init__(self, scenario: FlightScenario, plume: PlumeSection) -> None:
        self._nozzles = np.array([t.position_m for t in scenario.chaser.thrusters])
        self._forces = np.array([t.direction for t in scenario.chaser.thrusters])
        self._boxes = scenario.target_model().boxes
        self._half_angle_rad = math.radians(scenario.detumble.plume_deg)
        self._reach_m, self._factor = plume.reach_m, 1.0 + plume.avoid_factor

    def cost_factors(self, own: Odometry | None, target: TargetEstimate) -> Array | None:
        """Return the factors (n,), above 1 for thrusters whose plume hits the target; None without a state or out of reach.

        The states may be those of different ticks, a fraction of a second apart.
        """
        if own is None:
            return None
        away = np.subtract(own.position_m, target.position_m)
        if float(np.linalg.norm(away)) > self._reach_m:
            return None
        nozzles = rotations.rotate_inverse(target.q_wxyz, away + rotations.rotate(own.q_wxyz, self._nozzles))
        forces = rotations.rotate_inverse(target.q_wxyz, rotations.rotate(own.q_wxyz, self._forces))
        hits = [
            plume_hits(nozzle, force, self._half_angle_rad, self._boxes)
            for nozzle, force in zip(nozzles, forces, strict=True)
        ]
        return np.where(hits, self._factor, 1.0)
