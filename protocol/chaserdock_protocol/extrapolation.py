"""Where a body is that has not been heard of for a moment: it goes on as it moved last."""

from __future__ import annotations

import msgspec
import numpy as np
from chaserdock_models import rotations

from .codec import vector
from .messages import Odometry


def extrapolate(odometry: Odometry, tick: int, time_ns: int) -> Odometry:
    """A body's odometry at a later tick and time (ns), by constant velocity (WRF) and rate (CRF)."""
    after_s = (time_ns - odometry.sim_time_ns) / 1e9
    turn = rotations.exp(np.asarray(odometry.omega_rad_s) * after_s)
    return msgspec.structs.replace(
        odometry,
        tick=tick,
        sim_time_ns=time_ns,
        position_m=vector(np.asarray(odometry.position_m) + np.asarray(odometry.velocity_m_s) * after_s),
        q_wxyz=vector(rotations.normalize(rotations.multiply(odometry.q_wxyz, turn))),
    )
