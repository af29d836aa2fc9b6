# SPDX-License-Identifier: Apache-2.0
"""Devices of the gateway on MAVLink, with pymavlink's connections as the vehicle."""

from __future__ import annotations

import math
import os
import pty
import select
import socket
import sys
import threading
import time
import tty
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.gateway.devices import DeviceError, LatchReading
from chaserdock_agents.gateway.drivers import (
    acknowledgements,
    command_stream,
    gripper,
    mavlink,
)
from device_cases import (
    Clock,
    command,
    complains,
    open_device,
    poll_until,
    use_entry_points,
    wait_for,
)
from general_position import matrix
from harness import free_port

os.environ["MAVLINK20"] = "1"  # read by pymavlink when it is imported
from pymavlink import mavutil

Q = (0.5417, -0.3214, 0.6109, 0.4791)
Q_WXYZ = np.array(Q) / np.linalg.norm(Q)
POSITION, LINEAR, ANGULAR = (0.31, -1.7, 2.9), (0.11, -0.22, 0.37), (0.021, 0.043, -0.035)
TRIANGLE = tuple(1e-4 * (k + 1) for k in range(21))
PX4, ARDUPILOT, SPACECRAFT, SUBMARINE, ROVER = 12, 3, 45, 12, 10


class Vehicle:
    """An autopilot that sends heartbeats, records what arrives and answers commands."""

    def __init__(
        self, url: str, system: int = 1, kind: tuple[int, int] = (PX4, SPACECRAFT)
    ) -> None:
        self.link: Any = mavutil.mavlink_connection(
            url, source_system=system, source_component=1, dialect="common"
        )
        self.kind, self.read, self.results = kind, [], {176: 0, 400: 0}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        beaten_s = 0.0
        while not self._over.is_set():
            if time.monotonic() - beaten_s > 0.2:
                beaten_s = time.monotonic()
                self.link.mav.heartbeat_send(self.kind[1], self.kind[0], 0, 0, 4)
            message = self.link.recv_match(blocking=True, timeout=0.02)
            if message is None or message.get_type() == "BAD_DATA":
                continue
            self.read.append(message)
            if message.get_type() == "COMMAND_LONG" and message.command in self.results:
                self.link.mav.command_ack_send(message.command, self.results[message.command])

    def of(self, kind: str) -> list[Any]:
        return [message for message in tuple(self.read) if message.get_type() == kind]

    def odometry(self, **changes: Any) -> None:
        fields = {
            "time_usec": 20_000_123,
            "frame_id": 1,
            "child_frame_id": 12,
            **dict(zip("xyz", POSITION, strict=True)),
            "q": Q_WXYZ.tolist(),
            **dict(zip(("vx", "vy", "vz"), LINEAR, strict=True)),
            **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), ANGULAR, strict=True)),
            "pose_covariance": TRIANGLE,
            "velocity_covariance": [math.nan] * 21,
        }
        self.link.mav.odometry_send(**{**fields, **changes})

    def buttons(self, state: int) -> None:
        self.link.mav.button_change_send(20_000, 19_950, state)

    def gripper_actions(self) -> list[tuple[int, float, float]]:
        asked = [c for c in self.of("COMMAND_LONG") if c.command == 211]
        return [(c.target_component, c.param1, c.param2) for c in asked]

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.link.close()


class Lab:
    def __init__(self) -> None:
        self.port = free_port()
        self.address = f"mavlink:udp://127.0.0.1:{self.port}"
        self._vehicles: list[Vehicle] = []

    def vehicle(self, system: int = 1, kind: tuple[int, int] = (PX4, SPACECRAFT)) -> Vehicle:
        self._vehicles.append(Vehicle(f"udpout:127.0.0.1:{self.port}", system, kind))
        return self._vehicles[-1]

    def close(self) -> None:
        for vehicle in self._vehicles:
            vehicle.close()


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    use_entry_points(monkeypatch)
    made = Lab()
    yield made
    made.close()
    left = list(mavlink._LINKS._users.values())
    mavlink._LINKS._users.clear()
    for shared, _ in left:
        shared.close()
    assert left == []  # every test closes its devices
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", made.port))  # and its port


