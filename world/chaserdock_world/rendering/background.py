# SPDX-License-Identifier: Apache-2.0
"""Draw the background of an image, space, stars and the Earth, and describe the light on
the scene.
"""

from __future__ import annotations

from ctypes import c_int64
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from numpy.typing import NDArray

from .native import function

AMBIENT = 0.35
"""Default share of ambient light; the rest is the sun's, by Lambert's cosine law."""

WHITE_LEVEL = 235.0
"""Grey level of reflectance 1 in full sun: below 255, so that noise does not clip on white."""

SPACE_LEVEL = 4
"""Grey level of empty space: a sensor's black level, above 0 so that noise does not clip on it."""
_STARS = 400
"""Number of stars on the whole sky: some 20 in an image of 60 degrees."""
# Step of the grid, px, on which the Earth is computed and interpolated, as it has no fine detail.
_EARTH_STEP_PX = 4
# Reflectance of the sea, and the additional reflectance of the thickest clouds.
_SEA, _CLOUDS = 0.12, 0.6
# Clouds by latitude and longitude: 0.7 degrees a texel.
_MAP_ROWS, _MAP_COLUMNS = 256, 512
# Sky and clouds are the same in all missions.
_SEED = 20230619


def star_field() -> tuple[Array, NDArray[np.uint8]]:
    """Return the directions (K, 3) of the stars in WRF, unit length, and their grey levels (K,)."""
    return _draw_star_field(np.random.Generator(np.random.PCG64(_SEED)))


def _draw_star_field(generator: np.random.Generator) -> tuple[Array, NDArray[np.uint8]]:
    stars = generator.standard_normal((_STARS, 3))
    levels = (30.0 + 150.0 * generator.random(_STARS) ** 3).astype(np.uint8)
    return stars / np.linalg.norm(stars, axis=1, keepdims=True), levels


@dataclass(frozen=True)
class Light:
    """Illumination of the scene.

    ``to_sun_w``: direction (3,) in WRF, any length. ``sun`` and ``ambient``: shares of full light
    from the sun and from all directions. ``lamp``: grey level of a white surface facing the
    camera's lamp at 1 m (inverse square, Lambert).

    Raises ValueError for a zero direction.
    """

    to_sun_w: tuple[float, float, float] = (-0.4, -0.5, 0.77)
    sun: float = 1.0 - AMBIENT
    ambient: float = AMBIENT
    lamp: float = 0.0

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.to_sun_w))
        if not (np.isfinite(length) and length > 0.0):
            raise ValueError("the direction to the sun must not be zero")

    @cached_property
    def direction_w(self) -> Array:
        """Unit vector (3,) to the sun in WRF; read-only."""
        direction = np.array(self.to_sun_w) / np.linalg.norm(self.to_sun_w)
        direction.setflags(write=False)
        return direction

    def level(self, cosine: float, to_camera: Array, normal: Array) -> float:
        """Return the grey level of a white face.

        ``cosine``: of the angle between the sun and the face's normal; ``to_camera`` (3,): from the
        face to the lamp beside the lens, metres, in the axes of ``normal`` (3,).
        """
        level = WHITE_LEVEL * (self.ambient + self.sun * max(0.0, cosine))
        if self.lamp > 0.0:
            distance = float(np.linalg.norm(to_camera))
            level += self.lamp * max(0.0, float(normal @ to_camera)) / max(distance, 1e-3) ** 3
        return level


@dataclass(frozen=True)
class Earth:
    """Disc of the Earth: direction to its centre (WRF) and angular radius."""

    direction_w: tuple[float, float, float]
    radius_rad: float


@dataclass(frozen=True)
class Sky:
    """What is behind all bodies.

    ``image`` (h, w), ideal. ``stars`` (n, 2): columns and rows of the only pixels that differ from
    `SPACE_LEVEL`; None with the Earth in view.
    """

    image: NDArray[np.uint8]
    stars: NDArray[np.int64] | None


