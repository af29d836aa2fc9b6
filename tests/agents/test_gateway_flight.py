# SPDX-License-Identifier: Apache-2.0
"""Whole flights of the unmodified flight software on a virtual laboratory, by the gateway."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.gateway import own_camera
from chaserdock_protocol import topics
from chaserdock_protocol.messages import ArmingCommand, ArmingReply
from chaserdock_protocol.process import ProcessOptions
from chaserdock_protocol.transport import Node
from virtual_lab import (
    SCENARIO,
    SENT,
    Fault,
    arm_again,
    arm_when_ready,
    flight_of,
    fly,
    killed_and_restarted,
    tracking_errors_m,
    two_free_flyers,
)

import chaserdock
from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.identification.fit import identify
from chaserdock.launch.twin import twin_of
from chaserdock.simulation.mission import SimulatedFlight
from chaserdock.simulation.network import SimulatedHost


def flown(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    faults: tuple[Any, ...] = (),
    seconds: float = 26.0,
    cameras: bool = True,
    **others: Any,
) -> tuple[SimulatedFlight, Any]:
    scenario = tmp_path / "lab.toml"
    text, lab = flight_of("tracking", 1, faults, cameras)
    scenario.write_text(text.replace("duration_s = 40.0", f"duration_s = {seconds}"))
    return fly(scenario, tmp_path / "run", lab, monkeypatch, **others), lab


@pytest.mark.slow
def test_free_flyers_track_the_target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight, lab = flown(tmp_path, monkeypatch)
    assert not flight.crashes
    assert set(flight.statuses.values()) == {0}
    for errors in tracking_errors_m(lab, 20.0).values():
        assert np.sqrt(np.mean(errors**2)) < 3e-3  # cameras are mounted to 0.5 mm and 0.05 deg
    assert "disarmed" not in flight.output
    assert "no odometry" not in flight.output
    judged = summary_of(load_flight(flight.folder / "mission.mcap"))
    assert judged["success"] is True
    for chaser in judged["chasers"].values():
        assert chaser["steady"]["position_mse_m2"] < 3e-3**2
    twin = twin_of(flight.folder)  # starts when the robots are armed, at rest
    for own, offset_m in zip(twin.chasers, ((-0.2, 0.065, 0.0), (-0.015, -0.2, 0.02)), strict=True):
        assert np.linalg.norm(np.subtract(own.start_offset_m, offset_m)) < 0.01
        assert np.linalg.norm(own.start_velocity_m_s) < 15e-3  # from what follows the start
    assert np.linalg.norm(np.degrees(twin.target.omega_rad_s) - [0.0, 0.0, 3.0]) < 0.5


@pytest.mark.slow(minutes=3)
def test_robots_dock_by_probe_and_port_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``benchmarks/simulate.py --only laboratory-docking`` flies it on a floor, too."""
    text, lab = flight_of("free-flyer-docking", 1)
    scenario = tmp_path / "lab.toml"
    scenario.write_text(text)
    flight = fly(scenario, tmp_path / "run", lab, monkeypatch)
    assert not flight.crashes
    assert "disarmed" not in flight.output
    for probe in lab.probes.values():
        assert probe.is_latched
        assert probe.misses == probe.refusals == []
    assert lab.clearance_m > 0.02
    judged = summary_of(load_flight(flight.folder / "mission.mcap"))
    assert judged["success"] is True


@pytest.mark.slow(2)
def test_a_flight_identifies_its_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By forces that are given as commanded, with motion capture of other noise than stated."""
    scenario = tmp_path / "lab.toml"
    scenario.write_text(SCENARIO)
    lab = two_free_flyers(4)
    for body in lab.chasers.values():
        body.mass_kg, body.inertia = 33.0, np.array([0.19, 0.15, 0.28])
    flight = fly(scenario, tmp_path / "run", lab, monkeypatch)
    true = {"mass": 33.0, "Ixx": 0.19, "Iyy": 0.15, "Izz": 0.28}
    found = identify(flight.folder / "mission.mcap", 1)
    values = {q.name: q for q in found.quantities}
    for name, value in true.items():
        assert values[name].known
        assert values[name].value == pytest.approx(value, rel=0.03)
    assert values["mass"].value == pytest.approx(33.0, rel=1e-3)
    # Its thrust follows a command with a time constant of 20 ms, which is no pure delay.
    assert values["delay"].value == pytest.approx(0.02, abs=0.004)
    assert found.robot.free_s == pytest.approx(40.0, abs=0.1)  # time begins with arming


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
    for errors in tracking_errors_m(lab, 20.0).values():
        assert np.sqrt(np.mean(errors**2)) < 3e-3  # cameras are mounted to 0.5 mm and 0.05 deg


def test_nothing_moves_unless_it_is_armed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def kill(options: ProcessOptions) -> int:
        node = Node("operator", "operator", options.link)
        node.host.sleep(3.0)
        killed = node.query(topics.ARMING_KEY, ArmingCommand(action="kill"), ArmingReply, 1.0)
        node.close()
        return 0 if killed is not None and killed.accepted else 1

    flight, _ = flown(tmp_path, monkeypatch, seconds=3.0, operator=kill)
    assert not flight.crashes
    assert not flight.stalled
    assert SENT == []
    assert (flight.statuses["operator"], flight.statuses["world"]) == (0, 1)
    assert "world: killed at 0.00 s" in flight.output


@pytest.mark.slow
def test_robots_may_be_armed_late_and_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is commanded to disarmed robots is not taken for their motion."""

    def arm_late(options: ProcessOptions) -> int:
        node = Node("operator", "operator", options.link)
        node.host.sleep(10.0)
        assert arm_when_ready(options) == 0
        node.host.sleep(5.0)
        disarm = ArmingCommand(action="disarm", operator="me")
        assert node.query(topics.ARMING_KEY, disarm, ArmingReply, 1.0) is not None
        node.host.sleep(5.0)
        node.close()
        return arm_when_ready(options)

    flight, lab = flown(tmp_path, monkeypatch, seconds=30.0, operator=arm_late)
    assert not flight.crashes
    assert "disarmed: chaser" not in flight.output
    assert "contradicts the estimate" not in flight.output
    for errors in tracking_errors_m(lab, 25.0).values():
        assert errors.max() < 0.02


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
    flight, lab = flown(tmp_path, monkeypatch, faults=(Fault(kind, 6.0),), seconds=12.0)
    assert not flight.crashes
    (reason,) = [line for line in flight.output.splitlines() if "disarmed" in line]
    assert FAULTS[kind] in reason
    assert lab.begun_ns is not None
    stopped_ns = max(at_ns for at_ns, _ in SENT)
    longest_s = 3.0 if kind == "robot does not obey" else 0.5 + 2 / 15  # stale_s, and two ticks
    assert (stopped_ns - lab.begun_ns) / 1e9 < 6.0 + longest_s


