# SPDX-License-Identifier: Apache-2.0
"""Flights without ground truth: judged against the reference of a motion capture, or without one;
and logs that lack a part of their mission.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.recorder.foxglove_layer import SHOWN, ViewerLayer
from chaserdock_agents.ros2.conversion import Converter
from chaserdock_models import rotations
from chaserdock_protocol import topics
from chaserdock_protocol.messages import ActuatorCommand, BodyReference, Message, ThrusterPulse
from chaserdock_protocol.recording.log import Record, read_log
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT
from message_samples import SAMPLES
from motion_cases import (
    SIGMA_M,
    SIGMA_RAD,
    SYSTEM,
    cropped,
    measured_motion,
    rewritten,
    track,
    without_truth,
)
from msgspec import structs
from typer.testing import CliRunner

from chaserdock.analysis import video
from chaserdock.analysis.actuation import commanded_output
from chaserdock.analysis.columns import Columns
from chaserdock.analysis.criteria import criteria_of
from chaserdock.analysis.figures import component_errors
from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.motion import Track
from chaserdock.analysis.pose_errors import (
    measured_covariance,
    pose_error,
    relative_measured_covariance,
    relative_pose,
)
from chaserdock.analysis.report import report_of
from chaserdock.analysis.snapshot import snapshot
from chaserdock.analysis.summary import summarize, summary_of, text_of
from chaserdock.cli.main import app
from chaserdock.logs.info import info_of
from chaserdock.logs.tracks import write_tracks
from chaserdock.replay.compare import compare
from chaserdock.replay.run import replay
from chaserdock.summary import Summary
from chaserdock.verdict import verdict_of
from chaserdock.viewer.logged import LoggedMission

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
CAPTURE = ROOT / "tests" / "golden" / "capture.mcap"
BODIES = ("target", "chaser/0", "chaser/1")
NO_REFERENCE = "the log has neither ground truth nor a reference of the target"


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden flight with references in place of its ground truth."""
    return without_truth(GOLDEN, tmp_path_factory.mktemp("measured") / "mission.mcap", BODIES)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden flight without ground truth and reference."""
    return without_truth(GOLDEN, tmp_path_factory.mktemp("bare") / "mission.mcap")


# -- the provider ----------------------------------------------------------------------------------


def turning(time_s: np.ndarray) -> Track:
    """A body that moves and turns at constant rates about no axis of a frame."""
    n, omega = len(time_s), np.array([0.7, -0.4, 1.1])
    begin = rotations.normalize([0.3, -0.5, 0.7, 0.4])
    return track(
        time_s,
        position_m=np.array([1.0, -2.0, 0.5]) + np.outer(time_s, [0.3, 0.2, -0.1]),
        velocity_m_s=np.tile([0.3, 0.2, -0.1], (n, 1)),
        q_wxyz=rotations.multiply(begin, rotations.exp(np.outer(time_s, omega))),
        omega_rad_s=np.tile(omega, (n, 1)),
        sigma_m=np.full(n, 0.003),
        sigma_rad=np.full(n, 0.02),
    )


def test_pose_between_measurements_is_that_of_its_own_time() -> None:
    """Times of measurements are no ticks; a measurement at the nearest one would be 3 mm off."""
    ticks = np.arange(0.0, 1.0, 1.0 / 15.0)
    motion = measured_motion({"target": turning(np.arange(-0.013, 1.0, 0.01))}, ticks)
    found, true = motion["target"], turning(ticks)
    assert motion.source == "reference"
    np.testing.assert_array_equal(found.time_s, ticks)
    for name in ("position_m", "velocity_m_s", "omega_rad_s"):
        np.testing.assert_allclose(getattr(found, name), getattr(true, name), atol=1e-12)
    assert rotations.angle_between(found.q_wxyz, true.q_wxyz).max() < 1e-9


def test_noise_of_two_measurements_averages() -> None:
    """Half way between two it is 1/sqrt(2) of one, at a measurement it is that of one."""
    _, at = turning(np.array([0.0, 0.04])).interpolated(np.array([0.0, 0.01, 0.02, 0.04]))
    share = np.array([1.0, math.hypot(0.75, 0.25), math.sqrt(0.5), 1.0])
    np.testing.assert_allclose(at.sigma_m, 0.003 * share)
    np.testing.assert_allclose(at.sigma_rad, 0.02 * share)


def test_pose_is_not_known_where_the_measurement_is_interrupted() -> None:
    measured = turning(np.array([0.0, 0.05, 0.3, 0.35]))
    rows, at = measured.interpolated(np.array([-0.01, 0.03, 0.2, 0.31, 0.36]))
    assert rows.tolist() == [1, 3]
    np.testing.assert_array_equal(at.time_s, [0.03, 0.31])
    assert len(turning(np.array([0.0])).interpolated(np.array([0.0]))[0]) == 0


def test_late_and_doubled_measurements_count_once_and_in_order() -> None:
    """The body accelerates: only neighbours in time give its place."""
    times, ticks = np.array([0.0, 0.03, 0.01, 0.02, 0.02, 0.04]), np.arange(0.005, 0.04, 0.01)
    measured = track(times, position_m=np.outer(times**2, [3.0, -2.0, 1.0]))
    found = measured_motion({"target": measured}, ticks)["target"]
    np.testing.assert_array_equal(found.time_s, ticks)
    between = (np.square(ticks - 0.005) + np.square(ticks + 0.005)) / 2.0
    np.testing.assert_allclose(found.position_m, np.outer(between, [3.0, -2.0, 1.0]), atol=1e-12)


def jumping(moved: Track, rows: slice, by: tuple[float, float, float], turn: float = 0.0) -> Track:
    """A motion whose measurements are beside the body, and turned, in some rows."""
    position, q = moved.position_m.copy(), moved.q_wxyz.copy()
    position[rows] += by
    q[rows] = rotations.multiply(q[rows], rotations.exp(np.array([0.0, 0.0, turn])))
    return replace(moved, position_m=position, q_wxyz=q)


@pytest.mark.parametrize(
    ("by", "turn"),
    [((0.3, -0.2, 0.1), 0.0), ((0.0, 0.0, 0.0), math.pi / 2)],
    ids=["position", "attitude"],
)
def test_measurements_of_a_jump_are_left_out_until_the_body_is_back(by: Any, turn: float) -> None:
    """Though the jump lasts long enough for the body to have got there meanwhile."""
    times, ticks = np.arange(0.0, 4.0, 0.01), np.arange(0.05, 3.9, 0.1)
    true = turning(times)
    motion = measured_motion({"target": jumping(true, slice(100, 300), by, turn)}, ticks)
    found = motion["target"]
    np.testing.assert_array_equal(found.time_s, [t for t in ticks if not 0.99 < t < 3.0])
    np.testing.assert_allclose(found.position_m, turning(found.time_s).position_m, atol=1e-9)
    (jump,) = motion.reference_jumps()
    assert (jump.body, jump.until_s) == ("target", 3.0)
    assert jump.from_s == 1.0
    assert abs(jump.distance_m - np.linalg.norm(by)) < 0.01
    assert abs(jump.angle_rad - turn) < 0.02


def test_bodies_that_a_reference_swaps_are_left_out_while_they_are_swapped() -> None:
    times = np.arange(0.0, 2.0, 0.01)
    one, other = turning(times), turning(times)
    other = replace(other, position_m=other.position_m + np.array([0.0, 0.6, 0.0]))
    swapped = slice(80, 130)
    moved = [jumping(one, swapped, (0, 0.6, 0)), jumping(other, swapped, (0, -0.6, 0))]
    motion = measured_motion(dict(zip(("chaser/0", "chaser/1"), moved, strict=True)), times)
    assert [j.body for j in motion.reference_jumps()] == ["chaser/0", "chaser/1"]
    for name, true in (("chaser/0", one), ("chaser/1", other)):
        found = motion[name]
        assert len(found.time_s) >= 148
        kept = np.isin(times, found.time_s)
        np.testing.assert_allclose(found.position_m, true.position_m[kept], atol=1e-9)


def test_noise_and_single_outliers_are_no_gap() -> None:
    """Outliers are left out, and bridged; noise of the stated size is no jump."""
    times, rng = np.arange(0.0, 2.0, 0.01), np.random.default_rng(3)
    noisy = replace(turning(times), sigma_m=np.full(200, 0.03))
    noisy = replace(noisy, position_m=noisy.position_m + 0.03 * rng.standard_normal((200, 3)))
    assert measured_motion({"target": noisy}, times).reference_jumps() == []
    spiked = jumping(turning(times), slice(50, 51), (0.0, 0.4, 0.0))
    motion = measured_motion({"target": spiked}, times)
    assert [(j.from_s, j.until_s) for j in motion.reference_jumps()] == [(0.5, 0.51)]
    assert len(motion["target"].time_s) == 200
    error = motion["target"].position_m - turning(times).position_m
    assert np.abs(error).max() < 1e-4


def test_flight_is_not_judged_by_a_reference_that_jumped(measured: Path, tmp_path: Path) -> None:
    def moved(record: Record) -> Message:
        message = record.message
        if not isinstance(message, BodyReference) or message.body != "chaser/1":
            return message
        if message.sim_time_ns < 700_000_000:
            return message
        x, y, z = message.position_m
        return structs.replace(message, position_m=(x, y + 0.5, z))

    before = summarize(measured)
    after = summarize(rewritten(measured, tmp_path / "mission.mcap", moved))
    (said,) = (x for x in after["not_judged"] if x.startswith("reference jumped"))
    assert said.startswith("reference jumped: chaser/1 by 0.50 m, 0 deg at 0.70")
    assert said.endswith("left out to the end")
    assert said.removeprefix("reference jumped: ") in " ".join(text_of(after).split())
    own = after["chasers"]["1"]
    assert own["position_mse_m2"] < 2.0 * before["chasers"]["1"]["position_mse_m2"]
    assert after["chasers"]["0"] == before["chasers"]["0"]


def test_state_at_the_end_is_not_judged_after_a_jump_that_stays(measured: Path) -> None:
    flight = load_flight(measured)
    success = flight.scenario.success.model_copy(update={"docked": (1,)})
    scenario = flight.scenario.model_copy(update={"success": success})
    assert not [x for x in criteria_of(replace(flight, scenario=scenario))[1] if "docked" in x]
    times = np.arange(0.0, 1.2, 0.01)
    tracks = {name: turning(times) for name in BODIES}
    tracks["chaser/1"] = jumping(turning(times), slice(90, None), (0.0, 0.5, 0.0))
    jumped = replace(flight, scenario=scenario, motion=measured_motion(tracks, times))
    judged, skipped = criteria_of(jumped)
    assert judged.success.docked == ()
    assert "success.docked: the reference jumped, and did not come back" in skipped


def test_bodies_that_are_measured_at_different_times_are_compared_at_the_same_ticks() -> None:
    ticks = np.arange(0.0, 2.0, 0.1)
    late = turning(np.arange(0.53, 2.0, 0.01))
    early = turning(np.arange(0.0, 1.44, 0.01))
    late = replace(late, position_m=late.position_m + np.array([0.0, 3.0, 4.0]))
    motion = measured_motion({"chaser/1": late, "target": early}, ticks)
    own, target = motion.pair(1)
    np.testing.assert_array_equal(own.time_s, target.time_s)
    assert (own.time_s[0], own.time_s[-1]) == pytest.approx((0.6, 1.4))
    np.testing.assert_allclose(own.distance_to(target)[1], 5.0)
    assert motion.chasers == [1]
    assert motion.has_pair(1)
    assert not motion.has_pair(0)


def test_a_body_that_is_not_measured_at_any_tick_is_not_known() -> None:
    motion = measured_motion({"target": turning(np.array([0.0, 0.01]))}, np.array([0.5]))
    assert list(motion) == []
    assert "target" not in motion


def test_covariance_of_a_measured_relative_pose() -> None:
    """By differences of the relative pose, all axes different."""
    n = np.zeros((1,))
    own = track(
        n,
        position_m=np.array([[1.0, -0.7, 0.4]]),
        q_wxyz=rotations.normalize([[0.4, 0.3, -0.6, 0.2]]),
        sigma_m=np.array([0.002]),
        sigma_rad=np.array([0.01]),
    )
    other = track(
        n,
        position_m=np.array([[-0.5, 0.9, 1.3]]),
        q_wxyz=rotations.normalize([[0.7, -0.2, 0.5, 0.4]]),
        sigma_m=np.array([0.005]),
        sigma_rad=np.array([0.03]),
    )

    def pose(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return relative_pose(
            own.position_m[0] + x[:3],
            rotations.multiply(own.q_wxyz[0], rotations.exp(x[3:6])),
            other.position_m[0] + x[6:9],
            rotations.multiply(other.q_wxyz[0], rotations.exp(x[9:])),
        )

    step = 1e-6 * np.eye(12)
    jacobian = np.array([pose_error(*pose(d), *pose(-d)) / 2e-6 for d in step]).T
    sigmas = np.repeat([0.002, 0.01, 0.005, 0.03], 3)
    expected = jacobian @ np.diag(sigmas**2) @ jacobian.T
    np.testing.assert_allclose(relative_measured_covariance(own, other)[0], expected, atol=1e-10)
    np.testing.assert_allclose(
        measured_covariance(other)[0], np.diag(np.repeat([0.005, 0.03], 3) ** 2)
    )


# -- a flight with a reference ---------------------------------------------------------------------


def test_flight_with_a_reference_is_judged_against_it(measured: Path) -> None:
    """Figures are those of the truth to within the noise of the measurement."""
    true, found = summarize(GOLDEN), summarize(measured)
    assert found["judged_against"] == f"motion capture '{SYSTEM}', 1 sigma 0.2 mm, 0.057 deg"
    assert (true["judged_against"], found["sim_time_s"]) == ("ground truth", true["sim_time_s"])
    assert found["ticks"] == true["ticks"] == 18
    for i in ("0", "1"):
        a, b = true["chasers"][i], found["chasers"][i]
        # A measured distance from the target's centre errs by sigmas of positions, and the place
        # of the reference by the target's attitude over 1.2 m.
        assert math.sqrt(b["position_mse_m2"]) == pytest.approx(
            math.sqrt(a["position_mse_m2"]), abs=5 * 1.2 * SIGMA_RAD
        )
        assert b["min_distance_target_m"] == pytest.approx(a["min_distance_target_m"], abs=0.004)
        assert b["relative_estimate"]["nees_mean"] == pytest.approx(
            a["relative_estimate"]["nees_mean"], abs=2.0
        )
        assert b["docked"] is False
    assert found["target_estimate"]["position_rms_m"] == pytest.approx(
        true["target_estimate"]["position_rms_m"], abs=2 * SIGMA_M
    )
    assert found["target_estimate"]["omega_rms_rad_s"] is not None
    number = re.compile(r"\d+\.\d+")
    for measured_line, true_line in zip(found["failures"], true["failures"], strict=True):
        assert number.sub("", measured_line) == number.sub("", true_line)
        values = [float(x) for x in number.findall(true_line)]
        assert [float(x) for x in number.findall(measured_line)] == pytest.approx(values, rel=0.01)
    assert found["not_judged"] == ["collisions: the log has no ground truth of contacts"]
    json.dumps(found, allow_nan=False)
    assert Summary.from_dict(found).as_dict()["judged_against"] == found["judged_against"]


def test_error_of_the_measurement_is_in_the_bounds_of_the_estimate(measured: Path) -> None:
    """The first measurement comes after the first tick."""
    _, _, sigmas = component_errors(load_flight(measured))
    _, _, true = component_errors(load_flight(GOLDEN))
    more = sigmas**2 - true[1:] ** 2
    for part, sigma in ((slice(0, 3), SIGMA_M), (slice(6, 9), SIGMA_RAD)):
        assert np.all(more[:, part] <= sigma**2 * (1.0 + 1e-9))
        assert np.all(more[:, part] >= 0.5 * sigma**2)
    assert np.all(np.abs(more[:, 3:6]) < 1e-15)


def test_estimate_much_better_than_the_measurement_is_judged_by_the_latter(measured: Path) -> None:
    """Of a filter that states a millionth of its sigmas, the NEES is bounded by the measurement's:
    errors of 1 mm and 2 mrad are 5 and 2 of its sigmas."""
    flight = load_flight(measured)
    tiny = Columns(27)
    for row in flight.covariances.table() * 1e-12:
        tiny.add(row.tolist())
    nees = summary_of(replace(flight, covariances=tiny))["target_estimate"]["nees_mean"]
    assert 10.0 < nees < 150.0


def test_what_needs_velocities_is_not_judged_where_they_are_not_measured(tmp_path: Path) -> None:
    log = without_truth(GOLDEN, tmp_path / "mission.mcap", BODIES, rates=False)
    flight = load_flight(log)
    limited = flight.scenario.success.model_copy(
        update={
            "speed_limit": load_scenario(ROOT / "scenarios/afrl-docking.toml").success.speed_limit
        }
    )
    flight.scenario = flight.scenario.model_copy(update={"success": limited})
    result = summary_of(flight)
    assert result["target_estimate"]["omega_rms_rad_s"] is None
    assert result["target_estimate"]["position_rms_m"] is not None
    assert (
        "success.speed_limit: the reference does not measure velocities and rates"
        in result["not_judged"]
    )
    assert result["chasers"]["0"]["rendezvous"]["speed_margin_m_s"] is None
    json.dumps(result, allow_nan=False)


def test_chaser_without_a_reference_is_named_and_the_others_are_judged(tmp_path: Path) -> None:
    log = without_truth(GOLDEN, tmp_path / "mission.mcap", ("target", "chaser/1"))
    result = summarize(log)
    assert "chaser 0, criteria on its pose: the log has no reference of it" in result["not_judged"]
    assert result["chasers"]["0"]["steady"]["position_mse_m2"] is None
    assert {line.partition(", ")[2][:8] for line in result["failures"]} == {"chaser 1"}
    assert result["chasers"]["0"]["estimated_tracking"]["position_rms_m"] > 0.1


# -- a flight without any --------------------------------------------------------------------------


def test_flight_without_a_reference_is_judged_by_what_needs_none(bare: Path) -> None:
    result = summarize(bare)
    assert (result["sim_time_s"], result["ticks"]) == (1.2, 18)
    assert result["failures"] == []
    criteria = (
        "keep_distances",
        "steady_position_rms_m",
        "steady_orientation_rms_deg",
        "max_estimate_position_m",
        "max_estimate_orientation_deg",
    )
    assert result["not_judged"] == [
        *(f"success.{name}: {NO_REFERENCE}" for name in criteria),
        "collisions: the log has no ground truth of contacts",
    ]
    assert result["collisions"] is None
    assert result["target_estimate"]["position_rms_m"] is None
    assert verdict_of(result).headline == "success, but 6 criteria not judged"
    said = " ".join(text_of(result).split())
    assert "nothing: the log has neither ground truth nor a reference" in said
    judged = CliRunner().invoke(app, ["judge", str(bare)])
    assert (judged.exit_code, "1.2 s flown" in judged.output) == (0, True)


def test_estimated_tracking_error_is_that_of_the_flight_software(bare: Path) -> None:
    """It differs from the true one by the errors of odometry and estimate, which are millimetres
    here: compare with the truth, which the golden log has.
    """
    true, found = summarize(GOLDEN), summarize(bare)
    for i in ("0", "1"):
        errors, steady = found["chasers"][i]["estimated_tracking"], true["chasers"][i]["steady"]
        assert errors["position_rms_m"] == pytest.approx(
            math.sqrt(steady["position_mse_m2"]), rel=0.02
        )
        assert errors["orientation_rms_rad"] == pytest.approx(
            math.sqrt(steady["orientation_mse_rad2"]), rel=0.02
        )
        assert found["chasers"][i]["sightings"] == {"used": 18, "rejected": 0}


def test_flight_that_ends_early_fails_without_ground_truth_as_well(tmp_path: Path) -> None:
    flight = load_flight(without_truth(GOLDEN, tmp_path / "mission.mcap"))
    flight.scenario = flight.scenario.model_copy(update={"duration_s": 60.0})
    assert summary_of(flight)["failures"][0].startswith("flown: 1.20 s, at least 60 s; ")


def test_docking_is_judged_by_its_sensor() -> None:
    """The golden capture has no ground truth but the drawn bodies."""
    result = summarize(CAPTURE)
    capture = result["chasers"]["0"]["capture"]
    assert capture["latched"]
    assert capture["verified"]
    statuses = (r.message for r in read_log(CAPTURE, keys=("world/chaser/0/docking",)))
    latched_s = next(s.sim_time_ns for s in statuses if s.latched) / 1e9  # type: ignore[attr-defined]
    assert capture["latch_time_s"] == pytest.approx(latched_s)
    assert (capture["contact_lateral_m"], capture["probe_touches"]) == (None, 1)
    assert result["success"]
    assert f"verified, latched at {latched_s:.1f} s" in " ".join(text_of(result).split())
    # Without the latch the criterion is violated.
    flight = load_flight(CAPTURE)
    assert flight.latched == (0,)
    flight.sensed_docking[0].latched = False
    assert summary_of(flight)["failures"][0].startswith("latched and verified, chaser 0: never")


def test_loads_on_ports_are_not_judged_without_their_ground_truth() -> None:
    flight = load_flight(CAPTURE)
    docking = flight.scenario.docking
    (port,) = docking.ports
    weak = docking.model_copy(update={"ports": (port.model_copy(update={"force_limit_N": 1.0}),)})
    flight.scenario = flight.scenario.model_copy(update={"docking": weak})
    result = summary_of(flight)
    assert "loads on the ports: the log has no ground truth of them" in result["not_judged"]
    assert result["failures"] == []


def test_commanded_impulses_are_those_of_ideal_actuators(bare: Path) -> None:
    """The world's actuators are ideal in this flight; the last command acts after its end."""
    true, found = summarize(GOLDEN), summarize(bare)
    assert (true["impulses_are"], found["impulses_are"]) == ("true", "commanded")
    for i in ("0", "1"):
        assert found["chasers"][i]["impulse_N_s"] == pytest.approx(
            true["chasers"][i]["impulse_N_s"], rel=0.1
        )


