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
            # both fits agree to ``agreement_px`` and ``agreement_sigmas`` of the fit without it.
            "strip_px", "partial_px", "least_fall", "agreement_px", "agreement_sigmas",
            # Prior of an edge's blur (pixel and lens together): mean and standard deviation of the
            # logarithm of its sigma in px.
            "log_edge_sigma", "edge_sigma_spread",
            # Prior of the change of the light along a side, as a share: standard deviation.
            "fade_spread",
            # Columns whose pixels are taken for independent, beside those of a marker, which tell
            # how alike their errors are.
            "alike_columns",
            "rounds", "iterations", "strip_iterations",
            # Standard deviation, px, of a side's line beyond what the noise of its pixels explains.
            # At each end by itself: of any side, and of one along rows or columns of pixels, by 1 +
            # 2 n if it crosses n of them. Of the whole line: with cells 1 px wide, by the inverse
            # square of the width; with a border 1 px wide, and with one whose outer edge is fitted,
            # likewise; with a fitted outer edge that neighbours cut, outwards on all sides, and
            # otherwise. Share of the first three variances that all lines of an image have in
            # common. For each unit by which the logarithm of the blur differs from the prior by
            # more than ``free_blur``; and if it is larger, and only the fit with the outer edge is
            # there, as where something brighter adjoins.
            "least_sigma_px", "aligned_sigma_px", "fine_sigma_px", "border_sigma_px",
            "outer_sigma_px", "cut_sigma_px", "cut_spread_px", "common_share",
            "free_blur", "blur_sigma_px", "adjoining_sigma_px",
        )
    ]  # fmt: skip


# Values by the least corner errors in rendered images (benchmarks/perception.py, ``markers``);
# standard deviations by the lines' errors there and in photographs of sheets
# (docs/evidence/cameras.md#errors-of-corners).
SETTINGS = _Settings(
    0.45, 1.25,
    8.0, 0.4, 4.0,
    0.1, 0.9, 8, 11, 3.5, 0.6,
    48, 2.5, 0.2,
    2.75, 1.2, 1.5,
    2.5, 1.5, 0.25, 0.08, 3.0,
    float(np.log(0.67)), 0.15,
    0.03, 32.0,
    2, 2, 4,
    0.003, 0.015, 0.23, 0.08,
    0.045, 0.3, 0.15, 0.2,
    0.08, 0.03, 1.2,
)  # fmt: skip

# Corners of a unit square, as those of a marker.
_SQUARE = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], dtype=np.float32)


@dataclass(frozen=True)
class CornerErrors:
    """What is known of the errors of the corners of n markers, ideal px.

    ``whitening`` (n, 8, 8): turns those of a marker's corners, without what all markers of an image
    have in common, into independent ones of unit variance. ``common`` (n, 8): what the common
    error, of unit variance, is by that.
    """

    whitening: Array
    common: Array

    @staticmethod
    def even(sigma_px: Array) -> CornerErrors:
        """Return independent errors of standard deviation ``sigma_px`` (n,)."""
        sigma = np.asarray(sigma_px, dtype=float)[:, None, None]
        return CornerErrors(np.eye(8) / sigma, np.zeros((len(sigma), 8)))

    @staticmethod
    def of_places(sigma_px: Array) -> CornerErrors:
        """Return those of markers of which only the place is known, to ``sigma_px`` (n,) along both
        axes: four corners move together.
        """
        white = np.zeros((len(sigma_px), 8, 8))
        white[:, 0, 0::2] = white[:, 1, 1::2] = 0.25 / np.asarray(sigma_px, dtype=float)[:, None]
        return CornerErrors(white, np.zeros((len(white), 8)))

    def part(self, which: NDArray[np.bool_] | NDArray[np.intp] | list[int]) -> CornerErrors:
        """Return those of the markers selected by ``which``."""
        return CornerErrors(self.whitening[which], self.common[which])

    def followed_by(self, others: CornerErrors) -> CornerErrors:
        """Return those of these markers and of others."""
        return CornerErrors(
            np.concatenate([self.whitening, others.whitening]),
            np.concatenate([self.common, others.common]),
        )

    def with_others(
        self, which: NDArray[np.bool_] | NDArray[np.intp], others: CornerErrors
    ) -> CornerErrors:
        """Return a copy in which ``others`` replace the markers ``which`` (n,)."""
        white, common = self.whitening.copy(), self.common.copy()
        white[which], common[which] = others.whitening, others.common
        return CornerErrors(white, common)

    def weighted(self, weights: Array) -> CornerErrors:
        """Return them with the whitened errors times ``weights`` (n, 8)."""
        return CornerErrors(self.whitening * weights[:, :, None], self.common * weights)


@dataclass(frozen=True)
class Refined:
    """Refined corners of n markers.

    ``corners_px`` (n, 4, 2): ideal pixels; unchanged for markers that are not ``good``. ``good``
    (n,): all four sides are usable. ``errors``: of the corners.
    """

    corners_px: Array
    good: NDArray[np.bool_]
    errors: CornerErrors

    def part(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Refined:
        """Return the markers selected by ``which`` (n,)."""
        return Refined(self.corners_px[which], self.good[which], self.errors.part(which))

    def with_others(self, which: NDArray[np.bool_] | NDArray[np.intp], others: Refined) -> Refined:
        """Return a copy in which ``others`` replace the markers ``which`` (n,)."""
        corners, good = self.corners_px.copy(), self.good.copy()
        corners[which], good[which] = others.corners_px, others.good
        return Refined(corners, good, self.errors.with_others(which, others.errors))


COARSE_PX, COARSE_SHARE = 1.0, 0.06
"""Error of a detector's corner, px, least and as a share of the marker's side."""


def coarse_sigma_px(camera: Camera, corners_ideal_px: Array) -> Array:
    """Return the standard deviation (n,), ideal px, of corners (n, 4, 2) as the detector finds
    them.
    """
    stretch = strong_stretch(camera, corners_ideal_px.mean(axis=1))
    return np.maximum(COARSE_PX * stretch, COARSE_SHARE * mean_side_px(corners_ideal_px))


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
    good = np.zeros(n, dtype=np.uint8)
    white, common = np.zeros((n, 8, 8)), np.zeros((n, 8))
    k = camera
    matrix = (c_double * 4)(k.fx_px, k.fy_px, k.cx_px, k.cy_px)
    lens = byref(native_lens(camera)) if camera.distorts else None
    function("refine_corners")(
        c_void_p(image.ctypes.data), c_int64(image.shape[0]), c_int64(image.shape[1]),
        matrix, lens, address(frames.to_ray), address(frames.framed), byref(SETTINGS),
        c_double(cells),
        c_int64(n), address(margin), address(ends), address(corners), address(good),
        address(white), address(common),
    )  # fmt: skip
    errors = CornerErrors(frames.whitening_of(white, corners), common)
    return Refined(frames.out_of(corners), good.view(np.bool_), errors)
