# SPDX-License-Identifier: Apache-2.0
"""Scenario section [orbit]: values, and one clear line for what is no orbit."""

from __future__ import annotations

import math
from typing import Any

import pytest
from chaserdock_models.orbit import EARTH_RADIUS_M
from chaserdock_protocol.scenario import (
    ScenarioError,
    flight_scenario,
    flight_scenario_from_json,
    flight_scenario_json,
    parse_scenario,
)
from scenario_samples import good

STILL = {"velocity_m_s": [0.0, 0.0, 0.0]}


def in_orbit(orbit: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {**good(), "orbit": orbit, "target": STILL, **changes}


def test_altitude_gives_a_circular_orbit() -> None:
    section = parse_scenario(in_orbit({"altitude_m": 4e5}), "x").orbit
    assert section is not None
    assert section.elements.semi_major_axis_m == EARTH_RADIUS_M + 4e5
    assert section.elements.mean_motion_rad_s == pytest.approx(2 * math.pi / 5553.6, rel=1e-4)


def test_flight_software_knows_the_orbit() -> None:
    scenario = parse_scenario(in_orbit({"altitude_m": 4e5}), "x")
    flight = flight_scenario(scenario)
    assert flight.orbit == scenario.orbit
    assert flight_scenario_from_json(flight_scenario_json(flight), "x") == flight


def test_without_the_section_there_is_no_orbit() -> None:
    assert parse_scenario(good(), "x").orbit is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"orbit": {}}, "orbit: give either altitude_m or semi_major_axis_m"),
        (
            {"orbit": {"semi_major_axis_m": 6.3e6}},
            "orbit: the orbit lies inside the Earth: its perigee is 78.1 km below",
        ),
        (
            {"orbit": {"semi_major_axis_m": 7e6, "eccentricity": 0.1}},
            "orbit: the orbit lies inside the Earth: its perigee is 78.1 km below",
        ),
        ({"orbit": {"altitude_m": 5e4}}, "orbit: the perigee is at 50.0 km, inside the atmosphere"),
        ({"orbit": {"altitude_m": -5.0}}, "orbit.altitude_m: "),
        ({"orbit": {"altitude_m": 1e12}}, "semi-major axis is 1.00001e+09 km; at most 100000 km"),
        (
            {"orbit": {"altitude_m": 4e5, "eccentricity": 0.01}},
            "altitude_m: is of a circular orbit",
        ),
        (
            {"orbit": {"altitude_m": 4e5, "epoch": "2026-03-20T12:00:00"}},
            "epoch: needs a time zone",
        ),
        (
            {"orbit": {"altitude_m": 4e5, "epoch": "soon"}},
            "epoch: must be a moment such as 2026-03-20T12:00:00Z",
        ),
        (
            {"orbit": {"altitude_m": 4e5, "epoch": "1900-01-01T00:00:00Z"}},
            "epoch: must be in the years 1950 to 2050",
        ),
        (
            {"orbit": {"altitude_m": 4e5, "chaser_ballistic_coefficient_kg_m2": 50.0}},
            "give both or none",
        ),
        ({"target": {}}, "target.velocity_m_s: with [orbit], WRF is the target's Hill frame"),
        (
            {"target": {**STILL, "position_m": [1, 0, 0]}},
            "target.position_m: with [orbit], WRF is the target's",
        ),
        ({"camera": {"sun_direction": [1, 0, 0]}}, "camera.sun_direction: follows from [orbit]"),
    ],
)
def test_an_error_is_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(in_orbit({"altitude_m": 4e5}) | changes, "x")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
