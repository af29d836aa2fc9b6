# SPDX-License-Identifier: Apache-2.0
"""Whole flights of the unmodified flight software on a virtual laboratory, by the gateway."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.gateway import own_camera
from chaserdock_protocol.process import ProcessOptions
from virtual_lab import SCENARIO, SENT, Fault, fly, tracking_errors_m, two_free_flyers

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.identification.fit import identify
from chaserdock.launch.twin import twin_of
from chaserdock.simulation.mission import SimulatedFlight


def flown(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    seed: int = 1,
    faults: tuple[Any, ...] = (),
    seconds: float = 40.0,
    cameras: bool = True,
    **others: Any,
) -> tuple[SimulatedFlight, Any]:
    scenario = tmp_path / "lab.toml"
    text = SCENARIO.replace("duration_s = 40.0", f"duration_s = {seconds}")
    scenario.write_text(text if cameras else text.partition("[[lab.camera]]")[0])
    lab = two_free_flyers(seed, faults)
    return fly(scenario, tmp_path / "run", lab, monkeypatch, **others), lab


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_free_flyers_track_the_target(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, lab = flown(tmp_path, monkeypatch, seed)
    assert not flight.crashes
    assert set(flight.statuses.values()) == {0}
    for errors in tracking_errors_m(lab, 28.0).values():
        assert np.sqrt(np.mean(errors**2)) < 1e-3
    assert "disarmed" not in flight.output
    assert "no odometry" not in flight.output
    judged = summary_of(load_flight(flight.folder / "mission.mcap"))
    assert judged["success"] is True
    for chaser in judged["chasers"].values():
        assert chaser["steady"]["position_mse_m2"] < 2e-3**2
    twin = twin_of(flight.folder)  # starts when the robots are armed, at rest
    for own, offset_m in zip(twin.chasers, ((-0.2, 0.065, 0.0), (-0.015, -0.2, 0.02)), strict=True):
        assert np.linalg.norm(np.subtract(own.start_offset_m, offset_m)) < 0.01
        assert np.linalg.norm(own.start_velocity_m_s) < 3e-3
    assert np.linalg.norm(np.degrees(twin.target.omega_rad_s) - [0.0, 0.0, 3.0]) < 0.1


@pytest.mark.slow(2)
def test_a_flight_identifies_its_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By forces that are given as commanded, with motion capture of other noise than stated."""
    scenario = tmp_path / "lab.toml"
    scenario.write_text(SCENARIO)
    lab = two_free_flyers(4)
    lab.mass_kg, lab.inertia = 33.0, np.array([0.19, 0.15, 0.28])
    flight = fly(scenario, tmp_path / "run", lab, monkeypatch)
    true = {"mass": 33.0, "Ixx": 0.19, "Iyy": 0.15, "Izz": 0.28}
    for chaser in (0, 1):
        found = identify(flight.folder / "mission.mcap", chaser)
        values = {q.name: q for q in found.quantities}
        for name, value in true.items():
            assert values[name].known
            assert values[name].value == pytest.approx(value, rel=0.03)
        assert values["mass"].value == pytest.approx(33.0, rel=1e-3)
        # Its thrust follows a command with a time constant of 20 ms, which is no pure delay.
        assert values["delay"].value == pytest.approx(0.02, abs=0.004)
        assert found.robot.free_s < 40.0 - 0.4  # it was armed after the start


@pytest.mark.slow
def test_images_need_not_leave_the_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def with_camera(options: ProcessOptions) -> int:
        address = f"virtual:{options.chaser}"
        return own_camera.main(replace(options, camera=address, camera_latency_s=0.02))

    both: dict[str, Any] = {"chaser/0": with_camera, "chaser/1": with_camera}
    flight, lab = flown(tmp_path, monkeypatch, cameras=False, **both)
    assert not flight.crashes
    assert set(flight.statuses.values()) == {0}
    log = load_flight(flight.folder / "mission.mcap")
    assert summary_of(log)["success"] is True
    for errors in tracking_errors_m(lab, 28.0).values():
        assert np.sqrt(np.mean(errors**2)) < 1e-3


def test_nothing_moves_unless_it_is_armed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight, _ = flown(tmp_path, monkeypatch, seconds=3.0, operator=lambda options: 0)
    assert not flight.crashes
    assert SENT == []
    assert flight.statuses["world"] == 0


FAULTS = {
    "motion capture frozen": "chaser 0: odometry lost",
    "motion capture jumps": "chaser 0: odometry jumped by 0.5",
    "motion capture swapped": "chaser 0: odometry jumped by",
    "robot gone": "does not answer",
    "robot does not obey": "chaser 0: does not obey",
}
"""What disarms the robots, by what goes wrong."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_stops_all_robots_with_a_named_reason(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, lab = flown(tmp_path, monkeypatch, faults=(Fault(kind, 6.0),), seconds=25.0)
    assert not flight.crashes
    (reason,) = [line for line in flight.output.splitlines() if "disarmed" in line]
    assert FAULTS[kind] in reason
    assert lab.begun_ns is not None
    stopped_ns = max(at_ns for at_ns, _ in SENT)
    longest_s = 3.0 if kind == "robot does not obey" else 0.2 + 2 / 15
    assert (stopped_ns - lab.begun_ns) / 1e9 < 6.0 + longest_s


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["camera frozen", "frames lost", "camera clock steps"])
def test_a_camera_that_fails_stops_nothing_that_is_safe(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = (Fault(kind, 10.0, 14.0),)
    flight, lab = flown(tmp_path, monkeypatch, faults=faults)
    assert not flight.crashes
    assert "disarmed" not in flight.output
    for errors in tracking_errors_m(lab, 30.0).values():
        assert np.sqrt(np.mean(errors**2)) < 3e-3


def kill_by_topic(options: ProcessOptions) -> int:
    from chaserdock_protocol import topics
    from chaserdock_protocol.messages import Kill
    from chaserdock_protocol.transport import Node
    from virtual_lab import arm_when_ready

    assert arm_when_ready(options) == 0
    node = Node("operator", "operator", options.link)
    try:
        node.advertise(topics.KILL)
        node.host.sleep(2.0)
        node.publish(topics.KILL, Kill(by="a button"))
        node.host.sleep(0.5)
    finally:
        node.close()
    return 0


@pytest.mark.slow
def test_the_topic_kills_within_a_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight, lab = flown(tmp_path, monkeypatch, seconds=8.0, operator=kill_by_topic)
    assert not flight.crashes
    assert "kill accepted: killed by a button" in flight.output
    assert lab.begun_ns is not None
    newest_ns = max(at_ns for at_ns, _ in SENT)
    assert (newest_ns - lab.begun_ns) / 1e9 < 2.3
    for force, torque in lab.wrench.values():
        assert not force.any()
        assert not torque.any()
