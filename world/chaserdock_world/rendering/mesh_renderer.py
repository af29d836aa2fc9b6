# SPDX-License-Identifier: Apache-2.0
"""Render triangle meshes: z-buffer with eight samples per pixel, shadow maps, highlights, textures.

The arithmetic is in C (native/mesh.c). Every body casts shadows from the sun onto every other one
and onto itself. The lamp is at the lens, which sees none of the shadows that it casts. Each body in
view has a shadow map of its own, whose texels are half a pixel wide at its nearest point, as far as
``_MAP_TEXELS`` allow.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from ctypes import byref, c_int64
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import Material, MeshPart, TriangleMesh, triangle_soup
from chaserdock_models.native import address
from chaserdock_models.satellites import box
from chaserdock_models.targets import Box, box_around
from numpy.typing import ArrayLike, NDArray

from .background import WHITE_LEVEL, Background, Earth, Light
from .lens import LensMap, spread_points
from .native import function
from .scene_geometry import NEAR_M, Frustum, Obstacle

DAYLIGHT = Light()

_TEXTURES = {"": 0.0, "insulation": 1.0, "cells": 2.0}  # native/mesh.c
_MAP_TEXELS = 2_000_000
"""Most texels of a shadow map, which limit its resolution: 8 MB a body."""
_TEXEL_PX = 0.7
"""Width of a texel, px at the nearest point of a body. Shadow edges are displaced by 0.2 px with it
(docs/evidence/cameras.md).
"""
_BAND_ROWS, _SAMPLES, _GROUP = 8, 8, 32  # native/mesh.c
_WRINKLES = 256
"""Side of the periodic map of wrinkles, texels: 0.4 m of foil (``WRINKLE_PER_M`` in native/mesh.c).
"""

# native/mesh.c: Illumination, ShadowMap; bytes of a BodyPose and of a Triangle.
_ILLUMINATION = np.dtype(
    [
        ("sun", float, 3), ("sun_share", float), ("ambient", float), ("lamp", float),
        ("white", float),
        ("across", float, 3), ("along", float, 3),
    ]
)  # fmt: skip
_SHADOW_MAP = np.dtype(
    [
        ("width", np.int64), ("height", np.int64), ("offset", np.int64), ("padding", np.int64),
        ("low", float, 2), ("texel_m", float), ("used", float),
    ]
)  # fmt: skip
# Sizes of BodyPose and Triangle in native/mesh.c.
_POSE_BYTES, _TRIANGLE_BYTES = 96, 156


@dataclass(frozen=True, eq=False)
class _Body:
    """A mesh of m triangles as arrays, body axes.

    ``corners`` and ``normals`` (m, 3, 3); ``uv`` (m, 3, 2): texture coordinates, m. ``surface``
    (m,): rows of ``surfaces`` (k, 4), see ``Surface`` of native/mesh.c.
    """

    corners: Array
    normals: Array
    uv: Array
    surface: IntArray
    surfaces: Array

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (8, 3) of the cuboid around the body, body axes, and its centre (3,)."""
        points = self.corners.reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        corners = (
            np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low)
            + low
        )
        return corners, (low + high) / 2.0


def _body_of(mesh: TriangleMesh) -> _Body:
    soup = triangle_soup(mesh)
    rows = [
        (
            p.material.diffuse,
            p.material.specular,
            p.material.shininess,
            _TEXTURES[p.material.texture],
        )
        for p in mesh.parts
    ]
    uv = np.concatenate([_texture_coordinates(part) for part in mesh.parts])
    return _Body(
        np.ascontiguousarray(soup.corners_m), np.ascontiguousarray(soup.normals), uv,
        soup.part.astype(np.int64),
        np.array(rows, dtype=float),
    )  # fmt: skip


def _texture_coordinates(part: MeshPart) -> Array:
    """Return texture coordinates (m, 3, 2), m from the edges of the cuboid around a part.

    Each triangle has those of the side of the cuboid that it faces.
    """
    around = box_around(part)
    axes = rotations.to_matrix(around.q_wxyz)
    local = (part.vertices_m - np.array(around.position_m)) @ axes + np.array(around.size_m) / 2.0
    corners = local[part.triangles]
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    others = np.array([(1, 2), (0, 2), (0, 1)])[np.argmax(normal, axis=1)]
    return np.ascontiguousarray(
        np.take_along_axis(corners, np.repeat(others[:, None], 3, axis=1), axis=2)
    )


