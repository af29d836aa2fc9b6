# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[navigation]``: grades, explicit figures and their bounds."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import pytest
from chaserdock_protocol.scenario import (
    ScenarioError,
    load_scenario,
    parse_scenario,
    scenario_from_json,
)
from chaserdock_protocol.scenario.navigation import GRADES, NavigationErrors, NavigationSection
from harness import ROOT
from scenario_samples import good


def errors_of(**figures: Any) -> NavigationErrors:
    return parse_scenario(good() | {"navigation": figures}, "x").navigation.errors()


def test_grades_are_resolved_in_si_units_and_radians() -> None:
    orbit = errors_of(grade="orbit")
    assert (orbit.position_noise_m, orbit.position_drift_m, orbit.position_drift_time_s) == (
        0.003,
        0.02,
        100.0,
    )
    assert orbit.attitude_roll_noise_rad == math.radians(0.05)
    assert orbit.gyro_bias_rad_s == math.radians(0.001)
    assert orbit.camera_turn_rad == math.radians(0.1)
    assert not orbit.exact_odometry
    assert orbit.uncertain_mounting


def test_exact_has_no_errors_and_lab_is_the_default() -> None:
    exact = errors_of(grade="exact")
    assert exact.exact_odometry
    assert not any(value for name, value in asdict(exact).items() if name.startswith("camera_"))
    assert not exact.uncertain_mounting
    assert NavigationSection().errors() == errors_of(grade="lab")


def test_poor_is_three_times_orbit() -> None:
    assert GRADES["poor"] == pytest.approx(
        {key: 3.0 * value for key, value in GRADES["orbit"].items()}
    )


def test_a_given_figure_replaces_the_grades_and_survives_json() -> None:
    scenario = parse_scenario(
        good()
        | {"navigation": {"grade": "orbit", "position_noise_m": 0, "attitude_drift_deg": 1.0}},
        "x",
    )
    errors = scenario_from_json(scenario.model_dump_json(), "x").navigation.errors()
    assert (errors.position_noise_m, errors.attitude_drift_rad) == (0.0, math.radians(1.0))
    assert errors.position_drift_m == 0.02


def test_a_principal_point_alone_does_not_make_the_mounting_uncertain() -> None:
    errors = errors_of(grade="exact", camera_centre_px=1.0)
    assert errors.camera_centre_px == 1.0
    assert not errors.uncertain_mounting
    assert errors.exact_odometry


@pytest.mark.parametrize(
    ("figures", "line"),
    [
        (
            {"grade": "lap"},
            "navigation.grade: must be one of exact, lab, orbit, poor (got 'lap'); did you mean "
            "lab?",
        ),
        (
            {"position_noise_m": -1.0},
            "navigation.position_noise_m: must be a number from 0 to 10 (got -1.0)",
        ),
        (
            {"camera_turn_deg": 91.0},
            "navigation.camera_turn_deg: must be a number from 0 to 90 (got 91.0)",
        ),
        (
            {"position_drift_time_s": 0.0},
            "navigation.position_drift_time_s: must be a number from 0.1 to 1000000",
        ),
        (
            {"omega_noise_deg_s": float("nan")},
            "navigation.omega_noise_deg_s: must be a finite number",
        ),
    ],
)
def test_an_impossible_figure_is_one_line_with_path_and_bound(
    figures: dict[str, Any], line: str
) -> None:
    with pytest.raises(ScenarioError) as error:
        errors_of(**figures)
    assert str(error.value).startswith(f"x: {line}")
    assert "\n" not in str(error.value)


def test_shipped_scenarios_fly_on_lab_except_those_of_the_paper() -> None:
    for path in sorted((ROOT / "scenarios").glob("*.toml")):
        expected = "exact" if path.stem.startswith("paper-") else "lab"
        assert load_scenario(path).navigation.grade == expected, path.name
