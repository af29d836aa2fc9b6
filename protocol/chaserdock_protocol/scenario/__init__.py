# SPDX-License-Identifier: Apache-2.0
"""The scenario file: schema, loading, variants and overrides."""

from .errors import ScenarioError
from .loading import load_scenario, parse_scenario, scenario_from_json
from .schema import ESTIMATORS, PERCEPTIONS, SOLVERS, Scenario

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
