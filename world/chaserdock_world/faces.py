"""Which faces of which boxes a camera sees, and where in its picture.

All boxes at once: with many bodies in view, a call of NumPy for each would be most of a picture's time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from chaserdock_protocol import rotations
from chaserdock_protocol.camera import Camera
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.targets import Box, face_rotation
from numpy.typing import ArrayLike, NDArray

from chaserdock_world.sky import Light

NEAR_M = 0.01
"""Nothing nearer to the camera's plane than this is drawn."""

Obstacle = tuple[Sequence[Box], ArrayLike, ArrayLike]
"""Boxes in the axes of a body, its position (3,) in WRF and its attitude (4,), body -> WRF."""


@dataclass(frozen=True)
class Face:
    """One visible face, in IRF: ``centre`` (3,) in metres, unit vectors ``right`` and ``up``, width and height; grey
    level at reflectance 1 and reflectance; the clipped outline (n, 2) in pixels of the canvas, and whether all of it
    lies in front. ``body`` (0: the target), ``box`` in the body and ``side`` of the box say which it is."""

    centre: Array
    right: Array
    up: Array
    width_m: float
    height_m: float
    level: float
    shade: float
    outline_px: Array
    in_front: bool
    body: int
    box: int
    side: int


@dataclass(frozen=True)
class SeenBox:
    """A box of which something is seen: ``centre_m`` (3,) and ``rotation`` (3, 3) in IRF, ``half_m`` (3,) edges."""

    centre_m: Array
    rotation: Array
    half_m: Array
    faces: list[Face]

    def bounds_px(self) -> tuple[Array, Array]:
        """Least and greatest pixel (2,) of the canvas that its outline reaches."""
        outline = np.concatenate([face.outline_px for face in self.faces])
        return outline.min(axis=0), outline.max(axis=0)


