# SPDX-License-Identifier: Apache-2.0
"""Renders target and chasers with meshes for the outside view, as for the simulated cameras but
with each chaser in its colour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import Material, TriangleMesh, moved
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.orbit import earth_disc, to_sun
from chaserdock_world.rendering.background import Background, Earth, Light
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from numpy.typing import NDArray

from .chase_camera import BgrImage, BodyPose, RenderedBodies, Viewpoint

_AMBIENT = 0.45
"""Share of ambient light: more than in the cameras' images, so that the shaded side is visible."""
_GAMMA = 0.6
"""Exponent of the grey levels for display, as in snapshots."""
_BRIGHTER = 1.5
"""Brightness of a chaser's colour relative to grey of the same grey level; the colour's low
components would darken it.
"""
_BLACK = Material("black", diffuse=0.0)


class BodyRenderer:
    """Renders the bodies of one scenario, whose target has a mesh, for views of one size."""

    def __init__(self, scenario: Scenario, mesh: TriangleMesh, look: Viewpoint) -> None:
        disc, camera = earth_disc(scenario), look.pinhole()
        earth = None if disc is None else Earth(*disc)
        x, y, z = to_sun(scenario)
        self._light = Light((x, y, z), 1.0 - _AMBIENT, _AMBIENT)
        body, probe = scenario.chaser.boxes()
        self._boxes = (body, probe)
        self._black = tuple(replace(box, shade=0.0) for box in self._boxes)
        substitutes: dict[Box, TriangleMesh] = {}
        if scenario.chaser.mesh:
            shape = satellite(scenario.chaser.mesh)
            low, high = shape.bounds_m()
            shape = moved(shape, np.zeros(3), np.array(scenario.chaser.size_m) / (high - low))
            black = tuple(replace(part, material=_BLACK) for part in shape.parts)
            substitutes = {body: shape, self._black[0]: replace(shape, parts=black)}
        self._renderer = MeshRenderer(camera, mesh, earth, substitutes=substitutes)
        self._space = Background(camera, np.zeros(2), (look.width_px, look.height_px), earth)

    def render(
        self,
        look: Viewpoint,
        target: BodyPose,
        chasers: dict[int, BodyPose],
        tint: Callable[[int], Array],
    ) -> RenderedBodies:
        """Render the bodies at their poses. ``tint`` returns the colour (3,), BGR, of a chaser.

        A chaser's share of a pixel is how much the pixel darkens if that chaser is black.
        """
        eye, attitude = look.centre_m + look.axes()[2] * look.distance_m, look.attitude()

        def grey(black: int | None) -> NDArray[np.uint8]:
            bodies = [
                (self._black if i == black else self._boxes, *pose) for i, pose in chasers.items()
            ]
            return self._renderer.render(eye, attitude, *target, bodies, self._light)

        whole, behind = grey(None), self._space.draw(attitude, self._light)
        colours = np.repeat(whole[:, :, None].astype(float), 3, axis=2)
        for i in chasers:
            own = np.clip(whole.astype(float) - grey(i), 0.0, None)
            hue = _BRIGHTER * tint(i) / tint(i).max() - 1.0
            colours += own[:, :, None] * hue
        levels = np.array([255.0 * (v / 255.0) ** _GAMMA for v in range(256)]).astype(np.uint8)
        bgr: BgrImage = np.asarray(
            cv2.LUT(np.clip(colours, 0.0, 255.0).astype(np.uint8), levels), np.uint8
        )
        space: BgrImage = np.asarray(
            cv2.LUT(np.repeat(behind[:, :, None], 3, axis=2), levels), np.uint8
        )
        return RenderedBodies(space, bgr, np.any(bgr != space, axis=2))
