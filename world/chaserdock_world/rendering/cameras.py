"""The chasers' cameras: exact image, blur of motion, glare, effects, compression."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.rotations import Array
from chaserdock_protocol.messages import Image
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.overrides import ScenarioError
from numpy.typing import NDArray

from chaserdock_world.physics.simulation import TARGET, BodyState
from chaserdock_world.sensors.errors import true_camera

from .background import Earth, Light
from .effects import CameraEffects, Effects
from .glare import Glare, is_hidden
from .rasterizer import Renderer, chaser_boxes
from .scene_geometry import Obstacle
from .tinyrenderer import TinyRenderer

# Moments of an exposure: one for every so many pixels of motion, and at most so many.
_BLUR_STEP_PX, _BLUR_MOMENTS = 0.5, 16
_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])

States = dict[str, BodyState]


class Cameras:
    """Takes the images of all chasers of a scenario; an image depends on its arguments alone."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario, section = scenario, scenario.camera
        self._cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]
        self._target = scenario.target_model()
        e, earth = section.effects, section.earth
        self._exposure_s = e.exposure_s
        far = None if earth is None else Earth(earth.direction, math.radians(earth.radius_deg))

        @cache
        def renderer(camera: Camera) -> Renderer | TinyRenderer:
            try:
                kind = Renderer if section.renderer == "exact" else TinyRenderer
                return kind(camera, self._target, far)
            except ValueError as error:
                raise ScenarioError(f"camera: {error}") from None

        self._renderers = [renderer(camera) for camera in self._cameras]
        glares = {c: Glare(c, e.glare) for c in self._cameras} if e.glare > 0.0 else {}
        self._glares = [glares.get(c) for c in self._cameras]
        told = self._cameras[0]
        strengths = Effects(e.gain, e.point_spread_px, e.read_noise, e.shot_noise)
        self._effects = CameraEffects(told.width_px, told.height_px, strengths, scenario.seed)
        self._jpeg_quality = e.jpeg_quality
        self._day = Light(section.sun_direction, 1.0 - section.ambient, section.ambient, section.lamp)
        night = section.ambient * section.eclipse_ambient
        self._night = Light(section.sun_direction, 0.0, night, section.lamp)
        body, probe = chaser_boxes(scenario.chaser.size_m, scenario.chaser.probe_reach_m)
        # A chaser's own body lies behind its lens; its probe does not.
        self._own, self._others = (probe,), (body, probe)
        # PyBullet's renderer is one for all; what is drawn here has nothing to share.
        self._beside = ThreadPoolExecutor(1, "images") if section.renderer == "exact" else None

    def images(
        self, chasers: Sequence[int], number: int, tick: int, time_ns: int, states: States
    ) -> list[Image]:
        """``image`` of several chasers, of one moment, in their order: drawn on two threads."""
        if self._beside is None:
            return [self.image(i, number, tick, time_ns, states) for i in chasers]
        exposure = (number, tick, time_ns, states)
        beside = {i: self._beside.submit(self.image, i, *exposure) for i in chasers[1::2]}
        here = {i: self.image(i, *exposure) for i in chasers[::2]}
        return [here[i] if i in here else beside[i].result() for i in chasers]

    def image(self, chaser: int, number: int, tick: int, time_ns: int, states: States) -> Image:
        """Image ``number`` of chaser ``chaser`` of the bodies ``states``, exposed about ``time_ns``."""
        camera = self._cameras[chaser]
        taken = self.taken(chaser, number, time_ns, states)
        if self._jpeg_quality:
            data = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality])[1].tobytes()
        else:
            data = taken.tobytes()
        return Image(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            width_px=camera.width_px,
            height_px=camera.height_px,
            encoding="jpeg" if self._jpeg_quality else "mono8",
            data=data,
        )

    def taken(self, chaser: int, number: int, time_ns: int, states: States) -> NDArray[np.uint8]:
        """The image (h, w), uint8, before it is compressed."""
        eclipses = self._scenario.camera.eclipses
        dark = any(e.from_s <= time_ns * 1e-9 < e.to_s for e in eclipses)
        light = self._night if dark else self._day
        moments = self._moments(chaser, states)
        images = [self._exact(chaser, s, light) for s in moments]
        exact = images[0]
        if len(images) > 1:
            total = np.sum(images, axis=0, dtype=np.uint16)
            exact = np.asarray((total + len(images) // 2) // len(images), dtype=np.uint8)
        glare = self._glares[chaser]
        if glare is not None and not dark:
            position, attitude = self._eye(chaser, states)
            target = (self._target.boxes, states[TARGET].position_m, states[TARGET].q_wxyz)
            if not is_hidden(position, light.direction_w, [target, *self._bodies(chaser, states)]):
                exact = glare.add(exact, rotations.rotate_inverse(attitude, light.direction_w))
        return self._effects.apply(exact, chaser, number)

    def _exact(self, chaser: int, states: States, light: Light) -> NDArray[np.uint8]:
        position, attitude = self._eye(chaser, states)
        target = states[TARGET]
        bodies = self._bodies(chaser, states)
        return self._renderers[chaser].render(
            position, attitude, target.position_m, target.q_wxyz, bodies, light
        )

    def _eye(self, chaser: int, states: States) -> tuple[Array, Array]:
        own = states[f"chaser/{chaser}"]
        return self._cameras[chaser].irf_pose_in_world(own.position_m, own.q_wxyz)

    def _bodies(self, chaser: int, states: States) -> list[Obstacle]:
        own = f"chaser/{chaser}"
        return [
            (self._own if name == own else self._others, state.position_m, state.q_wxyz)
            for name, state in states.items()
            if name != TARGET
        ]

    def _moments(self, chaser: int, states: States) -> list[States]:
        """The bodies at moments spread over the exposure, as many as their motion in the image asks for."""
        if self._exposure_s == 0.0:
            return [states]
        ends = [self._corners(chaser, _moved(states, s * self._exposure_s)) for s in (-0.5, 0.5)]
        motion = np.abs(ends[1] - ends[0])
        motion_px = float(motion[np.isfinite(motion)].max(initial=0.0))
        n = min(math.ceil(motion_px / _BLUR_STEP_PX), _BLUR_MOMENTS)
        if n < 2:
            return [states]
        return [_moved(states, ((k + 0.5) / n - 0.5) * self._exposure_s) for k in range(n)]

    def _corners(self, chaser: int, states: States) -> Array:
        """Pixels (8, 2) of the corners of a cuboid about the target."""
        position, attitude = self._eye(chaser, states)
        target = states[TARGET]
        at_w = rotations.rotate(target.q_wxyz, _CUBE * self._target.size_m) + target.position_m
        return self._cameras[chaser].project_ideal(rotations.rotate_inverse(attitude, at_w - position))


def _moved(states: States, time_s: float) -> States:
    """The bodies ``time_s`` later at their present rates."""
    return {
        name: BodyState(
            s.position_m + s.velocity_m_s * time_s,
            s.velocity_m_s,
            rotations.integrate(s.q_wxyz, s.omega_rad_s, time_s),
            s.omega_rad_s,
        )
        for name, s in states.items()
    }
