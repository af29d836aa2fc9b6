# SPDX-License-Identifier: Apache-2.0
"""Make images that contain the pose of the target, for the perception ``statistical``.

Also the range sensor of other perceptions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.random_numbers import generator
from chaserdock_models.ranging import range_reading
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Image, RangeMeasurement
from chaserdock_protocol.pose_image import WIDTH_PX, encode_pose
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.ranging import Ranging

from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.sensors.errors import true_camera

from .cameras import Cameras, States


class PoseSensor:
    """Measure the pose of the target in each chaser's true camera.

    Mounting and focal length are those that the world gives the camera.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._seed = scenario.seed
        self._focal_px = scenario.camera_model().fx_px
        self._cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]

    def seen_pose(self, chaser: int, states: States) -> tuple[Array, Array]:
        """Return the pose as seen: with a longer focal length than calibrated the target seems
        nearer.
        """
        position, q = self.pose(chaser, states)
        return position * [1.0, 1.0, self._focal_px / self._cameras[chaser].fx_px], q

    def pose(self, chaser: int, states: States) -> tuple[Array, Array]:
        """Return position (3,) m in IRF and rotation (4,) TRF to IRF."""
        camera, own, target = self._cameras[chaser], states[f"chaser/{chaser}"], states[TARGET]
        eye, attitude = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        position = rotations.rotate_inverse(attitude, target.position_m - eye)
        return position, rotations.multiply(rotations.conjugate(attitude), target.q_wxyz)

    def drawn(self, chaser: int, number: int) -> tuple[int, int]:
        """Return the numbers below 2^32 that the errors of image ``number`` are drawn from."""
        drawn = hashlib.blake2s(
            f"{self._seed}/image/{chaser}/{number}".encode(), digest_size=8
        ).digest()
        return int.from_bytes(drawn[:4], "little"), int.from_bytes(drawn[4:], "little")


class PoseCameras:
    """Make the images of all chasers of a scenario as ``Cameras`` does.

    An image depends on its arguments only. Light, blur, noise of the sensor and what stands between
    camera and target have no effect.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._sensor = PoseSensor(scenario)

    def images(
        self, chasers: Sequence[int], number: int, tick: int, time_ns: int, states: States
    ) -> list[Image]:
        """Return ``image`` of several chasers at one time, in their order."""
        return [self.image(i, number, tick, time_ns, states) for i in chasers]

    def image(self, chaser: int, number: int, tick: int, time_ns: int, states: States) -> Image:
        """Return image ``number`` of a chaser, which sees the target as in ``states``."""
        position, q = self._sensor.seen_pose(chaser, states)
        return Image(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            width_px=WIDTH_PX,
            height_px=1,
            encoding="mono8",
            data=encode_pose(position, q, self._sensor.drawn(chaser, number)),
        )


class RangingCameras:
    """Make rendered images as ``Cameras`` does, with the measurements of ``[ranging]`` at the same
    time.
    """

    def __init__(self, scenario: Scenario, ranging: Ranging) -> None:
        self._cameras, self._sensor = Cameras(scenario), PoseSensor(scenario)
        self._errors, self._calibrated = ranging.errors(), scenario.camera_model()

    def images(
        self, chasers: Sequence[int], number: int, tick: int, time_ns: int, states: States
    ) -> list[Image]:
        """Return ``image`` of several chasers at one time, in their order."""
        rendered = self._cameras.images(chasers, number, tick, time_ns, states)
        return [self._ranged(image, number, states) for image in rendered]

    def image(self, chaser: int, number: int, tick: int, time_ns: int, states: States) -> Image:
        """Return image ``number`` of a chaser, which sees the target as in ``states``."""
        return self._ranged(
            self._cameras.image(chaser, number, tick, time_ns, states), number, states
        )

    def _ranged(self, image: Image, number: int, states: States) -> Image:
        position, q = self._sensor.pose(image.chaser, states)
        white = generator(self._sensor.drawn(image.chaser, number)).standard_normal(4)
        found = range_reading(self._errors, self._calibrated, position, q, white)
        if found is None:
            return image
        measured = RangeMeasurement(
            range_m=found.range_m,
            range_sigma_m=found.sigma_m,
            q_wxyz=vector(found.q_wxyz),
            attitude_covariance_rad2=vector(self._errors.attitude_rad**2 * np.eye(3)),
        )
        return msgspec.structs.replace(image, ranging=measured)


def make_cameras(scenario: Scenario) -> Cameras | PoseCameras | RangingCameras:
    """Return the cameras that the scenario's perception needs."""
    if scenario.perception.name == "statistical":
        return PoseCameras(scenario)
    return (
        Cameras(scenario)
        if scenario.ranging is None
        else RangingCameras(scenario, scenario.ranging)
    )
