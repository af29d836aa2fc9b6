# SPDX-License-Identifier: Apache-2.0
"""Marker corners from lines fitted to the sides, in undistorted coordinates.

Contours and corner filters bias the corners of a black square inwards; the centroid of the grey-level gradient across a
side is unbiased. Sides are curves in the distorted image, so samples are placed on ideal pixels and mapped through the lens.

Where the white border is only a few pixels wide, blur mixes the side with the border's outer edge and biases the centroid
inwards (0.2 px at 1.5 px of border). There the profile of a blurred strip of known width is fitted instead.

The arithmetic is in C (native/corners.c): a few markers are too little work to vectorize with NumPy. cv2.remap is not used
for interpolation: it quantizes coordinates to 1/32 pixel, and the detector's corners are whole pixels, so many samples lie
on the boundary of a step, where rounding errors would decide.
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

from .native import function


class _Settings(Structure):
    """native/corners.c: fields in the order of the C struct."""

    _fields_ = [
        *((name, c_double) for name in (
            # The ends of a side are excluded, as they contain the gradient of the neighbouring side.
            "first", "last",
            # Half length across a side: at most this share of a cell, at least so many pixels.
            "reach_cells", "reach_least_px",
            # Minimum contrast of a row; minimum share of usable rows; maximum correction of a corner.
            "min_contrast", "min_rows_share", "max_move_px",
            # Strips: borders narrower than this; logarithm of an edge's sigma, pixels (pixel, lens and sampling together)
            # and how well that is known, a standard deviation; samples beyond the outer edge.
            "strip_px", "log_edge_sigma", "edge_sigma_spread", "strip_beyond_px",
            # Corners of markers with cells or borders of few pixels are less accurate: relative sigma
            # sqrt(1 + (this / width)^2), fitted to the errors in rendered images.
            "uncertain_px",
        )),
        *((name, c_double * 2) for name in ("rows", "taps", "reach_px", "reweighted")),
        *((name, c_double) for name in ("strip_rows", "strip_taps", "strip_steps")),
    ]  # fmt: skip


_SETTINGS = _Settings(
    0.1, 0.9,
    0.45, 1.25,
    8.0, 0.4, 4.0,
    4.0, float(np.log(0.75)), 0.15, 0.8,
    2.0,
    (8, 20), (11, 13), (3.5, 2.75), (1, 2),
    20, 15, 4,
)  # fmt: skip

_SQUARE = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], dtype=np.float32)


@dataclass(frozen=True)
class Refined:
    """``corners_px`` (n, 4, 2), ideal pixels; ``good`` (n,): markers with four good sides (corners of the others are
    unchanged); ``relative_sigma`` (n,): uncertainty relative to a large marker, at least 1.
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
        corners[which], good[which], sigma[which] = others.corners_px, others.good, others.relative_sigma
        return Refined(corners, good, sigma)


def inside_border(corners_px: Array, margin_share: Array) -> Array:
    """Return the corners (n, 4, 2) of the black squares, given the outer corners of their white borders.

    ``margin_share`` (n,): width of the border over the side of the square.
    """
    inner = [
        cv2.perspectiveTransform(
            _SQUARE[None] / (1.0 + 2.0 * share), cv2.getPerspectiveTransform(_SQUARE, quad.astype(np.float32))
        )[0]
        for quad, share in zip(corners_px, margin_share.tolist(), strict=True)
    ]
    return np.array(inner, dtype=float).reshape(-1, 4, 2)


def refine(
    image: NDArray[np.uint8], camera: Camera, corners_ideal_px: Array, cells: int, margin_share: Array
) -> Refined:
    """Refine corners by lines fitted along the sides of the black squares.

    ``image``: the distorted grey image. ``corners_ideal_px`` (n, 4, 2), ideal pixels: initial corners to within
    about two pixels, clockwise in the image. ``cells``: number of cells along a side, the black
    border included. ``margin_share`` (n,): width of the white border over the side of the marker.
    Raises ValueError for an image less than two pixels wide or high.
    """
    corners = np.array(corners_ideal_px, dtype=float, order="C")
    n = len(corners)
    image, margin = np.ascontiguousarray(image), np.array(margin_share, dtype=float, order="C")
    if min(image.shape) < 2:
        raise ValueError(f"an image of {image.shape} has no corners")
    good, sigma = np.zeros(n, dtype=np.uint8), np.ones(n)
    k = camera
    lens = (c_double * 9)(k.fx_px, k.fy_px, k.cx_px, k.cy_px, *k.distortion)
    function("refine_corners")(
        c_void_p(image.ctypes.data), c_int64(image.shape[0]), c_int64(image.shape[1]),
        lens, c_int64(bool(k.distortion)), byref(_SETTINGS), c_double(cells),
        c_int64(n), address(margin), address(corners), address(good), address(sigma),
    )  # fmt: skip
    return Refined(corners, good.view(np.bool_), sigma)
