# SPDX-License-Identifier: Apache-2.0
"""Simulate the chasers' cameras: rendering, motion blur, glare, sensor effects, compression."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Protocol

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import moved
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import cuboid_corners
from chaserdock_protocol.messages import Image
from chaserdock_protocol.scenario import Scenario
from numpy.typing import ArrayLike, NDArray

from chaserdock_world.orbit import TargetOrbit, earth_disc
from chaserdock_world.physics.simulation import TARGET, BodyState
from chaserdock_world.plant import true_mesh, true_target
from chaserdock_world.sensors.errors import true_camera

from .background import Earth, Light
from .effects import CameraEffects
from .glare import Glare, is_occluded
from .mesh_markers import with_markers
from .mesh_renderer import MeshRenderer
from .rasterizer import Renderer
from .scene_geometry import Obstacle

# Motion of the target, px, for which motion blur takes one sample of the exposure, and most
# samples.
_BLUR_STEP_PX, _BLUR_SAMPLES_MAX = 0.5, 16

_ECLIPSE_AMBIENT = 0.05
"""Share of `camera.ambient` that remains in an eclipse: a scene that is all but black."""

States = dict[str, BodyState]


class SceneRenderer(Protocol):
    """Draws what one camera sees: `Renderer`, `MeshRenderer`, or a renderer from elsewhere."""

    def render(
        self,
        camera_position_w_m: ArrayLike,
        camera_q_w_irf_wxyz: ArrayLike,
        target_p_w_m: ArrayLike,
        target_q_w_trf_wxyz: ArrayLike,
        obstacles: Sequence[Obstacle] = ...,
        light: Light = ...,
    ) -> NDArray[np.uint8]:
        """Return the image, as `Renderer.render` does."""
        ...


class Cameras:
    """Make the images of all chasers of a scenario; an image depends on its arguments only.

    ``renderer_of``: makes the renderer of a camera in place of the one that suits the target.
    """

    def __init__(
        self, scenario: Scenario, renderer_of: Callable[[Camera], SceneRenderer] | None = None
    ) -> None:
        self._scenario, section = scenario, scenario.camera
        self._cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]
        self._target = true_target(scenario)
        effects, disc = section.effects, earth_disc(scenario)
        self._orbit = None if scenario.orbit is None else TargetOrbit(scenario.orbit)
        self._exposure_s = effects.exposure_s
        background = None if disc is None else Earth(*disc)
        body, probe = scenario.chaser.boxes()
        mesh, substitutes = true_mesh(scenario), {}
        if mesh is not None:
            mesh = with_markers(mesh, self._target)
        if scenario.chaser.mesh:
            shape = satellite(scenario.chaser.mesh)
            low, high = shape.bounds_m()
            substitutes[body] = moved(shape, np.zeros(3), np.array(body.size_m) / (high - low))

        @cache
        def renderer(camera: Camera) -> SceneRenderer:
            if renderer_of is not None:
                return renderer_of(camera)
            spread_px = effects.point_spread_px
            if mesh is not None:
                return MeshRenderer(camera, mesh, background, spread_px, substitutes)
            return Renderer(camera, self._target, background, spread_px)

        self._renderers = [renderer(camera) for camera in self._cameras]
        glares = {c: Glare(c, effects.glare) for c in self._cameras} if effects.glare > 0.0 else {}
        self._glares = [glares.get(c) for c in self._cameras]
        first = self._cameras[0]
        self._effects = CameraEffects(first.width_px, first.height_px, effects, scenario.seed)
        self._jpeg_quality = effects.jpeg_quality
        self._day = Light(
            section.sun_direction, 1.0 - section.ambient, section.ambient, section.lamp
        )
        night = section.ambient * _ECLIPSE_AMBIENT
        self._night = Light(section.sun_direction, 0.0, night, section.lamp)
        # A chaser's own body is behind its lens, its probe is not.
        self._own, self._others = (probe,), (body, probe)
        self._second_thread = ThreadPoolExecutor(1, "images")

    def images(
        self, chasers: Sequence[int], number: int, tick: int, time_ns: int, states: States
    ) -> list[Image]:
        """Return ``image`` of several chasers at one time, in their order, rendered on two
        threads.
        """
        exposure = (number, tick, time_ns, states)
        futures = {i: self._second_thread.submit(self.image, i, *exposure) for i in chasers[1::2]}
        images = {i: self.image(i, *exposure) for i in chasers[::2]}
        return [images[i] if i in images else futures[i].result() for i in chasers]

    def image(self, chaser: int, number: int, tick: int, time_ns: int, states: States) -> Image:
        """Return image ``number`` of a chaser of the bodies ``states``; the exposure is centred on
        ``time_ns``.
        """
        camera = self._cameras[chaser]
        pixels = self.render(chaser, number, time_ns, states)
        if self._jpeg_quality:
            data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality])[
                1
            ].tobytes()
        else:
            data = pixels.tobytes()
        return Image(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            width_px=camera.width_px,
            height_px=camera.height_px,
            encoding="jpeg" if self._jpeg_quality else "mono8",
            data=data,
        )

    def light_at(self, time_s: float) -> Light:
        """Return the light at a time of the mission."""
        section, orbit = self._scenario.camera, self._orbit
        if orbit is None:
            dark = any(e.from_s <= time_s < e.to_s for e in section.eclipses)
            return self._night if dark else self._day
        share = orbit.sunlit_share(time_s)
        x, y, z = orbit.to_sun(time_s).tolist()
        ambient = section.ambient * (_ECLIPSE_AMBIENT + (1.0 - _ECLIPSE_AMBIENT) * share)
        return Light((x, y, z), (1.0 - section.ambient) * share, ambient, section.lamp)

    def render(self, chaser: int, number: int, time_ns: int, states: States) -> NDArray[np.uint8]:
        """Return the image (h, w), uint8, before compression."""
        light = self.light_at(time_ns * 1e-9)
        samples = [
            self._render_sharp(chaser, s, light) for s in self._sample_exposure(chaser, states)
        ]
        image = samples[0]
        if len(samples) > 1:
            total = np.sum(samples, axis=0, dtype=np.uint16)
            image = np.asarray((total + len(samples) // 2) // len(samples), dtype=np.uint8)
        glare = self._glares[chaser]
        if glare is not None and light.sun > 0.0:
            position, attitude = self._camera_pose(chaser, states)
            target = (self._target.boxes, states[TARGET].position_m, states[TARGET].q_wxyz)
            if not is_occluded(
                position, light.direction_w, [target, *self._bodies(chaser, states)]
            ):
                image = glare.add(image, rotations.rotate_inverse(attitude, light.direction_w))
        return self._effects.apply(image, chaser, number)

    def _render_sharp(self, chaser: int, states: States, light: Light) -> NDArray[np.uint8]:
        position, attitude = self._camera_pose(chaser, states)
        target = states[TARGET]
        bodies = self._bodies(chaser, states)
        return self._renderers[chaser].render(
            position, attitude, target.position_m, target.q_wxyz, bodies, light
        )

    def _camera_pose(self, chaser: int, states: States) -> tuple[Array, Array]:
        own = states[f"chaser/{chaser}"]
        return self._cameras[chaser].irf_pose_in_world(own.position_m, own.q_wxyz)

    def _bodies(self, chaser: int, states: States) -> list[Obstacle]:
        own = f"chaser/{chaser}"
        return [
            (self._own if name == own else self._others, state.position_m, state.q_wxyz)
            for name, state in states.items()
            if name != TARGET
        ]

    def _sample_exposure(self, chaser: int, states: States) -> list[States]:
        """Return the bodies at times spread over the exposure.

        As many as the motion of the target in the image needs.
        """
        if self._exposure_s == 0.0:
            return [states]
        ends = [
            self._corners(chaser, _propagate(states, s * self._exposure_s)) for s in (-0.5, 0.5)
        ]
        motion = np.abs(ends[1] - ends[0])
        motion_px = float(motion[np.isfinite(motion)].max(initial=0.0))
        n = min(math.ceil(motion_px / _BLUR_STEP_PX), _BLUR_SAMPLES_MAX)
        if n < 2:
            return [states]
        return [_propagate(states, ((k + 0.5) / n - 0.5) * self._exposure_s) for k in range(n)]

    def _corners(self, chaser: int, states: States) -> Array:
        """Return the pixels (8, 2) of the corners of a cuboid around the target."""
        position, attitude = self._camera_pose(chaser, states)
        target = states[TARGET]
        at_w = (
            rotations.rotate(target.q_wxyz, cuboid_corners(self._target.size_m)) + target.position_m
        )
        return self._cameras[chaser].project_ideal(
            rotations.rotate_inverse(attitude, at_w - position)
        )


def _propagate(states: States, time_s: float) -> States:
    """Return the bodies ``time_s`` later at constant rates."""
    return {
        name: BodyState(
            s.position_m + s.velocity_m_s * time_s,
            s.velocity_m_s,
            rotations.integrate(s.q_wxyz, s.omega_rad_s, time_s),
            s.omega_rad_s,
        )
        for name, s in states.items()
    }
