# SPDX-License-Identifier: Apache-2.0
"""Estimators by name."""

from __future__ import annotations

from chaserdock_protocol import plugins
from chaserdock_protocol.scenario import ESTIMATORS, FlightScenario

from .guarded import GuardedEstimator
from .joint import JointEstimator, parameters_of
from .paper import PaperEstimator
from .types import Estimator


def make_estimator(name: str, scenario: FlightScenario) -> Estimator:
    """Create the estimator ``name`` for a scenario: a built-in one, or an installed
    ``chaserdock.estimators`` entry point, which is called with the scenario and guarded.

    Raises PluginError if there is none of that name.
    """
    if name == "joint":
        return JointEstimator(parameters_of(scenario), len(scenario.chasers))
    if name == "paper":
        return PaperEstimator(scenario.camera_model())
    installed = plugins.make("estimator", name, ESTIMATORS, scenario)
    return GuardedEstimator(name, installed, len(scenario.chasers))
