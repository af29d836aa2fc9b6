# SPDX-License-Identifier: Apache-2.0
"""``chaserdock scenario``: list, check, show, create; and the schema."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import shipped_names, shipped_scenario
from typer.testing import CliRunner

from chaserdock.cli.main import app
from chaserdock.cli.scenario import as_toml


def call(*arguments: str) -> tuple[int, str, str]:
    """Return status, standard output and standard error."""
    result = CliRunner().invoke(app, ["scenario", *arguments])
    return result.exit_code, result.stdout, result.stderr


def test_list_has_every_shipped_scenario() -> None:
    status, out, _ = call()
    assert status == 0
    heads = [line for line in out.splitlines() if not line.startswith(" ")]
    assert [line.split()[0] for line in heads[1:]] == shipped_names()
    rows = json.loads(call("--json")[1])
    assert {"name": "single", "chasers": 1, "duration_s": 120.0}.items() <= rows[
        shipped_names().index("single")
    ].items()


def test_check_prints_one_line_per_error_and_exits_with_2(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text('extends = "single"\nseed = -1\ncamera.widht_px = 640\n')
    status, out, err = call("single", str(bad), "nowhere")
    assert status == 2
    assert out == "single: valid: single, 1 chaser, 120 s\n"
    lines = err.splitlines()
    assert len(lines) == 3
    assert f"{bad}: unknown key camera.widht_px; did you mean camera.width_px?" in err
    assert "nowhere: no such scenario file or shipped scenario" in lines[2]
    assert call("single", "swap")[0] == 0


@pytest.mark.parametrize("changes", [False, True])
@pytest.mark.parametrize("name", shipped_names())
def test_show_prints_toml_of_an_equal_scenario(name: str, changes: bool, tmp_path: Path) -> None:
    scenario = load_scenario(shipped_scenario(name))
    path = tmp_path / "shown.toml"
    path.write_text(as_toml(scenario, changes), encoding="utf-8")
    assert load_scenario(path) == scenario


def test_show_applies_overrides_and_can_be_limited_to_changes() -> None:
    status, out, _ = call("single", "--show", "--set", "seed=7")
    assert status == 0
    assert "seed = 7\n" in out
    assert "hfov_deg = 60.0\n" in out
    changed = call("single", "--changes", "--set", "seed=7")[1]
    assert "seed = 7\n" in changed
    assert "hfov_deg" not in changed


def test_schema_names_every_table() -> None:
    schema = json.loads(call("--schema")[1])
    assert {"target", "chasers", "success"} <= set(schema["properties"])


def test_new_writes_a_valid_scenario_and_does_not_overwrite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, _ = call("mine", "--new")
    assert status == 0
    assert out == "mine.toml: run it with: chaserdock run mine.toml\n"
    assert load_scenario(tmp_path / "mine.toml").name == "mine"
    status, _, err = call("mine.toml", "--new")
    assert (status, err) == (2, "chaserdock: mine.toml: exists already\n")
    status, _, err = call("nowhere/mine", "--new")
    assert (status, err) == (
        2,
        "chaserdock: nowhere/mine.toml: cannot be written: No such file or directory\n",
    )
