# SPDX-License-Identifier: Apache-2.0
"""The Python API: runs, logs, scenarios, errors; no output and no signal handlers."""

from __future__ import annotations

import importlib.util
import json
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import pyarrow
import pytest
from chaserdock_protocol.messages import TargetEstimate
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.scenario import ScenarioError, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock_protocol.transport import TransportError
from harness import ROOT

import chaserdock as cd
from chaserdock.analysis.criteria import judged_criteria
from chaserdock.analysis.summary import summarize
from chaserdock.api import override_texts
from chaserdock.launch import launcher

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
CAPTURE = ROOT / "tests" / "golden" / "capture.mcap"
SMALL = {
    "camera": {"width_px": 480, "height_px": 270},
    "settling_s": 2.0,
}


def test_import_is_light() -> None:
    heavy = ["zenoh", "pybullet", "cv2", "numpy", "pydantic", "pyarrow", "typer", "rich", "casadi"]
    program = f"import sys, chaserdock; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


def test_public_names_exist() -> None:
    for name in cd.__all__:
        assert getattr(cd, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = cd.nothing  # type: ignore[attr-defined]


@pytest.mark.slow
def test_run_from_a_thread_prints_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
    results: list[cd.RunResult] = []
    events: list[object] = []

    def fly() -> None:
        results.append(
            cd.run(
                "single",
                out=tmp_path / "run",
                seed=3,
                duration_s=3.0,
                on_event=events.append,
                **SMALL,
            )
        )

    thread = threading.Thread(target=fly)
    thread.start()
    thread.join(240)
    (result,) = results
    assert result.dir == tmp_path / "run"
    assert result.summary.sim_time_s == 3.0
    assert result.summary.seed == 3
    assert result.summary.chasers[0].docked is False
    assert result.summary.chasers[0].steady.position_mse_m2 is not None
    assert result.log.scenario.camera.width_px == 480
    assert json.loads((result.dir / "summary.json").read_text())["digest"] == result.summary.digest
    kinds = [type(event).__name__ for event in events]
    assert (kinds[0], kinds[-1]) == ("Start", "Result")
    assert [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)] == before
    assert capfd.readouterr() == ("", "")


