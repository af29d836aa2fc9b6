# SPDX-License-Identifier: Apache-2.0
"""Read poses from MAVLink, and command robots and grippers by it. Needs the extra
``chaserdock[mavlink]``.

Poses: ``ODOMETRY`` and ``ATT_POS_MOCAP``. Their stamps are those of the sender's clock, which the
gateway estimates; ``TIMESYNC`` is not needed. Robots: ``MANUAL_CONTROL`` in the manual mode of
PX4's spacecraft and of ArduSub, which pass it on as forces and torques, and end it when it ceases.
Others that look fit are not: ``SET_ACTUATOR_CONTROL_TARGET`` is read neither by PX4 since 1.14 nor
by ArduPilot; ``SET_ATTITUDE_TARGET`` has no torque; ``DO_SET_ACTUATOR`` and ``DO_SET_SERVO`` hold
the last value for ever, so that a thruster stays open when the gateway ends.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.errors import require_extra
from chaserdock_protocol.messages import Latch
from chaserdock_protocol.transport.network import Undo

from ..devices import DeviceError, DeviceHost, LatchReading, PoseSample, RobotCommand
from ..options import read_options
from .autopilot import AutopilotRobot
from .gripper import DO_GRIPPER, Gripper
from .pose_samples import KEPT, is_finite, stated, turned
from .shares import Maxima, wrench_shares
from .sharing import Shared

SOURCE = (255, 190)
"""System and component of the gateway: those of a ground station, as ArduPilot takes manual control
from system 255 only (MAV_GCS_SYSID).
"""
_HEARTBEAT_S = 1.0
"""Interval of heartbeats, s (mavlink.io, Heartbeat/Connection Protocol)."""
_GONE_S = 3.0
"""Silence, s, after which a system is gone: it missed three heartbeats."""
_CONNECT_S = 5.0
"""Longest wait, s, for a TCP connection on a local network."""
_WAIT_S = 0.1
"""Longest wait, s, of the receiving thread, which looks then whether it is closed."""
_DATAGRAM = 65536
"""Bytes that are read at once: the largest datagram."""
# MAV_FRAME: frames of poses, and of velocities in the body's axes, by world axes.
_WORLD_FRAMES = {"ned": (1, 20), "enu": (4, 21)}
_BODY_FRAMES = {"ned": (8, 12), "enu": (13,)}
# MAV_AUTOPILOT and MAV_TYPE of a heartbeat.
_ARDUPILOT, _PX4, _SUBMARINE, _GROUND_STATION, _NO_AUTOPILOT = 3, 12, 12, 6, 8
_PX4_MANUAL, _ARDUSUB_MANUAL = 1.0, 19.0
"""Numbers of the manual modes (PX4_CUSTOM_MAIN_MODE_MANUAL; ArduSub, Mode::Number::MANUAL)."""
_LEAD_S = 0.3
"""Time, s, for which control must have arrived before PX4 arms in manual mode: three messages."""
_FULL = 1000.0
"""Full deflection of MANUAL_CONTROL."""
_PITCH_AND_ROLL = 3
"""Bits of MANUAL_CONTROL that state its fields ``s`` and ``t`` as valid."""


def _dialect() -> Any:
    """Return pymavlink's messages. Raises MissingPackageError, which says how to install it."""
    require_extra("pymavlink", "mavlink")
    from pymavlink.dialects.v20 import common

    return common


# -- link ------------------------------------------------------------------------------------------


def _open_port(address: str) -> _SocketPort | _SerialPort:
    """Open ``udp://HOST:PORT`` (or ``udpin``: listens), ``udpout``, ``tcp``, or
    ``serial://PATH:BAUD``. Raises DeviceError.
    """
    scheme, found, rest = address.partition("://")
    host, colon, port = rest.rpartition(":")
    if found and colon and host:
        if scheme == "serial" and port.isdecimal() and int(port):
            return _SerialPort(host, int(port))
        if scheme in ("udp", "udpin", "udpout", "tcp"):
            return _SocketPort(address, scheme, host, port)
    raise DeviceError(
        f"{address!r} must be udp://HOST:PORT (listens), udpout://HOST:PORT, tcp://HOST:PORT or "
        "serial://PATH:BAUD"
    )