def test_commanded_pulses_give_the_stated_thrust_while_a_valve_is_open() -> None:
    """Two valves, open for 30 and 20 ms, and one whose shut-off valve is closed."""
    body = load_scenario(ROOT / "scenarios/single-thrusters.toml").chaser
    a, b = body.thrusters[2], body.thrusters[7]
    pulses = ((2, 0, 20_000_000), (7, 5_000_000, 25_000_000), (2, 50_000_000, 60_000_000))
    command = ActuatorCommand(
        sim_time_ns=2_000_000_000,
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=(0.0, 0.0, 0.0),
        torque_N_m=(0.0, 0.0, 0.0),
        pulses=tuple(
            ThrusterPulse(thruster=k, open_ns=begin, close_ns=end)
            for k, begin, end in (*pulses, (4, 0, 50_000_000))
        ),
        isolated=(4,),
    )
    output = commanded_output(command, body, 0.1)
    impulses = 0.03 * a.thrust_N * np.array(a.direction) + 0.02 * b.thrust_N * np.array(b.direction)
    np.testing.assert_allclose(output.impulse_N_s, impulses)
    moment = np.cross(a.position_m, np.multiply(0.03 * a.thrust_N, a.direction))
    moment += np.cross(b.position_m, np.multiply(0.02 * b.thrust_N, b.direction))
    np.testing.assert_allclose(output.angular_impulse_N_m_s, moment)
    assert output.time_s == pytest.approx(2.1)
    assert output.thruster_open_s[4] == 0.0
    assert output.propellant_kg == pytest.approx(
        (0.03 * a.thrust_N / a.isp_s + 0.02 * b.thrust_N / b.isp_s) / 9.80665
    )


