# SPDX-License-Identifier: Apache-2.0
"""``chaserdock demo`` ends with a latched chaser, a report, a film and commands that exist."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import av
import pytest
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.cli import demo
from chaserdock.cli.main import GROUPS


@pytest.mark.parametrize(("name", "open_page"), [("DISPLAY", True), ("NOTHING", False)])
def test_browser_is_opened_where_there_is_a_display(
    monkeypatch: pytest.MonkeyPatch, name: str, open_page: bool
) -> None:
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv(name, ":0")
    monkeypatch.setattr(sys, "platform", "linux")
    assert demo.has_display() is open_page


def test_commands_to_try_next_exist() -> None:
    names = {function.__name__ for functions in GROUPS.values() for function in functions}
    lines = demo.NEXT.format(folder="runs/demo").splitlines()
    commands = [shlex.split(line) for line in lines if line.startswith("  ")]
    assert len(commands) == 3
    assert {words[0] for words in commands} == {"chaserdock"}
    assert {words[1] for words in commands} <= names


@pytest.mark.slow
def test_demo_docks_and_leaves_report_and_film(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    environment = {k: v for k, v in os.environ.items() if "DISPLAY" not in k}
    done = subprocess.run(
        [sys.executable, "-m", "chaserdock", "demo", "--out", str(folder)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["success"]
    assert (folder / "report.html").as_uri() in done.stdout
    assert (folder / "report.html").is_file()
    with av.open(str(folder / demo.FILM)) as film:
        seconds = float(film.duration or 0) / 1e6
    flown_s = load_scenario(find_scenario("demo")).duration_s
    assert flown_s + 6.0 < seconds < flown_s + 14.0  # slow motion at contact, and the last card
    assert "the viewer is at http://127.0.0.1:" in done.stderr
