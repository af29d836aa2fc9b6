# SPDX-License-Identifier: Apache-2.0
"""Command a robot with PX4 over ``rmw_zenoh``, in PX4's offboard mode.

Either ``VehicleThrustSetpoint`` and ``VehicleTorqueSetpoint``, which PX4 allocates to its
actuators, or ``ActuatorMotors``, one thruster each. PX4 obeys while ``OffboardControlMode`` arrives
at 2 Hz or more, and acts by COM_OBL_RC_ACT after COM_OF_LOSS_T without it (docs.px4.io, Offboard
Mode). Time stamps are 0: PX4's zenoh module and its DDS client replace them by its own time of
arrival, and a time of another clock may count as too old.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from numpy.typing import NDArray

from chaserdock_agents.ros2.types import TYPES

from ..devices import DeviceError, DeviceHost, RobotCommand
from ..options import read_options
from .autopilot import AutopilotRobot
from .ros2_network import RosEndpoints, RosOptions, absolute_name
from .shares import Maxima, wrench_shares

_MOTORS = 12
"""Length of ``ActuatorMotors.control``."""
_OFFBOARD = 6.0
"""PX4's number of its offboard mode (PX4_CUSTOM_MAIN_MODE_OFFBOARD)."""
_LEAD_S = 1.1
"""Time, s, for which the stream must have run before PX4 enters offboard mode: 1 s and a tenth."""


class Px4Options(RosOptions, frozen=True, kw_only=True):
    """Options of a robot with PX4: either the wrench at full thrust setpoints (``force_max_N``,
    ``torque_max_N_m``, FRD; 0: not actuated), or ``thrusters``, the number of PX4's motor, from 1,
    that each thruster is. ``system``: MAV_SYS_ID.
    """

    force_max_N: Maxima | None = None
    torque_max_N_m: Maxima | None = None
    thrusters: tuple[Annotated[int, msgspec.Meta(ge=1, le=_MOTORS)], ...] = ()
    system: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1


def motors(duty: Array, thrusters: tuple[int, ...]) -> NDArray[np.float32]:
    """Return ``ActuatorMotors.control`` (12,) of the duty (n,) of each thruster; NaN, which stops a
    motor, for motors that are no thruster. Raises DeviceError for another number of thrusters and
    a duty that is not from 0 to 1.
    """
    if len(duty) != len(thrusters):
        raise DeviceError(f"{len(duty)} duties for {len(thrusters)} thrusters (option thrusters)")
    if not all(0.0 <= d <= 1.0 for d in duty):  # nor NaN
        raise DeviceError(f"duty {list(map(float, duty))}: must be from 0 to 1")
    control = np.full(_MOTORS, np.nan, np.float32)
    control[[number - 1 for number in thrusters]] = duty
    return control


class Px4Robot(AutopilotRobot):
    """A robot with PX4."""

    body_axes = "frd"

    def __init__(self, namespace: str, options: Px4Options, host: DeviceHost) -> None:
        self.thrusters = len(options.thrusters)
        self._options = options
        self._endpoints = RosEndpoints(options)
        super().__init__(host.now_ns)
        try:
            where = f"{namespace}/fmu"
            self._endpoints.subscribe(
                f"{where}/out/vehicle_command_ack", "px4_msgs/msg/VehicleCommandAck", self._take
            )
            kinds = ["OffboardControlMode", "VehicleCommand"]
            if self.thrusters:
                kinds += ["ActuatorMotors"]
            else:
                kinds += ["VehicleThrustSetpoint", "VehicleTorqueSetpoint"]
            self._publishers = {
                kind: self._endpoints.publisher(
                    f"{where}/in/{_topic(kind)}", f"px4_msgs/msg/{kind}"
                )
                for kind in kinds
            }
        except BaseException:
            self._endpoints.close()
            raise

    def _put(self, kind: str, *fields: Any) -> None:
        self._publishers[kind].publish(TYPES.types[f"px4_msgs/msg/{kind}"](*fields))

    def _publish(self, command: RobotCommand | None) -> None:
        options, wrench = self._options, not self.thrusters
        no = (False,) * 5  # position, velocity, acceleration, attitude, body rate
        if wrench:
            assert options.force_max_N is not None
            assert options.torque_max_N_m is not None
            maxima = options.force_max_N, options.torque_max_N_m
            force, torque = wrench_shares(command, *maxima)
            setpoints = {"VehicleThrustSetpoint": force, "VehicleTorqueSetpoint": torque}
        else:
            duty = np.zeros(self.thrusters) if command is None else command.duty
            setpoints = {"ActuatorMotors": motors(duty, options.thrusters)}
        self._put("OffboardControlMode", 0, *no, wrench, not wrench)
        for kind, values in setpoints.items():
            reversible = () if wrench else (0,)
            self._put(kind, 0, 0, *reversible, np.asarray(values, np.float32))

    def send(self, command: RobotCommand) -> None:
        """See `Robot`. Sends nothing before `arm`, and zero after `stop`."""
        self._stream.put(command)
        self._endpoints.check()

    def arm(self) -> None:
        """Switch PX4 to offboard mode, and arm it. Raises DeviceError if it refuses, or does not
        answer.
        """
        self._stopped.clear()
        self._endpoints.check()
        self._start_stream(0.0 if self._was_armed else _LEAD_S)
        self._arm_in(_OFFBOARD, "PX4, offboard mode", "PX4, arming")

    def _release(self) -> None:
        self._endpoints.close()

    def _take(self, acknowledgement: Any) -> None:
        self._acknowledgements.take(int(acknowledgement.command), int(acknowledgement.result))

    def _command(self, command: int, attempt: int, param1: float, param2: float) -> None:
        system = self._options.system
        self._publishers["VehicleCommand"].publish(
            vehicle_command(system, command, attempt, param1, param2)
        )


def vehicle_command(system: int, command: int, attempt: int, param1: float, param2: float) -> Any:
    """Return a ``VehicleCommand`` to the autopilot of a system."""
    target, source = (system, 1), (255, 1)  # component 1: the autopilot
    fields = (0, param1, param2, *(0.0,) * 5, command, *target, *source, attempt, True)
    return TYPES.types["px4_msgs/msg/VehicleCommand"](*fields)


def px4_namespace(address: str) -> str:
    """Return the namespace before ``/fmu`` of an address; ``/`` is none. Raises DeviceError."""
    return absolute_name(address) if address != "/" else ""


def _topic(kind: str) -> str:
    """Return ``vehicle_thrust_setpoint`` for ``VehicleThrustSetpoint``."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in kind).lstrip("_")


def open_robot(address: str, options: Mapping[str, Any], host: DeviceHost) -> Px4Robot:
    """Open a robot with PX4: ``px4:/px4_1``, the namespace before ``/fmu``; ``px4:/`` without
    one.
    """
    read = read_options(Px4Options, options)
    wrench = read.force_max_N is not None and read.torque_max_N_m is not None
    if bool(read.thrusters) == wrench or (
        read.thrusters and (read.force_max_N or read.torque_max_N_m)
    ):
        raise DeviceError("needs either option thrusters, or both force_max_N and torque_max_N_m")
    if len(set(read.thrusters)) != len(read.thrusters):
        raise DeviceError(f"option thrusters names a motor twice: {list(read.thrusters)}")
    return Px4Robot(px4_namespace(address), read, host)
