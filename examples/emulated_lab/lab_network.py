# SPDX-License-Identifier: Apache-2.0
"""The emulated laboratory on networks: ROS 2 as rmw_zenoh_cpp has it, by zenoh-ros2-sdk; PX4 on
it; and MAVLink, by pymavlink.
"""

from __future__ import annotations

import os
import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from lab_devices import Capture, Laboratory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber

os.environ["MAVLINK20"] = "1"  # read by pymavlink when it is imported
from pymavlink import mavutil

TYPES = get_typestore(Stores.ROS2_JAZZY)
for _file in (Path(__file__).parent / "px4_msgs").glob("*.msg"):
    TYPES.register(get_types_from_msg(_file.read_text(), f"px4_msgs/msg/{_file.stem}"))
SET_MODE, ARM_DISARM, ACCEPTED = 176, 400, 0
BEAT_S = 0.5
MAVLINK_SYSTEM = 7
SPACECRAFT, PX4 = 45, 12
MILLISECOND_NS = 1_000_000


def ros(name: str, *fields: Any) -> Any:
    return TYPES.types[name](*fields)


def header(stamp_ns: int, frame: str) -> Any:
    stamp = ros("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
    return ros("std_msgs/msg/Header", stamp, frame)


class RosNetwork:
    """A router, and the laboratory's topics on it. What arrives waits in ``inbox``, as calls."""

    def __init__(self, port: int) -> None:
        config = zenoh.Config()
        for key, value in {
            "mode": '"router"',
            "listen/endpoints": f'["tcp/127.0.0.1:{port}"]',
            "scouting/multicast/enabled": "false",
        }.items():
            config.insert_json5(key, value)
        self._router = zenoh.open(config)
        self._port = port
        self._made: list[Any] = []
        self.inbox: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

    def _arguments(self, kind: str) -> dict[str, Any]:
        text, _ = TYPES.generate_msgdef(kind, ros_version=2)
        return {
            "msg_definition": text,
            "domain_id": 0,
            "router_port": self._port,
            "type_hash": TYPES.hash_rihs01(kind),
        }

    def publisher(self, topic: str, kind: str) -> ROS2Publisher:
        made = ROS2Publisher(topic, kind, **self._arguments(kind))
        self._made.append(made)
        return made

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None]) -> None:
        def put(message: Any) -> None:
            self.inbox.put(lambda: take(message))

        self._made.append(ROS2Subscriber(topic, kind, put, **self._arguments(kind)))

    def close(self) -> None:
        for made in self._made:
            made.close()
        self._router.close()


class WrenchRobot:
    """A robot that takes wrenches."""

    def __init__(self, lab: Laboratory, number: int, network: RosNetwork) -> None:
        self._lab, self._number = lab, number
        network.subscribe(f"/robot{number}/wrench", "geometry_msgs/msg/WrenchStamped", self._take)

    def _take(self, message: Any) -> None:
        force, torque = (
            np.array([v.x, v.y, v.z]) for v in (message.wrench.force, message.wrench.torque)
        )
        if force.any() or torque.any() or self._lab.begun_ns is not None:
            obey(self._lab, self._number, force, torque)


class Px4Robot:
    """A robot under PX4: the duty of each thruster is the control of its motor."""

    def __init__(self, lab: Laboratory, number: int, network: RosNetwork) -> None:
        self._lab, self._number = lab, number
        self._is_offboard = self._is_armed = False
        where = f"/robot{number}/fmu"
        self._ack = network.publisher(
            f"{where}/out/vehicle_command_ack", "px4_msgs/msg/VehicleCommandAck"
        )
        for topic, kind, take in (
            ("vehicle_command", "VehicleCommand", self._command),
            ("offboard_control_mode", "OffboardControlMode", self._mode),
            ("actuator_motors", "ActuatorMotors", self._motors),
        ):
            network.subscribe(f"{where}/in/{topic}", f"px4_msgs/msg/{kind}", take)

    def _command(self, asked: Any) -> None:
        if self._lab.has("robot gone", self._number):
            return
        if asked.command == SET_MODE:
            self._is_offboard = True
        elif asked.command == ARM_DISARM:
            self._is_armed = asked.param1 == 1.0 and self._is_offboard
            if not self._is_armed:
                self._lab.stop(self._number, time.monotonic_ns())
        self._ack.publish(
            timestamp=time.monotonic_ns() // 1000,
            command=asked.command,
            result=ACCEPTED,
            result_param1=0,
            result_param2=0,
            target_system=asked.source_system,
            target_component=asked.source_component,
            from_external=False,
        )

    def _mode(self, mode: Any) -> None:
        if self._is_armed and mode.direct_actuator and self._lab.chasers[self._number].is_on:
            self._lab.hear(self._number, time.monotonic_ns())

    def _motors(self, message: Any) -> None:
        if self._is_armed:
            thrusters = self._lab.actuators[self._number].matrix.shape[1]
            duty = np.asarray(message.control[:thrusters], dtype=float)
            obey(self._lab, self._number, np.zeros(3), np.zeros(3), duty)