class Frustum:
    """What of space a canvas shows: the picture of ``camera`` from pixel ``origin_px`` (2,), ``size_px`` wide and high."""

    def __init__(self, camera: Camera, origin_px: Array, size_px: Sequence[int]):
        self.camera = camera
        self.origin_px = origin_px
        # Planes n x + d >= 0 (n_x, n_y, n_z, d) within which a point is in front and on the canvas, with a
        # pixel to spare; and, of the canvas' borders, unit normals into it.
        left, top = (origin_px - 1.0 - (camera.cx_px, camera.cy_px)).tolist()
        right, bottom = left + size_px[0] + 1.0, top + size_px[1] + 1.0
        self.planes = np.array(
            [
                [0.0, 0.0, 1.0, -NEAR_M],
                [camera.fx_px, 0.0, -left, 0.0],
                [-camera.fx_px, 0.0, right, 0.0],
                [0.0, camera.fy_px, -top, 0.0],
                [0.0, -camera.fy_px, bottom, 0.0],
            ]
        )
        borders = self.planes[1:, :3] - [0.0, 0.0, 0.5]
        self._borders = borders / np.linalg.norm(borders, axis=1, keepdims=True)

    def reaches(self, centres: Array, radii: Array) -> NDArray[np.bool_]:
        """Which of the spheres (n, 3), (n,) may be seen: not behind the near plane, not beside the field of view."""
        beside = (centres @ self._borders.T < -radii[:, None]).any(axis=1)
        return ~beside & (centres[:, 2] + radii >= NEAR_M)

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of the canvas for points (..., 3) in IRF, without lens distortion."""
        return self.camera.project_ideal(points) - self.origin_px

    def clip(self, corners: Array, outside: NDArray[np.bool_]) -> Array:
        """The part (n, 3) of a face (4, 3) that is in front and on the canvas (Sutherland-Hodgman);
        ``outside`` (4, 5): which corners lie outside of which planes."""
        polygon = corners
        for plane in self.planes[outside.any(axis=0)]:
            distance = polygon @ plane[:3] + plane[3]
            kept: list[Array] = []
            for i in range(len(polygon)):
                d0, d1 = distance[i - 1], distance[i]
                if (d0 < 0.0) != (d1 < 0.0):
                    kept.append(polygon[i - 1] + (polygon[i] - polygon[i - 1]) * (d0 / (d0 - d1)))
                if d1 >= 0.0:
                    kept.append(polygon[i])
            if len(kept) < 3:
                return corners[:0]
            polygon = np.array(kept)
        return polygon


def visible_boxes(
    frustum: Frustum,
    bodies: Sequence[Obstacle],
    camera_position_w_m: Array,
    camera_q_w_irf_wxyz: Array,
    to_sun_irf: Array,
    light: Light,
) -> list[SeenBox]:
    """The boxes of which something is seen, in the order of ``bodies``; the first of them is the target.

    ``camera_position_w_m`` (3,), ``camera_q_w_irf_wxyz`` (4,): see `Camera.irf_pose_in_world`; ``to_sun_irf`` (3,) a
    unit vector.
    """
    q_irf_w = rotations.conjugate(camera_q_w_irf_wxyz)
    shapes = [_shapes(tuple(boxes)) for boxes, _, _ in bodies]
    q_irf_body = rotations.multiply(q_irf_w, np.array([q for _, _, q in bodies], dtype=float))
    r_body = rotations.to_matrix(q_irf_body)
    p_body = np.array([p for _, p, _ in bodies], dtype=float) - camera_position_w_m
    p_body = p_body @ rotations.to_matrix(q_irf_w).T

    counts = [len(shape.radius) for shape in shapes]
    body = np.repeat(np.arange(len(bodies)), counts)
    number = np.concatenate([np.arange(n) for n in counts])
    at = np.concatenate([shape.position for shape in shapes])
    centres = p_body[body] + (r_body[body] @ at[..., None])[..., 0]
    radii = np.concatenate([shape.radius for shape in shapes])
    kept = np.flatnonzero(frustum.reaches(centres, radii))
    if not len(kept):
        return []
    body, number, centres = body[kept], number[kept], centres[kept]
    turned = r_body[body] @ np.concatenate([shape.rotation for shape in shapes])[kept]
    extents = np.concatenate([shape.extents for shape in shapes])[kept]
    halves = np.concatenate([shape.half for shape in shapes])[kept]
    shades = np.concatenate([shape.shade for shape in shapes])[kept]

    # Faces (box, side): rows right, up, normal of each; those that turn their back are not seen.
    axes = (turned[:, None] @ _FACE_AXES).swapaxes(-1, -2)
    middles = centres[:, None] + extents[..., 2:] * axes[..., 2, :]
    which, side = np.nonzero((axes[..., 2, :] * middles).sum(axis=-1) < 0.0)
    axes, middles, sizes = axes[which, side], middles[which, side], extents[which, side, :2]
    offsets = _CORNERS * sizes[:, None]
    corners = middles[:, None] + offsets @ axes[:, :2]
    outside: NDArray[np.bool_] = corners @ frustum.planes[:, :3].T + frustum.planes[:, 3] < 0.0
    cut: NDArray[np.bool_] = np.any(outside, axis=(1, 2))
    beyond: NDArray[np.bool_] = np.any(
        np.all(outside, axis=1), axis=1
    )  # all four corners on the wrong side of one plane
    in_front: NDArray[np.bool_] = np.all(corners[..., 2] >= NEAR_M, axis=1)
    pixels = frustum.project(corners)
    cosines = (axes[:, 2] @ to_sun_irf).tolist()

    found: dict[int, list[Face]] = {}
    for k in np.flatnonzero(~beyond).tolist():
        outline = pixels[k]
        if cut[k]:
            polygon = frustum.clip(corners[k], outside[k])
            if len(polygon) < 3:
                continue
            outline = frustum.project(polygon)
        i = int(which[k])
        face = Face(
            centre=middles[k],
            right=axes[k, 0],
            up=axes[k, 1],
            width_m=float(sizes[k, 0]),
            height_m=float(sizes[k, 1]),
            level=light.level(cosines[k], -middles[k], axes[k, 2]),
            shade=float(shades[i]),
            outline_px=outline,
            in_front=bool(in_front[k]),
            body=int(body[i]),
            box=int(number[i]),
            side=int(side[k]),
        )
        found.setdefault(i, []).append(face)
    return [SeenBox(centres[i], turned[i], halves[i], faces) for i, faces in found.items()]


_FACE_AXES = np.array([rotations.to_matrix(face_rotation(face)) for face in range(6)])
_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])


@dataclass(frozen=True)
class _Shapes:
    """What the boxes of a body give by themselves: ``position`` (n, 3), ``rotation`` (n, 3, 3), ``half`` edges (n, 3),
    ``radius`` (n,) of the bounding sphere, ``shade`` (n,), and ``extents`` (n, 6, 3) of the faces: width, height and
    distance from the centre; metres."""

    position: Array
    rotation: Array
    half: Array
    radius: Array
    shade: Array
    extents: Array


@lru_cache(maxsize=1024)
def _shapes(boxes: tuple[Box, ...]) -> _Shapes:
    size = np.array([box.size_m for box in boxes])
    x, y, z = size.T
    # As `targets.face_extent`, without its general rotation: faces come in pairs along x, y and z.
    pairs = np.stack([[y, z, x / 2.0], [x, z, y / 2.0], [x, y, z / 2.0]]).transpose(2, 0, 1)
    return _Shapes(
        np.array([box.position_m for box in boxes]),
        np.array([rotations.to_matrix(box.q_wxyz) for box in boxes]),
        size / 2.0,
        0.5 * np.linalg.norm(size, axis=1),
        np.array([box.shade for box in boxes]),
        np.repeat(pairs, 2, axis=1),
    )