def poll_one(source: Any, send: Any) -> Any:
    return poll_until(source, 1, send)[0]


# -- poses -----------------------------------------------------------------------------------------


def test_odometry_of_a_vehicle_is_passed_on_in_ned_and_frd(lab: Lab) -> None:
    clock = Clock()
    source = open_device("pose", lab.address, {"system": 7}, clock)
    assert (source.world_axes, source.body_axes) == ("ned", "frd")
    vehicle, other = lab.vehicle(7), lab.vehicle(8)

    def both() -> None:
        other.odometry(x=99.0)
        vehicle.odometry()

    sample = poll_one(source, both)
    for _ in range(5):
        both()
        time.sleep(0.01)
        assert all(s.position_m[0] != 99.0 for s in source.poll())
    assert (sample.body, sample.stamp_ns, sample.arrived_ns) == ("", 20_000_123_000, clock.time_ns)
    np.testing.assert_allclose(sample.position_m, POSITION, rtol=1e-7)
    np.testing.assert_allclose(sample.q_wxyz, Q_WXYZ, rtol=1e-6)
    np.testing.assert_allclose(sample.velocity_m_s, matrix(Q_WXYZ) @ LINEAR, atol=1e-6)
    np.testing.assert_allclose(sample.omega_rad_s, ANGULAR, rtol=1e-6)
    rows = iter(TRIANGLE)
    for i in range(6):
        for j in range(i, 6):
            value = next(rows)
            assert sample.covariance[i, j] == pytest.approx(value)
            assert sample.covariance[j, i] == pytest.approx(value)
    source.close()


def stated(**changes: Any) -> Any:
    fields = {
        "frame_id": 1,
        "child_frame_id": 12,
        "time_usec": 9,
        **dict(zip("xyz", POSITION, strict=True)),
        "q": Q,
        "vx": 0.1,
        "vy": 0.2,
        "vz": 0.3,
        "rollspeed": 0.1,
        "pitchspeed": 0.2,
        "yawspeed": 0.3,
        "pose_covariance": TRIANGLE,
    }
    return SimpleNamespace(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "axes", "velocity"),
    [
        ({"child_frame_id": 1}, "ned", (0.1, 0.2, 0.3)),  # in the world
        ({"child_frame_id": 20}, "ned", None),  # its heading is unknown
        ({"frame_id": 4, "child_frame_id": 4}, "enu", (0.1, 0.2, 0.3)),
        ({"vy": math.nan}, "ned", None),
    ],
)
def test_velocity_is_in_the_frame_that_the_message_states(
    changes: Any, axes: str, velocity: Any
) -> None:
    sample: Any = mavlink.of_odometry(stated(**changes), 0, "", axes)
    np.testing.assert_array_equal(sample.velocity_m_s, velocity)


def test_what_is_not_stated_is_none() -> None:
    unknown = stated(pose_covariance=(math.nan, *TRIANGLE[1:]), time_usec=0, rollspeed=math.nan)
    sample: Any = mavlink.of_odometry(unknown, 0, "", "ned")
    assert (sample.stamp_ns, sample.omega_rad_s, sample.covariance) == (None, None, None)


def test_frame_of_other_axes_is_refused(lab: Lab) -> None:
    source = open_device("pose", lab.address, {"axes": "enu"})
    assert (source.world_axes, source.body_axes) == ("enu", "flu")
    complains(
        source,
        "states MAV_FRAME 1; axes 'enu' are 4 and 21: set option axes",
        lab.vehicle().odometry,
    )
    source.close()


