# SPDX-License-Identifier: Apache-2.0
"""Command a gripper with PX4 over ``rmw_zenoh``, by ``VehicleCommand`` and its acknowledgement.

The switches that tell of touch and grip are ``std_msgs/msg/Bool`` of another node: PX4 has no
message for them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from chaserdock_protocol.messages import Latch

from ..devices import DeviceError, DeviceHost, LatchReading
from ..options import read_options
from .gripper import DO_GRIPPER, Gripper
from .px4_robot import px4_namespace, vehicle_command
from .ros2_latch import BOOL
from .ros2_network import RosEndpoints, RosOptions, absolute_name

_COMMAND, _ACK = "px4_msgs/msg/VehicleCommand", "px4_msgs/msg/VehicleCommandAck"


class Px4LatchOptions(RosOptions, frozen=True, kw_only=True):
    """Options of a gripper with PX4: number of the gripper; MAV_SYS_ID; and topics below the
    namespace: ``contact``, of the switch at the probe, and ``latched``, of one that tells that the
    gripper holds the port (``""``: it does once a grab is acknowledged).
    """

    contact: str
    latched: str = ""
    gripper: Annotated[int, msgspec.Meta(ge=1, le=6)] = 1
    system: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1


class Px4Latch:
    """A gripper with PX4, with a switch at the probe."""

    def __init__(self, namespace: str, options: Px4LatchOptions, host: DeviceHost) -> None:
        if not options.contact:
            raise DeviceError("option contact must name a topic")
        self._options = options
        name = f"PX4, gripper {options.gripper}"
        self._gripper = Gripper(name, self._ask, host.now_ns, bool(options.latched))
        contact, latched = (f"{namespace}/{part}" for part in (options.contact, options.latched))
        self._endpoints = RosEndpoints(options)
        try:
            self._endpoints.subscribe(
                absolute_name(contact), BOOL, lambda m: self._gripper.touch(bool(m.data))
            )
            if options.latched:
                self._endpoints.subscribe(
                    absolute_name(latched), BOOL, lambda m: self._gripper.grip(bool(m.data))
                )
            where = f"{namespace}/fmu"
            self._endpoints.subscribe(f"{where}/out/vehicle_command_ack", _ACK, self._take)
            self._publisher = self._endpoints.publisher(f"{where}/in/vehicle_command", _COMMAND)
        except BaseException:
            self._endpoints.close()
            raise

    def _take(self, acknowledgement: Any) -> None:
        if acknowledgement.command == DO_GRIPPER:
            self._gripper.acknowledge(int(acknowledgement.result))

    def _ask(self, action: float, attempt: int) -> None:
        options = self._options
        gripper = float(options.gripper)
        message = vehicle_command(options.system, DO_GRIPPER, attempt, gripper, action)
        try:
            self._publisher.publish(message)
        except Exception as error:  # of a session that is closed
            raise DeviceError(f"cannot send: {error}") from error

    def poll(self) -> LatchReading | None:
        """See `DockingLatch`."""
        self._endpoints.check()
        return self._gripper.poll()

    def command(self, latch: Latch) -> None:
        """See `DockingLatch`."""
        self._gripper.command(latch)

    def close(self) -> None:
        """See `DockingLatch`."""
        self._endpoints.close()


def open_latch(address: str, options: Mapping[str, Any], host: DeviceHost) -> Px4Latch:
    """Open a gripper with PX4: ``px4:/px4_1``, the namespace before ``/fmu``; ``px4:/`` without
    one.
    """
    return Px4Latch(px4_namespace(address), read_options(Px4LatchOptions, options), host)
