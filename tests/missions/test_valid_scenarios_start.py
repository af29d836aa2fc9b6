# SPDX-License-Identifier: Apache-2.0
"""A scenario that is valid starts: no process of its mission ends with a traceback."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import pytest
from chaserdock_protocol.scenario import ScenarioError, load_scenario, parse_scenario
from chaserdock_protocol.shipped_scenarios import shipped_names, shipped_scenario
from hypothesis import HealthCheck, assume, given, settings
from scenario_draws import changed_scenarios, with_changes

from chaserdock.simulation.flight import memory_folder
from chaserdock.simulation.mission import simulate
from chaserdock.toml_text import toml_document


def starts(values: dict[str, Any]) -> None:
    """Fly a mission of some ticks; every process ends by itself, with status 0."""
    with tempfile.TemporaryDirectory(dir=memory_folder()) as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(toml_document(values), encoding="utf-8")
        flight = simulate(path, Path(folder) / "run")
    assert flight.crashes == {}, "\n".join(flight.crashes.values())
    assert flight.stalled == ()
    assert set(flight.statuses.values()) <= {0, None}, flight.output


@pytest.mark.slow(10)
@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)
@given(changed_scenarios())
def test_a_valid_scenario_starts(drawn: tuple[str, dict[Any, Any]]) -> None:
    """Keys of shipped scenarios have other values: in general position, and at their bounds."""
    values = with_changes(*drawn)
    try:
        parse_scenario(values, "drawn")
    except ScenarioError:
        assume(False)
    starts(values)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({("chaser", "size_m"): [0.8, 0.4, 0.4]}, "chaser: probe_reach_m: the probe's tip, 0.35 m"),
        ({("chaser", "mass_kg"): 1e-12}, "chaser: mass_kg: must be at least 0.001"),
        ({("chaser", "torque_max_N_m"): 1e-300}, "chaser.torque_max_N_m: must be at least 1e-12"),
        ({("camera", "sun_direction"): [1e-300, 0.0, 0.0]}, "sun_direction must not be zero"),
        (
            {("camera", "effects", "point_spread_px"): 1e12},
            "camera.effects.point_spread_px: must be a number from 0 to 20",
        ),
    ],
)
def test_what_would_end_a_process_is_refused(changes: dict[Any, Any], line: str) -> None:
    """These ended world or controller with a traceback after the scenario had been called valid."""
    with pytest.raises(ScenarioError) as refused:
        parse_scenario(with_changes("single", changes), "test")
    assert line in str(refused.value)


@pytest.mark.parametrize("name", shipped_names())
def test_draws_begin_with_valid_scenarios(name: str) -> None:
    drawn = parse_scenario(with_changes(name, {}), name)
    assert drawn.chasers == load_scenario(shipped_scenario(name)).chasers