class Background:
    """Draw the background of ideal images that begin at ``origin_px``.

    ``size_px``: width and height.
    """

    def __init__(
        self, camera: Camera, origin_px: Array, size_px: tuple[int, int], earth: Earth | None = None
    ):
        self._size, self._earth = size_px, earth
        generator = np.random.Generator(np.random.PCG64(_SEED))
        self._stars, self._star_levels = _draw_star_field(generator)
        # As in Camera.project_ideal: focal lengths, centre, and the first pixel of the canvas.
        lens = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *origin_px.tolist())
        self._lens = np.array(lens)
        if earth is not None:
            self._albedo = _albedo_map(generator)
            self._rays = _rays(camera, origin_px, size_px, _EARTH_STEP_PX)

    def draw(self, q_w_irf_wxyz: Array, light: Light | None = None) -> Sky:
        """Draw stars and Earth; ``light`` illuminates the Earth."""
        width, height = self._size
        canvas = np.full((height, width), SPACE_LEVEL, dtype=np.uint8)
        turn = rotations.to_matrix(q_w_irf_wxyz)
        directions, at = self._stars @ turn, np.empty((_STARS, 2), dtype=np.int64)
        drawn = function("draw_stars", c_int64)(
            address(directions), address(self._star_levels), c_int64(_STARS), address(self._lens),
            c_int64(width), c_int64(height), address(canvas), address(at),
        )  # fmt: skip
        earth = self._earth is not None and self._draw_earth(
            canvas, turn, self._earth, light or Light()
        )
        return Sky(canvas, None if earth else at[:drawn])

    def _draw_earth(
        self, canvas: NDArray[np.uint8], turn: Array, earth: Earth, light: Light
    ) -> bool:
        """Draw a Lambertian sphere with clouds fixed to it; return whether it is in view."""
        centre = np.array(earth.direction_w) / np.linalg.norm(earth.direction_w)
        rays = self._rays @ turn.T  # in WRF, unit
        cosine = rays @ centre
        if float(cosine.max()) < np.cos(earth.radius_rad) - 0.05:
            return False
        # A sphere of radius sin(radius) at distance 1.
        radius = np.sin(earth.radius_rad)
        inside = cosine**2 - (1.0 - radius**2)
        distance = cosine - np.sqrt(np.maximum(inside, 0.0))
        normals = (distance[..., None] * rays - centre) / radius
        longitude = np.arctan2(normals[..., 1], normals[..., 0]) / (2.0 * np.pi) + 0.5
        latitude = np.arccos(np.clip(normals[..., 2], -1.0, 1.0)) / np.pi
        albedo = cv2.remap(
            self._albedo,
            (longitude * _MAP_COLUMNS - 0.5).astype(np.float32),
            (latitude * _MAP_ROWS - 0.5).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        # The Earth's night side is visible while the target is in eclipse.
        day = np.maximum(normals @ light.direction_w, 0.0) * light.sun / (1.0 - AMBIENT)
        level = SPACE_LEVEL + WHITE_LEVEL * albedo * day
        # The limb is narrower than a grid step: fade it in, from zero where a ray is tangent.
        edge = np.clip(inside / 2e-3, 0.0, 1.0) * (cosine > 0.0)
        height, width = canvas.shape
        size_px = (width, height)
        share = cv2.resize(edge.astype(np.float32), size_px, interpolation=cv2.INTER_LINEAR)
        shown = cv2.resize(level.astype(np.float32), size_px, interpolation=cv2.INTER_LINEAR)
        mixed = canvas * (1.0 - share) + shown * share
        np.copyto(canvas, np.clip(np.rint(mixed), 0, 255).astype(np.uint8))
        return True


def _rays(camera: Camera, origin_px: Array, size_px: tuple[int, int], step_px: int) -> Array:
    """Return unit rays (rows, columns, 3) in IRF through the centres of blocks of ``step_px`` ideal
    pixels.
    """
    columns, rows = -(-size_px[0] // step_px), -(-size_px[1] // step_px)
    u = (np.arange(columns) + 0.5) * size_px[0] / columns - 0.5 + origin_px[0]
    v = (np.arange(rows) + 0.5) * size_px[1] / rows - 0.5 + origin_px[1]
    x, y = np.meshgrid((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _albedo_map(generator: np.random.Generator) -> NDArray[np.float32]:
    """Return reflectance by latitude and longitude: sea with clouds, noise at several scales."""
    clouds = np.zeros((_MAP_ROWS, _MAP_COLUMNS), dtype=np.float32)
    for octave in range(5):
        size = (8 << octave, 4 << octave)
        noise = generator.standard_normal((size[1], size[0])).astype(np.float32)
        noise[:, -1] = noise[:, 0]
        clouds += (
            cv2.resize(noise, (_MAP_COLUMNS, _MAP_ROWS), interpolation=cv2.INTER_CUBIC)
            * 0.6**octave
        )
    return (_SEA + _CLOUDS * np.clip(0.35 + 0.4 * clouds, 0.0, 1.0)).astype(np.float32)