def test_motion_capture_of_several_bodies_on_one_port(lab: Lab) -> None:
    source = open_device("pose", lab.address, {"message": "ATT_POS_MOCAP"})
    first, second = lab.vehicle(3), lab.vehicle(4)
    unknown = [math.nan, *[0.0] * 20]
    found: dict[str, Any] = {}

    def both() -> bool:
        first.link.mav.att_pos_mocap_send(11_000_001, Q_WXYZ.tolist(), *POSITION, TRIANGLE)
        second.link.mav.att_pos_mocap_send(11_000_002, Q_WXYZ.tolist(), 0.5, 0.6, 0.7, unknown)
        found.update((sample.body, sample) for sample in source.poll())
        return len(found) == 2

    wait_for(both)
    assert (found["3"].stamp_ns, found["4"].stamp_ns) == (11_000_001_000, 11_000_002_000)
    np.testing.assert_allclose(found["3"].position_m, POSITION, rtol=1e-7)
    np.testing.assert_allclose(found["4"].position_m, (0.5, 0.6, 0.7), rtol=1e-7)
    assert found["3"].covariance[0, 1] == pytest.approx(TRIANGLE[1])
    assert (found["4"].covariance, found["3"].velocity_m_s, found["3"].omega_rad_s) == (None,) * 3
    source.close()


def test_silent_vehicle_is_gone_and_noise_is_ignored(lab: Lab) -> None:
    clock = Clock()
    source = open_device("pose", lab.address, {"system": 1}, clock)
    vehicle = lab.vehicle()
    poll_one(source, vehicle.odometry)
    vehicle.link.port.sendto(b"\xfd\x09noise\x00\xff" * 9, ("127.0.0.1", lab.port))
    poll_one(source, vehicle.odometry)
    vehicle.close()
    lab._vehicles.clear()
    while source._arrived:
        source.poll()
    clock.time_ns += 2_900_000_000
    assert source.poll() == []
    clock.time_ns += 200_000_000
    complains(source, f"system 1 on udp://127.0.0.1:{lab.port} is silent for over 3 s")
    source.close()


def test_tcp_is_closed_by_the_other_side(lab: Lab) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"mavlink:tcp://127.0.0.1:{server.getsockname()[1]}"
        source = open_device("pose", address, {})
        side, _ = server.accept()
        dialect: Any = mavutil.mavlink
        packet = dialect.MAVLink(None, 5, 1)
        message = dialect.MAVLink_att_pos_mocap_message(1, Q, *POSITION)
        side.sendall(message.pack(packet))
        assert source.poll() == []  # another message
        side.close()
        complains(source, "is closed by the other side")
        source.close()


# -- robot -----------------------------------------------------------------------------------------

PLANAR = {"force_max_N": [3.0, 1.5, 0.0], "torque_max_N_m": [0.0, 0.0, 0.29]}
ALL = {"force_max_N": [3.0, 1.5, 2.0], "torque_max_N_m": [0.1, 0.2, 0.29]}


def deflection(message: Any) -> tuple[int, ...]:
    return tuple(getattr(message, name) for name in "xyzrst")


NEUTRAL = (0, 0, 500, 0, 0, 0)


