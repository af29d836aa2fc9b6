# SPDX-License-Identifier: Apache-2.0
"""The command line: statuses, JSON lines, help without heavy imports, completion, docs/cli.md."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import pytest
from chaserdock_protocol.shipped_scenarios import shipped_names
from harness import ROOT, SHORT, chaserdock, finished, sets
from typer.main import get_command

from chaserdock.cli.main import app
from chaserdock.cli.renamed import RENAMED, renamed
from chaserdock.launch.json_events import (
    CommandNotice,
    EventNotice,
    Failed,
    JsonLine,
    Progress,
    Result,
    Start,
)
from chaserdock.launch.launcher import free_port
from chaserdock.launch.mission_address import ADDRESS_FILE

COMMANDS = list(get_command(app).commands)  # type: ignore[attr-defined]
HEAVY = (
    "cv2",
    "casadi",
    "viser",
    "matplotlib",
    "numba",
    "numpy",
    "pydantic",
    "pybullet",
    "rich",
    "zenoh",
    "av",
)

_LOADED_BY_HELP = """
import contextlib, io, json, sys
from chaserdock.cli.main import app
printed = {}
for path in json.loads(sys.argv[1]):
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        app([*path, "--help"])
    printed[" ".join(path)] = out.getvalue()
loaded = sorted(name for name in json.loads(sys.argv[2]) if name in sys.modules)
print(json.dumps({"printed": printed, "loaded": loaded}))
"""


def test_help_imports_no_heavy_module() -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            _LOADED_BY_HELP,
            json.dumps([[], *([name] for name in COMMANDS)]),
            json.dumps(HEAVY),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    result = json.loads(done.stdout)
    assert result["loaded"] == []
    assert len(result["printed"]) == len(COMMANDS) + 1
    for path, text in result["printed"].items():
        assert text.startswith(f"Usage: {path}".rstrip()) or f" {path} " in text.splitlines()[0], (
            path
        )
        assert "-h, --help" in text


def test_help_lists_every_command_in_its_group() -> None:
    status, text = finished("-h")
    assert status == 0
    sections = ["Fly", "Processes", "Operate", "Look at a flight", "Compare"]
    sections += ["Laboratory", "Prepare"]
    assert [
        line.rstrip(":") for line in text.splitlines() if re.match(r"[A-Z][a-z ]+:$", line)
    ] == [
        "Options",
        *sections,
    ]
    for name in COMMANDS:
        assert re.search(rf"^  {name}  ", text, re.MULTILINE), name


def test_there_are_at_most_thirty_commands() -> None:
    """With those to come; and a command that was renamed says so in one line."""
    assert len({*COMMANDS, "track", "gateway", "mapper", "demo"}) <= 30
    for old, new in RENAMED.items():
        assert new.split()[0] in COMMANDS
        assert old not in COMMANDS
        assert (
            renamed([*old.split(), "anything"]) == f"`chaserdock {old}` is now `chaserdock {new}`"
        )
    assert renamed(["log", "runs/first"]) is None
    status, said = finished("summary", "anything", "--json")
    assert (status, said) == (2, "chaserdock: `chaserdock summary` is now `chaserdock judge LOG`\n")


def test_version() -> None:
    assert finished("--version") == (0, f"chaserdock {metadata.version('chaserdock')}\n")


def test_a_full_disk_under_standard_output_is_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        process = chaserdock("scenario", stdout=full, stderr=subprocess.PIPE, text=True)
        _, errors = process.communicate()
    assert (process.returncode, errors) == (
        2,
        "chaserdock: standard output: No space left on device\n",
    )


def test_closed_pipe_is_no_error() -> None:
    golden = str(ROOT / "tests" / "golden" / "two-chasers.mcap")
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = chaserdock("compare", golden, golden, env={"PYTHONUNBUFFERED": ""}, **pipes)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()  # as head does, while the text is still buffered
    assert process.stderr.read() == b""
    process.wait()


def test_cli_page_is_up_to_date() -> None:
    command = [sys.executable, str(ROOT / "docs" / "make_cli.py"), "--print"]
    made = subprocess.run(
        command, capture_output=True, text=True, check=True, encoding="utf-8"
    ).stdout
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    assert page == made, "run: python docs/make_cli.py"
    for name in COMMANDS:
        assert f"\n### {name}\n" in page


def completed(*words: str) -> list[str]:
    """Return what the shell offers for the last word."""
    env = {
        **os.environ,
        "_CHASERDOCK_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }
    program = "from chaserdock.cli.main import app; app(prog_name='chaserdock')"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=env,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.split()


def test_completion() -> None:
    assert {"run", "report", "replay"} <= set(completed("chaserdock", "r"))
    assert completed("chaserdock", "run", "four") == [
        n for n in shipped_names() if n.startswith("four")
    ]
    assert completed("chaserdock", "run", "scenarios/sin") == [
        "scenarios/single-thrusters.toml",
        "scenarios/single.toml",
    ]
    assert completed("chaserdock", "command", "ab") == ["abort"]
    assert completed("chaserdock", "scenario", "swa") == ["swap", "swarm-64"]


def lines_of(out: str) -> list[JsonLine]:
    return [msgspec.json.decode(line, type=JsonLine, strict=True) for line in out.splitlines()]


def flown(*arguments: str, **options: Any) -> tuple[int, list[JsonLine], str]:
    """Return status, JSON lines and standard error of a run."""
    process = chaserdock(*arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
    out, error = process.communicate(timeout=300)
    return process.returncode, lines_of(out.decode()), error.decode()


@pytest.mark.slow
def test_run_prints_json_lines_for_the_whole_flight(tmp_path: Path) -> None:
    out = tmp_path / "run"
    status, lines, error = flown("run", "single", "--json", "--out", str(out), *sets(*SHORT))
    assert isinstance(lines[0], Start)
    assert (lines[0].scenario, lines[0].chasers, lines[0].duration_s) == ("single", 1, 6.0)
    last = lines[-1]
    assert isinstance(last, Result)
    assert status == last.status == (0 if last.summary["success"] else 1)
    assert last.summary == json.loads((out / "summary.json").read_text())
    notices = [line for line in lines if isinstance(line, EventNotice | CommandNotice)]
    assert any(
        isinstance(n, EventNotice) and n.what.startswith("initialised by chaser 0") for n in notices
    )
    progress = [line for line in lines if isinstance(line, Progress)]
    assert progress
    assert progress[-1].tick == 89
    assert progress[-1].target == "tracking"
    assert [c.chaser for c in progress[-1].chasers] == [0]
    assert [p.sim_time_s for p in progress] == sorted(p.sim_time_s for p in progress)
    assert "Traceback" not in error


def test_commands_reach_a_mission_by_its_folder_and_by_its_address(tmp_path: Path) -> None:
    out, port = tmp_path / "run", free_port()
    mission = chaserdock(
        *("run", "single", "--out", str(out), "--port", str(port), "--namespace", "berth"),
        *sets(*SHORT, "duration_s=60.0"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        deadline = time.monotonic() + 60.0
        while not (out / ADDRESS_FILE).exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        by_folder = ("--run", str(out))
        by_address = ("-e", f"tcp/127.0.0.1:{port}", "--namespace", "berth")
        for what, where in (("hold", by_folder), ("abort", by_address)):
            status, output = 1, "refused: the target has not been found yet"
            while "not been found yet" in output and time.monotonic() < deadline:
                status, output = finished("command", what, "0", *where, "--timeout", "60")
            assert (status, output.split(":")[0]) == (0, "accepted"), output
    finally:
        mission.send_signal(signal.SIGINT)
        _, error = mission.communicate(timeout=60)
    assert f"-e tcp/127.0.0.1:{port} --namespace berth" in error.decode()
    status, output = finished("command", "hold", "0", *by_folder)
    assert status == 2
    assert ADDRESS_FILE in output  # removed at the end of the mission


def test_run_excludes_another_address(tmp_path: Path) -> None:
    status, output = finished("status", "--run", str(tmp_path), "--namespace", "other")
    assert (status, "--run excludes" in output) == (2, True)


def test_run_refuses_a_port_in_use(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        status, output = finished(
            "run", "single", "--out", str(tmp_path / "run"), "--port", str(port)
        )
    assert status == 2
    assert output == f"chaserdock: port {port}: Address already in use; choose another port\n"
    assert not (tmp_path / "run").exists()


def test_error_is_the_last_json_line() -> None:
    status, lines, error = flown("run", "nowhere", "--json")
    assert status == 2
    assert lines == [Failed(status=2, text=lines[0].text)]  # type: ignore[union-attr]
    assert "no such scenario file" in error
