"""Chasers that look about for the target: what each does now, from where it began."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body

from chaserdock_controller.estimation.types import TargetState

from .pointing import facing, search_wrench, turning_wrench

# A target that was searched for is flown by once its rates are known so well (largest sigma).
_SETTLED_M_S, _SETTLED_RAD_S = 0.01, 0.02


def settled(fused: TargetState) -> bool:
    """Whether the target's rates are known well enough to fly by."""
    sums = [float(fused.covariance.diagonal()[i : i + 3].sum()) for i in (3, 9)]
    if sums[0] < _SETTLED_M_S**2 and sums[1] < _SETTLED_RAD_S**2:
        return True  # no eigenvalue is larger than the sum of all
    largest = [float(np.linalg.eigvalsh(fused.covariance[i : i + 3, i : i + 3])[-1]) for i in (3, 9)]
    return largest[0] < _SETTLED_M_S**2 and largest[1] < _SETTLED_RAD_S**2


class Searches:
    """The attitude with which each chaser began its search."""

    def __init__(self, body: Body, camera: Camera) -> None:
        self._body, self._camera = body, camera
        self._from: dict[int, tuple[float, Array]] = {}

    def wrench(self, odometry: Odometry, since_s: float, fused: TargetState) -> Array:
        """Force and torque (6,), body axes, of a chaser that has searched since ``since_s``: it looks about or, once
        somebody sees the target, at it."""
        if fused.status in ("tracking", "predicting"):
            q = facing(odometry.q_wxyz, fused.position_m - odometry.position_m)
            return turning_wrench(odometry, self._body, q, q)
        begun_s, q_start = self._from.get(odometry.chaser, (-1.0, np.zeros(4)))
        if begun_s != since_s:
            q_start = np.array(odometry.q_wxyz)
            self._from[odometry.chaser] = since_s, q_start
        return search_wrench(
            odometry, self._body, self._camera, q_start, odometry.sim_time_ns / 1e9 - since_s
        )
