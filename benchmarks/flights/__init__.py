# SPDX-License-Identifier: Apache-2.0
"""Closed loops and drawn scenarios that benchmarks and tests share."""

from __future__ import annotations

from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.shipped_scenarios import shipped_scenario


def load_shipped(name: str, *overrides: str) -> Scenario:
    """Load a shipped scenario by name. Raises ScenarioNotFound or ScenarioError."""
    return load_scenario(shipped_scenario(name), overrides)
