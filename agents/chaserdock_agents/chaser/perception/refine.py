# SPDX-License-Identifier: Apache-2.0
"""Refine a pose by Levenberg-Marquardt on the whitened reprojection error."""

from __future__ import annotations

from ctypes import c_double, c_int64
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.native import address

from .native import function

_ZERO = np.zeros(3)


@dataclass(frozen=True)
class PoseInCamera:
    """Pose of a target in the camera: ``position`` (3,) in IRF, metres; ``rotation`` (3, 3), TRF ->
    IRF.
    """

    position: Array
    rotation: Array


def rotation_matrix(rotation_vector: object) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector of three numbers, radians."""
    return np.asarray(cv2.Rodrigues(np.asarray(rotation_vector, dtype=float))[0], dtype=float)


def residual_of(
    matrix: Array, points: Array, pixels: Array, whitening: Array, pose: PoseInCamera
) -> tuple[Array, Array] | None:
    """Return the whitened reprojection error (8n,) of n markers and its Jacobian (8n, 6); None
    behind the camera.

    The Jacobian is by a rotation phi in camera axes, R_true = exp([phi]x) R, and by position.
    ``matrix`` (3, 3) of the camera; ``points`` (n, 4, 3) in TRF, metres; ``pixels`` (n, 4, 2),
    ideal; ``whitening`` (n, 8, 8): of the errors of a marker's corners.
    """
    turned = points.reshape(-1, 3) @ pose.rotation.T
    if not float(turned[:, 2].min()) + float(pose.position[2]) > 1e-6:
        return None
    # With rotated points, OpenCV's derivative by the rotation vector at zero is that by phi.
    projected, jacobian = cv2.projectPoints(turned, _ZERO, pose.position, matrix, None)
    error = (np.ravel(projected) - pixels.ravel()).reshape(-1, 8, 1)
    by = whitening @ jacobian[:, :6].reshape(-1, 8, 6)
    return (whitening @ error).ravel(), by.reshape(-1, 6)


def refine(
    matrix: Array, points: Array, pixels: Array, whitening: Array, pose: PoseInCamera
) -> PoseInCamera | None:
    """Return the pose of least whitened squared error near ``pose``; None behind the camera.

    Arguments as for `residual_of`; implemented in native/pose.c.
    """
    lens = (c_double * 4)(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    given = [np.ascontiguousarray(a, dtype=float) for a in (points, pixels, whitening)]
    out = np.empty(12)
    out[:3], out[3:] = pose.position, pose.rotation.ravel()
    refined = function("refine_pose", c_int64)(
        lens, *map(address, given), c_int64(len(points)), address(out)
    )
    return PoseInCamera(out[:3], out[3:].reshape(3, 3)) if refined else None
