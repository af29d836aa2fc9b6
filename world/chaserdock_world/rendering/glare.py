# SPDX-License-Identifier: Apache-2.0
"""Add the glare of the sun in or near the image: its disc, and stray light in the lens."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import NDArray

from .scene_geometry import Obstacle

SUN_RADIUS_RAD = 0.00465
"""Angular radius of the sun at 1 AU, rad (696,000 km of 149.6 million km)."""
_STEP_PX = 4
"""Step of the grid, px, on which stray light is computed and interpolated. It changes slowly but
for the sun itself, which is drawn.
"""


class Glare:
    """Add the sun's disc, and stray light that falls with the squared angle from the sun.

    ``level_at_1_deg``: grey levels at one degree (W. S. Stiles, J. Holladay, 1929).
    """

    def __init__(self, camera: Camera, level_at_1_deg: float):
        self._camera, self._level = camera, level_at_1_deg
        width, height = camera.width_px, camera.height_px
        columns, rows = -(-width // _STEP_PX), -(-height // _STEP_PX)
        u = (np.arange(columns) + 0.5) * width / columns - 0.5
        v = (np.arange(rows) + 0.5) * height / rows - 0.5
        ideal = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
        x, y = (
            (ideal[..., 0] - camera.cx_px) / camera.fx_px,
            (ideal[..., 1] - camera.cy_px) / camera.fy_px,
        )
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        # Beyond the lens no light arrives: a ray of 0 is at 80 degrees from every sun.
        self._rays = np.nan_to_num(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def add(self, image: NDArray[np.uint8], to_sun_irf: Array) -> NDArray[np.uint8]:
        """Return the image (h, w) with the sun in direction ``to_sun_irf`` (3,), a unit vector.

        Returns ``image`` itself if the sun is behind the camera.
        """
        if to_sun_irf[2] <= 0.0:
            return image
        # The squared angle is 2 (1 - cos), to 1 % up to 20 degrees.
        angle2 = np.maximum(2.0 * (1.0 - self._rays @ to_sun_irf), SUN_RADIUS_RAD**2)
        stray = np.minimum(self._level * np.deg2rad(1.0) ** 2 / angle2, 255.0).astype(np.float32)
        size = (image.shape[1], image.shape[0])
        scattered = np.rint(cv2.resize(stray, size, interpolation=cv2.INTER_LINEAR)).astype(
            np.uint8
        )
        out = np.asarray(cv2.add(image, scattered), dtype=np.uint8)
        px = self._camera.project(to_sun_irf)
        radius_px = self._camera.fx_px * SUN_RADIUS_RAD
        if np.all(np.abs(px) < 1e4):
            centre = np.rint(px * 16.0).astype(int).tolist()
            cv2.circle(out, (centre[0], centre[1]), round(16.0 * radius_px), 255, -1, cv2.LINE_8, 4)
        return out


def is_occluded(origin_w_m: Array, direction_w: Array, bodies: Sequence[Obstacle]) -> bool:
    """Return whether a ray from ``origin_w_m`` (3,) along ``direction_w`` (3,) hits a box of the
    bodies.

    By the slab method.
    """
    for boxes, p_w, q_w in bodies:
        for box in boxes:
            q = rotations.multiply(q_w, box.q_wxyz)
            centre = np.asarray(p_w) + rotations.rotate(q_w, box.position_m)
            start = rotations.rotate_inverse(q, origin_w_m - centre)
            along = rotations.rotate_inverse(q, direction_w)
            along = np.where(np.abs(along) < 1e-12, 1e-12, along)
            half = np.array(box.size_m) / 2.0
            a, b = (-half - start) / along, (half - start) / along
            first, last = float(np.minimum(a, b).max()), float(np.maximum(a, b).min())
            if last > max(first, 0.0):
                return True
    return False
