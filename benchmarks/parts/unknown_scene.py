# SPDX-License-Identifier: Apache-2.0
"""Images and odometry of two chasers that hold beside a turning target which nobody described.

The chasers translate with the target and keep their attitudes. Images are those of the world's
cameras with errors of grade `lab`; a folder keeps them, as JPEG files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, Vector3
from chaserdock_models.camera import Camera
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario, parse_scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import Cameras
from chaserdock_world.sensors.errors import OdometrySensor
from numpy.typing import NDArray

TICKS_PER_IMAGE = 6
"""Ticks of odometry, at 30 Hz, from image to image: five images a second."""


SUNS: dict[str, Vector3] = {
    "behind": (-0.866, 0.25, 0.433),
    "right": (-0.5, -0.8, 0.33),
    "above": (-0.3, 0.3, 0.9),
    "below": (-0.5, -0.3, -0.81),
    "side": (0.3, -0.9, 0.3),
}
"""Directions to the sun, WRF, for chasers that look along X: 30 to 110 degrees off the first camera
and 35 to 90 degrees off the second one."""
TUMBLES: tuple[Vector3, ...] = (
    (0.015, 0.045, 0.03),
    (0.04, -0.02, 0.03),
    (-0.03, 0.03, 0.035),
    (0.03, 0.04, -0.025),
    (-0.02, -0.045, 0.02),
)
"""Directions of the rate, TRF, in general position; a seed has one of them."""


@dataclass(frozen=True)
class SceneCase:
    """One sequence.

    ``mesh``: a shipped satellite. ``places_m``: of the chasers from the target's centre, WRF.
    ``to_sun``: direction in WRF. ``omega_rad_s``: rate of the target, constant, TRF.
    """

    mesh: str = "geo_servicer"
    places_m: tuple[Vector3, ...] = ((-2.0, 0.0, 0.0), (-1.0, -1.732, 0.0))
    to_sun: Vector3 = (-0.866, 0.25, 0.433)
    omega_rad_s: Vector3 = (0.015, 0.045, 0.03)
    velocity_m_s: Vector3 = (0.015, 0.0075, 0.03)
    duration_s: float = 120.0
    seed: int = 0

    @property
    def turn_s(self) -> float:
        """Duration of a full turn, s."""
        return float(2.0 * np.pi / np.linalg.norm(self.omega_rad_s))

    def scenario(self) -> Scenario:
        """Return the scenario whose cameras and odometry are simulated."""
        return parse_scenario(
            {
                "name": "unknown",
                "seed": self.seed,
                "duration_s": self.duration_s,
                "navigation": {"grade": "lab"},
                "perception": {"name": "model"},
                "target": {
                    "model": self.mesh,
                    "motion": "constant_rates",
                    "velocity_m_s": list(self.velocity_m_s),
                    "omega_rad_s": list(self.omega_rad_s),
                },
                "camera": {
                    "width_px": 960,
                    "height_px": 540,
                    "sun_direction": list(self.to_sun),
                    "earth": {"direction": [1.0, 1.0, -0.3], "radius_deg": 66.0},
                    "effects": {"jpeg_quality": 95},
                },
                "chasers": [
                    {"position_m": list(place), "look_at": "target"} for place in self.places_m
                ],
            },
            "unknown",
        )


@dataclass(frozen=True, eq=False)
class Exposure:
    """What a chaser's flight software gets at one time: image (h, w) and odometry."""

    chaser: int
    time_s: float
    image: NDArray[np.uint8]
    odometry: BodyState


def _name(chaser: int, number: int) -> str:
    return f"{chaser}-{number:05d}.jpg"


class UnknownImages:
    """The images of a case in the order of time; rendered where ``folder`` does not keep them.

    ``folder``: of the case's own, from then on.
    """

    def __init__(self, case: SceneCase, folder: Path) -> None:
        self.case, self.scenario = case, case.scenario()
        key = {k: v for k, v in asdict(case).items() if k != "duration_s"}
        name = hashlib.sha256(repr(sorted(key.items())).encode()).hexdigest()[:12]
        self.folder = folder / f"{case.mesh}-{name}"
        self.folder.mkdir(parents=True, exist_ok=True)

    @property
    def camera(self) -> Camera:
        """The calibrated camera of every chaser; the true ones differ by the errors of the
        grade.
        """
        return self.scenario.camera_model()

    @cached_property
    def _cameras(self) -> Cameras:
        return Cameras(self.scenario)

    def target_pose(self, time_s: float) -> tuple[Array, Array]:
        """Return the true position (3,), WRF, and attitude (4,) of the target."""
        state = self.state(TARGET, time_s)
        return state.position_m, state.q_wxyz

    def state(self, body: str, time_s: float) -> BodyState:
        """Return the true state of a body."""
        velocity = np.array(self.case.velocity_m_s)
        if body == TARGET:
            omega = np.array(self.case.omega_rad_s)
            q = rotations.exp(omega * time_s)
            return BodyState(velocity * time_s, velocity, q, omega)
        chaser = self.scenario.chasers[int(body.removeprefix("chaser/"))]
        q = np.asarray(chaser.q_wxyz, dtype=float)
        place = np.asarray(chaser.position_m, dtype=float)
        return BodyState(place + velocity * time_s, velocity, q, np.zeros(3))

    def exposures(self, from_s: float = 0.0, until_s: float | None = None) -> Iterator[Exposure]:
        """Yield what the chasers get, by time and chaser."""
        sensor = OdometrySensor(self.scenario)
        period_s = TICKS_PER_IMAGE / 30.0
        first = round(from_s / period_s)
        last = round((self.case.duration_s if until_s is None else until_s) / period_s)
        for number in range(first, last):
            time_s, tick = number * period_s, number * TICKS_PER_IMAGE
            for i in range(len(self.scenario.chasers)):
                odometry = sensor.measure(i, tick, self.state(f"chaser/{i}", time_s))
                yield Exposure(i, time_s, self._image(i, number, time_s), odometry)

    def kept(self, every: int, until_s: float) -> dict[str, tuple[int, float]]:
        """Render each chaser's images, ``every`` numbers apart, into ``folder``; return chaser and
        time (s) of each, by name.
        """
        found = {}
        for number in range(0, round(30.0 * until_s / TICKS_PER_IMAGE), every):
            time_s = number * TICKS_PER_IMAGE / 30.0
            for i in range(len(self.scenario.chasers)):
                self._image(i, number, time_s)
                found[_name(i, number)] = i, time_s
        return found

    def _image(self, chaser: int, number: int, time_s: float) -> NDArray[np.uint8]:
        path = self.folder / _name(chaser, number)
        if not path.exists():
            bodies = [TARGET, *(f"chaser/{i}" for i in range(len(self.scenario.chasers)))]
            states = {body: self.state(body, time_s) for body in bodies}
            tick = number * TICKS_PER_IMAGE
            image = self._cameras.image(chaser, number, tick, round(time_s * 1e9), states)
            path.write_bytes(image.data)
        pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if pixels is None:
            raise SystemExit(f"{path}: not an image; delete it to render it again")
        return np.asarray(pixels, dtype=np.uint8)