@pytest.mark.parametrize(
    ("kind", "options", "mode", "expected"),
    [
        ((PX4, SPACECRAFT), PLANAR, 1.0, (300, -1000, 500, 200, 0, 0)),
        # Down and positive about FRD's axes: z below the middle.
        ((ARDUPILOT, SUBMARINE), ALL, 19.0, (300, -1000, 375, 200, 250, -400)),
    ],
    ids=["PX4", "ArduSub"],
)
def test_wrench_is_deflection_after_arming_and_neutral_when_commands_cease(
    lab: Lab,
    monkeypatch: pytest.MonkeyPatch,
    kind: tuple[int, int],
    options: dict[str, Any],
    mode: float,
    expected: tuple[int, ...],
) -> None:
    monkeypatch.setattr(command_stream, "HOLD_S", 0.15)
    monkeypatch.setattr(mavlink, "_HEARTBEAT_S", 0.1)
    robot = open_device("robot", lab.address, {"system": 2, **options})
    assert (robot.body_axes, robot.thrusters) == ("frd", 0)
    vehicle = lab.vehicle(2, kind)
    wait_for(lambda: vehicle.of("HEARTBEAT"))
    robot.send(command())
    robot.stop()
    time.sleep(0.1)
    assert {m.get_type() for m in vehicle.read} == {"HEARTBEAT"}
    robot.arm()
    sent = command((0.9, -4.0, 0.5), (-0.04, 0.05, 0.058))
    asked = [(c.target_system, c.command, c.param1, c.param2) for c in vehicle.of("COMMAND_LONG")]
    assert asked == [(2, 176, 1.0, mode), (2, 400, 1.0, 0.0)]
    assert {deflection(m) for m in vehicle.of("MANUAL_CONTROL")} == {NEUTRAL}

    def send_until_obeyed() -> Any:
        number = len(vehicle.of("MANUAL_CONTROL"))

        def obeyed() -> list[Any]:
            new = vehicle.of("MANUAL_CONTROL")[number:]
            return [message for message in new if deflection(message) != NEUTRAL]

        wait_for(lambda: robot.send(sent) or obeyed())
        return obeyed()[-1]

    newest = send_until_obeyed()
    assert (newest.target, newest.enabled_extensions, newest.buttons) == (2, 3, 0)
    assert deflection(newest) == expected
    wait_for(lambda: deflection(vehicle.of("MANUAL_CONTROL")[-1]) == NEUTRAL)  # by itself
    send_until_obeyed()
    robot.stop()
    wait_for(lambda: vehicle.of("COMMAND_LONG")[-1].param2 == 21196.0)
    assert vehicle.of("COMMAND_LONG")[-1].param1 == 0.0
    robot.send(sent)
    wait_for(lambda: len(vehicle.of("HEARTBEAT")) > 2)
    assert deflection(vehicle.of("MANUAL_CONTROL")[-1]) == NEUTRAL
    beat = vehicle.of("HEARTBEAT")[-1]
    assert (beat.get_srcSystem(), beat.type, beat.autopilot) == (255, 6, 8)
    robot.close()
    with pytest.raises(DeviceError, match="closed"):
        robot.send(sent)


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ((PX4, SPACECRAFT), ALL, "PX4 takes force x, y and torque z only"),
        ((ARDUPILOT, ROVER), PLANAR, "autopilot 3 of vehicle type 10 is neither PX4 nor ArduSub"),
    ],
)
def test_robot_that_cannot_give_the_wrench_does_not_arm(
    lab: Lab, kind: tuple[int, int], options: dict[str, Any], said: str
) -> None:
    robot = open_device("robot", lab.address, options)
    vehicle = lab.vehicle(kind=kind)
    with pytest.raises(DeviceError, match=said):
        robot.arm()
    assert vehicle.of("MANUAL_CONTROL") == []
    robot.close()


def test_robot_that_refuses_or_is_silent_is_named(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mavlink, "_GONE_S", 0.2)
    robot = open_device("robot", lab.address, PLANAR)
    with pytest.raises(DeviceError, match="no heartbeat of an autopilot with system 1"):
        robot.arm()
    robot.send(command())  # nothing is sent before it is armed
    robot.stop()  # never raises
    monkeypatch.setattr(mavlink, "_GONE_S", 3.0)
    monkeypatch.setattr(acknowledgements, "REPLY_S", 0.1)
    vehicle = lab.vehicle()
    vehicle.results[400] = 1
    with pytest.raises(DeviceError, match=r"^arming: temporarily rejected$"):
        robot.arm()
    vehicle.results.clear()
    with pytest.raises(DeviceError, match="manual mode: no acknowledgement within"):
        robot.arm()
    assert [c.confirmation for c in vehicle.of("COMMAND_LONG")][-4:] == [0, 1, 2, 3]
    robot.close()