# -- the flight scenario alone ---------------------------------------------------------------------


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("chaserdock.analysis.report.draw_figures", lambda *_: ())


@pytest.mark.usefixtures("no_figures")
def test_log_with_the_flight_scenario_alone_says_so_and_judges_no_criteria(tmp_path: Path) -> None:
    log = without_truth(GOLDEN, tmp_path / "mission.mcap", BODIES, flight=True)
    result = summarize(log)
    assert result["log_lacks"] == [
        "holds the flight scenario, without success criteria and ground truth"
    ]
    assert result["not_judged"][0] == (
        "success: the log holds the flight scenario, which states no criteria"
    )
    assert verdict_of(result).level == "partial"
    assert result["chasers"]["0"]["min_distance_target_m"] > 1.0  # measured all the same
    assert info_of(log).run["scenario"] == "flight"
    page = report_of(log)
    assert "holds the flight scenario, without success criteria" in page


@pytest.mark.slow
@pytest.mark.parametrize("through", ["perception", "fusion", "controller"])
def test_replay_needs_no_ground_truth(through: str, tmp_path: Path) -> None:
    """The stages read what flight software received, and give the same as from the whole log."""
    log = without_truth(GOLDEN, tmp_path / "mission.mcap", BODIES, flight=True)
    ours, whole = replay(log, through), replay(GOLDEN, through)
    assert [(t.key, t.compared, t.unequal) for t in ours.topics] == [
        (t.key, t.compared, t.unequal) for t in whole.topics
    ]
    assert ours.notes == whole.notes == []


