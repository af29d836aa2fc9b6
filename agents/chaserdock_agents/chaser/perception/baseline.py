# SPDX-License-Identifier: Apache-2.0
"""Run the perception of the paper as a baseline: undistort the image, ArUco, EPnP on all corners.

Fourlas et al., "Vision Based Docking of Multiple Satellites with an Uncooperative Target", IFAC
2023, sec. 4. Corners by OpenCV's sub-pixel refinement. EPnP is OpenCV's and fails on about half of
the views of a single face; that is part of the baseline. The authors' public code calls OpenCV's
``estimatePoseBoard`` instead, which is the iterative PnP without an initial guess. The only check
is that the result is a finite pose in front of the camera.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import NDArray

from . import pnp
from .corners import CornerErrors
from .detect import NOTHING, Detections
from .refine import PoseInCamera

LEAST_SIGMA_PX = 0.015  # of a corner: no corner in an image is better (docs/evidence/cameras.md)


def detect(
    image: NDArray[np.uint8], camera: Camera, dictionary: cv2.aruco.Dictionary
) -> Detections:
    """Detect markers with OpenCV's default settings and sub-pixel corners, in ideal pixels."""
    if camera.distorts:
        image = np.asarray(cv2.remap(image, *_maps(camera), cv2.INTER_LINEAR), dtype=np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if ids is None or len(ids) == 0:
        return NOTHING
    return Detections(
        np.asarray(ids, dtype=np.int64).ravel(), np.array(corners, dtype=float).reshape(-1, 4, 2)
    )


@lru_cache(maxsize=4)
def _maps(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the pixel of the image, x and y (h, w), of each ideal pixel; outside of the image
    where the lens images nothing.
    """
    grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
    px = np.nan_to_num(camera.distort(grid), nan=-10.0).astype(np.float32)
    return np.ascontiguousarray(px[..., 0]), np.ascontiguousarray(px[..., 1])


def solve(
    camera: Camera, points_trf_m: Array, corners_ideal_px: Array, iterative: bool = False
) -> tuple[pnp.TargetPose, ...]:
    """Estimate the pose by EPnP or iterative PnP from the corners of all markers.

    ``corners_ideal_px`` (n, 4, 2): ideal pixels. ``points_trf_m`` (n, 4, 3): the same corners in
    TRF. Returns one pose, or none if it is not finite or behind the camera; its covariance is
    first-order, from its residuals.
    """
    if not len(points_trf_m):
        return ()
    points, pixels = points_trf_m.reshape(-1, 3), corners_ideal_px.reshape(-1, 2)
    try:
        method = cv2.SOLVEPNP_ITERATIVE if iterative else cv2.SOLVEPNP_EPNP
        ok, rvec, tvec = cv2.solvePnP(points, pixels, camera.matrix(), None, flags=method)
    except cv2.error:  # degenerate corners
        return ()
    position = np.asarray(tvec, dtype=float).ravel()
    rotation = np.asarray(cv2.Rodrigues(rvec)[0], dtype=float)
    if not ok or not np.all(np.isfinite(position)) or not np.all(np.isfinite(rotation)):
        return ()
    pose, unweighted = (
        PoseInCamera(position, rotation),
        CornerErrors.even(np.ones(len(points_trf_m))),
    )
    result = pnp.pose_covariance(camera, points_trf_m, corners_ideal_px, unweighted, pose)
    if result is None:
        return ()
    covariance = max(LEAST_SIGMA_PX**2, result[2] / (2 * len(points) - 6)) * result[0]
    rms = pnp.reprojection_rms_px(camera, points, pixels, position, rotation)
    return (pnp.TargetPose(position, rotations.from_matrix(rotation), covariance, rms),)