def test_command_that_is_not_finite_is_refused_and_not_repeated(lab: Lab) -> None:
    robot = open_device("robot", lab.address, PLANAR)
    vehicle = lab.vehicle()
    robot.arm()
    with pytest.raises(DeviceError, match="force or torque is not finite"):
        robot.send(command((math.nan, 0.0, 0.0)))
    number = len(vehicle.of("MANUAL_CONTROL"))
    wait_for(lambda: len(vehicle.of("MANUAL_CONTROL")) > number + 1)
    assert {deflection(m) for m in vehicle.of("MANUAL_CONTROL")} == {NEUTRAL}
    robot.close()


def test_poses_and_robot_share_a_port(lab: Lab) -> None:
    source = open_device("pose", lab.address, {})
    robot = open_device("robot", lab.address, PLANAR)
    vehicle = lab.vehicle()
    assert poll_one(source, vehicle.odometry).body == "1"
    robot.arm()
    robot.close()
    poll_one(source, vehicle.odometry)
    source.close()


# -- latch -----------------------------------------------------------------------------------------

ACCEPTED, REJECTED, DENIED, IN_PROGRESS, CANCELLED = 0, 1, 2, 5, 6
OPEN, TOUCH, OTHERS = 0b1111, 0b1101, 0b0010
"""States of four switches to ground: none is pressed; the second is; all but the second are."""


def opened_gripper(lab: Lab, **options: Any) -> tuple[Any, Vehicle]:
    """Return a latch that is open, and its vehicle."""
    latch = open_device("latch", lab.address, {"contact": 2, "gripper": 3, "system": 2, **options})
    vehicle = lab.vehicle(2, (ARDUPILOT, SUBMARINE))
    wait_for(lambda: vehicle.of("HEARTBEAT"))
    vehicle.results[211] = ACCEPTED
    latch.command("release")
    wait_for(latch.poll)
    return latch, vehicle


def test_gripper_grabs_at_the_touch_and_is_latched_when_that_is_acknowledged(lab: Lab) -> None:
    latch = open_device("latch", lab.address, {"contact": 2, "gripper": 3, "system": 2})
    latch.command("keep")
    with pytest.raises(DeviceError, match="system 2 was not heard"):
        latch.command("release")
    assert latch.poll() is None
    vehicle, other = lab.vehicle(2, (ARDUPILOT, SUBMARINE)), lab.vehicle(1)
    wait_for(lambda: vehicle.of("HEARTBEAT") and other.of("HEARTBEAT"))
    vehicle.results[211] = ACCEPTED
    latch.command("release")
    wait_for(lambda: latch.poll() == LatchReading(contact=False, armed=False, latched=False))

    def arm_until(holds: Any) -> None:
        wait_for(lambda: latch.command("arm") or holds(latch.poll()))

    vehicle.results[211] = IN_PROGRESS
    vehicle.buttons(OTHERS)
    other.buttons(TOUCH)
    time.sleep(0.1)
    arm_until(lambda reading: reading.armed)
    assert vehicle.gripper_actions() == [(1, 3.0, 0.0)]  # open until the probe touches
    vehicle.buttons(TOUCH)
    arm_until(lambda reading: reading.contact and len(vehicle.gripper_actions()) == 2)
    vehicle.buttons(OPEN)
    arm_until(lambda reading: not reading.contact)
    assert latch.poll() == LatchReading(contact=False, armed=True, latched=False)
    vehicle.link.mav.command_ack_send(400, ACCEPTED)
    vehicle.link.mav.command_ack_send(211, ACCEPTED)
    arm_until(lambda reading: reading.latched)
    vehicle.results[211] = ACCEPTED
    latch.command("release")
    wait_for(lambda: latch.poll() == LatchReading(contact=False, armed=False, latched=False))
    assert vehicle.gripper_actions() == [(1, 3.0, 0.0), (1, 3.0, 1.0), (1, 3.0, 0.0)]
    assert other.gripper_actions() == []
    latch.close()