# -- logs that lack a part -------------------------------------------------------------------------


@pytest.mark.usefixtures("no_figures")
def test_log_that_begins_late_says_so_with_its_verdict(tmp_path: Path) -> None:
    log = cropped(GOLDEN, tmp_path / "mission.mcap", 0.4, 99.0)
    result = summarize(log)
    assert result["log_lacks"] == ["begins at 0.4 s; earlier messages are missing"]
    verdict = verdict_of(replace_failures(result))
    assert (verdict.level, verdict.headline) == ("partial", "success, but log incomplete")
    assert "the log: begins at 0.4 s; earlier messages are missing" in text_of(result)
    assert "the log: begins at 0.4 s; earlier messages are missing" in report_of(log)


def replace_failures(result: dict[str, Any]) -> dict[str, Any]:
    """The summary of a flight that meets its criteria."""
    return result | {"success": True, "failures": [], "doubts": []}


def test_log_that_ends_early_says_that_it_does_and_not_that_the_flight_did(tmp_path: Path) -> None:
    log = cropped(GOLDEN, tmp_path / "mission.mcap", 0.0, 0.7)
    result = summarize(log)
    assert result["failures"][0].startswith("flown: 0.67 s, at least 1.2 s; ")
    assert result["ended"] == "not known: the log ends before the mission does, at 0.67 s"
    assert CliRunner().invoke(app, ["judge", str(log)]).exit_code == 1


