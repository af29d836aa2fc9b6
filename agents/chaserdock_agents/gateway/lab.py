# SPDX-License-Identifier: Apache-2.0
"""The devices of a laboratory as a whole: open, read, command, stop."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Latch
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.flight import flight_scenario
from chaserdock_protocol.scenario.lab import LabSection

from .actuation import RobotActuation
from .axes import MeasuredPose, robot_axes
from .devices import DeviceHost, DockingLatch, ImageArray, Robot, RobotCommand, open_device
from .feeds import CameraFeed, PoseFeed, PoseSystem, open_poses
from .safety import Obedience, RobotSight, limited_duty, limited_wrench


class Laboratory:
    """Opened devices of ``[lab]``. ``dry_run``: nothing is sent to robots and latches."""

    def __init__(self, scenario: Scenario, host: DeviceHost, dry_run: bool = False) -> None:
        assert scenario.lab is not None
        self.lab: LabSection = scenario.lab
        self._host, self._dry_run = host, dry_run
        self._camera = flight_scenario(scenario).camera_model()
        self._systems: Sequence[PoseSystem] = []
        self._references: Sequence[PoseSystem] = []
        self.cameras: list[CameraFeed] = []
        self.robots: dict[int, Robot] = {}
        self.latches: dict[int, DockingLatch] = {}
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        self._turn = {r.chaser: robot_axes(r.body_axes) for r in self.lab.robot}
        feeds = (feed for system in self._systems for feed in system.feeds.values())
        by_body = {feed.device.body: feed for feed in feeds}
        self.obedience = {
            i: Obedience(scenario.chaser.mass_kg) for i in range(len(scenario.chasers))
        }
        self.odometry = {i: by_body[f"chaser/{i}"] for i in range(len(scenario.chasers))}

    def _open(self) -> None:
        lab, host = self.lab, self._host
        self._systems = open_poses(lab.odometry, lab, host)
        self._references = open_poses(lab.reference, lab, host)
        for camera in lab.camera:
            self.cameras.append(CameraFeed(camera, replace(host, camera=self._camera)))
        for latch in lab.latch:
            self.latches[latch.chaser] = open_device("latch", latch.address, latch.options, host)
        for robot in lab.robot:
            self.robots[robot.chaser] = open_device("robot", robot.address, robot.options, host)

    def pose_feeds(self) -> Iterator[tuple[PoseFeed, Counter[str]]]:
        """Yield the feeds of all bodies, with the names that their device states besides."""
        for system in (*self._systems, *self._references):
            for feed in system.feeds.values():
                yield feed, system.unknown

    def read_odometry(self) -> None:
        """Take the poses of the robots that have arrived. Raises DeviceError."""
        for system in self._systems:
            for _ in system.poll():
                pass

    def read_references(self) -> Iterator[tuple[PoseFeed, MeasuredPose]]:
        """Yield the reference poses that have arrived. Raises DeviceError."""
        for system in self._references:
            yield from system.poll()

    def read_images(self) -> Iterator[tuple[int, ImageArray, int, int]]:
        """Yield chaser, image, exposure and arrival by the host's clock. Raises DeviceError."""
        for camera in self.cameras:
            for image, time_ns in camera.poll():
                yield camera.device.chaser, image, time_ns, camera.watch.newest_ns

    def sights(self, command_ages_s: dict[int, float]) -> tuple[RobotSight, ...]:
        """Return what is known of each robot now. ``command_ages_s``: by chaser."""
        now_ns, found = self._host.now_ns(), []
        for chaser, feed in self.odometry.items():
            age = command_ages_s.get(chaser, math.inf)
            newest_ns = feed.track.newest_ns
            if feed.newest is None or newest_ns is None:
                found.append(RobotSight(chaser, math.inf, age))
                continue
            age_s = (now_ns - newest_ns) / 1e9
            state = feed.track.newest_state()
            speed = rate = 0.0
            if state is not None:
                speed, rate = math.hypot(*state.velocity_m_s), math.hypot(*state.omega_rad_s)
                self.obedience[chaser].observe(newest_ns, state.velocity_m_s)
            jumped_m, feed.track.jumped_m = feed.track.jumped_m, 0.0
            if jumped_m > 0.0:
                self.obedience[chaser].restart()
            found.append(
                RobotSight(
                    chaser,
                    age_s,
                    age,
                    feed.newest.position_m,
                    speed,
                    rate,
                    jumped_m,
                    self.obedience[chaser].unexplained_m_s2,
                )
            )
        return tuple(found)

    def arm(self) -> None:
        """Let the robots obey, one after the other. Raises DeviceError if one refuses. Only this
        may run on another thread.
        """
        if not self._dry_run:
            for robot in self.robots.values():
                robot.arm()

    def forget_motion(self) -> None:
        """Judge the robots' obedience from now on."""
        for obedience in self.obedience.values():
            obedience.restart()

    def send(
        self, chaser: int, actuation: RobotActuation, output: tuple[Array, Array, Array]
    ) -> None:
        """Command a robot within the limits, from now on. Raises DeviceError."""
        force, torque, duty = output
        if len(duty):
            duty = limited_duty(duty, actuation.matrix, self.lab.safety)
            wrench = actuation.matrix @ duty
            force, torque = wrench[:3], wrench[3:]
        force, torque = limited_wrench(force, torque, self.lab.safety)
        turn, pose = self._turn[chaser], self.odometry[chaser].newest
        if pose is not None:
            self.obedience[chaser].command(rotations.rotate(pose.q_wxyz, force))
        if not self._dry_run:
            command = RobotCommand(self._host.now_ns(), turn(force), turn(torque), duty)
            self.robots[chaser].send(command)

    def command_latch(self, chaser: int, latch: Latch) -> None:
        """Command the latch of a chaser, if it has one. Raises DeviceError."""
        if chaser in self.latches and not self._dry_run:
            self.latches[chaser].command(latch)

    def stop(self) -> None:
        """Command zero to all robots."""
        for robot in self.robots.values():
            robot.stop()

    def close(self) -> None:
        """Stop the robots and release all devices."""
        with suppress(Exception):
            self.stop()
        sources = [c.source for c in self.cameras]
        systems = [s.source for s in (*self._systems, *self._references)]
        for device in (*self.robots.values(), *self.latches.values(), *sources, *systems):
            with suppress(Exception):  # a driver may raise anything; the others are closed, too
                device.close()