def test_short_touch_of_an_armed_gripper_is_not_lost_and_one_before_does_not_count(
    lab: Lab,
) -> None:
    latch, vehicle = opened_gripper(lab, pressed="high")
    for armed in (False, True):
        latch.command("arm" if armed else "release")
        vehicle.buttons(0b0010)
        vehicle.buttons(0b1101)
        wait_for(lambda: latch.poll().contact)
        wait_for(lambda: not latch.poll().contact)
        latch.command("arm")
        latch.command("arm")
        if armed:
            wait_for(lambda: latch.poll().latched)
        time.sleep(0.1)
        assert [c[2] for c in vehicle.gripper_actions()] == ([0.0, 1.0] if armed else [0.0])
    latch.close()


def test_switch_tells_what_the_gripper_holds(lab: Lab) -> None:
    """It has closed on nothing: the acknowledgement does not make it latched."""
    latch, vehicle = opened_gripper(lab, latched=4)
    vehicle.buttons(TOUCH)
    wait_for(lambda: latch.command("arm") or len(vehicle.gripper_actions()) == 2)
    time.sleep(0.1)
    assert latch.poll() == LatchReading(contact=True, armed=True, latched=False)
    vehicle.buttons(TOUCH & 0b0111)
    wait_for(lambda: latch.poll().latched)
    vehicle.buttons(OPEN)
    wait_for(lambda: not latch.poll().latched)
    latch.close()


def test_gripper_that_refuses_is_named_once_and_asked_again(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acknowledgements, "REPLY_S", 0.1)
    monkeypatch.setattr(gripper, "_DONE_S", 0.3)
    latch, vehicle = opened_gripper(lab)
    vehicle.buttons(TOUCH)
    wait_for(lambda: latch.poll().contact)
    for result, said in [
        (DENIED, "gripper 3, grab: denied"),
        (None, "gripper 3, grab: no acknowledgement within 0.4 s"),
        (REJECTED, "gripper 3, grab: temporarily rejected"),
        (CANCELLED, "gripper 3, grab: no acknowledgement within 0.4 s"),
        (IN_PROGRESS, "gripper 3, grab: in progress for over 0.3 s"),
    ]:
        vehicle.results.pop(211, None)
        if result is not None:
            vehicle.results[211] = result
        number = len(vehicle.of("COMMAND_LONG"))
        latch.command("arm")
        complains(latch, said)
        assert latch.poll() == LatchReading(contact=True, armed=True, latched=False)
        attempts = [c.confirmation for c in vehicle.of("COMMAND_LONG")][number:]
        assert attempts == [0] if result in (DENIED, IN_PROGRESS) else [0, 1, 2, 3]
    vehicle.results[211] = ACCEPTED
    latch.command("arm")
    wait_for(lambda: latch.poll().latched)
    latch.close()


def test_gripper_that_is_busy_for_a_moment_grabs(lab: Lab) -> None:
    """PX4 rejects a repeated command while its first one is under way."""
    latch, vehicle = opened_gripper(lab)
    vehicle.results[211] = REJECTED
    vehicle.buttons(TOUCH)
    wait_for(lambda: latch.command("arm") or len(vehicle.gripper_actions()) == 2)
    vehicle.link.mav.command_ack_send(211, ACCEPTED)
    wait_for(lambda: latch.poll().latched)
    latch.close()


