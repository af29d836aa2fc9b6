# SPDX-License-Identifier: Apache-2.0
"""The scenario file: schema, loading, variants and overrides. Flight software receives a
``FlightScenario``.
"""

from .errors import ScenarioError
from .flight import FlightScenario, flight_scenario, flight_scenario_from_json, flight_scenario_json
from .loading import load_scenario, parse_scenario, scenario_from_json
from .mapping import PortChoice
from .mission import Scenario
from .schema import ESTIMATORS, PERCEPTIONS, SOLVERS

__all__ = [
    "ESTIMATORS",
    "PERCEPTIONS",
    "SOLVERS",
    "FlightScenario",
    "PortChoice",
    "Scenario",
    "ScenarioError",
    "flight_scenario",
    "flight_scenario_from_json",
    "flight_scenario_json",
    "load_scenario",
    "parse_scenario",
    "scenario_from_json",
]
