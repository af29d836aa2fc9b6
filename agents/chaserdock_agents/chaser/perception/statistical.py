# SPDX-License-Identifier: Apache-2.0
"""Statistical perception: draws the measured pose around the true one, with the errors that images of the pose have.

Markers count as seen if they are large enough, face the camera and lie in the image. Corner noise of ``SIGMA_PX`` then
gives the covariance of the pose, as in ``pnp``, and the error is drawn from it. ``tests/missions/test_statistical.py``
compares both with rendered images. Where no marker is seen, ``[ranging]`` gives bearing, range and attitude.
"""

from __future__ import annotations

import math

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel
from chaserdock_protocol.pose_image import decode_pose
from chaserdock_protocol.scenario.ranging import Ranging
from numpy.typing import ArrayLike, NDArray

from .pipeline import PerceptionResult
from .pnp import MIN_SINGLE_COSINE, MarkerTable, TargetPose, pose_covariance

SIGMA_PX = 0.042
"""Standard deviation of the coordinates of a corner of a large marker, pixels."""
SMALL_SIDE_PX = 25.0
"""Of markers with a shorter side, the standard deviation is larger in inverse proportion."""
MIN_SIDE_PX = 14.0
"""Shortest side of a marker that is detected, pixels."""
MIN_COSINE = 0.3
_MARGIN_PX = 2.0
_NOTHING = PerceptionResult((), np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), ())


class StatisticalPerception:
    """Measures the pose that an image of ``pose_image`` contains. Stateless, as `Perception`."""

    def __init__(self, camera: Camera, model: TargetModel, ranging: Ranging | None = None) -> None:
        self._camera, self._ranging = camera, ranging
        self._table = MarkerTable.of(model)

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> PerceptionResult:
        """Return one solution, or none if too little of the target is in view. Raises ValueError for a rendered image."""
        position, q, seed = decode_pose(image)
        rotation = rotations.to_matrix(q)
        corners = self._table.corners.reshape(-1, 3) @ rotation.T + position
        if corners[:, 2].min() <= 0.0:
            return _NOTHING
        seen_near = self._by_markers(position, q, rotation, corners, seed)
        return seen_near or self._by_range(position, q, seed) or _NOTHING

    def _by_markers(
        self, position: Array, q: Array, rotation: Array, corners: Array, seed: tuple[int, int]
    ) -> PerceptionResult | None:
        table = self._table
        px = self._camera.project_ideal(corners).reshape(-1, 4, 2)
        sides = px - px[:, (1, 2, 3, 0)]
        side_px = np.sqrt(np.einsum("ijk,ijk->ij", sides, sides).min(axis=1))
        seen = self._visible(px, side_px, rotation, position)
        if not seen.any():
            return None
        points, pixels = table.corners[seen].reshape(-1, 3), np.ascontiguousarray(px[seen].reshape(-1, 2))
        relative = np.repeat(np.maximum(1.0, SMALL_SIDE_PX / side_px[seen]), 4)
        found = pose_covariance(self._camera, points, pixels, position, rotation, SIGMA_PX, relative)
        if found is None:
            return None
        covariance, _ = found
        error = np.linalg.cholesky(covariance) @ np.random.default_rng(seed).standard_normal(6)
        pose = TargetPose(
            position + error[:3], rotations.multiply(q, rotations.exp(error[3:])), covariance, SIGMA_PX
        )
        return PerceptionResult((pose,), table.ids[seen], self._camera.distort(px[seen]), ())

    def _by_range(self, position: Array, q: Array, seed: tuple[int, int]) -> PerceptionResult | None:
        """Return the pose from bearing, range and the attitude that the target sends; None out of the image or of reach."""
        ranging, camera = self._ranging, self._camera
        distance = float(np.linalg.norm(position))
        if ranging is None or distance > ranging.reach_m:
            return None
        u, v = camera.project_ideal(position[None])[0]
        if not (0.0 <= u <= camera.width_px - 1.0 and 0.0 <= v <= camera.height_px - 1.0):
            return None
        along = position / distance
        range_m = np.hypot(ranging.range_noise_m, ranging.range_share * distance)
        across_m = math.radians(ranging.bearing_noise_deg) * distance
        covariance = np.zeros((6, 6))
        line = np.outer(along, along)
        covariance[:3, :3] = range_m**2 * line + across_m**2 * (np.eye(3) - line)
        covariance[3:, 3:] = math.radians(ranging.attitude_noise_deg) ** 2 * np.eye(3)
        error = np.linalg.cholesky(covariance) @ np.random.default_rng(seed).standard_normal(6)
        sigma_px = math.radians(ranging.bearing_noise_deg) * camera.fx_px
        pose = TargetPose(
            position + error[:3], rotations.multiply(q, rotations.exp(error[3:])), covariance, sigma_px
        )
        return PerceptionResult((pose,), _NOTHING.marker_ids, _NOTHING.corners_px, ())

    def _visible(self, px: Array, side_px: Array, rotation: Array, position: Array) -> NDArray[np.bool_]:
        """Return which markers (m,) are detected, from their corners' ideal pixels (m, 4, 2), shortest sides and the pose."""
        table, camera = self._table, self._camera
        centres = table.origins @ rotation.T + position
        towards = -np.einsum("ij,ij->i", table.normals @ rotation.T, centres)
        cosine = towards / np.sqrt(np.einsum("ij,ij->i", centres, centres))
        low, high = px.min(axis=(1, 2)), px.max(axis=1)
        right, bottom = camera.width_px - 1.0 - _MARGIN_PX, camera.height_px - 1.0 - _MARGIN_PX
        inside = (low >= _MARGIN_PX) & (high[:, 0] <= right) & (high[:, 1] <= bottom)
        seen = inside & (cosine > MIN_COSINE) & (side_px >= MIN_SIDE_PX)
        if seen.sum() == 1 and cosine[seen][0] < MIN_SINGLE_COSINE:
            seen[:] = False
        return seen
