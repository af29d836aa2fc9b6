# SPDX-License-Identifier: Apache-2.0
"""Compute visible faces of boxes, their outlines in the image, and their painting order.

The arithmetic is in C (native/scene.c): an image shows about a dozen faces, too few to vectorize
with NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure, byref, c_double, c_int64
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from chaserdock_models.targets import Box, face_rotation
from numpy.typing import ArrayLike, NDArray

from .native import LIBRARY, function
from .textures import FINEST_TEXEL_M

NEAR_M = 0.01
"""Distance of the near plane, m: geometry nearer to the camera's plane is not drawn."""

Obstacle = tuple[Sequence[Box], ArrayLike, ArrayLike]
"""A body: its boxes in body axes, position (3,) in WRF and attitude (4,), body to WRF."""

Shape = np.dtype(
    [
        ("body", float),
        ("position", float, 3),
        ("rotation", float, (3, 3)),
        ("half", float, 3),
        ("radius", float),
    ]
)
"""Mirror ``Shape`` of native/scene.c: a box in its body's axes, m.

``half``: half edges. ``radius``: of the bounding sphere.
"""

VisibleBox = np.dtype(
    [
        ("shape", float), ("centre", float, 3), ("rotation", float, (3, 3)), ("half", float, 3),
        ("low_px", float, 2), ("high_px", float, 2),
    ]
)  # fmt: skip
"""Mirror ``VisibleBox`` of native/scene.c: number of the box's shape, its pose in IRF, and the
pixels that bound its outline.
"""

VisibleFace = np.dtype(
    [
        ("box", float), ("side", float), ("in_front", float), ("width_m", float),
        ("height_m", float),
        ("centre", float, 3), ("right", float, 3), ("up", float, 3), ("normal", float, 3),
        ("count", float), ("outline_px", float, (10, 2)),
    ]
)  # fmt: skip
"""Mirror ``Face`` of native/scene.c: a visible face in IRF.

``box``: index of its visible box. ``side``: of the box. ``in_front``: whether all of it is in front
of the camera. Its clipped outline has ``count`` points in pixels of the canvas.
"""

_FACE_AXES = np.array([rotations.to_matrix(face_rotation(face)) for face in range(6)])


@LIBRARY.structure("Frustum")
class _Frustum(Structure):
    """Mirror `Frustum` of native/scene.c."""

    _fields_ = [
        ("planes", c_double * 20), ("borders", c_double * 12),
        ("fx", c_double), ("fy", c_double), ("cx", c_double), ("cy", c_double),
        ("origin", c_double * 2), ("near_m", c_double),
    ]  # fmt: skip


class Frustum:
    """View frustum of a canvas: the image of ``camera`` from pixel ``origin_px`` (2,) on.

    ``size_px``: width and height.
    """

    def __init__(self, camera: Camera, origin_px: Array, size_px: Sequence[int]):
        # Planes n x + d >= 0 (n_x, n_y, n_z, d) of points in front and on the canvas, with a margin
        # of one pixel, and inward unit normals of the canvas' borders.
        left, top = (origin_px - 1.0 - (camera.cx_px, camera.cy_px)).tolist()
        right, bottom = left + size_px[0] + 1.0, top + size_px[1] + 1.0
        planes = np.array(
            [
                [0.0, 0.0, 1.0, -NEAR_M],
                [camera.fx_px, 0.0, -left, 0.0],
                [-camera.fx_px, 0.0, right, 0.0],
                [0.0, camera.fy_px, -top, 0.0],
                [0.0, -camera.fy_px, bottom, 0.0],
            ]
        )
        borders = planes[1:, :3] - [0.0, 0.0, 0.5]
        borders = borders / np.linalg.norm(borders, axis=1, keepdims=True)
        self.native = _Frustum(
            (c_double * 20)(*planes.ravel()), (c_double * 12)(*borders.ravel()),
            camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px,
            (c_double * 2)(*origin_px.tolist()), NEAR_M,
        )  # fmt: skip