@lru_cache(maxsize=64)
def _joined(bodies: tuple[_Body, ...]) -> tuple[_Body, IntArray]:
    """Return all triangles of several bodies, and the index (n + 1,) of each body's first."""
    rows = np.cumsum([0, *(len(b.surfaces) for b in bodies[:-1])])
    corners, normals, uv, surfaces = (
        np.concatenate([getattr(b, key) for b in bodies])
        for key in ("corners", "normals", "uv", "surfaces")
    )
    surface = np.concatenate([b.surface + row for b, row in zip(bodies, rows, strict=True)])
    first = np.cumsum([0, *(len(b.corners) for b in bodies)]).astype(np.int64)
    return _Body(corners, normals, uv, surface, surfaces), first


def mesh_of_boxes(boxes: Sequence[Box]) -> TriangleMesh:
    """Return cuboids as a mesh."""
    parts = []
    for number, b in enumerate(boxes):
        x, y, z = rotations.log(np.array(b.q_wxyz)).tolist()
        parts.append(
            box(f"box_{number}", Material("paint", b.shade), b.size_m, b.position_m, (x, y, z))
        )
    return TriangleMesh("boxes", tuple(parts), {})


@lru_cache
def _wrinkles() -> NDArray[np.float32]:
    """Return slopes and relative reflectance (n, n, 3) of wrinkled foil, periodic."""
    generator = np.random.Generator(np.random.PCG64(20240229))
    height = np.zeros((_WRINKLES, _WRINKLES))
    for cells, weight in ((16, 1.0), (40, 0.45)):
        noise = np.tile(generator.standard_normal((cells, cells)).astype(np.float32), (3, 3))
        smooth = cv2.resize(noise, (3 * _WRINKLES, 3 * _WRINKLES), interpolation=cv2.INTER_CUBIC)
        # Foil is flat between sharp creases.
        height += (
            weight
            * np.abs(smooth[_WRINKLES : 2 * _WRINKLES, _WRINKLES : 2 * _WRINKLES])
            * 16
            / cells
        )
    slope_x = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) * 1.6
    slope_y = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) * 1.6
    tone = 0.12 * (height - height.mean())
    return np.ascontiguousarray(np.stack([slope_x, slope_y, tone], axis=-1).astype(np.float32))


