# SPDX-License-Identifier: Apache-2.0
"""Renders a scenario's bodies, Earth and stars in colour for the outside view: sun, cast shadows,
foil, as for the simulated cameras, once for each of three colours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import TriangleMesh
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.orbit import earth_disc, to_sun
from chaserdock_world.rendering.background import SPACE_LEVEL, WHITE_LEVEL, Background, Earth, Light
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from chaserdock_world.rendering.scene_geometry import Obstacle
from numpy.typing import NDArray

from .chase_camera import BgrImage, BodyPose, RenderedBodies, Viewpoint
from .dressed_bodies import AMBIENT, GAMMA, DressedBody, chaser_body, target_body

_SEA = (2.6, 1.25, 0.55)
"""Colour (blue, green, red) of dark parts of the Earth relative to grey: the sea under air."""
_CLOUD_LEVEL = 150.0
"""Grey level (0 to 255) from which on the Earth is white: clouds in the sun."""


class BodyRenderer:
    """Renders the bodies of one scenario for views of one size. ``chasers``: numbers."""

    def __init__(self, scenario: Scenario, chasers: tuple[int, ...], look: Viewpoint) -> None:
        disc, camera = earth_disc(scenario), look.pinhole()
        earth = None if disc is None else Earth(*disc)
        self._light = light_of(scenario)
        # A cuboid of its own stands for each chaser's mesh.
        self._places = {i: (Box((1.0 + i, 1.0, 1.0)),) for i in chasers}
        target = target_body(scenario)
        bodies = {i: chaser_body(scenario, i) for i in chasers}

        def renderer(mesh_of: Callable[[DressedBody], TriangleMesh]) -> MeshRenderer:
            chosen = {self._places[i][0]: mesh_of(bodies[i]) for i in chasers}
            return MeshRenderer(camera, mesh_of(target), substitutes=chosen)

        self._channels = [renderer(lambda b, k=k: b.mesh(k)) for k in (2, 1, 0)]
        self._white = renderer(lambda b: b.white())
        self._space = Background(camera, np.zeros(2), (look.width_px, look.height_px), earth)

    def render(
        self, look: Viewpoint, target: BodyPose, chasers: Mapping[int, BodyPose]
    ) -> RenderedBodies:
        """Render the bodies at their poses over stars and Earth."""
        eye, attitude = look.eye_m, look.attitude()
        obstacles = [(self._places[i], *pose) for i, pose in chasers.items()]
        cover = self._cover(eye, attitude, target, obstacles)
        layers = [renderer.render(eye, attitude, *target, obstacles, self._light)
                  for renderer in self._channels]  # fmt: skip
        space = coloured_space(self._space.draw(attitude, self._light).image)
        mixed = cover * np.stack(layers, axis=2) + (1.0 - cover) * space
        return RenderedBodies(shown(space), shown(mixed.astype(np.uint8)), cover[:, :, 0] > 0.0)

    def _cover(
        self, eye: Array, attitude: Array, target: BodyPose, obstacles: Sequence[Obstacle]
    ) -> NDArray[np.float32]:
        """Return the share (h, w, 1) of each pixel that bodies cover: what is brighter than space,
        stars apart, if bodies are white and lit from all sides.
        """
        nothing = (np.array([0.0, 0.0, 1e6]), np.array([1.0, 0.0, 0.0, 0.0]))
        even = Light(sun=0.0, ambient=1.0)
        white = self._white.render(eye, attitude, *target, obstacles, even).astype(np.float32)
        empty = self._white.render(eye, attitude, *nothing, (), even).astype(np.float32)
        share = (white - empty) / np.maximum(WHITE_LEVEL - empty, 1.0)
        return np.clip(share, 0.0, 1.0)[:, :, None].astype(np.float32)


def light_of(scenario: Scenario) -> Light:
    """Return the sun and the ambient light of films."""
    x, y, z = to_sun(scenario)
    return Light((x, y, z), 1.0 - AMBIENT, AMBIENT)


def coloured_space(grey: NDArray[np.uint8]) -> BgrImage:
    """Return stars and Earth (h, w) in colour: what is dark is bluish, bright clouds are white."""
    level = np.maximum(np.arange(256.0) - SPACE_LEVEL, 0.0)  # an eye has no black level
    white = np.clip(level / _CLOUD_LEVEL, 0.0, 1.0)[:, None]
    table = np.clip(level[:, None] * (white + (1.0 - white) * np.array(_SEA)), 0.0, 255.0)
    return np.asarray(table.astype(np.uint8)[grey], np.uint8)


def shown(bgr: NDArray[np.uint8]) -> BgrImage:
    """Return an image with the exponent for display applied."""
    levels = np.array([255.0 * (v / 255.0) ** GAMMA for v in range(256)]).astype(np.uint8)
    return np.asarray(cv2.LUT(bgr, levels), np.uint8)