@pytest.mark.slow
@pytest.mark.parametrize(
    ("silent", "other"),
    [("camera frozen", "frames lost"), ("camera repeats", "camera clock steps")],
)
def test_a_camera_that_fails_stops_nothing_that_is_safe(
    silent: str, other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = (Fault(silent, 8.0, 11.0), Fault(other, 12.0, 15.0))
    flight, lab = flown(tmp_path, monkeypatch, faults=faults)
    assert not flight.crashes
    assert "disarmed" not in flight.output
    (warned_s,) = re.findall(r"([\d.]+) s: no new image: chaser 0", flight.output)
    assert 9.0 <= float(warned_s) < 11.0  # a second into the first fault; the other one is none
    for errors in tracking_errors_m(lab, 22.0).values():
        assert np.sqrt(np.mean(errors**2)) < 3e-3


ARMING_S = 2.0


def arm_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let robots take a while to be armed, in the background, as those under PX4 do."""
    worker = SimulatedHost.worker

    def slow(host: Any, call: Any) -> Any:
        if host.name != "world":
            return worker(host, call)

        def put(item: Any) -> None:
            scheduler = host._scheduler
            scheduler.call_at(scheduler.now_s + ARMING_S, call, args=(item,))

        return put, lambda: None

    monkeypatch.setattr(SimulatedHost, "worker", slow)


def test_the_mission_goes_on_while_robots_are_armed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm_slowly(monkeypatch)
    flight, lab = flown(tmp_path, monkeypatch, seconds=4.0)
    assert not flight.crashes
    assert lab.begun_ns is not None
    ticks_s = [
        tick.sim_time_ns / 1e9 for tick in chaserdock.open_log(flight.folder).messages("world/tick")
    ]
    assert np.diff(ticks_s).max() < 0.07
    assert "actuators stopped" not in flight.output
    (added,) = re.findall(r"added latency: (.*)", flight.output)
    latest_ms = {
        kind: float(p99) for kind, p99 in re.findall(r"(\w+) [\d.]+ ms, p99 ([\d.]+)", added)
    }
    assert latest_ms.keys() == {"images", "references", "commands"}
    assert max(latest_ms.values()) <= 2.0  # the interval at which devices are read


def test_disarming_wins_over_arming(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arm_slowly(monkeypatch)

    def disarm_meanwhile(options: ProcessOptions) -> int:
        node = Node("operator", "operator", options.link)
        arm = ArmingCommand(action="arm", operator="one")
        node.host.sleep(1.0)
        node.query(topics.ARMING_KEY, arm, ArmingReply, 0.1)
        again = node.query(topics.ARMING_KEY, arm, ArmingReply, 0.5)
        assert again is not None
        assert not again.accepted
        assert again.reason == "robots are being armed"
        disarm = ArmingCommand(action="disarm", operator="two")
        assert node.query(topics.ARMING_KEY, disarm, ArmingReply, 0.5) is not None
        node.host.sleep(2.0)
        node.query(topics.ARMING_KEY, ArmingCommand(action="kill"), ArmingReply, 0.5)
        node.close()
        return 0

    flight, _ = flown(tmp_path, monkeypatch, seconds=4.0, operator=disarm_meanwhile)
    assert not flight.crashes
    assert "arm refused: disarmed by two" in flight.output
    assert SENT == []


@pytest.mark.slow
def test_a_gateway_that_was_killed_takes_the_mission_up_again_disarmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed_s, absent_s, armed_s = 12.0, 4.0, 20.0
    lab = two_free_flyers(1)
    scenario = tmp_path / "lab.toml"
    scenario.write_text(SCENARIO)
    flight = fly(
        scenario,
        tmp_path / "run",
        lab,
        monkeypatch,
        world=killed_and_restarted(lab, killed_s, absent_s, monkeypatch),
        operator=partial(arm_again, after_s=armed_s),
    )
    assert not flight.crashes
    assert set(flight.statuses.values()) == {0}  # controller, chasers and recorder survive
    assert flight.output.count("the world is back, and the mission goes on") == 4
    assert lab.begun_ns is not None
    sent_s = np.array([at_ns - lab.begun_ns for at_ns, _ in SENT]) / 1e9
    assert not ((sent_s > killed_s) & (sent_s < armed_s)).any()  # nothing moves before arm
    for errors in tracking_errors_m(lab, killed_s + 2.0, armed_s).values():
        assert errors.max() > 0.05  # at rest beside a target that turns
    assert "world: completed at 40.00 s" in flight.output
    for errors in tracking_errors_m(lab, 35.0).values():
        assert errors.max() < 0.02
    assert not (tmp_path / "begun.json").exists()
