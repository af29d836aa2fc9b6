# SPDX-License-Identifier: Apache-2.0
"""Refine marker corners by lines fitted to the sides, in undistorted coordinates.

Contours and corner filters bias the corners of a black square inwards. Here a coarse step moves
each side to the centroids of the grey-level gradient across it. Then the grey levels of the pixels
along a side are fitted by those of a blurred edge; a white border that ends at a known distance is
fitted with its outer edge. Sides are curves in the distorted image, so the place of each pixel is
mapped through the lens; where that compresses the image much, as a fisheye does, sides are fitted
on a plane across the line of sight to the marker (`MarkerFrames`). Pixels are not interpolated:
that would bias an edge by its place between pixels.

The arithmetic is in C (native/corners.c): a few markers are too little work to vectorize with
NumPy.
"""

from __future__ import annotations

from ctypes import Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from numpy.typing import NDArray

from .lens import MarkerFrames, native_lens, strong_stretch
from .native import LIBRARY, function


@LIBRARY.structure("Settings")
class _Settings(Structure):
    """Mirror `Settings` of native/corners.c."""

    _fields_ = [
        (name, c_double) for name in (
            # Both steps: length inwards across a side, as a share of a cell, and its least value in
            # pixels.
            "reach_cells", "reach_least_px",
            # Both steps: least contrast, grey levels; least share of usable lines across a side;
            # largest correction of a corner, px.
            "min_contrast", "min_rows_share", "max_move_px",
            # Coarse step: used part of a side, from and to; lines across it; samples on each;
            # length to either side, px, and as a share of the border.
            "first", "last", "rows", "taps", "coarse_reach_px", "border_share",
            # Fit: lines of pixels across a side; length left out at its ends, px, and at most as a
            # share of the side.
            "columns", "end_px", "end_share",
            # Fit: length outwards across a side, px. It ends this far before a border's outer edge
            # if that is not fitted, and this far beyond it otherwise.
            "reach_px", "clear_px", "beyond_px",
            # A border narrower than ``strip_px`` (``partial_px`` where it ends at neighbours beside
            # a part of the side) is fitted with its outer edge at once. A wider one is so in the
            # last round, if grey levels fall there by ``least_fall`` of the rise at the side, and
            # both fits agree to ``agreement_px``.
            "strip_px", "partial_px", "least_fall", "agreement_px",
            # Prior of an edge's blur (pixel and lens together): mean and standard deviation of the
            # logarithm of its sigma in px.
            "log_edge_sigma", "edge_sigma_spread",
            "rounds", "iterations", "strip_iterations",
            # Corners are less accurate at small cells or borders (px) and at low contrast (grey
            # levels): relative sigma sqrt(1 + (uncertain_px / width)^2 + (uncertain_level /
            # contrast)^2), fitted to the errors in rendered images.
            "uncertain_px", "uncertain_level",
        )
    ]  # fmt: skip


# Values by the least corner errors in rendered images (benchmarks/perception.py, ``markers``).
SETTINGS = _Settings(
    0.45, 1.25,
    8.0, 0.4, 4.0,
    0.1, 0.9, 8, 11, 3.5, 0.6,
    48, 2.5, 0.2,
    2.75, 1.2, 1.5,
    2.5, 1.5, 0.25, 0.08,
    float(np.log(0.67)), 0.15,
    2, 2, 4,
    2.0, 120.0,
)  # fmt: skip

# Corners of a unit square, as those of a marker.
_SQUARE = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], dtype=np.float32)


@dataclass(frozen=True)
class Refined:
    """Refined corners of n markers.

    ``corners_px`` (n, 4, 2): ideal pixels; unchanged for markers that are not ``good``. ``good``
    (n,): all four sides are usable. ``relative_sigma`` (n,): uncertainty relative to a large marker
    of high contrast, at least 1.
    """

    corners_px: Array
    good: NDArray[np.bool_]
    relative_sigma: Array

    def part(self, which: NDArray[np.bool_]) -> Refined:
        """Return the markers selected by ``which`` (n,)."""
        return Refined(self.corners_px[which], self.good[which], self.relative_sigma[which])

    def with_others(self, which: NDArray[np.bool_], others: Refined) -> Refined:
        """Return a copy in which ``others`` replace the markers ``which`` (n,)."""
        corners, good, sigma = self.corners_px.copy(), self.good.copy(), self.relative_sigma.copy()
        corners[which], good[which], sigma[which] = (
            others.corners_px,
            others.good,
            others.relative_sigma,
        )
        return Refined(corners, good, sigma)


