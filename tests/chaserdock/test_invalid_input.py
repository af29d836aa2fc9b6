# SPDX-License-Identifier: Apache-2.0
"""Invalid command lines: one line on standard error that names the fault, status 2, nothing on
standard output.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import pytest
from chaserdock_protocol.process import SINGLE_THREADED
from harness import ROOT

from chaserdock.cli.main import main

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
NO_MISSION = "-e tcp/127.0.0.1:1"

INVALID = [
    # commands
    ("nothing", "No such command 'nothing'"),
    ("rnu", "Did you mean 'run'?"),
    ("log info x", "`chaserdock log info` is now `chaserdock log LOG`"),
    ("keys init x", "`chaserdock keys` is now `chaserdock deploy --keys FOLDER`"),
    ("--nothing", "No such option: --nothing"),
    # run
    ("run", "needs a scenario, or --like RUN"),
    ("run nowhere", "nowhere: no such scenario file or shipped scenario; shipped: abort, "),
    ("run single extra", "extra"),
    ("run single --nothing", "No such option: --nothing"),
    ("run single --mode fast", "'fast' is not one of 'lockstep', 'realtime'"),
    ("run single --seed -1", "--seed"),
    ("run single --seed 4294967296", "--seed"),
    ("run single --seed 1.5", "--seed"),
    ("run single --quiet --json", "--quiet and --json exclude each other"),
    ("run single --set duration_s", "--set duration_s"),
    ("run single --set duration_s=nan", "duration_s"),
    ("run single --set duration_s=-1", "duration_s"),
    ("run single --set \"duration_s='30'\"", "duration_s: must be a number"),
    ("run single --set camera.widht_px=640", "widht_px"),
    ("run single --set chaser.mass_kg=-3", "chaser.mass_kg"),
    ("run single --set estimator.name=magic", "estimator.name"),
    ("run single --set chasers.0.q_wxyz=[1,1,0,0]", "unit length"),
    ("run single --set name=a/b", "name"),
    (
        "run two-chaser-tracking --set chasers.1.position_m=[-1.0,0.0,0.0] --set "
        "chasers.1.start_offset_m=[-0.2,0.03,0.0]",
        "nearer than limits.min_distance_chasers_m",
    ),
    (
        "run v-bar --set orbit={{semi_major_axis_m=6.2e6}}",
        "orbit: the orbit lies inside the Earth: its perigee is 178.1 km below",
    ),
    (
        "run v-bar --set timeline.3.offset_m=[-0.5,0.0,0.0]",
        "timeline.3.offset_m: 0.5 m from the target, inside the keep-out of "
        "limits.min_distance_target_m (0.75 m)",
    ),
    (
        "run v-bar --set approach.cone_deg=40",
        "from the edge of the cone the target is 40 degrees off the view of chaser 0, whose camera "
        "sees 18 degrees",
    ),
    ("simulate single --seeds=1:3 --jobs 2 --cluster tcp://a:1", "it excludes --cluster"),
    ("simulate single --cluster tcp://a:1", "--cluster: only with --seeds"),
    ("simulate single --seeds=5:3", "must be FIRST:LAST or one number, below 2^32"),
    ("simulate single --seeds=x", "must be FIRST:LAST or one number, below 2^32"),
    ("simulate single --seeds=-1", "must be FIRST:LAST or one number, below 2^32"),
    ("simulate single --seeds=1:5000000000", "must be FIRST:LAST or one number, below 2^32"),
    ("run single --keys nowhere", "--keys nowhere"),
    # processes
    ("world nowhere", "nowhere: no such scenario file"),
    ("world single --lease -5", "--lease"),
    ("world single --rejoin-timeout -1", "--rejoin-timeout"),
    ("world single -l tcp/nonsense", "--listen tcp/nonsense: must be PROTOCOL/HOST:PORT"),
    ("chaser", "Missing argument"),
    ("chaser one", "must be a whole number"),
    ("chaser -1", "-1"),
    ("chaser 256", "less than or equal to 255"),
    ("chaser 0 --timeout nan", "--timeout"),
    ("chaser 0 --timeout -1", "--timeout"),
    ("chaser 0 --timeout inf", "'--timeout': must be a finite number"),
    ("chaser 0 --timeout soon", "--timeout"),
    ("chaser 0 --patience 1", "No such option: --patience"),
    ("chaser 0 --lease nan", "--lease"),
    ("chaser 0 --lease 0", "--lease"),
    ("chaser 0 --net-mode router", "'router' is not one of 'peer', 'client'"),
    ("chaser 0 -e nonsense", "--connect nonsense: must be PROTOCOL/HOST:PORT"),
    (
        "chaser 0 -e tcp/127.0.0.1:99999",
        "--connect tcp/127.0.0.1:99999: must be PROTOCOL/HOST:PORT",
    ),
    ("chaser 0 -e tcp/127.0.0.1:port", "--connect tcp/127.0.0.1:port"),
    ("chaser 0 -e ftp/127.0.0.1:21", "--connect ftp/127.0.0.1:21"),
    ("chaser 0 -c nowhere.json5", "--config nowhere.json5: no such file"),
    ("chaser 0 --keys nowhere", "make a mission's keys"),
    ("chaser 0 --keys nowhere -e tcp/127.0.0.1:1", "must be tls/HOST:PORT with --keys"),
    (f"chaser 0 --timeout 0.1 {NO_MISSION}", "no world answered within"),
    ("controller --timeout 0", "--timeout"),
    ("record --rotate-size 0", "--rotate-size"),
    ("record --rotate-time nan", "--rotate-time"),
    ("router --until nobody", "--until nobody: must be a process"),
    ("router -l tcp/nonsense", "--listen tcp/nonsense"),
    ("router -l tcp/203.0.113.1:7447", "Cannot assign requested address"),
    # operator
    ("command fly 0", "'fly' is not one of"),
    ("command hold 0 --offset 1 2 3", "--offset X Y Z: with goto only"),
    ("command port 0", "port: needs either --image and --pixel X Y"),
    ("command port 0 --pixel 1 2", "port: needs either --image and --pixel X Y"),
    ("command port 0 --find flat --point 1 2 3", "port: needs either --image and --pixel X Y"),
    ("command port 0 --image 1 --pixel 1 2", "--image: '1' is not chaser/N"),
    ("command hold 0 --find flat", "--find: only with port"),
    ("command port 0 --offset 1 2 3", "--offset: not with port"),
    ("command goto 0 --offset 1 2 nan", "'--offset': must be a finite number"),
    ("command goto 0 --offset 1 2", "--offset"),
    ("command isolate 0", "--thruster N: required by isolate and restore"),
    ("command isolate 0 --thruster -1", "--thruster"),
    ("command hold 0 --timeout nan", "--timeout"),
    ("command hold 0 --before nan", "--before"),
    (f"command hold 0 --timeout 0.2 {NO_MISSION}", "no reply from the controller within 0.2 s"),
    ("command thruster-fault 0 --fault loud", "'loud' is not one of"),
    ("command thruster-fault 0 --fault weak", "needs --thruster and --fault"),
    ("command thruster-fault 0 --thruster 0 --fault weak", "--factor: required by weak"),
    ("command thruster-fault 0 --factor 2", "--factor"),
    ("command thruster-fault 0 --factor nan", "--factor"),
    ("command thruster-fault 0 --before 3", "--before: not with thruster-fault"),
    ("command isolate 0 --thruster 1 --fault weak", "--fault: only with thruster-fault"),
    (f"status --duration 0.2 {NO_MISSION}", "no process found within 0.2 s"),
    ("status --duration nan", "--duration"),
    (f"judge runs --live --timeout 0.1 {NO_MISSION}", "no world answered within"),
    (f"judge {{golden}} {NO_MISSION}", "--connect: only with --live"),
    ("judge {golden} --timeout 3", "--timeout: only with --live"),
    ("judge runs --world-timeout -1", "--world-timeout"),
    ("view --at 3", "--at: needs a log"),
    ("view {golden} --at nan", "--at"),
    ("view {golden} --at 9999", "--at 9999: the log ends at 1.13 s"),
    ("view --port 0", "--port"),
    # recorded flights
    ("judge nowhere.mcap", "nowhere.mcap"),
    ("judge {toml}", "single.toml"),
    ("report nowhere", "nowhere"),
    ("report nowhere --figures --out {tmp}/figures", "nowhere"),
    ("report {golden} --figures --format gif", "'gif' is not one of 'svg', 'png', 'pdf'"),
    ("report {golden} --figures", "--out: needed with --figures and --at"),
    ("report {golden} --figures --at 1", "--figures and --at exclude each other"),
    ("report {golden} --format pdf", "--format: only with --figures"),
    ("report {golden} --width 100", "--width: only with --at"),
    ("video nowhere --out a.txt", "must end in"),
    ("video {golden} --out {tmp}/a.mp4 --speed nan", "--speed"),
    ("video {golden} --out {tmp}/a.mp4 --from inf", "'--from': must be a finite number"),
    ("video {golden} --out {tmp}/a.mp4 --width 10", "--width"),
    ("report {golden} --at nan --out {tmp}/a.png", "--at"),
    ("report {golden} --at -1 --out {tmp}/a.png", "--at"),
    ("report {golden} --at 9999 --out {tmp}/a.png", "--at 9999: the last image"),
    ("report {golden} --at 1 --out {tmp}/a.txt", "must end in .png or .jpg"),
    ("report {golden} --at 1 --out {tmp}/none/a.png", "cannot be written"),
    # logs
    ("log nowhere.mcap", "nowhere.mcap"),
    ("log", "Missing argument"),
    ("log {golden} --recover {golden}", "already exists"),
    (
        "log {golden} --export {tmp} --format xls",
        "'xls' is not one of 'parquet', 'csv', 'tum', 'rosbag2'",
    ),
    ("log {golden} --export {tmp} --format tum --from nan", "--from"),
    ("log {golden} --from 3", "--from: only with --format tum"),
    ("log {golden} --images", "--images: only with --export"),
    ("log {golden} {golden} --recover {tmp}/a", "--recover: needs one log"),
    (
        "log {golden} --export {tmp} --format tum --from 5 --to 6",
        "contains no track between 5 and 6 s",
    ),
    ("play {golden} --speed nan", "--speed"),
    ("play {golden} --timeout 0.2 -l tcp/127.0.0.1:0", "no recorder joined within 0.2 s"),
    # comparison
    ("replay nowhere --through fusion", "nowhere"),
    ("replay {golden} --through everything", "--through everything: must be one of"),
    ("replay {golden} --through fusion --tolerance nan", "--tolerance"),
    ("compare nowhere nobody", "nowhere"),
    ("compare {golden} {golden} --tolerance -1", "--tolerance"),
    ("campaign nowhere.toml", "nowhere.toml"),
    ("campaign nowhere.toml --jobs 0", "--jobs"),
    ("campaign nowhere.toml --jobs 2 --cluster tcp://a:1", "it excludes --cluster"),
    ("campaign nowhere.toml --only 0 --jobs 2", "--only flies one run"),
    ("check controller nowhere -- true", "nowhere"),
    ("check controller {golden} --timeout nan -- true", "--timeout"),
    ("check controller {golden} --ticks 0 -- true", "--ticks"),
    # preparation
    ("scenario --show", "--show: needs a scenario"),
    ("scenario single --schema", "--schema: not with a scenario"),
    ("scenario single --show --new", "--show, --new, --schema and --flight exclude each other"),
    ("scenario single swap --show", "swap: one scenario only with --show and --new"),
    ("target nothing --markers a.pdf", "nothing"),
    ("target nothing", "nothing"),
    ("target nothing --mesh a.glb", "unknown satellite 'nothing'; known: "),
    ("target geo_servicer --mesh a.png", "--mesh a.png: must end in .glb or .obj"),
    ("target paper --markers a.png", "must end in .pdf or .svg"),
    ("target paper --markers a.pdf --paper a3", "'a3' is not one of 'a4', 'letter'"),
    ("target paper --paper a4", "--paper: only with --markers"),
    ("target paper --scale 0.1", "--scale: only with a mesh file"),
    ("dataset nowhere", "nowhere"),
    ("dataset single --out {tmp}/new", "--images: needed with --out"),
    ("dataset nowhere --seed 3", "--seed: only with --out"),
    ("dataset single --out {tmp}/new --split all", "--split: not with --out"),
    ("calibrate nowhere --out a.yaml", "nowhere"),
    ("calibrate nowhere --out a.txt", "must end in .yaml, .json or .xml"),
    ("calibrate nowhere --out a.yaml --square nan", "--square"),
    ("calibrate nowhere --out a.yaml --square -0.03", "--square"),
    ("deploy --chasers 65", "--chasers 65: at most 64 without --keys"),
    ("deploy --days 3", "--days: only with --keys"),
    ("deploy --keys {tmp} --view", "--view: not with --keys"),
    ("deploy --keys {tmp} --chasers 0", "--chasers"),
    ("deploy --keys {tmp} --days 1.5", "--days"),
]


@pytest.mark.parametrize(("line", "fragment"), INVALID, ids=[line for line, _ in INVALID])
def test_invalid_input_is_one_line_with_status_2(
    line: str,
    fragment: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    for name, value in SINGLE_THREADED.items():  # `replay` sets these for the whole process
        monkeypatch.setenv(name, value)
    names = {"golden": GOLDEN, "tmp": tmp_path, "toml": ROOT / "scenarios" / "single.toml"}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["chaserdock", *shlex.split(line.format(**names))])
    with pytest.raises(SystemExit) as ended:
        main()
    out, error = capfd.readouterr()
    assert ended.value.code == 2
    assert out == ""
    assert len(error.splitlines()) == 1, error
    assert fragment in error
    assert "Traceback" not in error
    assert ".rs:" not in error


def test_one_line_per_fault_of_a_scenario(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    sets = ["--set", "duration_s=-1", "--set", "camera.width_px=0"]
    monkeypatch.setattr(sys, "argv", ["chaserdock", "run", "single", *sets])
    with pytest.raises(SystemExit) as ended:
        main()
    lines = capfd.readouterr().err.splitlines()
    assert ended.value.code == 2
    assert len(lines) == 2
    assert "duration_s" in lines[0]
    assert "camera.width_px" in lines[1]
