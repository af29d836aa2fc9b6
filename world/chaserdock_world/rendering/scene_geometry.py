"""Which faces of which boxes a camera sees, where in its image, and in which order they are painted.

The arithmetic is a kernel (native/scene.c): an image shows a dozen faces, too few for as many calls into NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure, byref, c_double, c_int64
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from chaserdock_models.rotations import Array
from chaserdock_models.targets import Box, face_rotation
from numpy.typing import ArrayLike, NDArray

from .native import function
from .textures import FINEST_TEXEL_M

NEAR_M = 0.01
"""Nothing nearer to the camera's plane than this is drawn."""

Obstacle = tuple[Sequence[Box], ArrayLike, ArrayLike]
"""Boxes in the axes of a body, its position (3,) in WRF and its attitude (4,), body -> WRF."""

Shape = np.dtype(
    [
        ("body", float),
        ("position", float, 3),
        ("rotation", float, (3, 3)),
        ("half", float, 3),
        ("radius", float),
    ]
)
"""native/scene.c: a box by itself, in its body's axes, metres; ``half`` edges, ``radius`` of the bounding sphere."""

SeenBox = np.dtype(
    [
        ("shape", float), ("centre", float, 3), ("rotation", float, (3, 3)), ("half", float, 3),
        ("low_px", float, 2), ("high_px", float, 2),
    ]
)  # fmt: skip
"""native/scene.c: a box of which something is seen: which shape, in IRF, and the pixels that bound its outline."""

Face = np.dtype(
    [
        ("box", float), ("side", float), ("in_front", float), ("width_m", float), ("height_m", float),
        ("centre", float, 3), ("right", float, 3), ("up", float, 3), ("normal", float, 3),
        ("count", float), ("outline_px", float, (10, 2)),
    ]
)  # fmt: skip
"""native/scene.c: a visible face in IRF: of which seen box, which ``side`` of it, whether all of it lies ``in_front``, and
its clipped outline, ``count`` points in pixels of the canvas."""

_FACE_AXES = np.array([rotations.to_matrix(face_rotation(face)) for face in range(6)])


class _Frustum(Structure):
    """native/scene.c."""

    _fields_ = [
        ("planes", c_double * 20), ("borders", c_double * 12),
        ("fx", c_double), ("fy", c_double), ("cx", c_double), ("cy", c_double),
        ("origin", c_double * 2), ("near_m", c_double),
    ]  # fmt: skip


class Frustum:
    """What of space a canvas shows: the image of ``camera`` from pixel ``origin_px`` (2,), ``size_px`` wide and high."""

    def __init__(self, camera: Camera, origin_px: Array, size_px: Sequence[int]):
        # Planes n x + d >= 0 (n_x, n_y, n_z, d) within which a point is in front and on the canvas, with a
        # pixel to spare; and, of the canvas' borders, unit normals into it.
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
    """The boxes of several bodies: ``table`` (n,) of Shape, and of each the number of its body, its own number in
    that, and its reflectance."""

    table: NDArray[np.void]
    bodies: list[int]
    numbers: list[int]
    shades: list[float]


@lru_cache(maxsize=256)
def shapes_of(bodies: tuple[tuple[Box, ...], ...]) -> Shapes:
    """The table of these bodies' boxes, in their order."""
    boxes = [(body, number, box) for body, own in enumerate(bodies) for number, box in enumerate(own)]
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
        table, [b for b, _, _ in boxes], [n for _, n, _ in boxes], [box.shade for _, _, box in boxes]
    )


def see_faces(
    frustum: Frustum, shapes: Shapes, eye: Array, poses: Array
) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Boxes of which something is seen (b,) and their faces that are seen (f,), in the order of ``shapes`` and sides.

    ``eye`` (7,): position in WRF and attitude IRF -> WRF of the camera; ``poses`` (bodies, 7): theirs, body -> WRF.
    """
    n = len(shapes.table)
    seen, faces, counts = np.empty(n, SeenBox), np.empty(6 * n, Face), np.zeros(2, np.int64)
    function("see_faces")(
        byref(frustum.native), address(eye), address(poses), c_int64(n), address(shapes.table),
        address(_FACE_AXES), address(seen), address(faces), address(counts),
    )  # fmt: skip
    return seen[: counts[0]], faces[: counts[1]]


def paint_order(boxes: NDArray[np.void]) -> list[int]:
    """Indices of ``boxes`` (n,) of SeenBox in the order in which to paint them: nothing before what it hides.

    Boxes that hide one another in a circle (long thin ones can) leave no such order; of those the farthest
    is painted first.
    """
    n = len(boxes)
    hidden, order = np.empty(n * n, np.uint8), np.empty(n, np.int64)
    function("paint_order")(c_int64(n), address(boxes), address(hidden), address(order))
    return order.tolist()


def hides(boxes: NDArray[np.void], a: int, b: int) -> int:
    """1 when box ``a`` of ``boxes`` (n,) of SeenBox is in front of ``b`` as seen from the origin, -1 when behind, 0
    when neither can hide the other."""
    return int(function("hides", c_int64)(address(boxes[a : a + 1]), address(boxes[b : b + 1])))


def texture_place(
    frustum: Frustum,
    face: NDArray[np.void],
    at: tuple[int, int, int],
    patch: tuple[int, ...],
    finest: tuple[int, ...],
) -> tuple[list[int], list[int], Array] | None:
    """Where the texture of ``face`` (1,) goes on a patch (rows, columns) of the canvas that has ``at[0]`` samples a
    pixel from pixel ``at[1:]`` on; None where that is nowhere.

    The region of the patch (left, top, right, bottom); how often the texture's width and height, ``finest`` (rows,
    columns) at textures.FINEST_TEXEL_M, are halved so that a texel is about a sample in the middle of the outline; and
    the matrix (3, 3) from the region's samples to texels.
    """
    sizes = np.array([patch[1], patch[0], finest[1], finest[0]], dtype=np.int64)
    out, matrix = np.empty(6, dtype=np.int64), np.empty((3, 3))
    there = function("place_texture", c_int64)(
        byref(frustum.native), address(face), *map(c_double, at), address(sizes[:2]), address(sizes[2:]),
        c_double(FINEST_TEXEL_M), address(out[:4]), address(out[4:]), address(matrix),
    )  # fmt: skip
    return (out[:4].tolist(), out[4:].tolist(), matrix) if there else None
