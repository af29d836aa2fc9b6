# SPDX-License-Identifier: Apache-2.0
"""Simulate the lens: point spread, and the mapping from the ideal image to the distorted one."""

from __future__ import annotations

import math
from ctypes import c_int64, c_void_p
from functools import lru_cache

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from numpy.typing import NDArray

from .background import SPACE_LEVEL, Sky
from .native import function

_CANVAS_MOST = 4.0
"""Largest ideal image, in widths and heights of the image: 77 and 74 degrees from the axis for a
fisheye of 640 x 480 with 285 px. It bounds memory and time."""
_WEAK_STRETCH, _STRETCH_STEP_PX = 1.5, 8
"""A lens is sampled once a pixel where a pixel covers at most so many ideal ones along a side,
which draws edges within 0.01 px; looked at on a grid of this step."""
_STRONG_SAMPLES = 3
"""Otherwise so many samples along a pixel: at 60 degrees from a fisheye's axis it covers 4 x 1.7
ideal pixels."""
_STAR_PIXELS = 10_000
"""Pixels of an image that are blurred in the time of one star alone, 10 us: most of it is calls."""
_OUTSIDE = -1e4
"""Coordinate outside of every image."""


def spread_points(image: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    """Return an image (h, w) blurred by a Gaussian with this standard deviation; itself if that is
    0.
    """
    if sigma_px == 0.0:
        return image
    size = (2 * math.ceil(3.0 * sigma_px) + 1,) * 2
    blurred = cv2.GaussianBlur(image, size, sigma_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.uint8)


def spread_and_halve(fine: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    """Return an image (2h, 2w) blurred as by `spread_points`, with each square of four pixels
    averaged: in one pass (native/blur.c), rounded once.
    """
    weights = _halving_weights(sigma_px)
    height, width, reach = fine.shape[0] // 2, fine.shape[1] // 2, len(weights) // 2 - 1
    out = np.empty((height, width), dtype=np.uint8)
    work = np.empty(4 * (width + reach + 1), dtype=np.uint16)
    fine = np.ascontiguousarray(fine)
    function("spread_and_halve")(
        c_void_p(fine.ctypes.data), c_int64(height), c_int64(width), address(weights),
        c_int64(reach), address(out), address(work),
    )  # fmt: skip
    return out


@lru_cache(maxsize=64)
def _halving_weights(sigma_px: float) -> NDArray[np.uint16]:
    """Return the weights (2n + 2,) of samples in a pixel's mean along one axis, which add up to
    256.
    """
    reach = math.ceil(3.0 * sigma_px)
    away = np.arange(-reach, reach + 1.0)
    spread = np.exp(-0.5 * np.square(away / sigma_px)) if sigma_px > 0.0 else np.ones(1)
    exact = np.convolve(spread / spread.sum(), [0.5, 0.5])
    # Rounding the sums from an end to the middle leaves no error in what the weights add up to.
    half = np.diff(np.rint(256.0 * np.cumsum(exact[: reach + 1])), prepend=0.0)
    return np.concatenate([half, half[::-1]]).astype(np.uint16)


def spread_sky(sky: Sky, sigma_px: float) -> NDArray[np.uint8]:
    """Return the same as `spread_points` of a sky's image; of a large one in a fifth of its time
    where only stars are in view, as all else is unchanged.
    """
    stars = sky.stars
    if stars is None or sigma_px == 0.0 or sky.image.size < len(stars) * _STAR_PIXELS:
        return spread_points(sky.image, sigma_px)
    reach, out = math.ceil(3.0 * sigma_px), sky.image.copy()
    for x, y in stars.tolist():
        x0, y0 = max(x - 2 * reach, 0), max(y - 2 * reach, 0)
        around = spread_points(sky.image[y0 : y + 2 * reach + 1, x0 : x + 2 * reach + 1], sigma_px)
        left, top = max(x - reach, 0), max(y - reach, 0)
        inner = around[top - y0 : y - y0 + reach + 1, left - x0 : x - x0 + reach + 1]
        out[top : y + reach + 1, left : x + reach + 1] = inner
    return out


class LensMap:
    """Map the ideal image, which renderers draw, to the distorted image of ``camera``.

    ``point_spread_px``: standard deviation of the lens' Gaussian blur. ``origin_px`` (2,): ideal
    pixel coordinates of the ideal image's first pixel; ``size_px``: its width and height, larger
    than the frame where the lens covers more. ``canvas_spread_px``: the blur of the ideal image.
    The image is black where the lens images nothing, and beyond ``_CANVAS_MOST``.
    """

    def __init__(self, camera: Camera, point_spread_px: float = 0.0):
        self.camera = camera
        self.origin_px = np.zeros(2)
        self.size_px = (camera.width_px, camera.height_px)
        self.canvas_spread_px, self._spread_px = point_spread_px, 0.0
        self._samples = 1
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if camera.distorts:
            self._make_maps()

    def _make_maps(self) -> None:
        ideal = self._ideal_pixels()
        stretch = self.camera.stretch(ideal[::_STRETCH_STEP_PX, ::_STRETCH_STEP_PX])
        if np.nanmax(stretch) > _WEAK_STRETCH:
            # A pixel covers several of the ideal image: it averages them, and then comes the blur.
            self._samples = _STRONG_SAMPLES
            self.canvas_spread_px, self._spread_px = 0.0, self.canvas_spread_px
            ideal = self._between(ideal)
        else:
            ideal = ideal[1:-1, 1:-1]
        low = np.floor(np.nanmin(ideal, axis=(0, 1))) - 1.0
        high = np.ceil(np.nanmax(ideal, axis=(0, 1))) + 2.0
        self.origin_px = low
        self.size_px = (int(high[0] - low[0]), int(high[1] - low[1]))
        maps = np.nan_to_num(ideal - low, nan=_OUTSIDE).astype(np.float32)
        self._maps = (np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1]))

    def _ideal_pixels(self) -> Array:
        """Return the ideal pixels (h + 2, w + 2, 2) of the image and one pixel around it; NaN where
        nothing is drawn.
        """
        camera = self.camera
        width, height = camera.width_px, camera.height_px
        grid = np.stack(
            np.meshgrid(np.arange(-1.0, width + 1.0), np.arange(-1.0, height + 1.0)), axis=-1
        )
        if camera.lens_model == "perspective" and math.isinf(camera.lens.valid_radius):
            # Faster for a million points than Camera.undistort.
            matrix = camera.matrix()
            criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
            coefficients = np.array(camera.distortion)
            ideal = np.asarray(
                cv2.undistortPoints(
                    grid.reshape(-1, 1, 2), matrix, coefficients, None, None, matrix,
                    criteria=criteria,
                ),
                dtype=float,
            ).reshape(grid.shape)  # fmt: skip
            with np.errstate(invalid="ignore", over="ignore"):
                missed = ~np.all(np.abs(camera.distort(ideal) - grid) < 1e-3, axis=-1)
            ideal[missed] = camera.undistort(grid[missed])
        else:
            ideal = camera.undistort(grid)
        middle = 0.5 * np.array([width - 1.0, height - 1.0])
        most = 0.5 * _CANVAS_MOST * np.array([width, height])
        with np.errstate(invalid="ignore"):
            ideal[np.any(np.abs(ideal - middle) > most, axis=-1)] = np.nan
        return ideal

    def _between(self, ideal: Array) -> Array:
        """Return the ideal pixels of samples within the pixels, by linear interpolation: within
        0.01 px, as the lens is smooth.
        """
        n = self._samples
        size = (n * ideal.shape[1], n * ideal.shape[0])
        fine = np.asarray(cv2.resize(ideal, size, interpolation=cv2.INTER_LINEAR), dtype=float)
        return fine[n:-n, n:-n]

    def distort(self, ideal: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the distorted image (h, w) of an ideal image of ``size_px``.

        Without distortion it is the ideal image itself.
        """
        if self._maps is None:
            return ideal
        image = np.asarray(
            cv2.remap(ideal, *self._maps, cv2.INTER_CUBIC, borderValue=SPACE_LEVEL),
            dtype=np.uint8,
        )
        if self._samples == 1:
            return image
        size = (self.camera.width_px, self.camera.height_px)
        fine = spread_points(image, self._samples * self._spread_px)
        return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