class _SerialPort:
    """A serial port, for this program alone. pymavlink's own reads it by pyserial, too, but hides
    that a port is gone.
    """

    fixed, must_speak, ended = "the serial line", True, "gone"

    def __init__(self, path: str, baud: int) -> None:
        require_extra("serial", "mavlink")
        import serial

        try:
            self._port = serial.Serial(
                path, baud, timeout=_WAIT_S, write_timeout=_WAIT_S, exclusive=True
            )
        except (OSError, ValueError) as error:
            number = getattr(error, "errno", None)
            why = "another program uses it" if number == errno.EAGAIN else str(error)
            if number not in (None, errno.EAGAIN):
                why = os.strerror(number)
            raise DeviceError(f"cannot open {path} at {baud} baud: {why}") from None

    def receive(self) -> tuple[bytes, Any] | None:
        """Return bytes, None if there are none after ``_WAIT_S``. Raises OSError at the end."""
        first = self._port.read(1)
        return (first + self._port.read(self._port.in_waiting), self.fixed) if first else None

    def send(self, data: bytes, receiver: Any) -> None:
        """Send bytes."""
        self._port.write(data)

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class _SocketPort:
    """A socket at ``udp://HOST:PORT`` (or ``udpin``: listens), ``udpout`` or ``tcp``."""

    must_speak, ended = False, "closed by the other side"

    def __init__(self, address: str, scheme: str, host: str, port: str) -> None:
        self._listens, self._streams = scheme in ("udp", "udpin"), scheme == "tcp"
        try:
            if self._streams:
                self._socket = socket.create_connection((host, int(port)), _CONNECT_S)
                self._socket.settimeout(_WAIT_S)  # of sending to a side that does not read
            else:
                self._socket = opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                (opened.bind if self._listens else opened.connect)((host, int(port)))
        except (OSError, ValueError, OverflowError) as error:
            if not self._streams:
                self._socket.close()
            what = "listen on" if self._listens else "reach"
            raise DeviceError(f"cannot {what} {address}: {error}") from None
        self.fixed = None if self._listens else (host, int(port))

    def receive(self) -> tuple[bytes, Any] | None:
        """Return bytes and their sender, None if there are none after ``_WAIT_S``. Raises EOFError
        at the end.
        """
        if not select.select([self._socket], [], [], _WAIT_S)[0]:
            return None
        try:
            data, sender = self._socket.recvfrom(_DATAGRAM)
        except ConnectionRefusedError:  # of an earlier datagram: nobody listens yet
            return None
        if not data and self._streams:
            raise EOFError
        return data, sender if self._listens else self.fixed

    def send(self, data: bytes, receiver: Any) -> None:
        """Send bytes; a datagram that nobody takes is lost."""
        if self._listens:
            self._socket.sendto(data, receiver)
            return
        try:
            self._socket.sendall(data)
        except ConnectionRefusedError:
            return

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class MavlinkLink:
    """One port, shared by all devices with its address: dispatches what arrives, and sends
    heartbeats.
    """

    def __init__(self, address: str, now_ns: Callable[[], int]) -> None:
        self._dialect = _dialect()
        self._address, self._now_ns = address, now_ns
        self._port = _open_port(address)
        self._opened_ns = now_ns()
        self._mav = self._dialect.MAVLink(self, *SOURCE)
        self._mav.robust_parsing = True
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._receiver: Any = None
        self._addresses: dict[int, Any] = {}
        self._heard_ns: dict[int, int] = {}
        self._ended = False
        self._listeners: list[Callable[[Any, int], None]] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def listen(self, names: tuple[str, ...], arrived: Callable[[Any, int], None]) -> Undo:
        """Call ``arrived(message, arrived_ns)`` on the link's thread for messages of these names;
        return what ends it.
        """

        def take(message: Any, arrived_ns: int) -> None:
            if message.get_type() in names:
                arrived(message, arrived_ns)

        self._listeners.append(take)
        return lambda: self._listeners.remove(take)

    def write(self, data: bytes) -> None:
        """Send bytes of pymavlink to the receiver at hand."""
        self._port.send(bytes(data), self._receiver)

    def send(self, system: int, message: Any) -> None:
        """Send a message to a system. Raises DeviceError if it was not heard."""
        address = self._addresses.get(system, self._port.fixed)
        if address is None:
            raise DeviceError(f"system {system} was not heard on {self._address}")
        try:
            with self._lock:
                self._receiver = address
                self._mav.send(message)
        except OSError as error:
            raise DeviceError(f"{self._address}: {error}") from None

    def command(
        self, system: int, command: int, attempt: int, param1: float, param2: float
    ) -> None:
        """Send ``COMMAND_LONG`` to the autopilot (component 1) of a system. Raises DeviceError if
        it was not heard.
        """
        parameters = (param1, param2, *(0.0,) * 5)
        message = self._dialect.MAVLink_command_long_message(
            system, 1, command, attempt, *parameters
        )
        self.send(system, message)

    def check(self, system: int) -> None:
        """Raise DeviceError if a system (0: all that were heard) has become silent."""
        if self._ended:
            raise DeviceError(f"{self._address} is {self._port.ended}")
        silent_s = (self._now_ns() - self._opened_ns) / 1e9
        if self._port.must_speak and not self._heard_ns and silent_s > _GONE_S:
            raise DeviceError(
                f"{self._address}: no MAVLink within {_GONE_S:g} s: is the vehicle on, and set to "
                "this baud rate?"
            )
        heard = [t for s, t in self._heard_ns.items() if system in (0, s)]
        if heard and self._now_ns() - max(heard) > _GONE_S * 1e9:
            who = f"system {system}" if system else "everybody"
            raise DeviceError(f"{who} on {self._address} is silent for over {_GONE_S:g} s")

    def close(self) -> None:
        """Close the port."""
        self._closed.set()
        self._thread.join()
        self._port.close()

    def _run(self) -> None:
        due_ns = self._now_ns()
        while not self._closed.is_set():
            try:
                received = self._port.receive()
            except (EOFError, OSError):
                self._ended = True
                return
            if received is not None:
                self._dispatch(*received)
            if self._now_ns() >= due_ns:
                due_ns = self._now_ns() + round(_HEARTBEAT_S * 1e9)
                self._beat()

    def _dispatch(self, data: bytes, sender: Any) -> None:
        arrived_ns = self._now_ns()
        for message in self._mav.parse_buffer(data) or ():
            if message.get_type() == "BAD_DATA":
                continue
            system = message.get_srcSystem()
            self._addresses[system], self._heard_ns[system] = sender, arrived_ns
            for take in tuple(self._listeners):
                take(message, arrived_ns)

    def _beat(self) -> None:
        beat = self._dialect.MAVLink_heartbeat_message(
            _GROUND_STATION, _NO_AUTOPILOT, 0, 0, self._dialect.MAV_STATE_ACTIVE, 3
        )
        for address in set(self._addresses.values()) or {self._port.fixed}:
            if address is not None:
                with self._lock:
                    self._receiver = address
                    try:
                        self._mav.send(beat)
                    except OSError:  # the next `send`, or the end of the stream, tells
                        return


