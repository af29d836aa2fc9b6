# SPDX-License-Identifier: Apache-2.0
"""Run a chaser with a camera of its own, whose images never leave its process.

The camera states exposures by its clock, and ticks tell mission time: both clocks are estimated, so
that an image is used at its own time as if the gateway had sent it.
"""

from __future__ import annotations

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import Tick
from chaserdock_protocol.pose_image import NAME as STATISTICAL
from chaserdock_protocol.process import ProcessOptions
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.lab import LabCamera

from chaserdock_agents.chaser.process import ChaserProcess, run_chaser

from .clock import DeviceClock
from .devices import DeviceError, DeviceHost
from .feeds import CameraFeed
from .images import image_message, why_other_size

_POLL_S = 0.002
"""Interval, s, at which the camera is asked for images."""
_LOST_POLL_S = 1.0
"""Interval, s, at which a lost camera is asked again: its driver may find it."""
_UNCOMPRESSED = 0
"""JPEG quality of images that no network carries."""


class OwnCameraError(ChaserdockError):
    """A chaser's own camera cannot be used."""


class OwnCamera:
    """Pass the images of a camera to its chaser, with their time of the mission."""

    def __init__(self, chaser: ChaserProcess, feed: CameraFeed, scenario: FlightScenario) -> None:
        self._chaser, self._feed = chaser, feed
        self._camera, self._rate_hz = scenario.camera_model(), scenario.time.rate_hz
        self._sized = scenario.perception.name != STATISTICAL
        self._mission = DeviceClock()
        self._lost = ""
        self._now_s = chaser.node.host.now_s
        chaser.on_tick = self.note_tick

    def note_tick(self, tick: Tick) -> None:
        """Take a tick as a stamp of the mission's clock."""
        if tick.revision == 0:
            self._mission.add(tick.sim_time_ns, round(self._now_s() * 1e9))

    def poll(self) -> float:
        """Pass on what has arrived; return after how many seconds to ask again."""
        try:
            for image, time_ns in self._feed.poll():
                if not self._mission.is_known:
                    continue
                exposed_ns = self._mission.stamp_ns(time_ns)
                if exposed_ns <= 0:
                    continue
                if self._sized and (other := why_other_size(image, self._camera)):
                    self._feed.watch.refused[other] += 1
                    continue
                number = self._chaser.core.number
                self._chaser.look_at(
                    image_message(self._rate_hz, _UNCOMPRESSED, number, image, exposed_ns)
                )
        except DeviceError as error:
            if str(error) != self._lost:
                self._chaser.warn("camera lost", str(error))
            self._lost = str(error)
            return _LOST_POLL_S
        self._lost = ""
        return _POLL_S


def main(options: ProcessOptions) -> int:
    """Run chaser ``options.chaser`` with the camera at ``options.camera``; statuses as of a
    chaser.
    """

    def attach(chaser: ChaserProcess) -> None:
        if not chaser.core.realtime:
            raise OwnCameraError("--camera: the mission is in lock-step; a camera has its own pace")
        number, now_s = chaser.core.number, chaser.node.host.now_s
        device = LabCamera(
            chaser=number, address=options.camera, latency_s=options.camera_latency_s
        )
        feed = CameraFeed(device, DeviceHost(lambda: round(now_s() * 1e9)))
        camera = OwnCamera(chaser, feed, chaser.core.scenario)
        end = chaser.node.host.repeat(camera.poll)

        def close() -> None:
            end()
            feed.source.close()

        chaser.node.on_close(close)

    return run_chaser(options, attach)