_INTERRUPTED = """
import signal, sys, chaserdock as cd
# A background shell starts programs with SIGINT ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    show = lambda event: print(type(event).__name__, flush=True)
    cd.run("single", out=sys.argv[1], on_event=show)
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.slow
def test_keyboard_interrupt_ends_all_processes(tmp_path: Path) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", _INTERRUPTED, str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert program.stdout is not None
    assert program.stdout.readline() == "Start\n"
    children: list[psutil.Process] = []
    deadline = time.monotonic() + 60
    while len(children) < 4 and time.monotonic() < deadline:  # world, chaser, controller, recorder
        time.sleep(0.1)
        children = psutil.Process(program.pid).children(recursive=True)
    assert len(children) >= 4
    time.sleep(0.5)
    program.send_signal(signal.SIGINT)
    assert program.stdout.read().endswith("interrupted\n")
    assert program.wait(timeout=30) == 0
    assert not [child for child in children if child.is_running() and child.status() != "zombie"]


def test_interrupt_while_a_process_starts_leaves_none_running(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal arrives when the process exists, but is not yet in the list of those to end."""

    class Interrupted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(launcher.subprocess, "Popen", Interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    fleet = launcher.Fleet()
    try:
        with pytest.raises(KeyboardInterrupt):
            fleet.start("world", ["world", "single"], tmp_path)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
        fleet.end()
    assert [child.process.poll() is not None for child in fleet.children] == [True]


def test_errors_are_exceptions_with_the_text_of_the_command_line(tmp_path: Path) -> None:
    with pytest.raises(
        cd.ChaserdockError,
        match=r"nowhere: no such scenario file or shipped scenario; .*shipped: abort",
    ):
        cd.run("nowhere")
    with pytest.raises(ScenarioError, match=r"^camera\.widht_px=640: unknown key camera\.widht_px"):
        cd.run("single", out=tmp_path / "run", camera={"widht_px": 640})
    assert not (tmp_path / "run").exists()
    with pytest.raises(
        cd.ChaserdockError, match="camera: a value of type set cannot be set in a scenario"
    ):
        cd.load_scenario("single", camera={1, 2})
    with pytest.raises(LogError, match="nowhere"):
        cd.open_log(tmp_path / "nowhere")
    (tmp_path / "mission.mcap").write_bytes(b"")
    with pytest.raises(cd.ChaserdockError, match="a log is never overwritten"):
        cd.run("single", out=tmp_path)


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        ({"duraton_s": 20}, "duraton_s=20: unknown key duraton_s; did you mean duration_s"),
        ({"overrides": {"name.x": 1}}, "name.x=1: name is a value"),
        ({"overrides": {"chasers.9.position_m": 1}}, "9 must be a number from 0 to 0"),
        ({"camera": {"calibration": "none.yaml"}}, 'camera.calibration="none.yaml": '),
        ({"mode": "fast"}, "mode 'fast': must be one of lockstep, realtime"),
        ({"stall_s": 0.0}, "stall_s 0.0: must be at least 1 s"),
        ({"keys": "none"}, "keys none: it contains no keys"),
    ],
)
def test_errors_of_python_speak_python(
    refused: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(cd.ChaserdockError, match=re.escape(message)) as caught:
        cd.run("single", out=tmp_path / "a" / "run", **refused)
    assert not re.search(r"--(set|out|keys|mode|stall-s)\b", str(caught.value).split(";")[0])
    assert list(tmp_path.iterdir()) == []


def test_every_documented_error_is_a_public_name() -> None:
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    named = set(re.findall(r"\b[A-Z][A-Za-z]*Error\b", text))
    assert {"ScenarioError", "LogError", "RunError"} <= named
    for name in named:
        assert issubclass(getattr(cd, name), cd.ChaserdockError), name
    with pytest.raises(cd.ScenarioError, match="no such scenario file"):
        cd.load_scenario("nowhere")
    with pytest.raises(cd.ScenarioError, match="a value of type set"):
        cd.load_scenario("single", camera={1})


@pytest.mark.parametrize("beside", [False, True])
def test_mission_that_cannot_start_leaves_no_folder(
    beside: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_hub(*_: Any, **__: Any) -> Any:
        if beside:  # another mission has begun to use the folder of runs meanwhile
            (tmp_path / "runs" / "other").mkdir()
        raise TransportError("no free port")

    monkeypatch.setattr("chaserdock.launch.launcher.open_hub", no_hub)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(cd.RunError, match="no free port"):
        cd.run("single")
    left = [path.relative_to(tmp_path) for path in tmp_path.rglob("*")]
    assert sorted(map(str, left)) == (["runs", "runs/other"] if beside else [])


def test_overrides_are_keywords_or_dotted_keys() -> None:
    by_keyword = cd.load_scenario(
        "four-chaser-docking",
        duration_s=20,
        camera={"width_px": 640, "height_px": 480},
        seed=np.int64(7),
    )
    by_key = cd.load_scenario(
        Path("scenarios") / "four-chaser-docking.toml"
        if Path("scenarios").is_dir()
        else "four-chaser-docking",
        overrides={"duration_s": 20.0, "camera.width_px": 640, "camera.height_px": 480, "seed": 7},
    )
    assert by_keyword == by_key
    assert by_keyword.camera.width_px == 640
    assert by_keyword.controller == cd.load_scenario("four-chaser-docking").controller


def test_override_values_in_toml() -> None:
    changes: dict[str, object] = {
        "a": {"b": 1, "c": {"d": [1.5, float("nan")]}},
        "e": True,
        "f": 'quote " and \\',
        "g": {},
        "h": ({"x": np.float64(2.0)},),
        "i": Path("p/q"),
    }
    assert override_texts({"k.l": -3}, changes) == (
        "a.b=1",
        "a.c.d=[1.5, nan]",
        "e=true",
        'f="quote \\" and \\\\"',
        "g={}",
        'h=[{"x" = 2.0}]',
        'i="p/q"',
        "k.l=-3",
    )


def test_open_log_takes_text_and_path_file_and_folder(tmp_path: Path) -> None:
    (tmp_path / "mission.mcap").write_bytes(GOLDEN.read_bytes())
    for source in (str(GOLDEN), GOLDEN, str(tmp_path), [str(GOLDEN)]):
        log = cd.open_log(source)
        table = log.table("controller/target")
        assert isinstance(table, pyarrow.Table)
        assert table.num_rows == 18
    estimates = list(log.messages(TargetEstimate))
    assert estimates[0].position_m[0] == table["position_m_x"][0].as_py()
    if importlib.util.find_spec("pandas"):
        assert list(table.to_pandas()["position_m_x"]) == [e.position_m[0] for e in estimates]
    with pytest.raises(LogError, match="no topic has messages of this type"):
        log.messages(msgspec.Struct)


@pytest.mark.parametrize("log", [GOLDEN, CAPTURE], ids=lambda path: path.stem)
def test_typed_summary_has_every_field(log: Path) -> None:
    plain = summarize(log)
    typed = cd.Summary.from_dict(plain)
    # Fields with a default are left out when they have it.
    assert msgspec.to_builtins(typed, str_keys=True) == {
        key: value
        for key, value in plain.items()
        if key not in ("peak_memory_bytes", "cpu_s")
        and (key, value)
        not in (
            ("drawn", []),
            ("doubts", []),
            ("log_lacks", []),
            ("impulses_are", "true"),
        )
    }


def test_list_scenarios() -> None:
    assert "single" in cd.list_scenarios()
    assert cd.list_scenarios() == sorted(cd.list_scenarios())


def test_a_full_flight_is_judged_by_every_criterion() -> None:
    for name in cd.list_scenarios():
        scenario = cd.load_scenario(name)
        judged, skipped = judged_criteria(scenario)
        assert (judged, skipped) == (scenario, []), name


def test_a_shortened_flight_is_judged_by_what_it_contains() -> None:
    path = find_scenario("four-chaser-docking")
    scenario = load_scenario(path, ("duration_s=20.0", "settling_s=20.0"))
    judged, skipped = judged_criteria(scenario)
    assert judged.success.docked == ()
    assert judged.success.keep_distances == scenario.success.keep_distances
    assert sum("success.docked" in line for line in skipped) == len(scenario.success.docked) > 0
    longer, skipped = judged_criteria(load_scenario(path, ("settling_s=20.0",)))
    assert longer.success.docked == scenario.success.docked
    assert skipped == []


def test_packages_are_typed() -> None:
    folders = [ROOT / "chaserdock", *ROOT.glob("*/chaserdock_*")]
    packages = [f for f in folders if (f / "__init__.py").exists()]
    assert len(packages) == 6
    assert all((package / "py.typed").exists() for package in packages)