def test_latch_that_closed_before_the_log_begins_is_latched(tmp_path: Path) -> None:
    log = cropped(CAPTURE, tmp_path / "mission.mcap", 25.0, 99.0)
    result = summarize(log)
    assert result["chasers"]["0"]["capture"]["latched"]
    assert result["chasers"]["0"]["capture"]["latch_time_s"] is None
    assert "latched at" not in text_of(result)
    assert "never latched" not in text_of(result)
    assert "verified" in text_of(result)


# -- the tools -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_report_against_a_reference_names_it_and_replays_the_flight(measured: Path) -> None:
    page = report_of(measured)
    assert f"Judged against motion capture &#x27;{SYSTEM}&#x27;, 1 sigma 0.2 mm" in page
    assert 'id="replay-data"' in page
    for name in ("trajectories", "tracking", "docking", "inputs", "estimate", "consistency"):
        assert f'id="figure-{name}"' in page
    assert "against ground truth" not in page


@pytest.mark.slow
def test_report_without_a_reference_shows_what_needs_none(bare: Path) -> None:
    page = report_of(bare)
    for name in ("tracking", "inputs", "cameras", "solver", "latency"):
        assert f'id="figure-{name}"' in page
    assert 'id="replay-data"' not in page
    assert "as estimated in flight; sightings rejected" in page
    assert "Judged against nothing" in page
    assert "neither ground truth nor a reference of the target" in page


