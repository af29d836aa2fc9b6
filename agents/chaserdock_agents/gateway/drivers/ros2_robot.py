# SPDX-License-Identifier: Apache-2.0
"""Command a robot by ``geometry_msgs/msg/WrenchStamped``: force and torque in its body's axes.

The robot's node must stop its actuators when wrenches cease. This driver commands zero then, too,
as long as its process lives.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rosbags.typesys.stores import ros2_jazzy as ros

from chaserdock_agents.ros2.conversion import time_of

from ..devices import DeviceError, DeviceHost, RobotCommand
from ..options import read_options
from .command_stream import CommandStream
from .ros2_network import RosEndpoints, RosOptions, absolute_name
from .shares import wrench_of

WRENCH = "geometry_msgs/msg/WrenchStamped"


class RosRobotOptions(RosOptions, frozen=True, kw_only=True):
    """Options of a robot on ROS 2. ``frame``: name of its body's frame, stated in each message."""

    frame: str = ""


def wall_ns(time_ns: int, now_ns: Callable[[], int]) -> int:
    """Return a time of the host's clock as a time of the wall clock, which nodes of ROS use."""
    return time.time_ns() + time_ns - now_ns()


class RosRobot:
    """A robot that takes wrenches on one topic."""

    body_axes, thrusters = "flu", 0

    def __init__(self, topic: str, options: RosRobotOptions, host: DeviceHost) -> None:
        self._topic, self._frame, self._host = topic, options.frame, host
        self._endpoints = RosEndpoints(options)
        try:
            self._publisher = self._endpoints.publisher(topic, WRENCH)
        except BaseException:
            self._endpoints.close()
            raise
        self._stream = CommandStream(self._publish, host.now_ns)

    def _publish(self, command: RobotCommand | None) -> None:
        now_ns = self._host.now_ns()
        header = ros.std_msgs__msg__Header(
            time_of(wall_ns(command.time_ns if command else now_ns, self._host.now_ns)), self._frame
        )
        force, torque = (ros.geometry_msgs__msg__Vector3(*v.tolist()) for v in wrench_of(command))
        self._publisher.publish(
            ros.geometry_msgs__msg__WrenchStamped(
                header, ros.geometry_msgs__msg__Wrench(force, torque)
            )
        )

    def send(self, command: RobotCommand) -> None:
        """See `Robot`. Sends nothing before `arm`, and zero after `stop`."""
        self._stream.put(command)
        self._endpoints.check()

    def arm(self) -> None:
        """Let wrenches pass. Raises DeviceError if nobody subscribes to them."""
        self._endpoints.check()
        if not self._endpoints.has_peer:
            raise DeviceError(f"nobody subscribes to {self._topic} ({WRENCH})")
        self._stream.start()
        self._stream.arm()

    def stop(self) -> None:
        """See `Robot`."""
        self._stream.disarm()

    def close(self) -> None:
        """See `Robot`."""
        self._stream.close()
        self._endpoints.close()


def open_robot(address: str, options: Mapping[str, Any], host: DeviceHost) -> RosRobot:
    """Open a robot that takes wrenches: ``ros2:/robot0/wrench``."""
    return RosRobot(absolute_name(address), read_options(RosRobotOptions, options), host)
