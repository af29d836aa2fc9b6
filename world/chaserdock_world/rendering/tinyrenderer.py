# SPDX-License-Identifier: Apache-2.0
"""Adapter to PyBullet's software renderer TinyRenderer, for targets of any shape.

Renders a scene of its own, separate from the physics, with the camera at the origin (x right, y up,
looking along -z). TinyRenderer samples half a pixel off, which is compensated here, and does not
supersample, so the image is rendered ``supersampled`` times as wide and high and averaged.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import Box, TargetModel, face_extent, face_rotation
from numpy.typing import ArrayLike, NDArray

from chaserdock_world.physics.bullet import connect, pybullet

from . import textures
from .background import WHITE_LEVEL, Background, Earth, Light
from .lens import Lens, spread_points
from .rasterizer import DAYLIGHT
from .scene_geometry import NEAR_M, Obstacle

_FAR_M = 50.0
_BEHIND = (0.0, 0.0, 1000.0)
# IRF (x right, y down, z forward) -> the axes of Bullet's camera.
_Q_GL_IRF = np.array([0.0, 1.0, 0.0, 0.0])
# Markers on a mesh are drawn this far above their plane, so that the mesh does not hide them.
_LIFT_M = 2e-4


class TinyRenderer:
    """Renders what ``camera`` sees with TinyRenderer; the interface is that of
    `rasterizer.Renderer`.

    ``model.mesh``, if given, replaces the target's boxes. ``supersampled``: samples per pixel along
    each axis. Raises ValueError for a mesh that PyBullet cannot read, and as `Lens` does.
    """

    def __init__(
        self,
        camera: Camera,
        model: TargetModel,
        earth: Earth | None = None,
        point_spread_px: float = 0.0,
        supersampled: int = 2,
    ) -> None:
        self.camera, self.model, self._samples = camera, model, supersampled
        self._point_spread_px = point_spread_px
        self._lens = Lens(camera)
        self._background = Background(camera, self._lens.origin_px, self._lens.size_px, earth)
        self._bullet = connect()
        self._obstacles: dict[tuple[Box, ...], list[int]] = {}
        with tempfile.TemporaryDirectory(prefix="chaserdock-") as folder:
            self._folder = Path(folder)
            # Bodies with their position and attitude in TRF.
            self._target = self._mesh_parts() if model.mesh else self._box_parts()
        width, height = self._lens.size_px
        left, top = (self._lens.origin_px - (camera.cx_px, camera.cy_px)).tolist()
        # Borders of the image at the near plane. TinyRenderer samples at the upper left corners of
        # its pixels, counted from the bottom: half a sample to the left and half a sample up.
        left, top = left - 0.5 + 0.5 / supersampled, top - 0.5 - 0.5 / supersampled
        bounds = (
            left / camera.fx_px,
            (left + width) / camera.fx_px,
            -(top + height) / camera.fy_px,
            -top / camera.fy_px,
        )
        left, right, bottom, up = (NEAR_M * b for b in bounds)
        self._projection = pybullet.computeProjectionMatrix(left, right, bottom, up, NEAR_M, _FAR_M)

    def render(
        self,
        camera_position_w_m: ArrayLike,
        camera_q_w_irf_wxyz: ArrayLike,
        target_p_w_m: ArrayLike,
        target_q_w_trf_wxyz: ArrayLike,
        obstacles: Sequence[Obstacle] = (),
        light: Light = DAYLIGHT,
    ) -> NDArray[np.uint8]:
        """Return the image (h, w), uint8; arguments as for `rasterizer.Renderer.render`.

        TinyRenderer has a single light: in the dark the camera's lamp replaces the sun, without
        inverse-square falloff.
        """
        q_w_irf = np.asarray(camera_q_w_irf_wxyz, dtype=float)
        eye = np.asarray(camera_position_w_m, dtype=float)
        q_gl_w = rotations.multiply(_Q_GL_IRF, rotations.conjugate(q_w_irf))

        def place(bodies: list[tuple[int, Array, Array]], p_w: ArrayLike, q_w: ArrayLike) -> None:
            q = rotations.multiply(q_gl_w, q_w)
            p = rotations.rotate(q_gl_w, np.asarray(p_w, dtype=float) - eye)
            for body, p_body, q_body in bodies:
                at = p + rotations.rotate(q, p_body)
                turn = rotations.multiply(q, q_body).tolist()
                self._bullet.resetBasePositionAndOrientation(
                    body, at.tolist(), [*turn[1:], turn[0]]
                )

        place(self._target, target_p_w_m, target_q_w_trf_wxyz)
        used: dict[tuple[Box, ...], int] = {}
        for boxes, p_w, q_w in obstacles:
            kind = tuple(boxes)
            k = used[kind] = used.get(kind, -1) + 1
            place(self._obstacle(kind, k), p_w, q_w)
        for kind, bodies in self._obstacles.items():
            for body in bodies[(used.get(kind, -1) + 1) * len(kind) :]:
                self._bullet.resetBasePositionAndOrientation(body, _BEHIND, [0.0, 0.0, 0.0, 1.0])
        drawn = self._draw(self._background.draw(q_w_irf, light), q_gl_w, light)
        return self._lens.distort(spread_points(drawn, self._point_spread_px))

    def _draw(
        self, background: NDArray[np.uint8], q_gl_w: Array, light: Light
    ) -> NDArray[np.uint8]:
        height, width = background.shape
        n = self._samples
        full = WHITE_LEVEL / 255.0
        lamp = light.lamp / WHITE_LEVEL
        to_light = rotations.rotate(q_gl_w, light.direction_w)
        if light.sun == 0.0 and lamp > 0.0:
            to_light = np.array([0.0, 0.0, 1.0])
        _, _, rgba, _, segments = self._bullet.getCameraImage(
            n * width,
            n * height,
            viewMatrix=np.eye(4).ravel().tolist(),
            projectionMatrix=self._projection,
            lightDirection=to_light.tolist(),
            lightColor=[1.0, 1.0, 1.0],
            shadow=0,
            lightAmbientCoeff=full * light.ambient,
            lightDiffuseCoeff=full * (light.sun or lamp),
            lightSpecularCoeff=0.0,
            renderer=pybullet.ER_TINY_RENDERER,
        )
        grey = np.ascontiguousarray(
            np.reshape(rgba, (n * height, n * width, 4))[..., 0], dtype=np.uint8
        )
        behind = np.reshape(segments, grey.shape) < 0
        far = cv2.resize(background, (n * width, n * height), interpolation=cv2.INTER_NEAREST)
        np.copyto(grey, np.asarray(far, dtype=np.uint8), where=behind)
        if n == 1:
            return grey
        return np.asarray(
            cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )

    def _obstacle(self, kind: tuple[Box, ...], k: int) -> list[tuple[int, Array, Array]]:
        """Return the parts of the k-th body made of the boxes ``kind``."""
        bodies = self._obstacles.setdefault(kind, [])
        while len(bodies) < (k + 1) * len(kind):
            bodies += [self._box(box) for box in kind]
        mine = bodies[k * len(kind) : (k + 1) * len(kind)]
        return [
            (i, np.array(b.position_m), np.array(b.q_wxyz)) for i, b in zip(mine, kind, strict=True)
        ]

    def _box(self, box: Box) -> int:
        return self._body(
            shapeType=pybullet.GEOM_BOX,
            halfExtents=[s / 2.0 for s in box.size_m],
            rgbaColor=[box.shade, box.shade, box.shade, 1.0],
        )

    def _body(self, **shape: object) -> int:
        try:
            visual = self._bullet.createVisualShape(specularColor=[0.0, 0.0, 0.0], **shape)
            return self._bullet.createMultiBody(baseMass=0.0, baseVisualShapeIndex=visual)
        except pybullet.error as error:
            raise ValueError(f"PyBullet cannot create the visual shape: {error}") from None

    def _box_parts(self) -> list[tuple[int, Array, Array]]:
        parts = []
        for index, box in enumerate(self.model.boxes):
            for face in range(6):
                texture = textures.finest_texture(self.model, index, face)
                if texture is None:
                    texture = np.full((2, 2), round(255 * box.shade), dtype=np.uint8)
                width, height, depth = face_extent(box.size_m, face)
                q = rotations.multiply(box.q_wxyz, face_rotation(face))
                centre = np.array(box.position_m) + rotations.rotate(q, [0.0, 0.0, depth])
                parts.append((self._quad(width, height, texture), centre, q))
        return parts

    def _mesh_parts(self) -> list[tuple[int, Array, Array]]:
        mesh, shade = self.model.mesh, self.model.boxes[0].shade
        if not Path(mesh).is_file():
            raise ValueError(f"the target's mesh {mesh} is not a file")
        body = self._body(
            shapeType=pybullet.GEOM_MESH,
            fileName=mesh,
            meshScale=[self.model.mesh_scale] * 3,
            rgbaColor=[shade, shade, shade, 1.0],
        )
        parts = [(body, np.zeros(3), rotations.IDENTITY)]
        for marker in self.model.markers:
            q = np.array(marker.q_trf_marker_wxyz)
            side = marker.side_m + 2.0 * self.model.white_margin_m
            at = np.array(marker.position_trf_m) + rotations.rotate(q, [0.0, 0.0, _LIFT_M])
            parts.append(
                (self._quad(side, side, textures.label_texture(self.model, marker)), at, q)
            )
        return parts

    def _quad(self, width_m: float, height_m: float, texture: NDArray[np.uint8]) -> int:
        """Return a textured rectangle (x right, y up, seen from +z) about its centre."""
        x, y = width_m / 2.0, height_m / 2.0
        body = self._body(
            shapeType=pybullet.GEOM_MESH,
            vertices=[[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]],
            indices=[0, 1, 2, 0, 2, 3],
            uvs=[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
            normals=[[0.0, 0.0, 1.0]] * 4,
            rgbaColor=[1.0, 1.0, 1.0, 1.0],
        )
        path = self._folder / f"{body}.png"
        cv2.imwrite(str(path), cv2.cvtColor(texture, cv2.COLOR_GRAY2BGR))
        self._bullet.changeVisualShape(
            body, -1, textureUniqueId=self._bullet.loadTexture(str(path))
        )
        return body

    def close(self) -> None:
        """Disconnect the PyBullet client."""
        self._bullet.disconnect()
