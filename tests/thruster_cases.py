# SPDX-License-Identifier: Apache-2.0
"""Builders shared by the tests of thrusters."""

from __future__ import annotations

from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry, WrenchCommand
from chaserdock_protocol.scenario import Scenario, parse_scenario
from flight_cases import odometry


def mission(body: str = "tetra12", **changes: Any) -> Scenario:
    """One chaser with thrusters, a metre from the target."""
    chaser = {"body": body, "actuation": "thrusters", **changes.pop("chaser", {})}
    values: dict[str, Any] = {
        "name": "thrusters",
        "duration_s": 10.0,
        "navigation": {"grade": "exact"},
        "chaser": chaser,
        "chasers": [{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return parse_scenario(values | changes, "test")


def box(s: Scenario) -> Array:
    """The greatest force and torque (6,) that the controller may ask for."""
    return np.array([s.chaser.force_max_N] * 3 + [s.chaser.torque_max_N_m] * 3)


def at_rest(s: Scenario, tick: int) -> Odometry:
    still: Any = (0.0, 0.0, 0.0)
    return odometry(
        tick=tick, time_ns=s.timing.tick_time_ns(tick), velocity_m_s=still, omega_rad_s=still
    )


def wrench(s: Scenario, tick: int, force_N: float = 0.0, **changes: Any) -> WrenchCommand:
    values: dict[str, Any] = {
        "tick": tick,
        "sim_time_ns": s.timing.tick_time_ns(tick),
        "chaser": 0,
        "effective_time_ns": s.timing.effective_ns(tick),
        "expires_ns": 10**12,
        "mode": "nmpc",
        "force_N": (force_N, 0.0, 0.0),
        "torque_N_m": (0.0, 0.0, 0.0),
    }
    return WrenchCommand(**(values | changes))
