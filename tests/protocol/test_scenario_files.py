"""Scenario files and overrides on the command line: one line that names the file and the path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from chaserdock_protocol.scenario import (
    Scenario,
    ScenarioError,
    load_scenario,
    parse_scenario,
    scenario_from_json,
)
from scenario_samples import GOOD, good


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "two.toml"
    path.write_text(GOOD, encoding="utf-8")
    return path


# -- files ------------------------------------------------------------------------------------------------


def file_complaint(path: Path, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_files_that_are_no_scenario(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    assert file_complaint(path).startswith(f"{path}: cannot be read: No such file")
    assert file_complaint(tmp_path).startswith(f"{tmp_path}: cannot be read: Is a directory")
    path.write_text("name = \n", encoding="utf-8")
    assert file_complaint(path).startswith(f"{path}: not TOML: ")
    path.write_text('{"name": "json"}', encoding="utf-8")
    assert file_complaint(path).startswith(f"{path}: not TOML: ")
    path.write_bytes(b'name = "\xff"\n')
    assert file_complaint(path).startswith(f"{path}: not UTF-8 text: ")
    path.write_bytes(b"")
    with pytest.raises(ScenarioError, match="name: is missing"):
        load_scenario(path)


def test_json_that_is_no_scenario() -> None:
    scenario = parse_scenario(good(), "x")
    for text in ("", "{", "[]", "null", scenario.model_dump_json()[:-1], '{"name": "x"}'):
        with pytest.raises(ScenarioError, match=r"^the world's scenario: "):
            scenario_from_json(text, "the world's scenario")


# -- overrides --------------------------------------------------------------------------------------------


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
        ("chasers.1.start_offset_m=[0.1,0,0]", lambda s: s.chasers[1].start_offset_m == (0.1, 0.0, 0.0)),
        ("chasers.0.position_m.2=0.5", lambda s: s.chasers[0].position_m == (-1.0, 0.0, 0.5)),
        ("timeline.0={at_s=1, command='abort', chasers=[0]}", lambda s: s.timeline[0].command == "abort"),
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
        ("seed", "--set seed: must be key.path=value"),
        ("", "--set : must be key.path=value"),
        ("=3", "--set =3: must be key.path=value"),
        (" =3", "--set  =3: must be key.path=value"),
        ("chasers.2.q_wxyz=[1,0,0,0]", "--set chasers.2.q_wxyz=[1,0,0,0]: 2 must be a number from 0 to 1"),
        ("chasers.-1.q_wxyz=[1,0,0,0]", "--set chasers.-1.q_wxyz=[1,0,0,0]: -1 must be a number from 0 to 1"),
        ("chasers.first.q_wxyz=[1,0,0,0]", "first must be a number from 0 to 1"),
        ("chasers.².q_wxyz=[1,0,0,0]", "² must be a number from 0 to 1"),
        ("chasers.0.position_m.3=1", "3 must be a number from 0 to 2"),
        ("seed.x=1", "--set seed.x=1: seed is a value, not a table"),
        ("chasers.0.position_m.0.x=1", "0 is a value, not a table"),
        ("typo=1", "two.toml: typo: is not a key that is known here"),
        ("target.typo=1", "two.toml: target.typo: is not a key that is known here"),
        ("target..model=1", "two.toml: target.: is not a key that is known here"),
        ("nowhere.deep.value=1", "two.toml: nowhere: is not a key that is known here"),
        ("seed=", "two.toml: seed: "),
        ("seed=x", "two.toml: seed: "),
        ("duration_s=nan", "two.toml: duration_s: "),
        ("chasers=4", "two.toml: chasers: "),
        ("target=paper", "two.toml: target: "),
    ],
)
def test_bad_overrides_are_one_line(file: Path, override: str, where: str) -> None:
    assert where in file_complaint(file, override)


def test_an_empty_array_has_no_items_to_set(file: Path) -> None:
    assert "timeline" in file_complaint(file, "timeline=[]", "timeline.0.at_s=1")


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
    [("perception.name", "default"), ("estimator.name", "mekf"), ("controller.solver", "rti")],
)
def test_a_part_that_is_not_installed_is_told_where_the_file_is_read(
    path: str, own: str, tmp_path: Path
) -> None:
    file = tmp_path / "s.toml"
    file.write_text(GOOD)
    assert load_scenario(file, (f"{path}={own}",))
    with pytest.raises(ScenarioError, match=f"{path}: .*'magic' is unknown; built in: {own}"):
        load_scenario(file, (f"{path}=magic",))
    # Who reads a log, or flies another part of the mission, need not have it.
    text = load_scenario(file).model_dump_json().replace(f'"{own}"', '"magic"')
    assert scenario_from_json(text, "a log")
