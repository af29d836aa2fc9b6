"""The chasers' cameras: exact picture, effects, compression."""

from __future__ import annotations

import cv2
from chaserdock_protocol.messages import Image
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.targets import target_model

from .effects import CameraEffects, Effects
from .physics import TARGET, BodyState
from .render import Obstacle, Renderer, chaser_boxes
from .sky import Light


class Cameras:
    """Takes the pictures of all chasers of a scenario; a picture depends on its arguments alone."""

    def __init__(self, scenario: Scenario) -> None:
        self._camera = scenario.camera_model()
        self._renderer = Renderer(self._camera, target_model(scenario.target.model))
        e = scenario.camera.effects
        strengths = Effects(e.gain, e.point_spread_px, e.read_noise, e.shot_noise)
        self._effects = CameraEffects(self._camera.width_px, self._camera.height_px, strengths, scenario.seed)
        self._jpeg_quality = e.jpeg_quality
        self._light = Light(scenario.camera.sun_direction)
        body, probe = chaser_boxes(scenario.chaser.size_m, scenario.chaser.probe_reach_m)
        # A chaser's own body lies behind its lens; its probe does not.
        self._own, self._others = (probe,), (body, probe)

    def picture(
        self, chaser: int, number: int, tick: int, time_ns: int, states: dict[str, BodyState]
    ) -> Image:
        """Picture ``number`` of chaser ``chaser`` of the bodies ``states``, exposed at ``time_ns``."""
        own = f"chaser/{chaser}"
        obstacles: list[Obstacle] = [
            (self._own if name == own else self._others, state.position_m, state.q_wxyz)
            for name, state in states.items()
            if name != TARGET
        ]
        position, attitude = self._camera.irf_pose_in_world(states[own].position_m, states[own].q_wxyz)
        target = states[TARGET]
        exact = self._renderer.render(
            position, attitude, target.position_m, target.q_wxyz, obstacles, self._light
        )
        taken = self._effects.apply(exact, chaser, number)
        if self._jpeg_quality:
            data = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality])[1].tobytes()
        else:
            data = taken.tobytes()
        return Image(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            width_px=self._camera.width_px,
            height_px=self._camera.height_px,
            encoding="jpeg" if self._jpeg_quality else "mono8",
            data=data,
        )
