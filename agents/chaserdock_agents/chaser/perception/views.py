# SPDX-License-Identifier: Apache-2.0
"""Project a target's markers for a pose, by native/views.c.

For the few markers of a target C takes a third of NumPy's time, at up to seven poses per image.
Points are rotated here by NumPy's matrix product, whose rounding the C code would not reproduce.
"""

from __future__ import annotations

from ctypes import c_double, c_int64

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address

from .native import function
from .refine import PoseInCamera


def marker_errors(
    camera: Camera, points_trf_m: Array, normals_trf: Array, pixels: Array, pose: PoseInCamera
) -> list[float]:
    """Return the largest corner error (n,) of each marker, px.

    Infinite for a marker behind the camera or facing away. ``points_trf_m`` (n, 4, 3): corners;
    ``normals_trf`` (n, 3); ``pixels`` (n, 4, 2): ideal.
    """
    to_irf, n = pose.rotation.T, len(points_trf_m)
    at = points_trf_m.reshape(-1, 3) @ to_irf
    at += pose.position
    pixels = np.ascontiguousarray(pixels, dtype=float)
    outwards, error = normals_trf @ to_irf, np.empty(n)
    function("marker_errors")(
        _lens(camera), address(at), address(pixels), address(outwards), c_int64(n), address(error)
    )
    return error.tolist()


def squared_errors(camera: Camera, points_trf_m: Array, pixels: Array, pose: PoseInCamera) -> Array:
    """Return squared distances (n,), ideal px, of projected points (n, 3) from ``pixels`` (n, 2).

    NaN for points behind the camera.
    """
    at, n = points_trf_m @ pose.rotation.T, len(points_trf_m)
    at += pose.position
    pixels, square = np.ascontiguousarray(pixels, dtype=float), np.empty(n)
    function("squared_errors")(
        _lens(camera), address(at), address(pixels), c_int64(n), address(square)
    )
    return square


def count_visible_markers(
    camera: Camera, surface_trf: Array, row: int, pose: PoseInCamera, frame_margin_px: float
) -> tuple[int, float]:
    """Return how many other markers should be visible at a pose, and a marker's viewing cosine.

    ``row``: the marker; its cosine is 1 face-on, negative from behind. Others count if they are at
    least as visible: all corners at least ``frame_margin_px`` inside the image, of about the same
    size, at about the same viewing angle. ``surface_trf`` (6 m, 3): 4 m corners, m centres and m
    normals of m markers.
    """
    markers = len(surface_trf) // 6
    surface, position = surface_trf @ pose.rotation.T, np.array(pose.position, dtype=float)
    right, bottom = (
        camera.width_px - 1.0 - frame_margin_px,
        camera.height_px - 1.0 - frame_margin_px,
    )
    size, cosine = np.empty(markers), np.empty(markers)
    count = function("count_visible_markers", c_int64)(
        _lens(camera), (c_double * 3)(frame_margin_px, right, bottom),
        address(surface), address(position), c_int64(markers), c_int64(row), address(size),
        address(cosine),
    )  # fmt: skip
    return int(count), float(cosine[row])


def _lens(camera: Camera) -> object:
    return (c_double * 4)(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