def test_snapshot_shows_the_cameras_without_ground_truth(bare: Path) -> None:
    assert snapshot(bare, 1.0, 320).shape[1] == 640


def test_comparison_of_truth_and_reference_finds_the_noise_of_the_measurement(
    measured: Path,
) -> None:
    found = compare(GOLDEN, measured)
    assert set(found.deviations) == {*BODIES, "target estimate"}
    for body in BODIES:
        deviation = found.deviations[body]
        assert 0.3 * SIGMA_M < deviation.position_m < 6.0 * SIGMA_M
        assert 0.3 * SIGMA_RAD < deviation.orientation_rad < 6.0 * SIGMA_RAD
    assert found.deviations["target estimate"].position_m == 0.0
    assert found.summary["judged_against"][0] == "ground truth"


def test_tracks_have_the_measured_poses_at_their_own_times(measured: Path, tmp_path: Path) -> None:
    points = write_tracks(measured, tmp_path / "tracks")
    assert {name for name in points if "measured" in name} == {
        f"{body.replace('/', '_')}_measured.tum" for body in BODIES
    }
    assert not any("truth" in name for name in points)
    first, second = (tmp_path / "tracks" / "target_measured.tum").read_text().splitlines()[:2]
    assert (first.split()[0], second.split()[0]) == ("0.003700000", "0.013700000")