@dataclass(frozen=True)
class Shapes:
    """The n boxes of several bodies.

    ``table`` (n,) of Shape. For each box: number of its body, number within that body, reflectance.
    """

    table: NDArray[np.void]
    bodies: list[int]
    numbers: list[int]
    shades: list[float]


@lru_cache(maxsize=256)
def shape_table(bodies: tuple[tuple[Box, ...], ...]) -> Shapes:
    """Return the boxes of these bodies, in their order."""
    boxes = [
        (body, number, box) for body, own in enumerate(bodies) for number, box in enumerate(own)
    ]
    table = np.zeros(len(boxes), dtype=Shape)
    for row, (body, _, box) in zip(table, boxes, strict=True):
        half = np.array(box.size_m) / 2.0
        row["body"], row["position"], row["half"], row["radius"] = (
            body,
            box.position_m,
            half,
            np.linalg.norm(half),
        )
        row["rotation"] = rotations.to_matrix(box.q_wxyz)
    return Shapes(
        table,
        [b for b, _, _ in boxes],
        [n for _, n, _ in boxes],
        [box.shade for _, _, box in boxes],
    )


def visible_faces(
    frustum: Frustum, shapes: Shapes, camera_pose: Array, poses: Array
) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Return the visible boxes (b,) and their visible faces (f,), in the order of ``shapes`` and
    sides.

    ``camera_pose`` (7,): position in WRF and attitude IRF to WRF. ``poses`` (bodies, 7): of the
    bodies, body to WRF.
    """
    n = len(shapes.table)
    boxes, faces, counts = (
        np.empty(n, VisibleBox),
        np.empty(6 * n, VisibleFace),
        np.zeros(2, np.int64),
    )
    function("visible_faces")(
        byref(frustum.native), address(camera_pose), address(poses), c_int64(n),
        address(shapes.table),
        address(_FACE_AXES), address(boxes), address(faces), address(counts),
    )  # fmt: skip
    return boxes[: counts[0]], faces[: counts[1]]


def paint_order(boxes: NDArray[np.void]) -> list[int]:
    """Return the indices of ``boxes`` (n,) in painting order: every box after those that it
    occludes.

    Boxes that occlude one another cyclically (long thin ones can) have no such order; the farthest
    is painted first.
    """
    n = len(boxes)
    occluded, order = np.empty(n * n, np.uint8), np.empty(n, np.int64)
    function("paint_order")(c_int64(n), address(boxes), address(occluded), address(order))
    return order.tolist()


def place_texture(
    frustum: Frustum,
    face: NDArray[np.void],
    at: tuple[int, int, int],
    patch: tuple[int, ...],
    finest: tuple[int, ...],
) -> tuple[list[int], list[int], Array] | None:
    """Place the texture of ``face`` (1,) on a patch of the canvas; None if they do not overlap.

    ``at``: samples per pixel of the patch, and its first pixel (x, y). ``patch`` (rows, columns).
    ``finest`` (rows, columns): size of the texture at textures.FINEST_TEXEL_M. Returns the region
    of the patch (left, top, right, bottom); how often the texture's width and height are halved so
    that a texel is about a sample at the centre of the outline; and the homography (3, 3) from the
    region's samples to texels.
    """
    sizes = np.array([patch[1], patch[0], finest[1], finest[0]], dtype=np.int64)
    out, matrix = np.empty(6, dtype=np.int64), np.empty((3, 3))
    overlaps = function("place_texture", c_int64)(
        byref(frustum.native), address(face), *map(c_double, at), address(sizes[:2]),
        address(sizes[2:]),
        c_double(FINEST_TEXEL_M), address(out[:4]), address(out[4:]), address(matrix),
    )  # fmt: skip
    return (out[:4].tolist(), out[4:].tolist(), matrix) if overlaps else None
