# SPDX-License-Identifier: Apache-2.0
"""Interfaces between the gateway and the devices of a laboratory: one per kind of device.

A driver is a function that opens a device: ``open_…(address, options, host) -> device``. It is
found by an entry point in the group of its kind, under the scheme of the address: ``ros2`` opens
``ros2:/robot0/odom``. A driver passes on what the device says, in the device's own axes, units and
clock, and changes nothing; the gateway converts (``axes``, ``clock``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Literal, Protocol

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.failure_watch import text_of
from chaserdock_protocol.messages import Latch
from numpy.typing import NDArray

ImageArray = NDArray[np.uint8]

DeviceKind = Literal["camera", "pose", "robot", "latch"]

GROUPS: dict[DeviceKind, str] = {
    "camera": "chaserdock.cameras",
    "pose": "chaserdock.poses",
    "robot": "chaserdock.robots",
    "latch": "chaserdock.latches",
}
"""Groups of entry points, by kind of device. ``pose``: odometry and motion capture."""


class DeviceError(ChaserdockError):
    """A device is absent, busy, mute or of another type. The text names its address, and says what
    would be right.
    """


@dataclass(frozen=True)
class DeviceHost:
    """What a driver may use of its process. ``now_ns``: monotonic clock of all arrival times.
    ``camera``: the scenario's calibration, for a camera that states one to compare.
    """

    now_ns: Callable[[], int]
    camera: Camera | None = None


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """An image as a camera gave it.

    image (h, w) or (h, w, 3) in OpenCV's order, uint8. ``stamp_ns``: middle of the exposure by the
    device's clock, None without one. ``arrived_ns``: by the host's clock.
    """

    image: ImageArray
    stamp_ns: int | None
    arrived_ns: int


class CameraSource(Protocol):
    """A camera."""

    def poll(self) -> Sequence[CameraFrame]:
        """Return what has arrived since the last call, oldest first, without waiting. Raises
        DeviceError if the device is gone.
        """
        ...

    def close(self) -> None:
        """Release the device."""
        ...


@dataclass(frozen=True, eq=False)
class PoseSample:
    """Pose of one body as a device states it.

    ``body``: the device's name of the body, empty if it knows one only. ``stamp_ns``: time of the
    measurement by the device's clock, None without one. ``arrived_ns``: by the host's clock.
    position_m (3,) and q_wxyz (4,), body to world: in the device's axes. velocity_m_s (3,), in the
    device's world axes, and omega_rad_s (3,), in its body axes: None where it states none.
    covariance (6, 6) of position (world) and rotation (body): None where it states none.
    """

    body: str
    stamp_ns: int | None
    arrived_ns: int
    position_m: Array
    q_wxyz: Array
    velocity_m_s: Array | None = None
    omega_rad_s: Array | None = None
    covariance: Array | None = None


class PoseSource(Protocol):
    """Odometry of a robot, or a motion capture system."""

    def poll(self) -> Sequence[PoseSample]:
        """Return what has arrived since the last call, oldest first, without waiting. Raises
        DeviceError if the device is gone.
        """
        ...

    def close(self) -> None:
        """Release the device."""
        ...


@dataclass(frozen=True, eq=False)
class RobotCommand:
    """What the actuators of one robot are to do until the next command.

    ``time_ns``: by the host's clock, when it takes effect. force_N (3,) and torque_N_m (3,): in the
    robot's body axes. duty (n,): share of the time, from 0 to 1, that each thruster is to be open;
    empty for a robot that takes wrenches.
    """

    time_ns: int
    force_N: Array
    torque_N_m: Array
    duty: Array


class Robot(Protocol):
    """Actuators of one chaser. It must stop by itself when commands cease."""

    def send(self, command: RobotCommand) -> None:
        """Command the actuators. Raises DeviceError if the device is gone."""
        ...

    def stop(self) -> None:
        """Command zero, and disarm where the robot can be disarmed. Never raises. May come from
        another thread while ``arm`` waits.
        """
        ...

    def arm(self) -> None:
        """Let the robot obey, where it needs to be told. Raises DeviceError if it refuses."""
        ...

    def close(self) -> None:
        """Stop, and release the device."""
        ...


@dataclass(frozen=True)
class LatchReading:
    """What a docking sensor and its latch state; fields as in ``DockingStatus``."""

    contact: bool
    armed: bool
    latched: bool


class DockingLatch(Protocol):
    """Docking sensor and latch of one chaser."""

    def poll(self) -> LatchReading | None:
        """Return the newest reading, with any contact since the last call; None before the first
        one. Raises DeviceError if the device is gone.
        """
        ...

    def command(self, latch: Latch) -> None:
        """Command the latch. Raises DeviceError if the device is gone."""
        ...

    def close(self) -> None:
        """Release the device."""
        ...


def open_device(
    kind: DeviceKind, address: str, options: Mapping[str, Any], host: DeviceHost
) -> Any:
    """Open the device at ``SCHEME:REST``: a CameraSource, PoseSource, Robot or DockingLatch.

    Raises DeviceError for a scheme without a driver, an option that the driver does not know, and
    what the driver raises.
    """
    scheme, colon, rest = address.partition(":")
    known = {e.name: e for e in entry_points(group=GROUPS[kind])}
    if not colon or scheme not in known:
        raise DeviceError(
            f"{kind} {address!r}: must be SCHEME:ADDRESS with one of the installed drivers: "
            f"{', '.join(sorted(known))} (entry points of {GROUPS[kind]!r})"
        )
    try:
        driver = known[scheme].load()
    except Exception as error:  # a driver's import may raise anything
        raise DeviceError(
            f"{kind} {address!r}: its driver cannot be loaded: {text_of(error)}"
        ) from error
    try:
        return driver(rest, options, host)
    except ChaserdockError as error:
        raise DeviceError(f"{kind} {address!r}: {error}") from error
    except Exception as error:  # a driver may raise anything
        raise DeviceError(f"{kind} {address!r}: {text_of(error)}") from error
