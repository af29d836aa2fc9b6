"""The scenario file: schema, overrides, and loading."""

from .overrides import ScenarioError
from .schema import (
    ESTIMATORS,
    PERCEPTIONS,
    SOLVERS,
    Scenario,
    load_scenario,
    parse_scenario,
    scenario_from_json,
)

__all__ = [
    "ESTIMATORS",
    "PERCEPTIONS",
    "SOLVERS",
    "Scenario",
    "ScenarioError",
    "load_scenario",
    "parse_scenario",
    "scenario_from_json",
]
