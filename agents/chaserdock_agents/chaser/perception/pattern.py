# SPDX-License-Identifier: Apache-2.0
"""Fit the corners of small markers to the grey levels of all their cells.

With cells of a few pixels the line of a single side is easily drawn to an edge of an inner cell.
Here the known cells, black border and white margin, blurred by lens and pixel, are compared with
all pixels of a marker at once: Gauss-Newton over the homography, blur and levels. The arithmetic
is in C (native/pattern.c).
"""

from __future__ import annotations

from ctypes import Structure, byref, c_double, c_int64, c_void_p

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from numpy.typing import NDArray

from .corners import SETTINGS, CornerErrors, Refined, mean_side_px
from .lens import MarkerFrames, native_lens, strong_stretch
from .native import LIBRARY, function

SMALL_CELL_PX = 5.0
"""Width of a cell, px, below which markers are fitted so: the errors of corners are a sixth of
those of sides with cells of 1 to 2 px, a quarter with 2 to 3, a half with 3 to 5. Wider: more time
for less."""
ENOUGH = 6
"""Markers in one image beyond which further ones hardly improve the pose: no further one is fitted
so. More: time, 0.2 ms each."""
LEAST_SIGMA = 0.0015
"""Standard deviation of each coordinate beyond what the residuals of pixels tell, as a share of a
cell: the NEES of poses from markers with cells of 3 to 5 px. Larger: far poses are better than
they state; smaller: near ones are worse."""


@LIBRARY.structure("PatternSettings")
class _PatternSettings(Structure):
    """Mirror `PatternSettings` of native/pattern.c."""

    _fields_ = [
        (name, c_double) for name in (
            # Prior of the blur: as for sides (`corners.SETTINGS`).
            "log_sigma", "sigma_spread",
            # Of a white border that does not end on all sides where it is said to: length before
            # its end from which on pixels are not used, and largest used width, px.
            "clear_px", "reach_px",
            # Least share of the variance of the pixels that the pattern explains; largest
            # correction of a corner, px; least contrast, grey levels.
            "least_explained", "max_move_px", "min_contrast",
            # Largest correction after which the fit has settled, px; most iterations.
            "settled_px", "iterations",
        )
    ]  # fmt: skip


# By errors of corners in rendered images (benchmarks/perception.py, ``markers-corners``). With fits
# that start up to a pixel off, 98 % of right ones explain more, and 6 of 7 wrong ones less.
_SETTINGS = _PatternSettings(
    SETTINGS.log_edge_sigma, SETTINGS.edge_sigma_spread,
    1.0, 2.5,
    0.85, SETTINGS.max_move_px, SETTINGS.min_contrast,
    0.05, 8,
)  # fmt: skip


def which_to_fit(
    camera: Camera, corners_ideal_px: Array, cells: int, known: int = 0
) -> NDArray[np.intp]:
    """Return the markers (n, 4, 2) to be fitted so: small ones, the largest first, as many as
    larger and ``known`` ones leave of `ENOUGH`.
    """
    side_px = mean_side_px(corners_ideal_px) / strong_stretch(camera, corners_ideal_px.mean(axis=1))
    small = np.flatnonzero(side_px < SMALL_CELL_PX * cells)
    left = max(ENOUGH - known - (len(side_px) - len(small)), 0)
    return small[np.argsort(-side_px[small], kind="stable")[:left]]


def fit(
    image: NDArray[np.uint8],
    camera: Camera,
    corners_ideal_px: Array,
    white: NDArray[np.uint8],
    margin_share: Array,
    outlined: NDArray[np.bool_],
) -> Refined:
    """Fit the corners of n markers; those whose pixels are not explained are not good.

    Arguments as for `corners.refine`; ``white`` (n, cells, cells): 1 for white cells.
    """
    frames, n = MarkerFrames.of(camera, corners_ideal_px), len(corners_ideal_px)
    corners = np.array(frames.into(corners_ideal_px), dtype=float, order="C")
    image, margin = np.ascontiguousarray(image), np.array(margin_share, dtype=float, order="C")
    ends, white = np.array(outlined, dtype=np.uint8, order="C"), np.ascontiguousarray(white)
    explained, covariance = np.zeros(n), np.tile(np.eye(8), (n, 1, 1))
    function("fit_patterns")(
        c_void_p(image.ctypes.data), c_int64(image.shape[0]), c_int64(image.shape[1]),
        (c_double * 4)(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
        byref(native_lens(camera)) if camera.distorts else None,
        address(frames.to_ray), address(frames.framed), byref(_SETTINGS),
        c_int64(white.shape[1]), c_int64(n), address(margin), address(ends), address(white),
        address(corners), address(explained), address(covariance),
    )  # fmt: skip
    least_px = LEAST_SIGMA * mean_side_px(corners) / white.shape[1]
    roots = np.linalg.cholesky(covariance + (least_px**2)[:, None, None] * np.eye(8))
    own = np.asarray(np.linalg.inv(roots), dtype=float)
    errors = CornerErrors(frames.whitening_of(own, corners), np.zeros((n, 8)))
    return Refined(frames.out_of(corners), explained > 0.0, errors)
