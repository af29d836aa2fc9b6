"""How a run's folder is called when several processes have to find it."""

from __future__ import annotations

from .messages import JoinReply
from .scenario import scenario_from_json


def run_name(mission: JoinReply) -> str:
    """Scenario and run, such as ``four-chaser-docking-3f2a9c01d4e5``; the same for all who joined the run."""
    return f"{scenario_from_json(mission.scenario_json, 'the world').name}-{mission.run_id}"
