# SPDX-License-Identifier: Apache-2.0
"""Cameras that see the pose of the target instead of a picture, for the perception ``statistical``."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from chaserdock_models import rotations
from chaserdock_protocol.messages import Image
from chaserdock_protocol.pose_image import WIDTH_PX, encode_pose
from chaserdock_protocol.scenario import Scenario

from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.sensors.errors import true_camera

from .cameras import Cameras, States


class PoseCameras:
    """Makes the images of all chasers of a scenario as ``Cameras`` does; an image depends on its arguments only.

    Each camera has the mounting and focal length that the world gives it. Light, blur, noise of the sensor and what stands
    between camera and target are not in these images.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._seed = scenario.seed
        self._focal_px = scenario.camera_model().fx_px
        self._cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]

    def images(
        self, chasers: Sequence[int], number: int, tick: int, time_ns: int, states: States
    ) -> list[Image]:
        """Return ``image`` of several chasers at one time, in their order."""
        return [self.image(i, number, tick, time_ns, states) for i in chasers]

    def image(self, chaser: int, number: int, tick: int, time_ns: int, states: States) -> Image:
        """Return image ``number`` of a chaser, which sees the target as in ``states``."""
        camera, own, target = self._cameras[chaser], states[f"chaser/{chaser}"], states[TARGET]
        eye, attitude = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        position = rotations.rotate_inverse(attitude, target.position_m - eye)
        # With a longer focal length than calibrated, the target seems nearer.
        position = position * [1.0, 1.0, self._focal_px / camera.fx_px]
        q = rotations.multiply(rotations.conjugate(attitude), target.q_wxyz)
        drawn = hashlib.blake2s(f"{self._seed}/image/{chaser}/{number}".encode(), digest_size=8).digest()
        seed = int.from_bytes(drawn[:4], "little"), int.from_bytes(drawn[4:], "little")
        return Image(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            width_px=WIDTH_PX,
            height_px=1,
            encoding="mono8",
            data=encode_pose(position, q, seed),
        )


def make_cameras(scenario: Scenario) -> Cameras | PoseCameras:
    """Return the cameras that the scenario's perception needs."""
    return PoseCameras(scenario) if scenario.perception.name == "statistical" else Cameras(scenario)
