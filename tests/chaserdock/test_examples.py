# SPDX-License-Identifier: Apache-2.0
"""The examples of docs/extend.md fly: a perception plugin, a solver plugin, and a foreign
controller.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from chaserdock_agents.gateway.devices import (
    DeviceError,
    DeviceHost,
    RobotCommand,
    open_device,
)
from chaserdock_controller.estimation.estimators import make_estimator
from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT, ByHand, finished, install_example, run, sets, summary
from joint_cases import SyntheticFlight, navigation

EXAMPLES = ROOT / "examples"
FOREIGN = EXAMPLES / "foreign_controller" / "foreign_controller.py"
SHORT = ("duration_s=30.0", "settling_s=22.0", "camera.width_px=640", "camera.height_px=360")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "part"),
    [
        ("own_perception", ("perception.name=own", "target.model=servicer")),
        # A PD law is less accurate under sensor errors than the NMPC.
        (
            "pd_controller",
            (
                "controller.solver=pd",
                "success.steady_position_rms_m=0.02",
                "success.steady_orientation_rms_deg=1.0",
            ),
        ),
    ],
)
def test_plugin_flies_to_success(example: str, part: tuple[str, ...], tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    parts.mkdir()
    env = install_example(EXAMPLES / example, parts)
    status, said = run("single", tmp_path / "run", *SHORT, *part, env=env, arguments=["--quiet"])
    assert status == 0, said
    assert summary(tmp_path / "run")["success"]


def test_missing_plugin_is_named(tmp_path: Path) -> None:
    status, said = run("single", tmp_path, "controller.solver=pd", timeout_s=60)
    assert status != 0
    assert "'pd'" in said
    assert "chaserdock.solvers" in said


@pytest.fixture
def udp_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Install the driver; return the socket of its robot."""
    install_example(EXAMPLES / "own_driver", tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.settimeout(30.0)
        robot.bind(("127.0.0.1", 0))
        yield robot
    sys.modules.pop("own_driver", None)


def test_own_driver_is_found_and_its_robot_gets_what_is_commanded(
    udp_driver: socket.socket,
) -> None:
    address = f"udp:127.0.0.1:{udp_driver.getsockname()[1]}"
    device = open_device("robot", address, {"thrusters": 2}, DeviceHost(time.monotonic_ns))

    def answer(armed: bool) -> None:
        asked, sender = udp_driver.recvfrom(1024)
        assert json.loads(asked) == {"arm": True}
        udp_driver.sendto(json.dumps({"armed": armed}).encode(), sender)

    for armed in (False, True):
        thread = threading.Thread(target=answer, args=(armed,))
        thread.start()
        with contextlib.nullcontext() if armed else pytest.raises(DeviceError, match="refuses"):
            device.arm()
        thread.join()
    force, torque, duty = np.array([0.1, -0.2, 0.3]), np.array([0.4, -0.5, 0.6]), np.array([0, 0.7])
    device.send(RobotCommand(1, force, torque, duty))
    device.close()
    read = [json.loads(udp_driver.recv(1024)) for _ in range(3)]
    assert read == [
        {"force_N": [0.1, -0.2, 0.3], "torque_N_m": [0.4, -0.5, 0.6], "duty": [0.0, 0.7]},
        {"force_N": [0.0] * 3, "torque_N_m": [0.0] * 3, "duty": [0.0] * 2},
        {"arm": False},
    ]


def test_own_driver_says_what_is_wrong_in_one_line(udp_driver: socket.socket) -> None:
    host = DeviceHost(time.monotonic_ns)
    with pytest.raises(DeviceError, match=r"robot 'udp:here': must be udp:HOST:PORT"):
        open_device("robot", "udp:here", {}, host)
    address = f"udp:127.0.0.1:{udp_driver.getsockname()[1]}"
    with pytest.raises(DeviceError, match="no other option than thrusters"):
        open_device("robot", address, {"rate": 3}, host)
    udp_driver.close()
    device = open_device("robot", address, {}, host)
    with pytest.raises(DeviceError, match="no answer to arming"):
        device.arm()
    device.close()


def test_estimator_of_the_docs_ignores_few_markers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "three_markers.py").write_text(code)
    info = tmp_path / "three_markers-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: three-markers\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[chaserdock.estimators]\nthree = three_markers:ThreeMarkers\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    scenario = load_scenario(ROOT / "scenarios/single.toml", ("estimator.name=three",))
    estimator = make_estimator("three", scenario)
    flight = SyntheticFlight(scenario, navigation("lab"), 1, 0)
    inputs = flight.inputs()
    few = tuple(msgspec.structs.replace(s, marker_ids=(0, 1)) for s in inputs.sightings)
    blind = estimator.update(dataclasses.replace(inputs, sightings=few))
    assert blind.target.status == "none"
    flight.step()
    found = estimator.update(flight.inputs())
    assert found.target.status == "tracking"
    assert np.linalg.norm(found.target.position_m - flight.target[:3]) < 0.01
    assert [m.chaser for m in found.chasers] == [0]


def test_foreign_controller_imports_only_zenoh_and_msgpack() -> None:
    tree = ast.parse(FOREIGN.read_text())
    names = {alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names}
    assert not [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    assert names - sys.stdlib_module_names == {"zenoh", "msgpack"}
    assert "importlib" not in names
    assert "__import__" not in FOREIGN.read_text()


@pytest.mark.slow
def test_foreign_controller_flies_to_success(tmp_path: Path) -> None:
    """Criteria of its own: a PD law and an alpha-beta filter are not as good as what they
    replace.
    """
    criteria = (
        "success.steady_position_rms_m=0.03",
        "success.steady_orientation_rms_deg=2.0",
        "success.max_estimate_orientation_deg=2.0",
    )
    hand, out = ByHand.at_free_port("foreign"), tmp_path / "run"
    words = (tmp_path / "foreign.txt").open("wb")
    try:
        hand.start("world", "world", str(ROOT / "scenarios/single.toml"), *sets(*SHORT, *criteria))
        hand.start("chaser", "chaser", "0")
        hand.start("recorder", "record", "--out", str(out))
        command = [sys.executable, "-I", str(FOREIGN), hand.endpoint, hand.namespace]
        hand.processes["foreign"] = subprocess.Popen(
            command, cwd=tmp_path, env={**os.environ, **SINGLE_THREADED}, stdout=words, stderr=words
        )
        status, said = hand.output_of("world", timeout_s=300)
        assert status == 0, said
        assert hand.output_of("recorder")[0] == 0
        assert hand.processes["foreign"].wait(timeout=30) == 0, (
            tmp_path / "foreign.txt"
        ).read_text()
    finally:
        hand.end()
        words.close()
    status, said = finished("judge", str(out))
    assert status == 0, said
