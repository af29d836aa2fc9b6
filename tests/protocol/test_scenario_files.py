# SPDX-License-Identifier: Apache-2.0
"""Scenario files, variants and overrides: every error is one line that names the file or the
override, and the path.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.scenario import (
    Scenario,
    ScenarioError,
    load_scenario,
    parse_scenario,
    scenario_from_json,
)
from chaserdock_protocol.scenario.fields import facing_origin, unit
from chaserdock_protocol.shipped_scenarios import ScenarioNotFound, find_scenario
from hypothesis import example, given
from hypothesis import strategies as st
from scenario_samples import GOOD, good


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "two.toml"
    path.write_text(GOOD, encoding="utf-8")
    return path


# -- files -----------------------------------------------------------------------------------------


def load_error(path: Path, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_files_that_are_not_toml_or_not_readable_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    assert load_error(path).startswith(f"{path}: cannot be read: No such file")
    assert load_error(tmp_path).startswith(f"{tmp_path}: cannot be read: Is a directory")
    path.write_text("name = \n", encoding="utf-8")
    assert load_error(path).startswith(f"{path}: not TOML: ")
    path.write_text('{"name": "json"}', encoding="utf-8")
    assert load_error(path).startswith(f"{path}: not TOML: ")
    path.write_bytes(b'name = "\xff"\n')
    assert load_error(path).startswith(f"{path}: not UTF-8 text: ")
    path.write_bytes(b"")
    with pytest.raises(ScenarioError, match="name: is missing"):
        load_scenario(path)


def test_json_that_is_not_a_scenario_is_an_error() -> None:
    scenario = parse_scenario(good(), "x")
    for text in ("", "{", "[]", "null", scenario.model_dump_json()[:-1], '{"name": "x"}'):
        with pytest.raises(ScenarioError, match=r"^the world's scenario: "):
            scenario_from_json(text, "the world's scenario")


# -- overrides -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "read"),
    [
        ("duration_s=20", lambda s: s.duration_s == 20.0),
        ("duration_s = 20.5", lambda s: s.duration_s == 20.5),
        ("seed=0x10", lambda s: s.seed == 16),
        ("name=other", lambda s: s.name == "other"),
        ('name="other"', lambda s: s.name == "other"),
        ("description=a = b", lambda s: s.description == "a = b"),
        ("description=two words", lambda s: s.description == "two words"),
        ("target.motion=static", lambda s: s.target.motion == "static"),
        ("target.omega_rad_s=[0, 0.1, -0.2]", lambda s: s.target.omega_rad_s == (0.0, 0.1, -0.2)),
        ("camera.effects.gain=2", lambda s: s.camera.effects.gain == 2.0),
        ("controller.feed_forward=false", lambda s: s.controller.feed_forward is False),
        (
            "chasers.1.start_offset_m=[0.1,0,0]",
            lambda s: s.chasers[1].start_offset_m == (0.1, 0.0, 0.0),
        ),
        ("chasers.0.position_m.2=0.5", lambda s: s.chasers[0].position_m == (-1.0, 0.0, 0.5)),
        (
            "timeline.0={at_s=1, command='abort', chasers=[0]}",
            lambda s: s.timeline[0].command == "abort",
        ),
        ("timeline=[]", lambda s: s.timeline == ()),
        ("success={docked=[0]}", lambda s: s.success.docked == (0,)),
    ],
)
def test_overrides_reach_values_tables_and_arrays(file: Path, override: str, read: Any) -> None:
    assert not read(load_scenario(file))
    assert read(load_scenario(file, (override,)))


def test_overrides_apply_in_order_and_leave_the_rest(file: Path) -> None:
    scenario = load_scenario(file, ("seed=7", "target.motion=static", "seed=8"))
    assert scenario.seed == 8
    assert scenario == Scenario.model_validate(
        good() | {"seed": 8, "target": {"model": "paper", "motion": "static"}}
    )


@pytest.mark.parametrize(
    ("override", "where"),
    [
        ("seed", "--set seed: must be KEY=VALUE, such as camera.width_px=640"),
        ("", "--set : must be KEY=VALUE, such as camera.width_px=640"),
        ("=3", "--set =3: must be KEY=VALUE, such as camera.width_px=640"),
        (" =3", "--set  =3: must be KEY=VALUE, such as camera.width_px=640"),
        (
            "chasers.2.q_wxyz=[1,0,0,0]",
            "--set chasers.2.q_wxyz=[1,0,0,0]: 2 must be a number from 0 to 1",
        ),
        (
            "chasers.-1.q_wxyz=[1,0,0,0]",
            "--set chasers.-1.q_wxyz=[1,0,0,0]: -1 must be a number from 0 to 1",
        ),
        ("chasers.first.q_wxyz=[1,0,0,0]", "first must be a number from 0 to 1"),
        ("chasers.².q_wxyz=[1,0,0,0]", "² must be a number from 0 to 1"),
        ("chasers.0.position_m.3=1", "3 must be a number from 0 to 2"),
        ("seed.x=1", "--set seed.x=1: seed is a value (3), not a table"),
        ("chasers.0.position_m.0.x=1", "0 is a value (-1.0), not a table"),
        ("typo=1", "--set typo=1: unknown key typo; known keys: "),
        ("target.typo=1", "--set target.typo=1: unknown key target.typo; known keys: "),
        ("target..model=1", '--set target..model=1: unknown key target.""; known keys: '),
        ("nowhere.deep.value=1", "--set nowhere.deep.value=1: unknown key nowhere; known keys: "),
        ("seed=", "--set seed=: seed: must be a whole number at least 0 and less than 4294967296"),
        ("seed=x", "--set seed=x: seed: must be a whole number"),
        ("duration_s=nan", "--set duration_s=nan: duration_s: must be a finite number (got nan)"),
        ("chasers=4", "--set chasers=4: chasers: must be an array of 1 to 64 tables (got 4)"),
        ("target=paper", "--set target=paper: target: must be a table"),
    ],
)
def test_bad_overrides_are_one_line(file: Path, override: str, where: str) -> None:
    assert where in load_error(file, override)


def test_an_empty_array_has_no_items_to_set(file: Path) -> None:
    assert "timeline" in load_error(file, "timeline=[]", "timeline.0.at_s=1")


def test_one_element_of_a_default_can_be_set(tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text(GOOD)
    before = load_scenario(file).camera.position_m
    after = load_scenario(file, ("camera.position_m.1=0.5",)).camera.position_m
    assert after == (before[0], 0.5, before[2])
    with pytest.raises(ScenarioError, match="from 0 to 2"):
        load_scenario(file, ("camera.position_m.3=0.5",))
    with pytest.raises(ScenarioError, match="lens"):
        load_scenario(file, ("camera.lens.0=0.5",))


@pytest.mark.parametrize(
    ("path", "own"),
    [("perception.name", "default"), ("estimator.name", "joint"), ("controller.solver", "rti")],
)
def test_an_uninstalled_plugin_is_an_error_of_the_file_but_not_of_a_log(
    path: str, own: str, tmp_path: Path
) -> None:
    file = tmp_path / "s.toml"
    file.write_text(GOOD)
    assert load_scenario(file, (f"{path}={own}",))
    with pytest.raises(ScenarioError, match=f"{path}: .*'magic' is unknown; built in: {own}"):
        load_scenario(file, (f"{path}=magic",))
    # A log can be read without the plugin.
    text = load_scenario(file).model_dump_json().replace(f'"{own}"', '"magic"')
    assert scenario_from_json(text, "a log")


# -- sources of errors -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (
            ("camera.widht_px=640",),
            "--set camera.widht_px=640: unknown key camera.widht_px; did you mean camera.width_px?",
        ),
        (
            ("width_px=640",),
            "--set width_px=640: unknown key width_px; did you mean camera.width_px?",
        ),
        (
            ("target.motion=statc",),
            "--set target.motion=statc: target.motion: must be one of constant_rates, static, "
            "torque_free "
            "(got 'statc'); did you mean static?",
        ),
        (
            ("seed=4", "time.rate_hz=16"),
            "--set time.rate_hz=16: time: rate_hz must be a multiple of image_hz (16, 15)",
        ),
        (
            ("chaser.mass_kg=1e300",),
            "--set chaser.mass_kg=1e300: chaser.mass_kg: must be a number greater than 0 and at "
            "most 1e+12 (got 1e+300)",
        ),
        (
            ("time.picture_hz=5",),
            "--set time.picture_hz=5: time.picture_hz: is now called time.image_hz",
        ),
    ],
)
def test_an_error_of_an_override_names_the_override(
    file: Path, overrides: tuple[str, ...], line: str
) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(file, overrides)
    assert str(caught.value).startswith(line)
    assert "\n" not in str(caught.value)


def test_an_error_of_the_file_names_the_file_even_with_overrides(file: Path) -> None:
    file.write_text(GOOD + "\n[camera]\nwidht_px = 640\n")
    line = f"{file}: unknown key camera.widht_px; did you mean camera.width_px?"
    assert load_error(file, "seed=4") == line


def test_rates_that_are_only_valid_together_can_be_set_together(file: Path) -> None:
    assert load_scenario(file, ("time.rate_hz=16", "time.image_hz=8")).time.rate_hz == 16


def test_deep_nesting_is_one_line(file: Path) -> None:
    assert "nested too deeply" in load_error(file, "target.geometry=" + "[" * 5000 + "]" * 5000)
    deep = ".".join(["a"] * 2000)
    file.write_text(f"{deep} = 1\n{GOOD}")
    assert load_error(file).startswith(f"{file}: ")
    assert "nested too deeply" in load_error(file, f"{deep}=1")


# -- format ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("format = 1", "format: 1 is not supported any more; set format = 3 and change: no key"),
        (
            "format = 1\ntime.picture_hz = 5",
            "set format = 3 and change: time.picture_hz: is now called time.image_hz",
        ),
        (
            "format = 4",
            "format: must be 3, the format that this version of chaserdock reads (got 4)",
        ),
        (
            'format = "3"',
            "format: must be 3, the format that this version of chaserdock reads (got '3')",
        ),
        ("time.picture_hz = 5", "time.picture_hz: is now called time.image_hz"),
        ("chaser.jet_test_s = 5", "chaser.jet_test_s: is now called chaser.thruster_test_s"),
        ("jet_failure = []", "jet_failure: is now called thruster_failure"),
        (
            "odometry.position_noise_m = 0.1",
            "odometry: is now called navigation; state the grade, too",
        ),
        (
            "camera.calibration_error.mounting_deg = 0.1",
            "camera.calibration_error.mounting_deg: is now called navigation.camera_turn_deg",
        ),
        (
            "format = 2\nestimator.camera_bias_position_m = 0.1",
            "set format = 3 and change: estimator.camera_bias_position_m: is now called "
            "navigation.camera_shift_m",
        ),
    ],
)
def test_an_older_format_is_one_line_that_names_the_new_key(
    file: Path, line: str, error: str
) -> None:
    file.write_text(f"{line}\n{GOOD}")
    assert error in load_error(file)


def test_the_present_format_may_be_stated(file: Path) -> None:
    file.write_text(f"format = 3\n{GOOD}")
    assert load_scenario(file).format == 3


def test_a_renamed_shipped_scenario_is_an_error_with_its_new_name() -> None:
    with pytest.raises(ScenarioNotFound, match=r"jet-failure: .* is now called thruster-failure"):
        find_scenario("jet-failure")
    with pytest.raises(ScenarioNotFound, match=r"did you mean single\?"):
        find_scenario("singel")
    with pytest.raises(ScenarioNotFound, match="no such scenario file"):
        find_scenario("nowhere/single.toml")


# -- extends ---------------------------------------------------------------------------------------


def variant(tmp_path: Path, text: str, name: str = "variant.toml") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_variant_merges_tables_and_replaces_arrays(file: Path, tmp_path: Path) -> None:
    path = variant(
        tmp_path,
        'extends = "two.toml"\nname = "variant"\ntarget.motion = "static"\n'
        "[[chasers]]\nposition_m = [-1.0, 0.0, 0.5]\nlook_at = 'target'\n"
        "[[timeline]]\nat_s = 1.0\ncommand = 'abort'\nchasers = [0]\n",
    )
    base, scenario = load_scenario(file), load_scenario(path)
    assert (scenario.name, scenario.seed, scenario.target.motion) == ("variant", 3, "static")
    assert scenario.target.model == base.target.model
    assert len(scenario.chasers) == len(scenario.timeline) == 1
    assert "extends" not in scenario.model_dump_json()
    assert scenario_from_json(scenario.model_dump_json(), "json") == scenario


def test_a_variant_may_extend_a_shipped_scenario_and_another_variant(tmp_path: Path) -> None:
    variant(tmp_path, 'extends = "single"\nseed = 5\n', "one.toml")
    folder = tmp_path / "below"
    folder.mkdir()
    scenario = load_scenario(variant(folder, 'extends = "../one.toml"\nname = "last"\n'))
    assert scenario == load_scenario(find_scenario("single"), ("seed=5", "name=last"))


@pytest.mark.parametrize(
    ("extends", "error"),
    [
        ('"variant.toml"', "extends: cycle: "),
        ('"nowhere.toml"', "nowhere.toml: no such file"),
        (
            '"singel"',
            "extends: singel: no such scenario file or shipped scenario; did you mean single?",
        ),
        ('"jet-failure"', "is now called thruster-failure"),
        (
            "3",
            "extends: must be the name of a shipped scenario or the path of a .toml file (got 3)",
        ),
        ('"../../etc/passwd"', "no such scenario file or shipped scenario"),
    ],
)
def test_an_invalid_parent_is_one_line_with_the_path(
    tmp_path: Path, extends: str, error: str
) -> None:
    path = variant(tmp_path, f"extends = {extends}\n")
    line = load_error(path)
    assert line.startswith(f"{path}: extends: ")
    assert error in line


def test_a_cycle_names_all_files(tmp_path: Path) -> None:
    first, second = variant(tmp_path, 'extends = "b.toml"', "a.toml"), tmp_path / "b.toml"
    second.write_text('extends = "a.toml"')
    assert load_error(first) == f"{first}: extends: cycle: {first} -> {second} -> {first}"


def test_an_error_of_the_base_names_the_base(file: Path, tmp_path: Path) -> None:
    file.write_text(GOOD + "\n[camera]\nhfov_deg = 300.0\n")
    path = variant(tmp_path, 'extends = "two.toml"\nseed = -1\n')
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    lines = str(caught.value).splitlines()
    assert sorted(line.partition(": ")[0] for line in lines) == [str(file), str(path)]


def test_extends_is_an_error_outside_files() -> None:
    with pytest.raises(ScenarioError, match="extends: is resolved in scenario files only"):
        parse_scenario(good() | {"extends": "single"}, "x")


# -- attitudes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("position", "q"),
    [
        ((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        ((0.0, -1.0, 0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))),
        ((0.0, 1.0, 0.0), (math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5))),
        ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        ((0.0, 0.0, 1.0), (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)),
    ],
)
def test_look_at_is_exact_along_the_axes(position: tuple[float, ...], q: tuple[float, ...]) -> None:
    values = good()
    values["chasers"] = [{"position_m": list(position), "look_at": "target"}]
    values["timeline"] = []
    assert parse_scenario(values, "x").chasers[0].q_wxyz == q


@given(st.tuples(*[st.floats(-20.0, 20.0)] * 3).filter(lambda p: math.hypot(*p) > 1e-3))
@example((2.2e-313, 2.2e-313, 1.0))
@example((1e-313, -3e-314, 2e-313))
def test_look_at_points_x_at_the_target_without_roll(position: tuple[float, float, float]) -> None:
    q = facing_origin(position)
    assert unit(q) == q
    ahead = rotations.rotate(q, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        ahead, -np.array(position) / math.hypot(*position), rtol=0, atol=1e-12
    )
    assert abs(rotations.rotate(q, [0.0, 1.0, 0.0])[2]) < 1e-12
    assert rotations.rotate(q, [0.0, 0.0, 1.0])[2] > -1e-12


def test_euler_angles_are_intrinsic_z_y_x() -> None:
    values = good()
    del values["chasers"][0]["q_wxyz"]
    values["chasers"][0]["attitude_deg"] = {"roll": 30, "pitch": -20.0, "yaw": 10.0}
    values["target"]["attitude_deg"] = {"yaw": 90.0}
    scenario = parse_scenario(values, "x")
    r, p, y = np.radians([30.0, -20.0, 10.0])
    about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_z = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    matrix = rotations.to_matrix(scenario.chasers[0].q_wxyz)
    np.testing.assert_allclose(matrix, about_z @ about_y @ about_x, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        scenario.target.q_wxyz, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], rtol=0, atol=1e-15
    )
    assert "attitude_deg" not in scenario.model_dump()["chasers"][0]


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        (
            {"look_at": "target"},
            "chasers.0: q_wxyz and look_at exclude each other; give one of them",
        ),
        ({"q_wxyz": None, "look_at": "moon"}, "chasers.0.look_at: must be target (got 'moon')"),
        (
            {"q_wxyz": None, "attitude_deg": {"yow": 3}},
            "unknown key chasers.0.attitude_deg.yow; did you mean",
        ),
        (
            {"q_wxyz": None, "attitude_deg": {"yaw": math.nan}},
            "chasers.0.attitude_deg.yaw: must be a finite",
        ),
        ({"q_wxyz": None, "attitude_deg": 3}, "chasers.0.attitude_deg: must be a table (got 3)"),
        ({"q_wxyz": None}, "chasers.0.q_wxyz: is missing; give it, attitude_deg or look_at"),
        (
            {"q_wxyz": None, "look_at": "target", "position_m": [0, 0, 0]},
            "chasers.0: position_m must not be",
        ),
        (
            {"q_wxyz": None, "look_at": "target", "position_m": [0, 0]},
            "chasers.0.position_m: must be an array of 3",
        ),
    ],
)
def test_an_invalid_attitude_is_one_line(keys: dict[str, Any], error: str) -> None:
    values = good()
    values["chasers"][0] |= keys
    values["chasers"][0] = {k: v for k, v in values["chasers"][0].items() if v is not None}
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(values, "x.toml")
    assert str(caught.value).startswith(f"x.toml: {error}")
    assert "\n" not in str(caught.value)


def test_an_override_replaces_another_form_of_the_attitude() -> None:
    path = find_scenario("single")
    assert load_scenario(path, ("chasers.0.q_wxyz=[0,0,0,1]",)).chasers[0].q_wxyz == (
        0.0,
        0.0,
        0.0,
        1.0,
    )
    yaw = load_scenario(path, ("chasers.0.attitude_deg.yaw=180",)).chasers[0].q_wxyz
    np.testing.assert_allclose(yaw, [0, 0, 0, 1], atol=1e-15)
    one = load_scenario(path, ("chasers.0.q_wxyz.3=1e-4",)).chasers[0].q_wxyz
    np.testing.assert_allclose(one, [1, 0, 0, 1e-4], atol=1e-8)


def test_a_known_target_replaces_the_geometry_of_the_base(file: Path, tmp_path: Path) -> None:
    geometry = (
        '[target.geometry]\ndictionary = "DICT_4X4_50"\ncuboids = [{ size_m = [1, 1, 1] }]\n'
        'markers = [{ id = 0, side_m = 0.2, face = "-x" }]\n'
    )
    file.write_text(GOOD.replace('model = "paper"', 'model = "mine"') + geometry)
    path = variant(tmp_path, 'extends = "two.toml"\ntarget.model = "servicer"\n')
    assert load_scenario(file).target.geometry is not None
    assert load_scenario(path).target.geometry is None


@pytest.mark.parametrize("key", ["width_px=640", "height_px=480", "hfov_deg=50.0"])
def test_camera_values_replaced_by_intrinsics_are_an_error(tmp_path: Path, key: str) -> None:
    lens = "{width_px=800,height_px=600,fx_px=700,fy_px=700,cx_px=400,cy_px=300}"
    error = (
        f"camera.{key.partition('=')[0]}: not used with camera.intrinsics; change "
        "camera.intrinsics instead"
    )
    variant = tmp_path / "variant.toml"
    variant.write_text(f'extends = "single"\n[camera]\nintrinsics = {lens}\n')
    assert load_scenario(variant).camera_model().width_px == 800
    assert load_error(variant, f"camera.{key}") == f"--set camera.{key}: {error}"
    variant.write_text(
        f'extends = "single"\n[camera]\n{key.replace("=", " = ")}\nintrinsics = {lens}\n'
    )
    assert load_error(variant) == f"{variant}: {error}"