@dataclass(frozen=True)
class SmallMarkers:
    """Errors of the corners of markers too small for the fit, and of those that it refuses.

    Fitted to rendered images; checked by benchmarks/perception.py (markers-small).
    """

    # Width of the finer of cell and border, px, below which the error of fitted corners exceeds
    # what their relative sigma states, by a power of the inverse,
    wide_px: float = 3.4
    power: float = 2.5
    # with a border that ends alike on all sides by a lower power,
    outlined_power: float = 1.4
    # up to this factor, half a pixel.
    most: float = 13.0
    # Error of a detector's corner, px, least and as a share of the marker's side.
    coarse_px: float = 1.0
    coarse_share: float = 0.06


SMALL = SmallMarkers()


def small_factor(finest_px: Array, outlined: NDArray[np.bool_]) -> Array:
    """Return the factor (n,), at least 1, of the relative sigma of fitted corners of small markers.

    ``finest_px`` (n,): width of the finer of cell and border; ``outlined`` (n,) as for `refine`.
    """
    power = np.where(outlined, SMALL.outlined_power, SMALL.power)
    return np.clip((SMALL.wide_px / np.maximum(finest_px, 1e-3)) ** power, 1.0, SMALL.most)


def coarse_sigma_px(camera: Camera, corners_ideal_px: Array) -> Array:
    """Return the standard deviation (n,), ideal px, of corners (n, 4, 2) as the detector finds
    them.
    """
    stretch = strong_stretch(camera, corners_ideal_px.mean(axis=1))
    return np.maximum(
        SMALL.coarse_px * stretch, SMALL.coarse_share * mean_side_px(corners_ideal_px)
    )


def mean_side_px(corners_px: Array) -> Array:
    """Return the mean length (n,) of the sides of quadrilaterals (n, 4, 2)."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    return np.linalg.norm(sides, axis=-1).mean(axis=1)


def inside_border(corners_px: Array, margin_share: Array) -> Array:
    """Return the corners (n, 4, 2) of black squares from the outer corners of their white borders.

    ``margin_share`` (n,): width of the border over the side of the square; negative for a square
    outside the given corners.
    """
    inner = [
        cv2.perspectiveTransform(
            _SQUARE[None] / (1.0 + 2.0 * share),
            cv2.getPerspectiveTransform(_SQUARE, quad.astype(np.float32)),
        )[0]
        for quad, share in zip(corners_px, margin_share.tolist(), strict=True)
    ]
    return np.array(inner, dtype=float).reshape(-1, 4, 2)


def refine(
    image: NDArray[np.uint8],
    camera: Camera,
    corners_ideal_px: Array,
    cells: int,
    margin_share: Array,
    outlined: NDArray[np.bool_],
) -> Refined:
    """Refine corners by lines fitted along the sides of the black squares.

    ``image``: the distorted grey image. ``corners_ideal_px`` (n, 4, 2), ideal pixels: initial
    corners to within about two pixels, clockwise in the image. ``cells``: number of cells along a
    side, the black border included. ``margin_share`` (n,): width of the white border over the side
    of the marker. Raises ValueError for an image less than two pixels wide or high.
    """
    frames = MarkerFrames.of(camera, corners_ideal_px)
    corners = np.array(frames.into(corners_ideal_px), dtype=float, order="C")
    n = len(corners)
    image, margin = np.ascontiguousarray(image), np.array(margin_share, dtype=float, order="C")
    ends = np.array(outlined, dtype=np.uint8, order="C")
    if min(image.shape) < 2:
        raise ValueError(f"an image of {image.shape} has no corners")
    good, sigma = np.zeros(n, dtype=np.uint8), np.ones(n)
    k = camera
    matrix = (c_double * 4)(k.fx_px, k.fy_px, k.cx_px, k.cy_px)
    lens = byref(native_lens(camera)) if camera.distorts else None
    function("refine_corners")(
        c_void_p(image.ctypes.data), c_int64(image.shape[0]), c_int64(image.shape[1]),
        matrix, lens, address(frames.to_ray), address(frames.framed), byref(SETTINGS),
        c_double(cells),
        c_int64(n), address(margin), address(ends), address(corners), address(good), address(sigma),
    )  # fmt: skip
    return Refined(frames.out_of(corners), good.view(np.bool_), sigma * frames.stretch)