def test_viewer_of_a_log_draws_the_measured_bodies_and_the_error_of_the_estimate(
    measured: Path,
) -> None:
    mission, whole = LoggedMission(measured), LoggedMission(GOLDEN)
    assert mission.truth
    at, true = mission.at(1.0).truth["target"], whole.at(1.0).truth["target"]
    assert math.dist(at.position_m, true.position_m) < 6 * SIGMA_M + 0.05 * 0.1
    for quantity, sigma in (("estimate_error_mm", 0.2), ("estimate_error_deg", 0.0573)):
        _, ours = mission.history.series[quantity, None].until(9.9)  # type: ignore[index]
        _, truth = whole.history.series[quantity, None].until(9.9)  # type: ignore[index]
        assert len(ours) >= len(truth) - 1
        assert np.abs(ours[-len(truth) + 1 :] - truth[1:]).max() < 5.0 * sigma


def test_film_draws_the_measured_bodies(measured: Path) -> None:
    (_, ours), (_, true) = (
        next(video.film_of(log, load_flight(log), 1.0, 1, 320, 180, (1.0, 1.1)).frames())
        for log in (measured, GOLDEN)
    )
    # The same bodies at the same places, to pixels at their edges.
    outside = np.s_[40:130, :220]
    assert np.mean(np.abs(ours[outside].astype(int) - true[outside]) > 60) < 0.02
    assert np.mean(true[outside] > 60) > 0.005


def test_viewer_layer_and_ros_bag_have_the_measured_poses() -> None:
    scenario = load_flight(GOLDEN).scenario
    sample = next(m for m in SAMPLES if isinstance(m, BodyReference))
    (ros,) = Converter(scenario).convert(sample)
    assert ros.topic == "/reference/target"
    covariance = ros.message.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(
        np.diag(covariance), [sample.sigma_m**2] * 3 + [sample.sigma_rad**2] * 3
    )
    written: list[str] = []
    layer = ViewerLayer(scenario, lambda topic, *_: written.append(topic))
    layer.write(sample)  # and what is written once
    before = len(written)
    layer.write(sample)
    assert written[before:] == ["/viewer/tf"]
    assert topics.BODY_REFERENCE in SHOWN
