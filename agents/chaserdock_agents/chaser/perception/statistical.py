# SPDX-License-Identifier: Apache-2.0
"""Draw the measured pose around the true one, with the errors that rendered images have.

Markers count as seen if they are large enough, face the camera and lie in the image. The errors of
the lines of their sides, as `corners` states them in rendered images, for small markers `pattern`,
give the covariance of the pose, as in ``pnp``, and the error is drawn from it.
``tests/missions/test_statistical.py`` compares both with rendered images. Where no marker is seen,
``[ranging]`` gives bearing, range and attitude.
"""

from __future__ import annotations

from ctypes import Structure, byref, c_double, c_int64

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from chaserdock_models.random_numbers import generator
from chaserdock_models.ranging import ranged_pose
from chaserdock_models.targets import TargetModel
from chaserdock_protocol.pose_image import decode_pose
from chaserdock_protocol.scenario.ranging import Ranging
from numpy.typing import ArrayLike, NDArray

from .corners import SETTINGS
from .detect import dictionary_of
from .lens import strong_stretch
from .native import LIBRARY, function
from .pattern import SMALL_CELL_PX
from .pipeline import PerceptionResult
from .pnp import MIN_SINGLE_COSINE, MarkerTable, TargetPose


@LIBRARY.structure("MarkerLimits")
class _MarkerLimits(Structure):
    """Mirror `MarkerLimits` of native/statistical.c."""

    _fields_ = [
        (name, c_double) for name in (
            # Standard deviation of the line fitted to a marker's side, px of the image, over the
            # square root of the lines of pixels across it: of its place, and of the difference of
            # its ends. Of both what small cells add, of 1 px, by the power -1.25 of their width.
            # Most lines of pixels that are fitted.
            "place_px", "slope_px", "fine_place_px", "fine_slope_px", "most_lines",
            # Width of a cell, px, below which a marker is fitted by all its cells (`pattern`), and
            # the two standard deviations of such a marker, to which nothing is added.
            "small_cell_px", "small_place_px", "small_slope_px",
            # Cells along a side; least width of one, px, and least cosine of the viewing angle of
            # a marker that is read where others put it.
            "cells", "least_cell_px", "least_cosine",
            # Least side, px, and cosine of one that is found by itself; that of a single one.
            "least_side_px", "least_cosine_found", "least_cosine_single",
            # Least distance from the border of the image, px: part of the white border must be in
            # view. Larger: the target is lost sooner at the border of the image.
            "margin_px",
        )
    ]  # fmt: skip


REPROJECTION_RMS_PX = 0.05
"""Stated root of the mean squared distance of corners from the pose, px: a median of images."""
_NOTHING = PerceptionResult((), np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), ())


class StatisticalPerception:
    """Measure the pose that an image of ``pose_image`` contains. Stateless, as `Perception`."""

    def __init__(self, camera: Camera, model: TargetModel, ranging: Ranging | None = None) -> None:
        self._camera, self._ranging = camera, ranging.errors() if ranging else None
        self._table = MarkerTable.of(model)
        cells = dictionary_of(model.dictionary).markerSize + 2
        self._limits = _MarkerLimits(
            0.0625, 0.187, 0.6, 0.9, SETTINGS.columns,
            SMALL_CELL_PX, 0.05, 0.1,
            cells, 1.2, 0.1, 14.0, 0.3, MIN_SINGLE_COSINE, 2.0,
        )  # fmt: skip
        self._lens = (c_double * 6)(
            camera.fx_px,
            camera.fy_px,
            camera.cx_px,
            camera.cy_px,
            camera.width_px,
            camera.height_px,
        )

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> PerceptionResult:
        """Return one solution, or none if too little of the target is in view.

        Raises ValueError for a rendered image.
        """
        position, q, seed = decode_pose(image)
        white = generator(seed).standard_normal(6)
        table = self._table
        m = len(table.ids)
        pose = np.concatenate([position, rotations.to_matrix(q).ravel()])

        seen, px, covariance, error = (
            np.empty(m, np.int64),
            np.empty((m, 4, 2)),
            np.empty((6, 6)),
            np.empty(6),
        )
        surface, outputs = (
            (table.corners, table.origins, table.normals),
            (seen, px, covariance, error),
        )
        imaged = self._imaged(pose) if self._camera.distorts else (None, None)
        count = function("measure_pose", c_int64)(
            self._lens,
            byref(self._limits),
            *map(address, surface),
            c_int64(m),
            address(pose),
            *(a if a is None else address(a) for a in imaged),
            *map(address, (white, *outputs)),
        )

        if count < 0:
            return _NOTHING
        if count == 0:
            return self._by_range(position, q, white) or _NOTHING

        found = TargetPose(
            position + error[:3],
            rotations.multiply(q, rotations.exp(error[3:])),
            covariance,
            REPROJECTION_RMS_PX,
        )
        used = seen != 0
        return PerceptionResult((found,), table.ids[used], self._camera.distort(px[used]), ())

    def _imaged(self, pose: Array) -> tuple[Array, Array]:
        """Return the pixels of all corners in the image (m, 4, 2), and the stretch of the image at
        each marker (m,).
        """
        turn, position = pose[3:].reshape(3, 3), pose[:3]
        with np.errstate(invalid="ignore"):
            px = self._camera.project(self._table.corners @ turn.T + position)
            centres = self._camera.project_ideal(self._table.origins @ turn.T + position)
            return px, strong_stretch(self._camera, centres)

    def _by_range(self, position: Array, q: Array, white: Array) -> PerceptionResult | None:
        """Return the pose from bearing, range and the attitude that the target sends.

        None out of the image or of reach.
        """
        found = (
            None
            if self._ranging is None
            else ranged_pose(self._ranging, self._camera, position, q, white)
        )
        if found is None:
            return None
        pose = TargetPose(found.position_m, found.q_wxyz, found.covariance, found.bearing_px)
        return PerceptionResult((pose,), _NOTHING.marker_ids, _NOTHING.corners_px, ())
