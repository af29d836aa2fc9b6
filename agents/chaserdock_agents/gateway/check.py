# SPDX-License-Identifier: Apache-2.0
"""Look at the devices of a laboratory before anything moves: are they there, how fast, how late, in
which units and axes, and what does perception see?
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.pose_image import NAME as STATISTICAL
from chaserdock_protocol.scenario import Scenario, flight_scenario

from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.vision import Vision

from .clock import DeviceClock
from .devices import DeviceError, DeviceHost, ImageArray
from .feeds import CameraFeed, DeviceWatch, PoseFeed
from .images import image_message, why_other_size
from .lab import Laboratory

MILLIMETRES_FROM = 50.0
"""How many times farther than the volume's edge a body must be for its unit to look wrong: metres
as millimetres are 1000 times as far, and a wrong origin hardly ever 50 times.
"""
_TILTED_RAD, _LEVEL_RAD = math.radians(60.0), math.radians(20.0)
"""A body that is tilted more than the first as stated, and less than the second with its quaternion
read in the other order, states it in the other order.
"""
_MOVING_M_S, _TURNING_RAD_S = 0.02, 0.05
"""Speed and rate above which stated velocities are compared with the change of the poses."""


@dataclass(frozen=True)
class DeviceFinding:
    """What was found about one device. ``problems``: what forbids a flight, or looks wrong."""

    device: str
    rate_hz: float
    jitter_s: float
    age_s: float
    offset_s: float | None
    sees: str = ""
    problems: tuple[str, ...] = ()


def check_laboratory(
    scenario: Scenario, host: DeviceHost, duration_s: float, wait: Callable[[float], None]
) -> list[DeviceFinding]:
    """Read all devices for ``duration_s``; return what was found, in the order of the scenario.

    ``wait``: sleeps for a time, s. Raises DeviceError for a device that cannot be opened.
    """
    laboratory = Laboratory(scenario, host, dry_run=True)
    try:
        return _check(laboratory, scenario, host, duration_s, wait)
    finally:
        laboratory.close()


def _check(
    laboratory: Laboratory,
    scenario: Scenario,
    host: DeviceHost,
    duration_s: float,
    wait: Callable[[float], None],
) -> list[DeviceFinding]:
    assert scenario.lab is not None
    eyes = {c.device.chaser: _Eyes(scenario, c) for c in laboratory.cameras}
    lost: list[str] = []
    end_ns = host.now_ns() + round(duration_s * 1e9)
    while host.now_ns() < end_ns:
        try:
            laboratory.read_odometry()
            for _ in laboratory.read_references():
                pass
            for chaser, image, time_ns, _ in laboratory.read_images():
                eyes[chaser].look(image, time_ns)
        except DeviceError as error:
            if str(error) not in lost:
                lost.append(str(error))
            wait(0.1)
        wait(0.002)
    now_ns, findings = host.now_ns(), []
    lower, upper = scenario.lab.safety.volume.lower_m, scenario.lab.safety.volume.upper_m
    reach_m = float(np.abs([lower, upper]).max())
    for feed, unknown in laboratory.pose_feeds():
        problems = list(_pose_problems(feed, unknown, scenario.time.rate_hz, reach_m))
        findings.append(_finding(feed.watch, feed.clock, now_ns, problems))
    for own in eyes.values():
        findings.append(
            _finding(own.feed.watch, own.feed.clock, now_ns, own.problems(), own.sees())
        )
    findings += [DeviceFinding("device", 0.0, 0.0, math.inf, None, "", (text,)) for text in lost]
    return findings


def _finding(
    watch: DeviceWatch, clock: DeviceClock, now_ns: int, problems: list[str], sees: str = ""
) -> DeviceFinding:
    if not watch.count:
        problems = ["mute: nothing has arrived", *problems]
    problems += [f"{reason} ({n} of {watch.count})" for reason, n in watch.refused.items()]
    return DeviceFinding(
        watch.name,
        watch.rate_hz(),
        watch.jitter_s(),
        watch.age_s(now_ns),
        clock.offset_s if clock.is_known else None,
        sees,
        tuple(problems),
    )


def _pose_problems(
    feed: PoseFeed, unknown: Counter[str], rate_hz: int, reach_m: float
) -> Iterator[str]:
    """Yield what is wrong, or looks wrong, with the poses of a body."""
    watch, pose = feed.watch, feed.newest
    if not watch.count and unknown:
        names = ", ".join(sorted(unknown))
        yield f"it states no body {feed.device.name!r}; it states {names}"
    if pose is None:
        return
    if watch.rate_hz() < rate_hz:
        yield f"{watch.rate_hz():.1f} Hz are less than the {rate_hz} ticks a second"
    if np.abs(pose.position_m).max() > MILLIMETRES_FROM * reach_m:
        x = ", ".join(f"{v:.4g}" for v in pose.position_m)
        yield f"position ({x}) m is far outside of the volume: millimetres?"
    other = np.roll(pose.q_wxyz, 1)  # as if the scalar had come last
    if _tilt_rad(pose.q_wxyz) > _TILTED_RAD and _tilt_rad(other) < _LEVEL_RAD:
        yield "tilted as stated, level with the scalar of its quaternion last: flipped order?"
    yield from _velocity_problems(feed)


def _velocity_problems(feed: PoseFeed) -> Iterator[str]:
    """Compare stated velocities with the change of the poses, while the body moves."""
    poses = feed.track.newest_poses()
    if len(poses) < 3 or poses[-1].velocity_m_s is None:
        return
    first, last = poses[0], poses[-1]
    between_s = (last.time_ns - first.time_ns) / 1e9
    velocity = (last.position_m - first.position_m) / between_s
    stated = np.mean([p.velocity_m_s for p in poses if p.velocity_m_s is not None], axis=0)
    if np.linalg.norm(velocity) > _MOVING_M_S:
        yield from _disagreement("velocity", stated, velocity)
    if last.omega_rad_s is not None:
        turn = rotations.log(rotations.multiply(rotations.conjugate(first.q_wxyz), last.q_wxyz))
        rate = turn / between_s
        stated = np.mean([p.omega_rad_s for p in poses if p.omega_rad_s is not None], axis=0)
        if np.linalg.norm(rate) > _TURNING_RAD_S:
            yield from _disagreement("rate", stated, rate)


def _disagreement(what: str, stated: Array, measured: Array) -> Iterator[str]:
    """Yield how a stated velocity differs from the measured one: by a factor, or by axes."""
    size, own = float(np.linalg.norm(stated)), float(np.linalg.norm(measured))
    factor = size / own
    if 40.0 < factor < 80.0 and what == "rate":
        yield f"stated rate is {factor:.0f} times the change of the attitude: degrees?"
    elif not 0.5 < factor < 2.0:
        yield f"stated {what} is {factor:.2g} times the change of the pose"
    elif float(stated @ measured) < 0.7 * size * own:
        yield (
            f"stated {what} points elsewhere than the change of the pose: other or left-handed "
            "axes?"
        )


def _tilt_rad(q_wxyz: Array) -> float:
    """Return the angle between the body's and the world's z axis."""
    up = rotations.rotate(q_wxyz, np.array([0.0, 0.0, 1.0]))
    return math.acos(max(-1.0, min(1.0, float(up[2]))))


@dataclass
class _Eyes:
    """What perception sees in the images of one chaser."""

    scenario: Scenario
    feed: CameraFeed
    seen: int = 0
    looked: int = 0
    newest: str = ""
    wrong_size: str = ""
    _vision: Vision = field(init=False)
    _camera: Camera = field(init=False)
    _sized: bool = field(init=False)

    def __post_init__(self) -> None:
        self._vision = Vision(make_perception(flight_scenario(self.scenario)))
        self._camera = self.scenario.camera_model()
        self._sized = self.scenario.perception.name != STATISTICAL

    def look(self, image: ImageArray, time_ns: int) -> None:
        if self._sized and (other := why_other_size(image, self._camera)):
            self.wrong_size = other
            return
        rate_hz, quality = self.scenario.time.rate_hz, self.scenario.camera.effects.jpeg_quality
        message = image_message(rate_hz, quality, self.feed.device.chaser, image, time_ns)
        sighting = self._vision.look(message)
        if sighting is None:
            return
        self.looked += 1
        if sighting.solutions:
            self.seen += 1
            x, y, z = sighting.solutions[0].position_m
            ids = ", ".join(map(str, sighting.marker_ids))
            self.newest = f"target at ({x:.3f}, {y:.3f}, {z:.3f}) m" + (
                f", markers {ids}" if ids else ""
            )
        elif sighting.detail:
            self.newest = sighting.detail

    def sees(self) -> str:
        """Return in how many images the target was seen, and where last."""
        return f"target in {self.seen} of {self.looked} images" + (
            f"; {self.newest}" if self.newest else ""
        )

    def problems(self) -> list[str]:
        """Return what forbids to use the images."""
        return [self.wrong_size] if self.wrong_size else []
