# SPDX-License-Identifier: Apache-2.0
"""Search for the target: criterion for its end, and the wrench of each searching chaser."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body

from chaserdock_controller.estimation.types import TargetState

from .pointing import facing, search_wrench, turning_wrench

# Largest sigmas of the target's rates with which a chaser leaves the search.
_SETTLED_M_S, _SETTLED_RAD_S = 0.01, 0.02


def is_settled(target: TargetState) -> bool:
    """Return whether the target's rates are known well enough to fly relative to it."""
    sums = [float(target.covariance.diagonal()[i : i + 3].sum()) for i in (3, 9)]
    if sums[0] < _SETTLED_M_S**2 and sums[1] < _SETTLED_RAD_S**2:
        return True  # no eigenvalue is larger than the trace
    largest = [float(np.linalg.eigvalsh(target.covariance[i : i + 3, i : i + 3])[-1]) for i in (3, 9)]
    return largest[0] < _SETTLED_M_S**2 and largest[1] < _SETTLED_RAD_S**2


class TargetSearch:
    """Keeps the attitude with which each chaser began its search."""

    def __init__(self, body: Body, camera: Camera) -> None:
        self._body, self._camera = body, camera
        self._starts: dict[int, tuple[float, Array]] = {}

    def wrench(self, odometry: Odometry, since_s: float, target: TargetState) -> Array:
        """Return force and torque (6,), body axes, of a chaser that has searched since ``since_s``.

        The chaser turns along the search pattern, or to the target once its pose is known.
        """
        if target.status in ("tracking", "predicting"):
            q = facing(odometry.q_wxyz, target.position_m - odometry.position_m)
            return turning_wrench(odometry, self._body, q, q)
        started_s, q_start = self._starts.get(odometry.chaser, (-1.0, np.zeros(4)))
        if started_s != since_s:
            q_start = np.array(odometry.q_wxyz)
            self._starts[odometry.chaser] = since_s, q_start
        time_s = odometry.sim_time_ns / 1e9 - since_s
        return search_wrench(odometry, self._body, self._camera, q_start, time_s)
