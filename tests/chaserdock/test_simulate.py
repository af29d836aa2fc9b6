# SPDX-License-Identifier: Apache-2.0
"""``chaserdock simulate``: verdicts, scenario files of failures, and invalid input."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
import typer
from chaserdock_protocol.messages import Tick
from chaserdock_protocol.scenario import ScenarioError, load_scenario
from harness import ROOT, chaserdock, finished

from chaserdock.cli.simulate import simulate
from chaserdock.simulation.checks import flight_checks
from chaserdock.simulation.checks.check import Check
from chaserdock.simulation.checks.flight_checks import FlightChecks
from chaserdock.simulation.checks.reader import reads
from chaserdock.simulation.flight import fly_case
from chaserdock.simulation.seeds import (
    SeedOptions,
    fly_seed,
    shrink_result,
    write_case,
)
from chaserdock.simulation.swarm import draw_case
from chaserdock.toml_text import toml_document

SHORT = """
extends = "single"
name = "short"
duration_s = 1.0
timeline = []
success = {docked = [DOCKED]}
"""


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.toml"
    path.write_text(SHORT.replace("DOCKED", ""))
    return path


@pytest.fixture
def bad(tmp_path: Path) -> Path:
    """A mission that is to dock on a command after its last tick, which violates liveness."""
    path = tmp_path / "bad.toml"
    approach = '[{at_s = 0.99, command = "approach", chasers = [0]}]'
    path.write_text(SHORT.replace("timeline = []", f"timeline = {approach}").replace("DOCKED", "0"))
    return path


@pytest.mark.slow
def test_seeds_of_a_good_mission_pass_on_two_processes(good: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    status, text = finished(
        "simulate", str(good), "--seeds", "1:2", "--jobs", "2", "--out", str(out)
    )
    assert status == 0, text
    assert "2 seeds in" in text
    assert not out.exists()


@pytest.mark.slow
def test_results_of_a_file_are_not_flown_again_but_count(bad: Path, tmp_path: Path) -> None:
    seed = next(s for s in range(1, 50) if fly_seed(SeedOptions(str(bad)), s).violations)
    table = tmp_path / "seeds.jsonl"
    arguments = ("simulate", str(bad), "--no-shrink", "--results", str(table), "--seeds")
    first = finished(*arguments, str(seed))
    rows = table.read_bytes()
    again = finished(*arguments, str(seed))
    assert (first[0], again[0], table.read_bytes()) == (1, 1, rows)
    notice, _, rest = again[1].partition("\n")
    assert notice == f"1 of 1 seeds are in {table} already"
    assert re.sub(r"in \d+ s", "", rest) == re.sub(r"in \d+ s", "", first[1])


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--seeds", "1:2")], ids=["one", "seeds"])
@pytest.mark.parametrize("out", ["good.toml", "good.toml/below"])
def test_out_must_be_a_folder_that_can_be_written(
    out: str, options: tuple[str, ...], good: Path
) -> None:
    status, text = finished("simulate", str(good), *options, "--out", str(good.parent / out))
    assert status == 2
    (line,) = text.splitlines()
    assert line.endswith(f"{out}: {good} is not a folder that can be written")


def test_out_must_be_writable(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: mode == os.F_OK)
    with pytest.raises(typer.Exit) as exit_:
        simulate(str(good), out=good.parent / "out")
    assert exit_.value.exit_code == 2


@pytest.mark.slow
def test_options_of_seeds_need_seeds(good: Path) -> None:
    options = ("--jobs", "2", "--results", "r", "--images", "--stop", "--no-shrink")
    status, text = finished("simulate", str(good), *options)
    assert status == 2
    assert (
        text == "chaserdock: --jobs, --results, --images, --no-shrink, --stop: only with --seeds\n"
    )


@pytest.mark.slow
def test_a_seed_that_cannot_be_flown_does_not_end_the_others(good: Path) -> None:
    """A goto beside the only distance that the limits allow is refused."""
    text = (
        good.read_text()
        + "limits = {min_distance_target_m = 1.0, max_reference_distance_m = 1.0}\n"
    )
    good.write_text(text)
    base = load_scenario(good)
    cases = [draw_case("good", s, base) for s in range(60)]
    wrong = next(
        s
        for s in range(59)
        if "goto" in {e["command"] for e in cases[s].get("timeline", ())}
        and "timeline" not in cases[s + 1]
    )
    status, text = finished("simulate", str(good), "--seeds", f"{wrong}:{wrong + 1}")
    assert status == 1
    assert f"seed {wrong}: not flown: (scenario): timeline." in text
    assert "scenario.toml" not in text
    assert "\n2 seeds in" in text
    assert "1 not flown" in text


@pytest.mark.slow
def test_targets_without_markers_need_images() -> None:
    status, text = finished("simulate", "markerless-docking", "--seeds", "1:3")
    assert status == 2
    (line,) = text.splitlines()
    assert line.endswith(
        "markerless-docking.toml: the target has no markers to draw measurements of; use --images"
    )


@pytest.mark.slow
def test_a_flight_without_seeds_keeps_its_log_once(good: Path, tmp_path: Path) -> None:
    arguments = ("simulate", str(good), "--out", str(tmp_path / "out"))
    status, text = finished(*arguments)
    assert status == 0, text
    assert (tmp_path / "out" / "good" / "run" / "mission.mcap").is_file()
    status, text = finished(*arguments)
    assert status == 2
    assert "exists already" in text


@pytest.mark.slow
def test_a_failing_seed_becomes_a_minimal_scenario_that_fails(bad: Path, tmp_path: Path) -> None:
    seed = next(s for s in range(1, 50) if fly_seed(SeedOptions(str(bad)), s).violations)
    result = fly_seed(SeedOptions(str(bad)), seed)
    arguments = ("simulate", str(bad), "--seeds", f"{seed}:{seed + 5}", "--no-shrink", "--stop")
    status, text = finished(*arguments)
    assert status == 1
    assert "\n1 seeds in" in text
    assert fly_seed(SeedOptions(str(bad)), seed).fingerprint == result.fingerprint
    *_, simplest = shrink_result(result, attempts=60)
    path = write_case(simplest, tmp_path / "out")
    case = simplest.case
    assert not case["fault"]
    assert case.keys() <= {"extends", "name", "seed", "perception", "fault", "duration_s"}
    assert path.read_text().startswith(
        "# liveness at 1.00 s: chaser/0: ends in phase hold, although nothing disturbed it"
    )
    assert load_scenario(path).duration_s == 1.0
    assert [v.invariant for v in fly_case({"extends": str(path)}, seed).violations] == ["liveness"]


@pytest.mark.parametrize(
    ("keys", "honest"),
    [
        ("", True),
        (
            '[[fault]]\nkind = "odometry_lie"\nat_s = 0.5\nduration_s = 1.0\n'
            'process = "chaser/0"\noffset_m = [1.0, 0.0, 0.0]\n',
            False,
        ),
        ("[truth.chaser]\nforce_N = 0.005\n", False),
    ],
    ids=["nothing", "lie", "truth"],
)
def test_a_case_is_as_honest_as_the_scenario_that_it_extends(
    keys: str, honest: bool, good: Path
) -> None:
    good.write_text(good.read_text() + keys)
    assert is_honest({"extends": str(good), "duration_s": 0.3}, good.parent) == honest


def is_honest(case: dict[str, Any], folder: Path) -> bool:
    """Whether nothing in a case misleads the flight software."""
    path = folder / "case.toml"
    path.write_text(toml_document(case))
    return FlightChecks(load_scenario(path)).view.causes.honest


def test_a_case_inherits_thruster_failures(tmp_path: Path) -> None:
    statistical = {"name": "statistical"}
    case = {"extends": "thruster-failure", "duration_s": 0.3, "perception": statistical}
    assert not is_honest(case, tmp_path)


def test_a_flight_may_end_at_the_first_violation(
    good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class ThirdTick(Check):
        name = "no third tick"

        @reads(Tick)
        def judge(self, tick: Tick) -> None:
            if tick.tick == 3:
                self.violate("test", "third tick")

    monkeypatch.setattr(flight_checks, "CHECKS", (*flight_checks.CHECKS, ThirdTick))
    rate_hz = load_scenario(good).time.rate_hz
    for to_violation, end_s in ((True, 3 / rate_hz), (False, 1.0)):
        result = fly_case({"extends": str(good)}, 0, to_violation=to_violation)
        assert [v.text for v in result.violations] == ["test: third tick"]
        assert result.sim_time_s == pytest.approx(end_s)


def test_cases_of_two_scenarios_have_files_of_their_own(
    good: Path, bad: Path, tmp_path: Path
) -> None:
    results = [fly_seed(SeedOptions(str(path)), 2) for path in (good, bad)]
    paths = [write_case(result, tmp_path / "out") for result in results]
    assert [path.name for path in paths] == ["good-seed-2.toml", "bad-seed-2.toml"]
    assert [load_scenario(path).success.docked for path in paths] == [(), (0,)]


@pytest.mark.slow
def test_ctrl_c_ends_flights_on_several_processes_at_once() -> None:
    """The parent alone receives the signal; a flight of ``detumble`` takes minutes."""
    arguments = ("simulate", "detumble", "--seeds", "1:20", "--jobs", "2")
    process = chaserdock(*arguments, stdout=subprocess.PIPE)
    try:
        while len(psutil.Process(process.pid).children()) < 2:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=30.0)
    finally:
        for left in (
            (*psutil.Process(process.pid).children(), process) if process.poll() is None else ()
        ):
            left.kill()
    assert process.returncode == 130
    assert out.startswith(b"0 seeds in")


@pytest.mark.slow
def test_ctrl_c_while_shrinking_writes_the_simplest_case_so_far(bad: Path, tmp_path: Path) -> None:
    arguments = ("simulate", str(bad), "--seeds", "2:5", "--out", str(tmp_path / "out"))
    process = chaserdock(*arguments, stdout=subprocess.PIPE)
    assert process.stdout is not None
    lines = iter(process.stdout.readline, b"")
    shrinking = next(line for line in lines if line.endswith(b": shrinking; Ctrl-C ends it\n"))
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30.0)
    assert process.returncode == 130
    assert b"seeds in" in out
    seed = int(shrinking.split()[1].rstrip(b":"))
    (path,) = (tmp_path / "out").iterdir()
    assert load_scenario(path).name == f"seed-{seed}"
    assert fly_case({"extends": str(path)}, seed).violations


@pytest.mark.slow
def test_regressions_are_scenarios_that_run_accepts() -> None:
    for path in (ROOT / "tests" / "regressions").glob("*.toml"):
        status, text = finished("scenario", str(path))
        assert status == 0, text


def test_refused_case_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"^unknown key duraton_s"):
        fly_case({"extends": "single", "duraton_s": 1.0}, 0, tmp_path / "case")
    assert list(tmp_path.iterdir()) == []