def test_gripper_that_is_armed_before_all_else_is_not_opened(lab: Lab) -> None:
    """It may hold the target since before a restart of the gateway."""
    latch = open_device("latch", lab.address, {"contact": 2})
    vehicle = lab.vehicle()
    wait_for(lambda: vehicle.of("HEARTBEAT"))
    vehicle.results[211] = ACCEPTED
    latch.command("arm")
    time.sleep(0.1)
    assert (latch.poll(), vehicle.gripper_actions()) == (None, [])
    vehicle.buttons(TOUCH)
    wait_for(lambda: latch.command("arm") or latch.poll())
    assert latch.poll() == LatchReading(contact=True, armed=True, latched=True)
    latch.close()


def test_gripper_of_a_silent_vehicle_is_gone(lab: Lab) -> None:
    clock = Clock()
    latch = open_device("latch", lab.address, {"contact": 2}, clock)
    vehicle = lab.vehicle()
    wait_for(lambda: latch._link._heard_ns)
    vehicle.close()
    lab._vehicles.clear()
    clock.time_ns += 3_100_000_000
    complains(latch, f"system 1 on udp://127.0.0.1:{lab.port} is silent for over 3 s")
    latch.close()


# -- serial ports ----------------------------------------------------------------------------------


class SerialLine:
    """A pseudo terminal: the vehicle is on one end, ``address`` is the other one."""

    def __init__(self) -> None:
        self.side, end = pty.openpty()
        tty.setraw(end)
        self.path = os.ttyname(end)
        self.address = f"mavlink:serial://{self.path}:57600"
        os.close(end)

    def write(self, data: bytes) -> None:
        os.write(self.side, data)

    def read(self) -> bytes:
        return os.read(self.side, 4096) if select.select([self.side], [], [], 0.0)[0] else b""

    def hang_up(self) -> None:
        os.close(self.side)


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> SerialLine:
    use_entry_points(monkeypatch)
    return SerialLine()


def packed(message: Any) -> bytes:
    dialect: Any = mavutil.mavlink
    return message.pack(dialect.MAVLink(None, 5, 1))


def mocap() -> bytes:
    dialect: Any = mavutil.mavlink
    return packed(dialect.MAVLink_att_pos_mocap_message(1, Q, *POSITION))


def test_serial_line_carries_poses_and_control_both_ways(line: SerialLine) -> None:
    """The sides of the line see each other's heartbeats, and the robot arms over it."""
    source = open_device("pose", line.address, {"message": "ATT_POS_MOCAP"})
    robot = open_device("robot", line.address, {**PLANAR, "system": 5})
    sample = poll_one(source, lambda: line.write(mocap()))
    assert sample.body == "5"
    np.testing.assert_allclose(sample.position_m, POSITION, atol=1e-6)
    dialect: Any = mavutil.mavlink
    line.write(packed(dialect.MAVLink_heartbeat_message(SPACECRAFT, PX4, 0, 0, 4, 3)))
    reader = dialect.MAVLink(None)
    reader.robust_parsing = True
    seen: set[str] = set()

    def vehicle() -> None:
        for message in reader.parse_buffer(line.read()) or ():
            seen.add(message.get_type())
            if message.get_type() == "COMMAND_LONG":
                line.write(packed(dialect.MAVLink_command_ack_message(message.command, 0)))

    arming = threading.Thread(target=robot.arm)
    arming.start()
    while arming.is_alive():
        vehicle()
        time.sleep(0.002)
    robot.send(command(force=(1.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0)))
    wait_for(lambda: vehicle() or {"HEARTBEAT", "COMMAND_LONG", "MANUAL_CONTROL"} <= seen)
    robot.close()
    source.close()
    line.hang_up()


def test_serial_line_that_is_unplugged_is_gone(line: SerialLine) -> None:
    source = open_device("pose", line.address, {"message": "ATT_POS_MOCAP"})
    poll_one(source, lambda: line.write(mocap()))
    line.hang_up()
    complains(source, f"serial://{line.path}:57600 is gone")
    source.close()


