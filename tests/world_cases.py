# SPDX-License-Identifier: Apache-2.0
"""Builders shared by the tests of the world: a small mission and its rates."""

from __future__ import annotations

from typing import Any

from chaserdock_protocol.scenario import Scenario, parse_scenario

HZ = 960
STEP_S = 1.0 / HZ


def scenario(**changes: Any) -> Scenario:
    """One chaser five metres from the target, unless stated otherwise."""
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 10.0,
        "navigation": {"grade": "exact"},
        "chasers": [{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return parse_scenario(values | changes, "test")