_LINKS: Shared[MavlinkLink] = Shared()


# -- poses -----------------------------------------------------------------------------------------


class MavlinkPoseOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a source of poses on MAVLink. ``system``: number of the sender (0: any; its number
    is the body's name then). ``axes``: world axes that ``ODOMETRY`` states.
    """

    message: Literal["ODOMETRY", "ATT_POS_MOCAP"] = "ODOMETRY"
    system: Annotated[int, msgspec.Meta(ge=0, le=255)] = 0
    axes: Literal["ned", "enu"] = "ned"


def full_covariance(triangle: Sequence[float]) -> Array | None:
    """Return the covariance (6, 6) of the upper triangle (21,) by rows; None if it is unknown."""
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = triangle
    whole = upper + upper.T - np.diag(upper.diagonal())
    return whole if stated(whole) else None


def _vector(*components: float) -> Array:
    return np.array(components, dtype=float)


def of_odometry(message: Any, arrived_ns: int, body: str, axes: str) -> PoseSample:
    """Read ``ODOMETRY``: pose in the world, twist in its child frame. Raises DeviceError for frames
    of other axes.
    """
    child = message.child_frame_id
    if message.frame_id not in _WORLD_FRAMES[axes]:
        raise DeviceError(
            f"ODOMETRY states MAV_FRAME {message.frame_id}; axes {axes!r} are "
            f"{' and '.join(map(str, _WORLD_FRAMES[axes]))}: set option axes"
        )
    q, velocity = _vector(*message.q), _vector(message.vx, message.vy, message.vz)
    in_world = None
    if child == message.frame_id:
        in_world = velocity if is_finite(velocity) else None
    elif child in _BODY_FRAMES[axes] and is_finite(q) and np.any(q):
        in_world = turned(q, velocity)
    omega = _vector(message.rollspeed, message.pitchspeed, message.yawspeed)
    return PoseSample(
        body,
        1000 * message.time_usec or None,
        arrived_ns,
        _vector(message.x, message.y, message.z),
        q,
        in_world,
        omega if is_finite(omega) else None,
        full_covariance(message.pose_covariance),
    )


def of_mocap(message: Any, arrived_ns: int, body: str, axes: str) -> PoseSample:
    """Read ``ATT_POS_MOCAP``: NED and FRD, no velocity."""
    return PoseSample(
        body,
        1000 * message.time_usec or None,
        arrived_ns,
        _vector(message.x, message.y, message.z),
        _vector(*message.q),
        covariance=full_covariance(message.covariance),
    )


class MavlinkPoses:
    """Poses that one message states."""

    def __init__(self, address: str, options: MavlinkPoseOptions, host: DeviceHost) -> None:
        ned = options.message == "ATT_POS_MOCAP" or options.axes == "ned"
        self.world_axes, self.body_axes = ("ned", "frd") if ned else ("enu", "flu")
        self._options, self._address = options, address
        self._read = of_mocap if options.message == "ATT_POS_MOCAP" else of_odometry
        self._arrived: deque[tuple[Any, int]] = deque(maxlen=KEPT)
        self._link = _LINKS.acquire(address, lambda: MavlinkLink(address, host.now_ns))
        self._end = self._link.listen((options.message,), self._take)

    def _take(self, message: Any, arrived_ns: int) -> None:
        if self._options.system in (0, message.get_srcSystem()):
            self._arrived.append((message, arrived_ns))

    def poll(self) -> Sequence[PoseSample]:
        """See `PoseSource`."""
        samples: list[PoseSample] = []
        while self._arrived:
            message, arrived_ns = self._arrived.popleft()
            body = "" if self._options.system else str(message.get_srcSystem())
            samples.append(self._read(message, arrived_ns, body, self._options.axes))
        if not samples:
            self._link.check(self._options.system)
        return samples

    def close(self) -> None:
        """See `PoseSource`."""
        self._end()
        _LINKS.release(self._address)


def open_poses(address: str, options: Mapping[str, Any], host: DeviceHost) -> MavlinkPoses:
    """Open poses: ``mavlink:udp://0.0.0.0:14550`` or ``mavlink:serial:///dev/ttyUSB0:57600``."""
    return MavlinkPoses(address, read_options(MavlinkPoseOptions, options), host)


# -- robot -----------------------------------------------------------------------------------------


class MavlinkRobotOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a robot on MAVLink: its system, and force and torque (FRD) at full deflection; 0
    where it has no actuator.
    """

    force_max_N: Maxima
    torque_max_N_m: Maxima
    system: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1


def deflections(force: Array, torque: Array) -> dict[str, int]:
    """Return the fields of ``MANUAL_CONTROL`` of force and torque (3,) as shares, FRD.

    x, y: forward and right. z: up, from 0 to 1000, 500 for none, as both autopilots read it. r, s,
    t: yaw, pitch and roll, positive about the axes of FRD in both, unlike MAVLink's text on r.
    """
    x, y, z = force
    roll, pitch, yaw = torque
    full = {"x": x, "y": y, "z": 0.5 - 0.5 * z, "r": yaw, "s": pitch, "t": roll}
    return {name: round(_FULL * float(share)) for name, share in full.items()}


class MavlinkRobot(AutopilotRobot):
    """A robot under PX4 (its spacecraft: force x and y, torque z) or ArduSub (all six)."""

    body_axes, thrusters = "frd", 0

    def __init__(self, address: str, options: MavlinkRobotOptions, host: DeviceHost) -> None:
        self._address, self._options = address, options
        self._link = _LINKS.acquire(address, lambda: MavlinkLink(address, host.now_ns))
        self._dialect = _dialect()
        super().__init__(host.now_ns)
        self._beaten = threading.Event()
        self._kind = (-1, -1)
        self._end = self._link.listen(("HEARTBEAT", "COMMAND_ACK"), self._take)

    def _take(self, message: Any, arrived_ns: int) -> None:
        if message.get_srcSystem() != self._options.system:
            return
        if message.get_type() == "COMMAND_ACK":
            self._acknowledgements.take(message.command, message.result)
        elif message.autopilot != _NO_AUTOPILOT:  # of a camera or a companion beside it
            self._kind = message.autopilot, message.type
            self._beaten.set()

    def _publish(self, command: RobotCommand | None) -> None:
        options = self._options
        shares = wrench_shares(command, options.force_max_N, options.torque_max_N_m)
        fields = deflections(*shares)
        message = self._dialect.MAVLink_manual_control_message(
            options.system, buttons=0, enabled_extensions=_PITCH_AND_ROLL, **fields
        )
        self._link.send(options.system, message)

    def send(self, command: RobotCommand) -> None:
        """See `Robot`. Sends nothing before `arm`, and zero after `stop`."""
        self._stream.put(command)
        self._link.check(self._options.system)

    def arm(self) -> None:
        """Switch the autopilot to its manual mode, and arm it. Raises DeviceError if it refuses, is
        silent, is another, or cannot do what the maxima state.
        """
        self._stopped.clear()
        if not self._beaten.wait(_GONE_S):
            raise DeviceError(
                f"no heartbeat of an autopilot with system {self._options.system} within "
                f"{_GONE_S:g} s"
            )
        mode = manual_mode(*self._kind, self._options)
        self._start_stream(_LEAD_S)
        self._arm_in(mode, "manual mode", "arming")

    def _release(self) -> None:
        self._end()
        _LINKS.release(self._address)

    def _command(self, command: int, attempt: int, param1: float, param2: float) -> None:
        self._link.command(self._options.system, command, attempt, param1, param2)


def manual_mode(autopilot: int, kind: int, options: MavlinkRobotOptions) -> float:
    """Return the number of an autopilot's manual mode, from its heartbeat. Raises DeviceError for
    another autopilot, and for actuation that PX4's spacecraft does not take from sticks.
    """
    force, torque = options.force_max_N, options.torque_max_N_m
    if autopilot == _PX4:
        if force[2] or torque[0] or torque[1]:
            raise DeviceError(
                "PX4 takes force x, y and torque z only from MANUAL_CONTROL: set the other maxima "
                "to 0, or use px4: over ROS 2"
            )
        return _PX4_MANUAL
    if autopilot == _ARDUPILOT and kind == _SUBMARINE:
        return _ARDUSUB_MANUAL
    raise DeviceError(
        f"autopilot {autopilot} of vehicle type {kind} is neither PX4 nor ArduSub: none of its "
        "modes takes forces and torques from MANUAL_CONTROL"
    )


def open_robot(address: str, options: Mapping[str, Any], host: DeviceHost) -> MavlinkRobot:
    """Open a robot: ``mavlink:udp://0.0.0.0:14550``."""
    return MavlinkRobot(address, read_options(MavlinkRobotOptions, options), host)


# -- latch -----------------------------------------------------------------------------------------

_Button = Annotated[int, msgspec.Meta(ge=1, le=8)]


class MavlinkLatchOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a gripper on MAVLink: number of the gripper; numbers of the switches in
    ``BUTTON_CHANGE`` that tell that the probe touches (``contact``) and that the gripper holds the
    port (``latched``; None: it does once a grab is acknowledged); level of a switch that is
    pressed, which for a switch to ground at ArduPilot is ``low``.
    """

    contact: _Button
    latched: _Button | None = None
    pressed: Literal["low", "high"] = "low"
    gripper: Annotated[int, msgspec.Meta(ge=1, le=6)] = 1
    system: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1


class MavlinkLatch:
    """A gripper under PX4 or ArduPilot, with a switch at the probe."""

    def __init__(self, address: str, options: MavlinkLatchOptions, host: DeviceHost) -> None:
        self._address, self._options = address, options
        self._link = _LINKS.acquire(address, lambda: MavlinkLink(address, host.now_ns))
        name, has_switch = f"gripper {options.gripper}", options.latched is not None
        self._gripper = Gripper(name, self._ask, host.now_ns, has_switch)
        self._end = self._link.listen(("BUTTON_CHANGE", "COMMAND_ACK"), self._take)

    def _ask(self, action: float, attempt: int) -> None:
        options = self._options
        self._link.command(options.system, DO_GRIPPER, attempt, options.gripper, action)

    def _take(self, message: Any, arrived_ns: int) -> None:
        options = self._options
        if message.get_srcSystem() != options.system:
            return
        if message.get_type() == "COMMAND_ACK":
            if message.command == DO_GRIPPER:
                self._gripper.acknowledge(message.result)
            return
        pressed = message.state if options.pressed == "high" else ~message.state
        self._gripper.touch(bool(pressed >> options.contact - 1 & 1))
        if options.latched is not None:
            self._gripper.grip(bool(pressed >> options.latched - 1 & 1))

    def poll(self) -> LatchReading | None:
        """See `DockingLatch`."""
        self._link.check(self._options.system)
        return self._gripper.poll()

    def command(self, latch: Latch) -> None:
        """See `DockingLatch`."""
        self._gripper.command(latch)

    def close(self) -> None:
        """See `DockingLatch`."""
        self._end()
        _LINKS.release(self._address)


def open_latch(address: str, options: Mapping[str, Any], host: DeviceHost) -> MavlinkLatch:
    """Open a gripper: ``mavlink:udp://0.0.0.0:14550``."""
    return MavlinkLatch(address, read_options(MavlinkLatchOptions, options), host)