@pytest.mark.parametrize("heard", [b"", b"\x55\xaa\xfd\x00" * 40], ids=["nothing", "noise"])
def test_mute_serial_device_is_named(line: SerialLine, heard: bytes) -> None:
    """Noise is what another baud rate looks like."""
    clock = Clock()
    source = open_device("pose", line.address, {}, clock)
    line.write(heard)
    clock.time_ns += 2_900_000_000
    assert source.poll() == []
    clock.time_ns += 200_000_000
    complains(source, "no MAVLink within 3 s: is the vehicle on, and set to this baud rate?")
    source.close()
    line.hang_up()


def test_serial_port_in_use_is_named(line: SerialLine) -> None:
    source = open_device("pose", line.address, {})
    other = f"mavlink:serial://{line.path}:115200"  # another address: a port of its own
    with pytest.raises(DeviceError, match="at 115200 baud: another program uses it") as raised:
        open_device("pose", other, {})
    assert "\n" not in str(raised.value)
    source.close()
    again = open_device("pose", other, {})
    again.close()
    line.hang_up()


# -- invalid input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "address", "options", "said"),
    [
        ("pose", "mavlink:/dev/ttyACM0", {}, "must be udp://HOST:PORT (listens), udpout://"),
        ("pose", "mavlink:udp://0.0.0.0", {}, "must be udp://HOST:PORT (listens), udpout://"),
        ("pose", "mavlink:udp://127.0.0.1:x", {}, "cannot listen on udp://127.0.0.1:x"),
        ("pose", "mavlink:udp://127.0.0.1:99999", {}, "cannot listen on udp://127.0.0.1:99999"),
        (
            "pose",
            "mavlink:serial:///dev/ttyNONE7:57600",
            {},
            "cannot open /dev/ttyNONE7 at 57600 baud: No such file or directory",
        ),
        ("pose", "mavlink:serial:///dev/null:57600", {}, "cannot open /dev/null at 57600 baud: "),
        ("pose", "mavlink:serial:///dev/ttyS0", {}, "tcp://HOST:PORT or serial://PATH:BAUD"),
        ("pose", "mavlink:serial:///dev/ttyS0:fast", {}, "tcp://HOST:PORT or serial://PATH:BAUD"),
        ("pose", "mavlink:tcp://127.0.0.1:1", {}, "cannot reach tcp://127.0.0.1:1"),
        ("pose", "mavlink:udp://127.0.0.1:1", {"message": "ATTITUDE"}, "in option message"),
        ("pose", "mavlink:udp://127.0.0.1:1", {"sysid": 1}, "unknown option 'sysid'"),
        ("robot", "mavlink:udp://127.0.0.1:1", {}, "missing required field `force_max_N`"),
        ("robot", "mavlink:udp://127.0.0.1:1", {**PLANAR, "system": 0}, "in option system"),
        ("latch", "mavlink:udp://127.0.0.1:1", {}, "missing required field `contact`"),
        ("latch", "mavlink:udp://127.0.0.1:1", {"contact": 9}, "in option contact"),
        ("latch", "mavlink:udp://127.0.0.1:1", {"contact": 1, "gripper": 0}, "in option gripper"),
    ],
)
def test_invalid_input_gives_one_line(
    kind: Any, address: str, options: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_entry_points(monkeypatch)
    with pytest.raises(DeviceError) as raised:
        open_device(kind, address, options)
    text = str(raised.value)
    assert text.startswith(f"{kind} {address!r}: ")
    assert said in text
    assert "\n" not in text


def test_missing_package_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    use_entry_points(monkeypatch)
    monkeypatch.setitem(sys.modules, "pymavlink", None)
    monkeypatch.setattr("chaserdock_protocol.errors.find_spec", lambda name: None)
    with pytest.raises(DeviceError, match=r"pymavlink, of the extra chaserdock\[mavlink\], is not"):
        open_device("pose", f"mavlink:udp://127.0.0.1:{free_port()}", {})
