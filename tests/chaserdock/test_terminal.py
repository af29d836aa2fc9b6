# SPDX-License-Identifier: Apache-2.0
"""Lines that fit a terminal of 80 columns, and the last lines of commands."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from harness import ROOT, finished
from ruamel.yaml import YAML
from typer.main import get_command

from chaserdock.analysis import report as report_page
from chaserdock.analysis.figures import FIGURES
from chaserdock.cli.analysis import report
from chaserdock.cli.main import app
from chaserdock.cli.simulate import simulate
from chaserdock.launch.judge import HOST_FOLDER, files_lines
from chaserdock.launch.launcher import MissionOutcome, print_where
from chaserdock.simulation import seeds
from chaserdock.simulation.checks.check import Violation
from chaserdock.simulation.flight import SimulationResult
from chaserdock.simulation.seeds import UnflownSeed
from chaserdock.terminal import COLUMNS, labelled, wrapped

LOG = ROOT / "tests" / "golden" / "two-chasers.mcap"


def test_lines_are_wrapped_but_what_is_copied_is_whole() -> None:
    path = "/" + "long/" * 30
    lines = [*wrapped(["  word " * 30]), *labelled("log", path).splitlines()]
    assert all(len(line) <= COLUMNS for line in lines if path not in line)
    assert lines[-2:] == ["log:", f"  {path}"]
    assert labelled("log", "here") == "log: here"


@pytest.mark.parametrize("columns", [80, 200])
def test_list_of_scenarios_fits_the_terminal(columns: int) -> None:
    status, said = finished("scenario", env={"COLUMNS": str(columns)})
    assert status == 0
    lines = said.splitlines()
    assert max(map(len, lines)) <= columns
    rows = [line for line in lines if not line.startswith(" ")]
    assert (len(lines) == len(rows)) == (columns == 200)
    assert sum(line.startswith("docking-contact ") for line in lines) == 1


def test_report_shows_its_steps_and_ends_with_its_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report_page, "draw_figures", lambda *_: ((f, "left out") for f in FIGURES))
    steps: list[tuple[str, int, int]] = []
    page = tmp_path / "a page.html"
    report_page.write_report(LOG, page, lambda *step: steps.append(step))
    assert steps[0] == ("reading the log", 0, len(steps))
    assert [done for _, done, _ in steps] == list(range(len(steps)))
    assert f"figure: {FIGURES[-1].title}" in [step for step, _, _ in steps]

    context = typer.Context(get_command(app), info_name="report")
    report(context, LOG, page)
    said = capsys.readouterr()
    assert said.out == f"{page}\n"
    assert said.err.splitlines()[-1].strip().endswith(page.as_uri())


def test_run_ends_with_its_folder_and_the_command_of_its_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    print_where(MissionOutcome(Path("runs/a b"), 0, {}, None))
    said = capsys.readouterr().out.splitlines()
    assert said[0].endswith(": runs/a b")
    command = said[1].partition(": ")[2]
    assert shlex.split(command) == ["chaserdock", "report", "runs/a b"]


def results(*violated: int) -> Iterator[SimulationResult | UnflownSeed]:
    """Flights of four seeds, of which those of ``violated`` fail."""
    for seed in range(1, 5):
        violations = (Violation("liveness", 1.0, "chaser/0: hangs"),) if seed in violated else ()
        outcome = "liveness" if violations else "docked"
        yield SimulationResult(seed, {"extends": "single"}, violations, outcome, "f", (), 1.0)


@pytest.mark.parametrize(
    ("violated", "shrinking", "ends"),
    [
        ((), True, ("no invariant is violated", "nothing, as no seed", "single --seeds 4")),
        ((2, 3), False, ("2 docked, 2 liveness; 2 failed", "nothing", "single --seeds 2")),
        ((3,), True, ("1 failed", "single-seed-3.toml", "single-seed-3.toml")),
    ],
)
def test_simulate_ends_with_verdict_files_and_a_command_that_parses(
    violated: tuple[int, ...],
    shrinking: bool,
    ends: tuple[str, str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(seeds, "fly_seeds", lambda *_: results(*violated))
    monkeypatch.setattr(seeds, "shrink_result", lambda result: iter((result,)))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(typer.Exit) as exit_:
        simulate("single", "1:4", shrinking=shrinking, out=Path("out"))
    assert exit_.value.exit_code == (1 if violated else 0)
    lines = capsys.readouterr().out.splitlines()[-3:]
    assert lines[0].startswith("4 seeds in ")
    assert max(map(len, lines)) <= COLUMNS
    for line, end in zip(lines, ends, strict=True):
        assert end in line
    command = shlex.split(lines[2].partition(": ")[2])
    program: Any = get_command(app)
    values = program.commands[command[1]].make_context("simulate", command[2:]).params
    assert values["scenario"] in ("single", "out/single-seed-3.toml")


def test_last_line_of_compose_names_the_files_on_the_host(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mission = YAML().load(ROOT / "compose.yaml")["services"]["mission"]
    host, _, inside = mission["volumes"][1].partition(":")
    assert mission["environment"][HOST_FOLDER] == host
    assert mission["command"].startswith(f"judge {inside} ")
    folder = tmp_path / "four-chaser-docking-20261128-031500"
    folder.mkdir()
    for name in ("mission.mcap", "summary.json"):
        (folder / name).touch()
    names = "mission.mcap, summary.json"
    assert files_lines(folder, None) == f"{folder}\n  {names}"
    monkeypatch.setenv(HOST_FOLDER, host)
    line = files_lines(folder, folder / "report.html")
    assert line == f"on the host, ./runs/{folder.name}\n  report.html, {names}"