def obey(lab: Laboratory, number: int, *command: np.ndarray) -> None:
    """Command a robot, which stops and says nothing if it is gone."""
    force, torque, *duty = command
    now_ns = time.monotonic_ns()
    try:
        lab.command(number, force, torque, now_ns, *duty)
    except ConnectionError:
        lab.stop(number, now_ns)


class Latch:
    """The probe of a robot: states whether it touches and is latched, and takes commands."""

    PERIOD_NS = 20 * MILLISECOND_NS

    def __init__(self, lab: Laboratory, number: int, network: RosNetwork) -> None:
        self._probe = lab.probes[number]
        where, kind = f"/robot{number}/latch", "std_msgs/msg/Bool"
        self._contact = network.publisher(f"{where}/contact", kind)
        self._latched = network.publisher(f"{where}/latched", kind)
        network.subscribe(f"{where}/command", kind, self._command)
        self._due_ns = 0

    def _command(self, message: Any) -> None:
        if bool(message.data) != self._probe.is_armed:  # it is repeated
            self._probe.command("arm" if message.data else "release")

    def tick(self, now_ns: int) -> None:
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + self.PERIOD_NS
        touched, self._probe.has_touched = self._probe.has_touched, False
        self._contact.publish(data=touched)
        self._latched.publish(data=bool(self._probe.is_latched))


class RosCamera:
    """Images and calibration of a robot's camera."""

    def __init__(self, number: int, matrix: np.ndarray, network: RosNetwork) -> None:
        where = f"/robot{number}/camera"
        self._images = network.publisher(f"{where}/image", "sensor_msgs/msg/Image")
        self._infos = network.publisher(f"{where}/camera_info", "sensor_msgs/msg/CameraInfo")
        self._frame, self._matrix = f"camera{number}", matrix

    def publish(self, image: np.ndarray, stamp_ns: int) -> None:
        height, width = image.shape
        stamp = header(stamp_ns, self._frame)
        self._images.publish(
            header=stamp,
            height=height,
            width=width,
            encoding="mono8",
            is_bigendian=0,
            step=width,
            data=image.ravel(),
        )
        self._infos.publish(
            header=stamp,
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=self._matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([self._matrix, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=ros("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False),
        )


class RosMotionCapture:
    """Poses of the bodies, each on a topic of its own."""

    KIND = "geometry_msgs/msg/PoseStamped"

    def __init__(self, names: list[str], network: RosNetwork) -> None:
        self._publishers = {name: network.publisher(f"/mocap/{name}", self.KIND) for name in names}

    def publish(self, capture: Capture) -> None:
        w, x, y, z = map(float, capture.q_wxyz)
        pose = ros(
            "geometry_msgs/msg/Pose",
            ros("geometry_msgs/msg/Point", *map(float, capture.position)),
            ros("geometry_msgs/msg/Quaternion", x, y, z, w),
        )
        self._publishers[capture.name].publish(header=header(capture.stamp_ns, "map"), pose=pose)


class MavlinkMotionCapture:
    """Poses of one body as ``ATT_POS_MOCAP``, NED and FRD, on UDP."""

    def __init__(self, name: str, port: int) -> None:
        self._name, self._beaten_ns = name, 0
        self._link: Any = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}",
            source_system=MAVLINK_SYSTEM,
            source_component=1,
            dialect="common",
        )

    def publish(self, capture: Capture) -> None:
        if capture.name != self._name:
            return
        x, y, z = capture.position
        w, a, b, c = capture.q_wxyz
        # ENU to NED on the left, FLU to FRD on the right: (0, 1, 1, 0) / sqrt 2, and (0, 1, 0, 0).
        s = np.sqrt(0.5)
        q = np.array([s * (w + c), s * (a + b), s * (a - b), s * (w - c)])
        self._link.mav.att_pos_mocap_send(
            capture.stamp_ns // 1000, q.tolist(), float(y), float(x), float(-z)
        )

    def tick(self, now_ns: int) -> None:
        if now_ns - self._beaten_ns > BEAT_S * 1e9:
            self._beaten_ns = now_ns
            self._link.mav.heartbeat_send(SPACECRAFT, PX4, 0, 0, 4)
            while self._link.recv_match(blocking=False) is not None:
                pass
