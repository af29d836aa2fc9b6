"""The ideal image behind a lens: how large it must be, and how the lens distorts it."""

from __future__ import annotations

import cv2
import numpy as np
from chaserdock_models.camera import Camera
from numpy.typing import NDArray


class Lens:
    """What lies between the ideal image, which renderers draw, and the image that ``camera`` takes.

    ``origin_px`` (2,): ideal pixel of the ideal image's first one; ``size_px``: its width and height, which
    reach beyond the frame where the lens shows more. Raises ValueError when the camera's distortion cannot be
    inverted everywhere in the image.
    """

    def __init__(self, camera: Camera):
        self.camera = camera
        self.origin_px = np.zeros(2)
        self.size_px = (camera.width_px, camera.height_px)
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if any(camera.distortion):
            self._prepare()

    def _prepare(self) -> None:
        width, height = self.size_px
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
        # As Camera.undistort, which is slow for a million points.
        matrix = self.camera.matrix()
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        found = cv2.undistortPoints(
            grid.reshape(-1, 1, 2),
            matrix,
            np.array(self.camera.distortion),
            None,
            None,
            matrix,
            criteria=criteria,
        )
        ideal = np.asarray(found, dtype=float).reshape(grid.shape)
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

    def distorted(self, ideal: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (h, w) that the camera takes of an ideal image of ``size_px``; itself without distortion."""
        if self._maps is None:
            return ideal
        return np.asarray(cv2.remap(ideal, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
