# SPDX-License-Identifier: Apache-2.0
"""Search for the target: criterion for its end, and the wrench of each searching chaser."""

from __future__ import annotations

import math

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body
from msgspec import Struct
from msgspec.structs import replace

from chaserdock_controller.estimation.types import TargetState

from .pointing import facing, search_wrench, turning_wrench

# Largest sigmas of the target's rates with which a chaser leaves the search.
_SETTLED_M_S, _SETTLED_RAD_S = 0.01, 0.02
_PAUSE_S, _BETWEEN_PAUSES_S = 8.0, 2.0
"""Longest time for which a chaser stops turning while it searches one of its images, and least time
of turning between two of these: an acquisition by shape takes up to 120 images, and half a field of
view passes in 2 s."""


class SearchProgress(Struct, frozen=True):
    """Search of one chaser: its begin and the attitude there, and its pauses.

    ``paused_s``: of all pauses; ``pause_s``: of the present one; ``resumed_s``: when the last one
    ended; ``updated_s``: time of this state.
    """

    since_s: float
    q_start_wxyz: Array
    updated_s: float
    paused_s: float = 0.0
    pause_s: float = 0.0
    resumed_s: float = -math.inf

    def at(self, now_s: float, acquiring: bool | None) -> SearchProgress:
        """Return the progress at ``now_s`` of a chaser that is ``acquiring`` the target in an
        earlier image, or is not.

        None: not known, as no sighting has come; a pause goes on.
        """
        step_s = now_s - self.updated_s
        if acquiring is None:
            acquiring = self.pause_s > 0.0
        begins = self.pause_s > 0.0 or now_s - self.resumed_s >= _BETWEEN_PAUSES_S
        if acquiring and begins and self.pause_s < _PAUSE_S:
            return replace(
                self,
                updated_s=now_s,
                paused_s=self.paused_s + step_s,
                pause_s=self.pause_s + step_s,
            )
        resumed_s = now_s if self.pause_s > 0.0 else self.resumed_s
        return replace(self, updated_s=now_s, pause_s=0.0, resumed_s=resumed_s)


def is_settled(target: TargetState) -> bool:
    """Return whether the target's rates are known well enough to fly relative to it."""
    v = target.covariance.diagonal().tolist()
    if v[3] + v[4] + v[5] < _SETTLED_M_S**2 and v[9] + v[10] + v[11] < _SETTLED_RAD_S**2:
        return True  # no eigenvalue is larger than the trace
    largest = [
        float(np.linalg.eigvalsh(target.covariance[i : i + 3, i : i + 3])[-1]) for i in (3, 9)
    ]
    return largest[0] < _SETTLED_M_S**2 and largest[1] < _SETTLED_RAD_S**2


class TargetSearch:
    """Keeps the progress of each chaser's search."""

    def __init__(self, body: Body, camera: Camera) -> None:
        self._body, self._camera = body, camera
        self._progress: dict[int, SearchProgress] = {}

    def wrench(
        self, odometry: Odometry, since_s: float, target: TargetState, acquiring: bool | None = None
    ) -> Array:
        """Return force and torque (6,), body axes, of a chaser that has searched since ``since_s``.

        The chaser turns along the search pattern, with pauses in which it is ``acquiring`` the
        target in an earlier image, or to the target once its pose is known.
        """
        if target.status in ("tracking", "predicting"):
            q = facing(odometry.q_wxyz, target.position_m - odometry.position_m)
            return turning_wrench(odometry, self._body, q, q)
        now_s, before = odometry.sim_time_ns / 1e9, self._progress.get(odometry.chaser)
        if before is None or before.since_s != since_s:
            before = SearchProgress(since_s, np.array(odometry.q_wxyz), now_s)
        progress = self._progress[odometry.chaser] = before.at(now_s, acquiring)
        time_s = now_s - since_s - progress.paused_s
        return search_wrench(odometry, self._body, self._camera, progress.q_start_wxyz, time_s)
