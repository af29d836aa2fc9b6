# SPDX-License-Identifier: Apache-2.0
"""Choose how a chaser's images are looked at."""

from __future__ import annotations

from chaserdock_protocol.scenario import FlightScenario

from .feature_vision import FeatureVision
from .perception import make_perception
from .vision import Vision


def make_vision(scenario: FlightScenario, chaser: int) -> Vision:
    """Return the vision of a chaser that the scenario asks for."""
    if scenario.maps_target:
        return FeatureVision(scenario, chaser)
    return Vision(make_perception(scenario))
