# SPDX-License-Identifier: Apache-2.0
"""Path-traced images of simulated cameras: the bodies, light, lens and background of the fast
renderers, which place every edge alike. Sensor effects come after (`Cameras`).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.orbit import earth_disc
from chaserdock_world.plant import true_mesh, true_target
from chaserdock_world.rendering.background import Background, Earth, Light
from chaserdock_world.rendering.lens import LensMap, spread_points
from chaserdock_world.rendering.mesh_markers import with_markers
from chaserdock_world.rendering.mesh_renderer import DAYLIGHT, mesh_of_boxes
from chaserdock_world.rendering.scene_geometry import Obstacle
from chaserdock_world.rendering.textures import BLACK, WHITE
from numpy.typing import ArrayLike, NDArray

from chaserdock.analysis.dressed_bodies import Coat, DressedBody, add_markers, grey_coat

from .path_tracer import PathTracer, Surfaces, fastest_variant, require_mitsuba, surfaces

_PAPER, _INK = Coat((WHITE, WHITE, WHITE)), Coat((BLACK, BLACK, BLACK))
"""Coats of markers: reflectances of the fast renderers' prints."""
_PRINT_LIFT_M = 1e-4
"""Distance, m, between the layers of a print: a hundred times the resolution of the tracer's
numbers at 5 m, and less than its markers are known to."""


def path_tracing(
    scenario: Scenario, samples: int, threads: int
) -> Callable[[Camera], PathTracedCamera]:
    """Return a function that makes the path tracer of a camera. Raise ChaserdockError without
    mitsuba.
    """
    require_mitsuba()
    tracer = PathTracer(samples, fastest_variant(), threads)
    return lambda camera: PathTracedCamera(scenario, camera, tracer)


class PathTracedCamera:
    """Draws what a camera sees of a scenario's true target and of boxes."""

    def __init__(self, scenario: Scenario, camera: Camera, tracer: PathTracer) -> None:
        self._tracer = tracer
        disc = earth_disc(scenario)
        self._earth = None if disc is None else Earth(*disc)
        self._target = surfaces(_true_body(scenario))
        self._boxes: dict[tuple[Box, ...], Surfaces] = {}
        self._lens = LensMap(camera, scenario.camera.effects.point_spread_px)
        self._size, origin = self._lens.size_px, self._lens.origin_px
        self._background = Background(camera, origin, self._size, self._earth)
        self._traced, self._to_canvas = _square(camera, origin, self._size)

    def render(
        self,
        camera_position_w_m: ArrayLike,
        camera_q_w_irf_wxyz: ArrayLike,
        target_p_w_m: ArrayLike,
        target_q_w_trf_wxyz: ArrayLike,
        obstacles: Sequence[Obstacle] = (),
        light: Light = DAYLIGHT,
    ) -> NDArray[np.uint8]:
        """Return the image (h, w), uint8. Arguments as of `Renderer.render`. Equal arguments give
        equal images.
        """
        q_w_irf = np.asarray(camera_q_w_irf_wxyz, dtype=float)
        place = np.asarray(camera_position_w_m, dtype=float), q_w_irf
        bodies = [(self._target, target_p_w_m, target_q_w_trf_wxyz)]
        bodies += [(self._of_boxes(tuple(boxes)), p, q) for boxes, p, q in obstacles]
        placed = [(s, (np.asarray(p), np.asarray(q))) for s, p, q in bodies]
        seed = zlib.crc32(np.concatenate([*place, *placed[0][1]]).tobytes())
        traced = self._tracer.trace(self._traced, place, placed, light, self._earth, seed)
        if self._to_canvas is not None:
            flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            traced = cv2.warpAffine(
                traced, self._to_canvas, self._size, None, flags, cv2.BORDER_REPLICATE
            )
        behind = self._background.draw(q_w_irf, light).image
        # Reflectances are equal in all colours: green is grey.
        level = 255.0 * traced[:, :, 1] + (1.0 - np.clip(traced[:, :, 3], 0.0, 1.0)) * behind
        canvas = np.clip(np.rint(level), 0.0, 255.0).astype(np.uint8)
        return self._lens.distort(spread_points(canvas, self._lens.canvas_spread_px))

    def _of_boxes(self, boxes: tuple[Box, ...]) -> Surfaces:
        if boxes not in self._boxes:
            parts = mesh_of_boxes(boxes).parts
            self._boxes[boxes] = surfaces(DressedBody([(p, grey_coat(p.material)) for p in parts]))
        return self._boxes[boxes]


def _true_body(scenario: Scenario) -> DressedBody:
    """Return the target as the world draws it."""
    model, mesh = true_target(scenario), true_mesh(scenario)
    shape = mesh_of_boxes(model.boxes) if mesh is None else with_markers(mesh, model)
    body = DressedBody([(part, grey_coat(part.material)) for part in shape.parts])
    if mesh is None:
        add_markers(body, model, _PAPER, _INK, _PRINT_LIFT_M)
    return body


def _square(
    camera: Camera, origin_px: Array, size_px: tuple[int, int]
) -> tuple[Camera, Array | None]:
    """Return the camera of the ideal image that begins at ``origin_px``, with square pixels of the
    smaller side, and the affine map (2, 3) from the ideal image's pixels to its; None if equal.
    """
    focal_px = max(camera.fx_px, camera.fy_px)
    scale = focal_px / np.array([camera.fx_px, camera.fy_px])
    width, height = (math.ceil(n * s - 1e-9) for n, s in zip(size_px, scale, strict=True))
    # Pixels have their centre at whole numbers: images begin at -1/2.
    x, y = (np.array([camera.cx_px, camera.cy_px]) - origin_px + 0.5) * scale - 0.5
    traced = Camera(width, height, focal_px, focal_px, float(x), float(y))
    if camera.fx_px == camera.fy_px:
        return traced, None
    return traced, np.column_stack([np.diag(scale), 0.5 * scale - 0.5])
