# SPDX-License-Identifier: Apache-2.0
"""Simulate the lens: point spread, and the mapping from the ideal image to the distorted one."""

from __future__ import annotations

import math

import cv2
import numpy as np
from chaserdock_models.camera import Camera
from numpy.typing import NDArray


def spread_points(image: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    """Return an image (h, w) blurred by a Gaussian with this standard deviation; itself if that is
    0.
    """
    if sigma_px == 0.0:
        return image
    size = (2 * math.ceil(3.0 * sigma_px) + 1,) * 2
    blurred = cv2.GaussianBlur(image, size, sigma_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.uint8)


class Lens:
    """Map the ideal image, which renderers draw, to the distorted image of ``camera``.

    ``origin_px`` (2,): ideal pixel coordinates of the ideal image's first pixel. ``size_px``: its
    width and height, larger than the frame where the lens covers more. Raises ValueError if the
    distortion is not invertible everywhere in the image.
    """

    def __init__(self, camera: Camera):
        self.camera = camera
        self.origin_px = np.zeros(2)
        self.size_px = (camera.width_px, camera.height_px)
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if any(camera.distortion):
            self._make_maps()

    def _make_maps(self) -> None:
        width, height = self.size_px
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
        # Camera.undistort is too slow for a million points.
        matrix = self.camera.matrix()
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        undistorted = cv2.undistortPoints(
            grid.reshape(-1, 1, 2),
            matrix,
            np.array(self.camera.distortion),
            None,
            None,
            matrix,
            criteria=criteria,
        )
        ideal = np.asarray(undistorted, dtype=float).reshape(grid.shape)
        if not np.all(np.abs(self.camera.distort(ideal) - grid) < 1e-3):
            raise ValueError("the lens distortion cannot be inverted everywhere in the image")
        low = np.floor(ideal.min(axis=(0, 1))) - 1.0
        high = np.ceil(ideal.max(axis=(0, 1))) + 2.0
        if np.any(high - low > 4.0 * np.array(self.size_px)):
            raise ValueError("the lens distortion is too strong to be rendered")
        self.origin_px = low
        self.size_px = (int(high[0] - low[0]), int(high[1] - low[1]))
        maps = (ideal - low).astype(np.float32)
        self._maps = (np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1]))

    def distort(self, ideal: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the distorted image (h, w) of an ideal image of ``size_px``.

        Without distortion it is the ideal image itself.
        """
        if self._maps is None:
            return ideal
        return np.asarray(cv2.remap(ideal, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
