"""The program as scripts and shells meet it: statuses, JSON lines, help that loads nothing, completion, docs/cli.md."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import pytest
from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.shipped_scenarios import shipped_names
from harness import ROOT, SHORT, chaserdock, finished, sets
from typer.main import get_command

from chaserdock.cli.main import app, main
from chaserdock.cli.plain import PlainGroup
from chaserdock.launch.json_events import Commanded, Failed, Line, Progress, Result, Start, Told


def verbs(group: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every verb, such as ``("log", "info")``."""
    for name, command in group.commands.items():
        if isinstance(command, PlainGroup):
            yield from verbs(command, (*above, name))
        else:
            yield (*above, name)


VERBS = list(verbs(get_command(app)))
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
told = {}
for path in json.loads(sys.argv[1]):
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        app([*path, "--help"])
    told[" ".join(path)] = out.getvalue()
loaded = sorted(name for name in json.loads(sys.argv[2]) if name in sys.modules)
print(json.dumps({"told": told, "loaded": loaded}))
"""


def test_help_of_every_verb_loads_nothing_heavy() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _LOADED_BY_HELP, json.dumps([[], *VERBS]), json.dumps(HEAVY)],
        capture_output=True,
        text=True,
        check=True,
    )
    result = json.loads(done.stdout)
    assert result["loaded"] == []
    assert len(result["told"]) == len(VERBS) + 1
    for path, text in result["told"].items():
        assert text.startswith(f"Usage: {path}".rstrip()) or f" {path} " in text.splitlines()[0], path
        assert "--help" in text


def test_version() -> None:
    assert finished("--version") == (0, f"chaserdock {metadata.version('chaserdock')}\n")


def test_a_reader_that_leaves_is_no_error() -> None:
    golden = str(ROOT / "tests" / "golden" / "two-chasers.mcap")
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = chaserdock("compare", golden, golden, env={"PYTHONUNBUFFERED": ""}, **pipes)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()  # as head does, while the text is still buffered
    assert process.stderr.read() == b""
    process.wait()


def test_the_page_is_up_to_date() -> None:
    command = [sys.executable, str(ROOT / "docs" / "make_cli.py"), "--print"]
    made = subprocess.run(command, capture_output=True, text=True, check=True, encoding="utf-8").stdout
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    assert page == made, "run: python docs/make_cli.py"
    for path in VERBS:
        assert f"\n### {' '.join(path)}\n" in page


def completed(*words: str) -> list[str]:
    """What the shell is offered for the last word."""
    env = {
        **os.environ,
        "_CHASERDOCK_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }
    program = "from chaserdock.cli.main import app; app(prog_name='chaserdock')"
    done = subprocess.run(
        [sys.executable, "-c", program], env=env, cwd=ROOT, capture_output=True, text=True, check=False
    )
    return done.stdout.split()


def test_completion() -> None:
    assert {"run", "report", "replay"} <= set(completed("chaserdock", "r"))
    assert completed("chaserdock", "run", "four") == [n for n in shipped_names() if n.startswith("four")]
    assert completed("chaserdock", "run", "scenarios/sin") == [
        "scenarios/single-thrusters.toml",
        "scenarios/single.toml",
    ]
    assert completed("chaserdock", "command", "ab") == ["abort"]
    assert completed("chaserdock", "log", "rec") == ["recover"]


def lines_of(out: str) -> list[Line]:
    return [msgspec.json.decode(line, type=Line, strict=True) for line in out.splitlines()]


def flown(*arguments: str, **options: Any) -> tuple[int, list[Line], str]:
    """Status, JSON lines and standard error of a run."""
    process = chaserdock(*arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
    out, error = process.communicate(timeout=300)
    return process.returncode, lines_of(out.decode()), error.decode()


@pytest.mark.slow
def test_run_tells_scripts_the_whole_flight(tmp_path: Path) -> None:
    out = tmp_path / "run"
    status, lines, error = flown("run", "single", "--json", "--out", str(out), *sets(*SHORT))
    assert isinstance(lines[0], Start)
    assert (lines[0].scenario, lines[0].chasers, lines[0].duration_s) == ("single", 1, 6.0)
    last = lines[-1]
    assert isinstance(last, Result)
    assert status == last.status == (0 if last.summary["success"] else 1)
    assert last.summary == json.loads((out / "summary.json").read_text())
    told = [line for line in lines if isinstance(line, Told | Commanded)]
    assert any(isinstance(t, Told) and t.what == "initialised by chaser 0" for t in told)
    progress = [line for line in lines if isinstance(line, Progress)]
    assert progress
    assert progress[-1].tick == 89
    assert progress[-1].target == "tracking"
    assert [c.chaser for c in progress[-1].chasers] == [0]
    assert [p.sim_time_s for p in progress] == sorted(p.sim_time_s for p in progress)
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["run", "nowhere"], 2, "no such scenario file"),
        (["run", "single", "--set", "duration_s='30'"], 2, "duration_s: must be a number (got '30')"),
        (["run", "single", "--quiet", "--json"], 2, "one or the other"),
        (["run"], 2, "Missing argument"),
        (["run", "single", "--mode", "fast"], 2, "lockstep"),
        (["nothing"], 2, "No such command"),
        (["summary", "nowhere.mcap"], 2, "nowhere.mcap"),
        (["log", "info", "nowhere.mcap"], 2, "nowhere.mcap"),
        (["compare", "nowhere", "nobody"], 2, "nowhere"),
        (["replay", "nowhere", "--through", "fusion"], 2, "nowhere"),
        (["report", "nowhere"], 2, "nowhere"),
        (["video", "nowhere", "--out", "a.txt"], 2, "must end in"),
        (["campaign", "nowhere.toml"], 2, "nowhere.toml"),
        (["command", "goto", "0"], 2, "--offset"),
        (["status", "-e", "tcp/127.0.0.1:1", "--seconds", "0.3"], 2, "nobody is there"),
        (["markers", "nothing", "--out", "a.pdf"], 2, "nothing"),
        (["calibrate", "nowhere", "--out", "a.yaml"], 2, "nowhere"),
        (["check", "controller", "nowhere", "--", "true"], 2, "nowhere"),
        (["keys", "init"], 2, "Missing argument"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_input_ends_with_status_2_and_says_why(
    arguments: list[str],
    status: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    for name, value in SINGLE_THREADED.items():  # `replay` sets these for good
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "argv", ["chaserdock", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    out, error = capfd.readouterr()
    assert said in error
    assert ended.value.code == status
    assert out == ""


def test_errors_are_told_to_scripts_too() -> None:
    status, lines, error = flown("run", "nowhere", "--json")
    assert status == 2
    assert lines == [Failed(status=2, text=lines[0].text)]  # type: ignore[union-attr]
    assert "no such scenario file" in error