class MeshRenderer:
    """Render what ``camera`` sees of a target with a mesh and of other bodies.

    Stateless but for caches: equal arguments give equal images. ``point_spread_px``: standard
    deviation of a Gaussian. ``substitutes``: meshes that are drawn in place of boxes.
    """

    def __init__(
        self,
        camera: Camera,
        mesh: TriangleMesh,
        earth: Earth | None = None,
        point_spread_px: float = 0.0,
        substitutes: Mapping[Box, TriangleMesh] | None = None,
    ):
        self.camera = camera
        self._substitutes = dict(substitutes or {})
        self._target = _body_of(mesh)
        self._bodies: dict[tuple[Box, ...], _Body] = {}
        self._threads = threading.local()
        self._lens = LensMap(camera, point_spread_px)
        self._point_spread_px = self._lens.canvas_spread_px
        self._size = self._lens.size_px
        self._background = Background(camera, self._lens.origin_px, self._size, earth)
        self._frustum = Frustum(camera, self._lens.origin_px, self._size)

    def render(
        self,
        camera_position_w_m: ArrayLike,
        camera_q_w_irf_wxyz: ArrayLike,
        target_p_w_m: ArrayLike,
        target_q_w_trf_wxyz: ArrayLike,
        obstacles: Sequence[Obstacle] = (),
        light: Light = DAYLIGHT,
    ) -> NDArray[np.uint8]:
        """Return the image (h, w), uint8, of the target and the ``obstacles`` with lens distortion.

        Arguments as of `Renderer.render`; here bodies cast shadows.
        """
        q_w_irf = np.asarray(camera_q_w_irf_wxyz, dtype=float)
        camera = np.concatenate([np.asarray(camera_position_w_m, dtype=float), q_w_irf])
        bodies = [self._target, *(self._body(tuple(boxes)) for boxes, _, _ in obstacles)]
        placed = [(target_p_w_m, target_q_w_trf_wxyz), *((p, q) for _, p, q in obstacles)]
        poses = np.array([np.concatenate([p, q]) for p, q in placed], dtype=float)
        canvas = self._background.draw(q_w_irf, light).image
        self._draw(canvas, camera, bodies, poses, light)
        return self._lens.distort(spread_points(canvas, self._point_spread_px))

    def _body(self, boxes: tuple[Box, ...]) -> _Body:
        if boxes not in self._bodies:
            plain = [b for b in boxes if b not in self._substitutes]
            parts = [
                part for b in boxes if b in self._substitutes for part in self._substitutes[b].parts
            ]
            parts += mesh_of_boxes(plain).parts
            self._bodies[boxes] = _body_of(TriangleMesh("body", tuple(parts), {}))
        return self._bodies[boxes]

    def _draw(
        self,
        canvas: NDArray[np.uint8],
        camera: Array,
        bodies: list[_Body],
        poses: Array,
        light: Light,
    ) -> None:
        scene, first = _joined(tuple(bodies))
        corners, normals, uv, surface, surfaces = (
            scene.corners, scene.normals, scene.uv, scene.surface, scene.surfaces
        )  # fmt: skip
        illumination = self._illumination(camera[3:], light)
        maps, texels = self._shadow_maps(illumination, camera, bodies, poses)
        count = 6 * len(corners)
        depth = self._memory("depth", 4 * texels)
        placed = self._memory("placed", _POSE_BYTES * len(bodies))
        triangles = self._memory("triangles", _TRIANGLE_BYTES * count)
        spans = self._memory(
            "spans", 8 * (count + count // _GROUP + 1 + self._size[1] // _BAND_ROWS + 1)
        )
        samples = self._memory("samples", _BAND_ROWS * self._size[0] * _SAMPLES * 8)
        wrinkles = _wrinkles()
        function("draw_meshes")(
            byref(self._frustum.native), c_int64(self._size[0]), c_int64(self._size[1]),
            address(camera),
            c_int64(len(bodies)), address(poses), address(first), address(corners),
            address(normals), address(uv),
            address(surface), address(surfaces), address(illumination), address(wrinkles),
            c_int64(_WRINKLES), address(maps),
            address(depth), address(placed), address(triangles), address(spans), address(samples),
            address(canvas),
        )  # fmt: skip

    def _memory(self, name: str, size: int) -> NDArray[np.uint8]:
        """Return working memory of this thread of at least ``size`` bytes.

        It is kept, as fresh pages would cost more than drawing.
        """
        held = self._threads.__dict__
        if name not in held or len(held[name]) < size:
            held[name] = np.empty(size, np.uint8)
        return held[name]

    def _illumination(self, q_w_irf: Array, light: Light) -> NDArray[np.void]:
        out = np.zeros(1, _ILLUMINATION)
        sun = rotations.rotate_inverse(q_w_irf, light.direction_w)
        across = np.cross(sun, np.eye(3)[int(np.argmin(np.abs(sun)))])
        across /= np.linalg.norm(across)
        out[0] = (
            sun,
            light.sun,
            light.ambient,
            light.lamp,
            WHITE_LEVEL,
            across,
            np.cross(sun, across),
        )
        return out

    def _shadow_maps(
        self, illumination: NDArray[np.void], camera: Array, bodies: list[_Body], poses: Array
    ) -> tuple[NDArray[np.void], int]:
        """Return the shadow map of every body, unused for those out of view, and the texels
        of all.
        """
        maps = np.zeros(len(bodies), _SHADOW_MAP)
        across, along = illumination["across"][0], illumination["along"][0]
        offset = 0
        for row, body, pose in zip(maps, bodies, poses, strict=True):
            if not np.all(np.isfinite(pose)):
                continue
            corners_w = rotations.rotate(pose[3:], body.bounds[0]) + pose[:3]
            corners = rotations.rotate_inverse(camera[3:], corners_w - camera[:3])
            centre = corners.mean(axis=0)
            radius = float(np.linalg.norm(corners - centre, axis=1).max())
            distance = float(np.linalg.norm(centre))
            if centre[2] < -radius or not float(illumination["sun_share"][0]) > 0.0:
                continue
            plane = np.stack([corners @ across, corners @ along], axis=1)
            low, extent = plane.min(axis=0), np.ptp(plane, axis=0)
            texel = _TEXEL_PX * max(distance - radius, 4.0 * NEAR_M) / self.camera.fx_px
            texel = max(texel, float(np.sqrt(np.prod(extent) / _MAP_TEXELS)), 1e-5)
            width, height = (np.ceil(extent / texel).astype(np.int64) + 4).tolist()
            width += -width % 8
            row["width"], row["height"], row["offset"], row["used"] = width, height, offset, 1.0
            row["low"], row["texel_m"] = low - 1.5 * texel, texel
            offset += width * height
        return maps, offset
