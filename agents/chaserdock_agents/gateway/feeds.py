# SPDX-License-Identifier: Apache-2.0
"""Read the devices of a laboratory: poses and images at their own times by the host's clock, and
how each device does.
"""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from chaserdock_protocol.scenario.lab import LabCamera, LabDevice, LabPose, LabSection

from .axes import MeasuredPose, body_pose, why_unusable
from .clock import DeviceClock
from .devices import (
    CameraSource,
    DeviceError,
    DeviceHost,
    ImageArray,
    PoseSample,
    PoseSource,
    open_device,
)
from .odometry import BodyTrack, MotionBounds

_REMEMBERED = 64
"""Arrivals from which rate and jitter of a device are computed."""
_BLIND_NS = 1_000_000_000
"""Time without a new image of a chaser, ns, after which it is warned of: several images of any
camera.
"""


@dataclass
class DeviceWatch:
    """How a device does. ``refused``: samples that were not used, by reason."""

    name: str
    count: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    _arrived_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))

    def arrived(self, now_ns: int) -> None:
        """Note that something has arrived."""
        self.count += 1
        self._arrived_ns.append(now_ns)

    @property
    def newest_ns(self) -> int:
        """Time of the newest arrival. Raises IndexError before the first one."""
        return self._arrived_ns[-1]

    def age_s(self, now_ns: int) -> float:
        """Return the time since the newest arrival, infinite before the first one."""
        return (now_ns - self._arrived_ns[-1]) / 1e9 if self._arrived_ns else math.inf

    def rate_hz(self) -> float:
        """Return the mean rate of the newest arrivals, 0 with fewer than two."""
        times = self._arrived_ns
        span_ns = times[-1] - times[0] if len(times) > 1 else 0
        return (len(times) - 1) * 1e9 / span_ns if span_ns > 0 else 0.0

    def jitter_s(self) -> float:
        """Return the largest deviation of an interval between arrivals from their mean."""
        times = list(self._arrived_ns)
        if len(times) < 3:
            return 0.0
        mean_ns = (times[-1] - times[0]) / (len(times) - 1)
        gaps = (b - a for a, b in itertools.pairwise(times))
        return max(abs(gap - mean_ns) for gap in gaps) / 1e9


class PoseFeed:
    """Poses of one body. ``newest``: the last usable one. ``track``: gives odometry at ticks."""

    def __init__(self, device: LabPose, bounds: MotionBounds) -> None:
        self.device = device
        self.clock = DeviceClock(device.latency_s)
        self.track = BodyTrack(bounds)
        self.watch = DeviceWatch(f"{device.body} by {device.address}")
        self.newest: MeasuredPose | None = None

    def take(self, sample: PoseSample) -> MeasuredPose | None:
        """Take a sample of this body; return the pose if it is used."""
        self.watch.arrived(sample.arrived_ns)
        if reason := why_unusable(sample):
            self.watch.refused[reason] += 1
            return None
        if sample.stamp_ns is None:
            time_ns = sample.arrived_ns - round(self.device.latency_s * 1e9)
        else:
            if self.clock.add(sample.stamp_ns, sample.arrived_ns):
                self.watch.refused["its clock has stepped"] += 1
            time_ns = self.clock.host_ns(sample.stamp_ns)
        pose = body_pose(sample, self.device, time_ns)
        rejected = self.track.rejected
        if not self.track.add(pose):
            jumped = self.track.rejected > rejected
            self.watch.refused["jumped" if jumped else "doubled"] += 1
            return None
        self.newest = pose
        return pose


@dataclass(frozen=True)
class PoseSystem:
    """A device that states the poses of one or several bodies, by the device's names of them."""

    source: PoseSource
    feeds: Mapping[str, PoseFeed]
    unknown: Counter[str]

    def poll(self) -> Iterator[tuple[PoseFeed, MeasuredPose]]:
        """Yield the usable poses that have arrived. Raises DeviceError if the device is gone."""
        for sample in self.source.poll():
            feed = self.feeds.get(sample.body) or self.feeds.get("")
            if feed is None:
                self.unknown[sample.body] += 1
            elif (pose := feed.take(sample)) is not None:
                yield feed, pose


