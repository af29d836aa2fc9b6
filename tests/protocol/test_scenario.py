# SPDX-License-Identifier: Apache-2.0
"""The scenario schema: shipped scenarios are valid, and every error is one line with its path."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.targets import target_model
from chaserdock_protocol.scenario import (
    ScenarioError,
    flight_scenario,
    load_scenario,
    parse_scenario,
    scenario_from_json,
)
from chaserdock_protocol.scenario.bodies import cuboid_inertia
from chaserdock_protocol.scenario.fields import unit
from chaserdock_protocol.shipped_scenarios import SHIPPED, find_scenario
from hypothesis import given, settings
from hypothesis import strategies as st
from scenario_samples import good

FOLDER = Path(__file__).resolve().parents[2] / "scenarios"
FILES = sorted(FOLDER.glob("*.toml"))


def changed(path: str, value: Any) -> dict[str, Any]:
    """Return the sample scenario with the value at a dotted path set, or removed for None."""
    values = good()
    place: Any = values
    *way, last = [int(k) if k.isdigit() else k for k in path.split(".")]
    for key in way:
        place = place.setdefault(key, {}) if isinstance(place, dict) else place[key]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return values


def errors_of(values: dict[str, Any]) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(values, "x.toml")
    return str(caught.value).splitlines()


# -- what is shipped -------------------------------------------------------------------------------


def test_scenarios_of_the_documentation_are_shipped() -> None:
    assert {"single", "two-chaser-tracking", "four-chaser-docking"} <= {f.stem for f in FILES}
    assert FOLDER in SHIPPED


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_shipped_scenarios_load(path: Path) -> None:
    scenario = load_scenario(path)
    assert scenario.name == path.stem
    assert find_scenario(path.stem) == path
    assert scenario.ticks == round(scenario.duration_s * scenario.time.rate_hz)
    assert (
        scenario.settling_s
        < (scenario.steady_until_s or scenario.duration_s)
        <= scenario.duration_s
    )
    assert all(entry.at_s < scenario.duration_s for entry in scenario.timeline)
    # What the world sends is what it read, to the last bit.
    assert scenario_from_json(scenario.model_dump_json(), "json") == scenario


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_shipped_scenarios_have_the_papers_rates_and_look_at_the_target(path: Path) -> None:
    scenario = load_scenario(path)
    if "paper" in scenario.description or path.stem in (
        "single",
        "two-chaser-tracking",
        "four-chaser-docking",
    ):
        assert scenario.target.omega_rad_s == (0.015, 0.045, 0.03)
        assert scenario.target.velocity_m_s == (0.015, 0.0075, 0.03)
    for chaser in scenario.chasers:
        ahead = rotations.rotate(chaser.q_wxyz, [1.0, 0.0, 0.0])
        assert float(ahead @ np.array(chaser.position_m)) < -0.9 * math.hypot(*chaser.position_m)


# -- what a scenario means -------------------------------------------------------------------------


def test_start_pose_is_the_reference_moved_in_trf_and_turned_in_crf() -> None:
    half = math.sqrt(0.5)
    values = good()
    values["target"] |= {
        "position_m": [10.0, 20.0, 30.0],
        "q_wxyz": [half, 0.0, 0.0, half],
    }  # 90 degrees about z
    values["chasers"][0] |= {
        "start_offset_m": [-0.5, 0.25, 0.0],
        "start_rotation_rad": [math.pi / 2, 0.0, 0.0],
    }
    position, attitude = parse_scenario(values, "x").start_pose(0)
    np.testing.assert_allclose(position, [10.0 - 0.25, 20.0 - 1.5, 30.0], rtol=0, atol=1e-15)
    # The camera looks along the target's x, which is world y; rolled by a quarter, the body's y is
    # world z.
    np.testing.assert_allclose(
        rotations.rotate(attitude, [1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(
        rotations.rotate(attitude, [0.0, 1.0, 0.0]), [0.0, 0.0, 1.0], rtol=0, atol=1e-15
    )


def test_latency_and_rates_become_whole_steps() -> None:
    timing = parse_scenario(good(), "x").timing
    assert (timing.physics_hz, timing.rate_hz, timing.image_hz) == (960, 15, 15)
    assert timing.latency_steps == 32


def test_inertia_defaults_to_the_cuboids() -> None:
    body = parse_scenario(changed("chaser.mass_kg", 12.0), "x").chaser
    assert body.inertia == cuboid_inertia(12.0, body.size_m)
    assert cuboid_inertia(12.0, (1.0, 2.0, 3.0)) == (13.0, 10.0, 5.0)
    given_one = parse_scenario(changed("chaser.inertia_kg_m2", [1.0, 2.0, 2.5]), "x").chaser
    assert given_one.inertia == (1.0, 2.0, 2.5)


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 1e-3),
    st.floats(-9e-4, 9e-4),
)
def test_normalizing_a_quaternion_is_idempotent_to_the_bit(
    q: tuple[float, float, float, float], error: float
) -> None:
    w, x, y, z = (part / math.hypot(*q) * (1.0 + error) for part in q)
    once = unit((w, x, y, z))
    assert unit(once) == once
    assert abs(math.hypot(*once) - 1.0) <= 4.0 * np.finfo(float).eps


@pytest.mark.parametrize(
    "q",  # found by benchmarks/fuzz.py
    [
        (0.7071067811865476, 0.0, 0.0, 0.707105476),
        (0.5392993294557796, -0.19975267097334765, -0.13347041596982093, -0.8071197965525293),
    ],
)
def test_a_quaternion_whose_last_bit_changes_under_repeated_division_is_stable(
    q: tuple[float, float, float, float],
) -> None:
    assert unit(unit(q)) == unit(q)
    assert np.abs(np.array(unit(q)) - rotations.normalize(np.array(q))).max() < 3e-16


def test_nearly_unit_quaternions_become_unit_ones() -> None:
    scenario = parse_scenario(changed("chasers.0.q_wxyz", [0.7071, 0.0, 0.0, 0.7071]), "x")
    assert math.hypot(*scenario.chasers[0].q_wxyz) == pytest.approx(1.0, abs=1e-15)


def test_scenarios_cannot_be_changed() -> None:
    scenario = parse_scenario(good(), "x")
    with pytest.raises(ValueError, match="frozen"):
        scenario.seed = 4
    assert isinstance(scenario.chasers, tuple)


# -- faults ----------------------------------------------------------------------------------------

FAULTS: list[tuple[str, Any, str, str]] = [
    # path, value (None: key removed), expected path, expected text
    ("name", None, "name", "is missing"),
    ("duration_s", None, "duration_s", "is missing"),
    ("chasers", None, "chasers", "is missing"),
    ("chasers.1.position_m", None, "chasers.1.position_m", "is missing"),
    ("timeline.0.command", None, "timeline.0.command", "is missing"),
    ("chaser.mass_kg", -3.0, "chaser.mass_kg", "greater than 0"),
    ("chaser.mass_kg", 0.0, "chaser.mass_kg", "greater than 0"),
    ("target.mass_kg", -1.0, "target.mass_kg", "greater than 0"),
    ("chaser.size_m", [0.2, -0.2, 0.1], "chaser.size_m.1", "greater than 0"),
    ("target.model", "death-star", "target", "death-star"),
    ("target.motion", "wobble", "target.motion", "constant_rates"),
    ("chasers.0.q_wxyz", [1.0, 1.0, 0.0, 0.0], "chasers.0.q_wxyz", "unit length"),
    ("chasers.0.q_wxyz", [0.0, 0.0, 0.0, 0.0], "chasers.0.q_wxyz", "unit length"),
    ("chasers.0.q_wxyz", [1.0, 0.0, 0.0], "chasers.0.q_wxyz", "must be an array of 4 numbers"),
    ("target.q_wxyz", [2.0, 0.0, 0.0, 0.0], "target.q_wxyz", "unit length"),
    (
        "chasers.1.position_m",
        [-1.0, 0.0, 0.0],
        "chasers.1",
        "nearer than limits.min_distance_chasers_m",
    ),
    ("chasers.1.start_offset_m", [-1.9, 0.0, 0.0], "chasers.1", "inside one another"),
    ("chasers.1.position_m", [0.0, 0.0, 0.0], "chasers.1", "origin"),
    ("name", "a/b", "name", "must begin with a letter or digit"),
    ("name", "", "name", "must begin with a letter or digit"),
    ("name", "two\nlines", "name", "must begin with a letter or digit"),
    ("name", "x" * 65, "name", "must begin with a letter or digit"),
    ("duration_s", math.nan, "duration_s", "finite"),
    ("duration_s", math.inf, "duration_s", "finite"),
    ("chaser.mass_kg", math.inf, "chaser.mass_kg", "finite"),
    ("chaser.mass_kg", math.nan, "chaser.mass_kg", "finite"),
    ("target.omega_rad_s", [0.0, math.nan, 0.0], "target.omega_rad_s.1", "finite"),
    ("target.velocity_m_s", [-math.inf, 0.0, 0.0], "target.velocity_m_s.0", "finite"),
    ("chasers.0.q_wxyz", [math.nan, 0.0, 0.0, 0.0], "chasers.0.q_wxyz.0", "finite"),
    ("time.latency_s", math.nan, "time.latency_s", "finite"),
    ("camera.hfov_deg", math.inf, "camera.hfov_deg", "finite"),
    ("camera.hfov_deg", 150.0, "camera.hfov_deg", "less than 150"),
    (
        "camera.effects.jpeg_quality",
        101,
        "camera.effects.jpeg_quality",
        "must be a whole number from 0 to 100 (got 101)",
    ),
    ("typo", 1, "unknown key typo", "known keys: format, name, duration_s"),
    ("target.typo", 1, "unknown key target.typo", "known keys: attitude_deg, model"),
    ("chasers.0.typo", 1, "unknown key chasers.0.typo", "look_at"),
    ("chaser.inertia_kg_m2", [1.0, 1.0, 2.1], "chaser", "inertia_kg_m2"),
    ("target.inertia_kg_m2", [1.0, 5.0, 1.0], "target", "inertia_kg_m2"),
    ("chaser.inertia_kg_m2", [1.0, 0.0, 1.0], "chaser.inertia_kg_m2.1", "greater than 0"),
    ("time.rate_hz", 16, "time", "multiple of image_hz (16, 15)"),
    ("time.rate_hz", 45, "time", "multiple of rate_hz (960, 45)"),
    ("time.image_hz", 2, "time", "multiple of image_hz (15, 2)"),
    ("time.rate_hz", 0, "time.rate_hz", "a whole number from 1 to 240 (got 0)"),
    ("time.rate_hz", 7.5, "time.rate_hz", "whole number"),
    ("timeline.0.chasers", [0, 2], "timeline.0.chasers", "there is no chaser 2"),
    ("timeline.0.chasers", [-1], "timeline.0.chasers.0", "at least 0"),
    ("timeline.0.chasers", [], "timeline.0.chasers", "an array of at least 1"),
    ("timeline.0.command", "ram", "timeline.0.command", "one of approach, hold"),
    ("timeline.0.command", "goto", "timeline.0", "goto needs it"),
    ("timeline.0.offset_m", [1.0, 0.0, 0.0], "timeline.0", "goes with the command goto"),
    ("timeline.0.at_s", -1.0, "timeline.0.at_s", "at least 0"),
    ("success.docked", [2], "success.docked", "there is no chaser 2"),
    ("success.docked", [-1], "success.docked.0", "at least 0"),
    ("controller.horizon_s", 0.04, "controller", "shorter than one step"),
    ("controller.dt_s", 0.001, "controller", "3000 stages; at most 500"),
    ("controller.dt_s", 0.0, "controller.dt_s", "greater than 0"),
    ("controller.falloff", 1.5, "controller.falloff", "a number from 0 to 1 (got 1.5)"),
    ("controller.weight_force", 0.0, "controller.weight_force", "greater than 0"),
    ("approach.max_speed_m_s", 0.0, "approach.max_speed_m_s", "greater than 0"),
    ("chasers", [], "chasers", "an array of 1 to 64 tables (got [])"),
    ("chasers", 4, "chasers", "must be an array of 1 to 64 tables (got 4)"),
    ("target", "paper", "target", "must be a table"),
    ("seed", -1, "seed", "at least 0"),
    ("seed", 2**32, "seed", "less than 4294967296"),
    ("seed", 1.5, "seed", "whole number"),
    ("duration_s", "long", "duration_s", "number"),
    # Types are strict.
    (
        "duration_s",
        "30",
        "duration_s",
        "must be a number greater than 0 and at most 7776000 (got '30')",
    ),
    (
        "duration_s",
        True,
        "duration_s",
        "must be a number greater than 0 and at most 7776000 (got true)",
    ),
    ("seed", "3", "seed", "must be a whole number"),
    ("seed", 3.0, "seed", "must be a whole number at least 0 and less than 4294967296 (got 3.0)"),
    ("controller.feed_forward", 1, "controller.feed_forward", "must be true or false (got 1)"),
    ("controller.feed_forward", "yes", "controller.feed_forward", "must be true or false"),
    ("chasers.1.position_m", ["1", 0, 0], "chasers.1.position_m.0", "must be a number"),
    ("target.omega_rad_s", "0, 0, 0", "target.omega_rad_s", "must be an array"),
    ("name", 5, "name", "must be text"),
]


@pytest.mark.parametrize(
    ("path", "value", "where", "what"), FAULTS, ids=[f"{f[0]}={f[1]!r:.30}" for f in FAULTS]
)
def test_an_error_is_one_line_with_its_path(path: str, value: Any, where: str, what: str) -> None:
    lines = errors_of(changed(path, value))
    assert len(lines) == 1, lines
    # Errors across sections are those of the whole scenario; their texts name the path.
    assert re.match(rf"x\.toml: (\(scenario\): .*)?{re.escape(where)}\b", lines[0]), lines
    assert what in lines[0], lines
    assert "Value error" not in lines[0]


def test_whole_numbers_stand_for_any_number() -> None:
    assert parse_scenario(changed("duration_s", 20), "x.toml").duration_s == 20.0
    assert parse_scenario(changed("chasers.1.position_m", [2, 0, 0]), "x.toml").chasers[
        1
    ].position_m == (
        2.0,
        0.0,
        0.0,
    )


def test_every_error_has_its_own_line() -> None:
    values = changed("chaser.mass_kg", -3.0) | {"typo": 1, "seed": -1}
    del values["name"]
    assert len(errors_of(values)) == 4


def test_known_targets_are_named() -> None:
    assert "paper" in errors_of(changed("target.model", "death-star"))[0]
    for name in ("paper", "servicer"):
        assert parse_scenario(changed("target.model", name), "x").target.model == name
        assert target_model(name).markers


def test_limits_themselves_are_allowed() -> None:
    parse_scenario(changed("chaser.inertia_kg_m2", [1.0, 1.0, 2.0]), "x")
    parse_scenario(changed("timeline.0.chasers", [0, 1]), "x")
    parse_scenario(changed("controller.horizon_s", 0.1), "x")
    parse_scenario(changed("time.image_hz", 5), "x")


@given(st.integers(1, 240), st.integers(1, 240), st.integers(60, 4000))
@settings(derandomize=True, deadline=None, max_examples=100)
def test_rates_are_accepted_exactly_when_they_divide(
    rate_hz: int, image_hz: int, physics_hz: int
) -> None:
    values = good() | {"time": {"rate_hz": rate_hz, "image_hz": image_hz, "physics_hz": physics_hz}}
    divides = physics_hz % rate_hz == 0 and rate_hz % image_hz == 0
    try:
        scenario = parse_scenario(values, "x")
    except ScenarioError:
        assert not divides
    else:
        assert divides
        assert scenario.timing.steps_per_tick * rate_hz == physics_hz


@pytest.mark.parametrize(("rate_hz", "dt_s"), [(60, 0.1), (10, 0.1), (8, 0.125), (1, 1.0)])
def test_the_step_of_the_prediction_is_at_least_a_tick(rate_hz: int, dt_s: float) -> None:
    values = good() | {"time": {"rate_hz": rate_hz, "image_hz": 1}}
    scenario = parse_scenario(values, "x")
    assert scenario.controller.dt_s == dt_s
    assert flight_scenario(scenario).controller == scenario.controller
