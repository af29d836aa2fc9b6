# SPDX-License-Identifier: Apache-2.0
"""Conversion of sightings to measurements of the target's pose in WRF."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry, Sighting

from .geometry import to_world
from .types import CameraPose, Measurement

_ODOMETRY_KEPT_NS = 2_000_000_000


class SightingConverter:
    """Keeps recent odometry, as sightings may belong to earlier ticks."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._odometry: dict[tuple[int, int], Odometry] = {}

    def add_odometry(self, odometry: Iterable[Odometry], now_ns: int) -> None:
        """Add measured odometry of this tick or earlier ones and remove what is too old."""
        for o in odometry:
            self._odometry[o.chaser, o.sim_time_ns] = o
        for key in [k for k in self._odometry if k[1] < now_ns - _ODOMETRY_KEPT_NS]:
            del self._odometry[key]

    def measurements(self, sightings: tuple[Sighting, ...]) -> list[Measurement]:
        """Return the measurements of sightings for which the odometry at the exposure is known."""
        measurements = []
        for s in sightings:
            odometry = self._odometry.get((s.chaser, s.sim_time_ns))
            if odometry is None:
                continue
            hypotheses = tuple(
                to_world(
                    odometry.position_m,
                    odometry.q_wxyz,
                    self._camera.position_crf_m,
                    self._camera.q_crf_irf_wxyz,
                    solution.position_m,
                    solution.q_wxyz,
                    np.reshape(solution.covariance, (6, 6)),
                )
                for solution in s.solutions
            )
            pose = CameraPose(*self._camera.irf_pose_in_world(odometry.position_m, odometry.q_wxyz))
            measurements.append(
                Measurement(s.chaser, s.sim_time_ns, hypotheses, len(s.marker_ids), pose)
            )
        return measurements