def open_poses(
    devices: tuple[LabPose, ...], lab: LabSection, host: DeviceHost
) -> tuple[PoseSystem, ...]:
    """Open each device once, for all bodies that it states. Raises DeviceError."""
    groups: dict[tuple[str, str], list[LabPose]] = {}
    for device in devices:
        groups.setdefault(_key_of(device), []).append(device)
    systems: list[PoseSystem] = []
    for group in groups.values():
        names = [d.name for d in group]
        if len(set(names)) < len(names) or ("" in names and len(names) > 1):
            raise DeviceError(
                f"lab: {group[0].address} states several bodies; each needs a name of its own"
            )
        try:
            source = open_device("pose", group[0].address, group[0].options, host)
        except DeviceError:
            for system in systems:
                system.source.close()
            raise
        feeds = {d.name: PoseFeed(d, _bounds(d, lab)) for d in group}
        systems.append(PoseSystem(source, feeds, Counter()))
    return tuple(systems)


def _key_of(device: LabDevice) -> tuple[str, str]:
    return device.address, json.dumps(device.options, sort_keys=True, default=str)


def _bounds(device: LabPose, lab: LabSection) -> MotionBounds:
    return MotionBounds(
        lab.safety.max_speed_m_s,
        lab.safety.jump_m,
        device.velocity_sigma_m_s,
        math.radians(device.rate_sigma_deg_s),
    )


class CameraFeed:
    """Images of one camera."""

    def __init__(self, device: LabCamera, host: DeviceHost) -> None:
        self.device = device
        self.clock = DeviceClock(device.latency_s)
        self.watch = DeviceWatch(f"camera of chaser {device.chaser} by {device.address}")
        self.source: CameraSource = open_device("camera", device.address, device.options, host)
        self._last: ImageArray | None = None

    def poll(self) -> Iterator[tuple[ImageArray, int]]:
        """Yield images with the middle of their exposure by the host's clock, ns; not those equal
        to the one before: no two exposures have the same noise. Raises DeviceError if the device is
        gone.
        """
        for frame in self.source.poll():
            self.watch.arrived(frame.arrived_ns)
            last, self._last = self._last, frame.image
            if last is not None and np.array_equal(last, frame.image):
                self.watch.refused["repeats the last image"] += 1
                continue
            if self.device.stamp == "arrival" or frame.stamp_ns is None:
                yield frame.image, frame.arrived_ns - round(self.device.latency_s * 1e9)
                continue
            if self.clock.add(frame.stamp_ns, frame.arrived_ns):
                self.watch.refused["its clock has stepped"] += 1
            yield frame.image, self.clock.host_ns(frame.stamp_ns)


class ImageWatch:
    """Notices chasers whose cameras are silent, or repeat an image. Times in ns."""

    def __init__(self, chasers: Iterable[int]) -> None:
        self._chasers = tuple(chasers)
        self._newest_ns: dict[int, int] = {}
        self._blind: set[int] = set()

    def expect(self, now_ns: int) -> None:
        """Expect images of all chasers from now on."""
        self._newest_ns = dict.fromkeys(self._chasers, now_ns)

    def note(self, chaser: int, now_ns: int) -> None:
        """Note a new image of a chaser."""
        self._newest_ns[chaser] = now_ns
        self._blind.discard(chaser)

    def newly_blind(self, now_ns: int) -> list[int]:
        """Return the chasers without a new image for too long, each once for each such time."""
        found = [
            i
            for i in self._chasers
            if i not in self._blind and now_ns - self._newest_ns[i] > _BLIND_NS
        ]
        self._blind.update(found)
        return found
