# SPDX-License-Identifier: Apache-2.0
"""Poses and images of devices count at the time at which they were measured, and their odometry
has each part in its place.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest
from chaserdock_agents.gateway import feeds
from chaserdock_agents.gateway.devices import CameraFrame, DeviceHost, PoseSample
from chaserdock_agents.gateway.feeds import CameraFeed, PoseFeed
from chaserdock_agents.gateway.images import image_message
from chaserdock_agents.gateway.odometry import FittedState, MotionBounds
from chaserdock_agents.gateway.process import odometry_of
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.scenario.lab import LabCamera, LabPose
from general_position import attitude, covariance, matrix

LATENCY_S = 0.013
LATENCY_NS, PERIOD_NS = 13_000_000, 10_000_000
BEHIND_NS = 5_000_000_000
"""How far the clock of a device is behind the host's."""
START_NS = 70_000_000_000
BOUNDS = MotionBounds(2.0, 0.05, 0.005, 0.003)
EXTRA_NS = (0, 4_000_000, 1_000_000, 7_000_000)
"""By how much messages are later than the fastest."""


def measured() -> Iterator[tuple[int, int, int]]:
    """Yield when something was measured and when it arrived, host's clock, and the device's stamp:
    the fastest message of each second has the least delay.
    """
    for k in range(40):
        time_ns = START_NS + k * PERIOD_NS
        yield time_ns, time_ns + LATENCY_NS + EXTRA_NS[k % 4], time_ns - BEHIND_NS


def pose_device() -> LabPose:
    q = tuple(attitude(np.random.default_rng(1)).tolist())
    values = {"address": "x:y", "body": "chaser/0", "latency_s": LATENCY_S}
    return LabPose.model_validate(values | {"position_m": (0.1, -0.2, 0.3), "q_wxyz": q})


def sample(stamp_ns: int | None, arrived_ns: int, place: Array, q: Array) -> PoseSample:
    return PoseSample("", stamp_ns, arrived_ns, place, q)


def test_a_pose_was_measured_the_least_delay_before_the_fastest_arrive() -> None:
    rng, feed = np.random.default_rng(2), PoseFeed(pose_device(), BOUNDS)
    place, q = rng.normal(size=3), attitude(rng)
    for time_ns, arrived_ns, stamp_ns in measured():
        pose = feed.take(sample(stamp_ns, arrived_ns, place, q))
        assert pose is not None
        assert pose is feed.newest
        assert abs(pose.time_ns - time_ns) <= 1
        assert pose.position_m == pytest.approx(place + matrix(q) @ feed.device.position_m)
        assert matrix(pose.q_wxyz) == pytest.approx(matrix(q) @ matrix(feed.device.q_wxyz))


def test_a_pose_without_a_stamp_was_measured_the_latency_before_it_arrives() -> None:
    feed, q = PoseFeed(pose_device(), BOUNDS), attitude(np.random.default_rng(3))
    for _, arrived_ns, _ in measured():
        pose = feed.take(sample(None, arrived_ns, np.array([1.0, 2.0, 3.0]), q))
        assert pose is not None
        assert pose.time_ns == arrived_ns - LATENCY_NS


def test_stated_velocities_and_rates_have_the_noise_of_the_device() -> None:
    """The bounds of a feed are those of its own device, in SI units."""
    values = {"velocity_sigma_m_s": 0.02, "rate_sigma_deg_s": 3.0}
    device = pose_device().model_copy(update=values)
    safety = type("Safety", (), {"max_speed_m_s": 0.7, "jump_m": 0.04})()
    lab = cast(Any, type("Lab", (), {"safety": safety})())

    class Source:
        def poll(self) -> tuple[PoseSample, ...]:
            return (
                PoseSample(
                    "", None, START_NS, np.ones(3), np.array([1.0, 0.0, 0.0, 0.0]),
                    np.array([0.1, 0.2, 0.3]), np.array([0.03, 0.02, 0.01]),
                ),
            )  # fmt: skip

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(feeds, "open_device", lambda *_: Source())
        (system,) = feeds.open_poses((device,), lab, DeviceHost(lambda: 0))
    ((feed, pose),) = system.poll()
    state = feed.track.at(pose.time_ns, pose.time_ns - 1)
    assert state is not None
    assert state.velocity_covariance_m2_s2 == pytest.approx(np.eye(3) * 0.02**2)
    assert state.omega_covariance_rad2_s2 == pytest.approx(np.eye(3) * np.radians(3.0) ** 2)


class Frames:
    """A camera whose frames are given."""

    def __init__(self, frames: list[CameraFrame]) -> None:
        self._frames = frames

    def poll(self) -> list[CameraFrame]:
        return self._frames


@pytest.mark.parametrize(("stamp", "states"), [("device", True), ("device", False),
                                               ("arrival", True)])  # fmt: skip
def test_an_image_was_exposed_by_the_stamp_or_the_latency_before_its_arrival(
    monkeypatch: pytest.MonkeyPatch, stamp: str, states: bool
) -> None:
    frames = [
        CameraFrame(np.full((4, 6), k, np.uint8), stamp_ns if states else None, arrived_ns)
        for k, (_, arrived_ns, stamp_ns) in enumerate(measured())
    ]
    values = {"address": "x:y", "chaser": 0, "latency_s": LATENCY_S, "stamp": stamp}
    monkeypatch.setattr(feeds, "open_device", lambda *_: Frames(frames))
    feed = CameraFeed(LabCamera.model_validate(values), DeviceHost(lambda: 0))
    for (time_ns, arrived_ns, _), (_, exposed_ns) in zip(measured(), feed.poll(), strict=True):
        by_stamp = states and stamp == "device"
        expected_ns = time_ns if by_stamp else arrived_ns - LATENCY_NS
        assert abs(exposed_ns - expected_ns) <= 1


@pytest.mark.parametrize(
    ("exposed_ns", "tick"),
    [(1, 1), (66_666_666, 1), (66_666_667, 2), (200_000_000, 3), (200_000_001, 4)],
)
def test_an_image_belongs_to_the_first_tick_at_or_after_its_exposure(
    exposed_ns: int, tick: int
) -> None:
    message = image_message(15, 0, 2, np.zeros((4, 6), np.uint8), exposed_ns)
    assert (message.tick, message.sim_time_ns, message.chaser) == (tick, exposed_ns, 2)
    assert (message.width_px, message.height_px) == (6, 4)


def test_odometry_has_each_part_of_a_state_in_its_place() -> None:
    rng = np.random.default_rng(4)
    parts = [rng.normal(size=3), rng.normal(size=3), attitude(rng), rng.normal(size=3)]
    noise = [covariance(rng, [1e-3, 2e-3, 3e-3]) for _ in range(4)]
    found = odometry_of(FittedState(7, *parts, *noise), 3, 12, 800_000_000)
    assert (found.chaser, found.tick, found.sim_time_ns) == (3, 12, 800_000_000)
    stated = (found.position_m, found.velocity_m_s, found.q_wxyz, found.omega_rad_s)
    assert stated == tuple(vector(part) for part in parts)
    spreads = (
        found.position_covariance_m2,
        found.velocity_covariance_m2_s2,
        found.attitude_covariance_rad2,
        found.omega_covariance_rad2_s2,
    )
    assert spreads == tuple(vector(part) for part in noise)
