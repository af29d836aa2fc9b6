# SPDX-License-Identifier: Apache-2.0
"""Renders a scenario's bodies, Earth and stars in colour for the outside view: sun, cast shadows,
foil, as for the simulated cameras, once for each of three colours.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.orbit import earth_disc, to_sun
from chaserdock_world.rendering.background import SPACE_LEVEL, Background, Earth, Light
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from numpy.typing import NDArray

from .chase_camera import BgrImage, BodyPose, RenderedBodies, Viewpoint, tint
from .film_bodies import chaser_body, target_body

_AMBIENT = 0.22
"""Share of ambient light: less than in the cameras' images, so that shadows are dark, but the
shaded side is visible."""
_GAMMA = 0.6
"""Exponent of the grey levels for display, as in snapshots."""
_SEA = (2.6, 1.25, 0.55)
"""Colour (blue, green, red) of dark parts of the Earth relative to grey: the sea under air."""
_CLOUD_LEVEL = 150.0
"""Grey level (0 to 255) from which on the Earth is white: clouds in the sun."""


class BodyRenderer:
    """Renders the bodies of one scenario for views of one size. ``chasers``: numbers."""

    def __init__(self, scenario: Scenario, chasers: tuple[int, ...], look: Viewpoint) -> None:
        disc, camera = earth_disc(scenario), look.pinhole()
        earth = None if disc is None else Earth(*disc)
        x, y, z = to_sun(scenario)
        self._light = Light((x, y, z), 1.0 - _AMBIENT, _AMBIENT)
        # A cuboid of its own stands for each chaser's mesh.
        self._places = {i: (Box((1.0 + i, 1.0, 1.0)),) for i in chasers}
        target = target_body(scenario)
        bodies = {i: chaser_body(scenario, i, reflectance(i)) for i in chasers}
        self._channels = [
            MeshRenderer(
                camera,
                target.mesh(channel),
                substitutes={self._places[i][0]: bodies[i].mesh(channel) for i in chasers},
            )
            for channel in (2, 1, 0)
        ]
        self._space = Background(camera, np.zeros(2), (look.width_px, look.height_px), earth)

    def background(self, look: Viewpoint) -> BgrImage:
        """Return stars and coloured Earth, before the display's exponent."""
        return coloured_space(self._space.draw(look.attitude(), self._light))

    def render(
        self, look: Viewpoint, target: BodyPose, chasers: Mapping[int, BodyPose]
    ) -> RenderedBodies:
        """Render the bodies at their poses over stars and Earth."""
        eye, attitude = look.eye_m, look.attitude()
        obstacles = [(self._places[i], *pose) for i, pose in chasers.items()]
        layers = [
            renderer.render(eye, attitude, *target, obstacles, self._light)
            for renderer in self._channels
        ]
        bodies, space = np.stack(layers, axis=2), self._space.draw(attitude, self._light)
        empty = self._channels[0].render(
            eye, attitude, (0.0, 0.0, 1e6), (1.0, 0.0, 0.0, 0.0), (), self._light
        )
        covered = np.any(bodies != empty[:, :, None], axis=2)
        behind = shown(coloured_space(space))
        bgr = np.where(covered[:, :, None], shown(bodies), behind)
        return RenderedBodies(behind, np.asarray(bgr, np.uint8), covered)


def reflectance(chaser: int) -> tuple[float, float, float]:
    """Return a chaser's colour as paint: red, green, blue, 0 to 1."""
    blue, green, red = (0.85 * (tint(chaser) / 255.0) ** 1.6).tolist()
    return red, green, blue


def coloured_space(grey: NDArray[np.uint8]) -> BgrImage:
    """Return stars and Earth (h, w) in colour: what is dark is bluish, bright clouds are white."""
    level = np.maximum(np.arange(256.0) - SPACE_LEVEL, 0.0)  # an eye has no black level
    white = np.clip(level / _CLOUD_LEVEL, 0.0, 1.0)[:, None]
    table = np.clip(level[:, None] * (white + (1.0 - white) * np.array(_SEA)), 0.0, 255.0)
    return np.asarray(table.astype(np.uint8)[grey], np.uint8)


def shown(bgr: NDArray[np.uint8]) -> BgrImage:
    """Return an image with the exponent for display applied."""
    levels = np.array([255.0 * (v / 255.0) ** _GAMMA for v in range(256)]).astype(np.uint8)
    return np.asarray(cv2.LUT(bgr, levels), np.uint8)
