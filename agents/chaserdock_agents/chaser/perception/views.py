"""What the markers of a target look like from a pose. The arithmetic is a kernel (native/views.c).

Points are turned here and not there: their bits are those of NumPy's matrix product, which no kernel repeats.
"""

from __future__ import annotations

from ctypes import c_double, c_int64

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address

from .native import function
from .refine import Pose


def marker_errors(
    camera: Camera, points_trf_m: Array, normals_trf: Array, pixels: Array, pose: Pose
) -> list[float]:
    """Distance (n,) in pixels of each marker's worst corner; infinite if behind or seen from behind.

    ``points_trf_m`` (n, 4, 3): corners; ``normals_trf`` (n, 3); ``pixels`` (n, 4, 2): ideal.
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


def squared_errors(camera: Camera, points_trf_m: Array, pixels: Array, pose: Pose) -> Array:
    """Squared distance (n,), ideal pixels, of projected points (n, 3) from ``pixels`` (n, 2); NaN for points not in
    front of the camera."""
    at, n = points_trf_m @ pose.rotation.T, len(points_trf_m)
    at += pose.position
    pixels, square = np.ascontiguousarray(pixels, dtype=float), np.empty(n)
    function("squared_errors")(_lens(camera), address(at), address(pixels), c_int64(n), address(square))
    return square


def plain_markers(
    camera: Camera, surface_trf: Array, row: int, pose: Pose, frame_margin_px: float
) -> tuple[int, float]:
    """How many markers other than ``row`` should be as plain to see as that one if the pose is right, and the cosine of
    the angle at which that one is seen: 1 from straight ahead, negative from behind.

    ``surface_trf`` (6 m, 3): of m markers the 4 m corners, m centres and m normals. As plain: with all corners at least
    ``frame_margin_px`` inside the image, about as large, and at about the same angle.
    """
    markers = len(surface_trf) // 6
    surface, position = surface_trf @ pose.rotation.T, np.array(pose.position, dtype=float)
    right, bottom = camera.width_px - 1.0 - frame_margin_px, camera.height_px - 1.0 - frame_margin_px
    size, cosine = np.empty(markers), np.empty(markers)
    count = function("plain_markers", c_int64)(
        _lens(camera), (c_double * 3)(frame_margin_px, right, bottom),
        address(surface), address(position), c_int64(markers), c_int64(row), address(size), address(cosine),
    )  # fmt: skip
    return int(count), float(cosine[row])


def _lens(camera: Camera) -> object:
    return (c_double * 4)(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
