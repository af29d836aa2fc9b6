# SPDX-License-Identifier: Apache-2.0
"""Name of a run's folder, which several processes must agree on."""

from __future__ import annotations

from .messages import JoinReply
from .scenario import flight_scenario_from_json


def run_name(mission: JoinReply) -> str:
    """Return scenario name and run id, such as ``four-chaser-docking-3f2a9c01d4e5``."""
    return f"{flight_scenario_from_json(mission.scenario_json, 'the world').name}-{mission.run_id}"
