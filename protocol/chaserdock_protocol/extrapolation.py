# SPDX-License-Identifier: Apache-2.0
"""Extrapolation of a body's last odometry."""

from __future__ import annotations

import msgspec
import numpy as np
from chaserdock_models import rotations

from .codec import vector
from .messages import Odometry


def extrapolate(odometry: Odometry, tick: int, time_ns: int) -> Odometry:
    """Extrapolate odometry to a later tick and time (ns) at constant velocity (WRF) and rate
    (CRF).
    """
    elapsed_s = (time_ns - odometry.sim_time_ns) / 1e9
    rotation = rotations.exp(np.asarray(odometry.omega_rad_s) * elapsed_s)
    return msgspec.structs.replace(
        odometry,
        tick=tick,
        sim_time_ns=time_ns,
        position_m=vector(
            np.asarray(odometry.position_m) + np.asarray(odometry.velocity_m_s) * elapsed_s
        ),
        q_wxyz=vector(rotations.normalize(rotations.multiply(odometry.q_wxyz, rotation))),
    )
