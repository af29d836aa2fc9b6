# SPDX-License-Identifier: Apache-2.0
"""Scale commands to what an autopilot takes: shares of declared maxima."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from chaserdock_models.arrays import Array

from ..devices import DeviceError, RobotCommand

_Maximum = Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
Maxima = tuple[_Maximum, _Maximum, _Maximum]


def shares(values: Array, maxima: Maxima) -> Array:
    """Return the components (3,) as shares of their maxima, from -1 to 1; 0 where the maximum is 0,
    which says that the robot has no actuator there.
    """
    limit = np.asarray(maxima, dtype=float)
    safe = np.where(limit > 0.0, limit, 1.0)
    return np.where(limit > 0.0, np.clip(np.asarray(values, float) / safe, -1.0, 1.0), 0.0)


def wrench_of(command: RobotCommand | None) -> tuple[Array, Array]:
    """Return force and torque (3,), zeros without a command. Raises DeviceError for values that are
    not finite.
    """
    if command is None:
        return np.zeros(3), np.zeros(3)
    force, torque = np.asarray(command.force_N, float), np.asarray(command.torque_N_m, float)
    if not (np.isfinite(force).all() and np.isfinite(torque).all()):
        raise DeviceError("force or torque is not finite")
    return force, torque


def wrench_shares(
    command: RobotCommand | None, force_max_N: Maxima, torque_max_N_m: Maxima
) -> tuple[Array, Array]:
    """Return force and torque (3,) as shares of their maxima. Raises DeviceError."""
    force, torque = wrench_of(command)
    return shares(force, force_max_N), shares(torque, torque_max_N_m)
