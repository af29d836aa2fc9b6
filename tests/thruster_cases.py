"""Builders shared by the tests of jets."""

from __future__ import annotations

from typing import Any

import numpy as np
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Scenario, parse_scenario


def mission(body: str = "tetra12", **changes: Any) -> Scenario:
    """One chaser with jets, a metre from the target."""
    chaser = {"body": body, "actuation": "thrusters", **changes.pop("chaser", {})}
    values: dict[str, Any] = {
        "name": "jets",
        "duration_s": 10.0,
        "chaser": chaser,
        "chasers": [{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return parse_scenario(values | changes, "test")


def box(s: Scenario) -> Array:
    """The greatest force and torque (6,) that the controller may ask for."""
    return np.array([s.chaser.force_max_N] * 3 + [s.chaser.torque_max_N_m] * 3)
