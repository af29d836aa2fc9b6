# SPDX-License-Identifier: Apache-2.0
"""Pointing: target search pattern and calibration manoeuvre."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.chaser_state import ChaserTick
from chaserdock_controller.guidance.fleet import ChaserFleet
from chaserdock_controller.guidance.phases import Trigger
from chaserdock_controller.guidance.pointing import (
    CALIBRATION_S,
    SearchProgress,
    calibration_turns,
    facing,
    field_of_view,
    search_angles,
    search_wrench,
)
from chaserdock_controller.interfaces import TargetState
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry, OperatorCommand
from estimation_cases import V, W
from flight_cases import fleet_of, known, odometry, order, scenario, step, tick_inputs
from hypothesis import given, settings
from hypothesis import strategies as st

CAMERA = Camera.from_hfov(1280, 720, math.radians(60.0))
WIDTH, HEIGHT = field_of_view(CAMERA)


def _odometry(chaser: int, tick: int, x: np.ndarray) -> Odometry:
    return odometry(
        chaser,
        tick,
        round(tick / 15 * 1e9),
        position_m=vector(x[:3]),
        velocity_m_s=vector(x[3:6]),
        q_wxyz=vector(x[6:10]),
        omega_rad_s=vector(x[10:]),
    )


# --- search -------------------------------------------------------------------------------------


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.floats(0.0, 2.0 * math.pi), st.floats(0.0, math.radians(50.0)))
def test_search_covers_50_degrees_within_14_seconds(azimuth: float, off_axis: float) -> None:
    q_goal = rotations.exp(off_axis * np.array([0.0, math.cos(azimuth), math.sin(azimuth)]))
    direction = rotations.rotate(q_goal, [1.0, 0.0, 0.0])
    for t in np.arange(0.0, 14.0, 0.1):
        yaw, pitch = search_angles(float(t), WIDTH, HEIGHT)
        x, y, z = rotations.rotate_inverse(rotations.exp([0.0, pitch, yaw]), direction).tolist()
        # One degree of margin for the size of the target.
        if (
            x > 0
            and abs(math.atan2(y, x)) < WIDTH / 2 - 0.02
            and abs(math.atan2(z, x)) < HEIGHT / 2 - 0.02
        ):
            return
    pytest.fail(f"never seen: {math.degrees(azimuth):.0f}, {math.degrees(off_axis):.0f} deg")


def test_search_rings_grow_without_jumps_of_the_line_of_sight() -> None:
    at = np.array([search_angles(t, WIDTH, HEIGHT) for t in np.arange(0.0, 120.0, 0.05)])
    assert tuple(at[0]) == (0.0, 0.0)
    assert np.abs(np.diff(at, axis=0)).max() < math.radians(2.5)
    largest = [
        np.abs(at[int(20 * a) : int(20 * b)]).max() for a, b in ((0, 14), (14, 40), (40, 80))
    ]
    assert largest[0] < largest[1] < largest[2] <= math.radians(170.0)


def test_chaser_pauses_its_search_for_8_s_at_most_to_acquire_and_turns_2_s_between() -> None:
    def turned_s(acquiring: Callable[[float], bool | None]) -> float:
        progress = SearchProgress(np.array([1.0, 0.0, 0.0, 0.0]), 1.0)
        for k in range(15 * 20 + 1):
            progress = progress.at(1.0 + k / 15, acquiring(k / 15))
        return 20.0 - progress.paused_s

    assert turned_s(lambda t: False) == 20.0
    assert turned_s(lambda t: t < 5.0) == pytest.approx(15.0, abs=0.1)
    # Images without a sighting do not end a pause.
    assert turned_s(lambda t: None if int(15 * t) % 3 else t < 5.0) == pytest.approx(15.0, abs=0.3)
    assert turned_s(lambda t: None) == 20.0
    assert turned_s(lambda t: True) == pytest.approx(4.0, abs=0.2)


def test_paused_search_goes_on_where_it_stopped() -> None:
    s = scenario()
    target = TargetState(0, V, V, np.array([1.0, 0.0, 0.0, 0.0]), W, np.eye(12), "none", 0, ())
    chaser, q = fleet_of(s).chasers[0], np.array([1.0, 0.0, 0.0, 0.0])
    chaser.fire(Trigger.TARGET_UNKNOWN, 0.0)
    x = np.concatenate([np.zeros(6), q, np.zeros(3)])
    command = None
    for k in range(61):
        now = ChaserTick(k / 15, _odometry(0, k, x), target, acquiring=k <= 30)
        command = chaser.directive(now, None).direct
    assert command is not None
    expected = search_wrench(_odometry(0, 60, x), s.chaser, s.camera_model(), q, 2.0)
    np.testing.assert_array_equal(command.wrench, expected)


def test_chaser_tracks_search_pattern_within_torque_limit() -> None:
    s = scenario()
    body = s.chaser
    x = np.concatenate([np.zeros(3), [0.02, 0.0, -0.01], [1.0, 0.0, 0.0, 0.0], np.zeros(3)])
    worst = 0.0
    for k in range(15 * 15):
        t = k / 15
        own = _odometry(0, k, x)
        u = search_wrench(own, body, CAMERA, np.array([1.0, 0.0, 0.0, 0.0]), t)
        assert np.abs(u[3:]).max() <= body.torque_max_N_m
        yaw, pitch = search_angles(t, WIDTH, HEIGHT)
        worst = max(
            worst, float(rotations.angle_between(x[6:10], rotations.exp([0.0, pitch, yaw])))
        )
        x = propagate(x, u, body, 1 / 15)
    assert worst < math.radians(12.0), math.degrees(worst)
    assert np.linalg.norm(x[3:6]) < 1e-3  # braked to rest


@settings(derandomize=True, max_examples=40, deadline=None)
@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
)
def test_facing_uses_the_smallest_rotation(turn: list[float], direction: list[float]) -> None:
    if np.linalg.norm(direction) < 1e-3:
        return
    q = rotations.exp(turn)
    found = facing(q, direction)
    x = rotations.rotate(found, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(x, np.array(direction) / np.linalg.norm(direction), atol=1e-9)
    angle = math.acos(float(np.clip(rotations.rotate(q, [1.0, 0.0, 0.0]) @ x, -1.0, 1.0)))
    assert float(rotations.angle_between(q, found)) == pytest.approx(angle, abs=1e-6)


def test_unknown_target_starts_search_then_goto_facing_the_target() -> None:
    guidance = fleet_of(scenario())
    guidance.miss_target(0.5, lost=False)
    assert guidance.chasers[0].phase == "acquire"
    guidance.miss_target(1.0, lost=False)
    assert [c.phase for c in guidance.chasers] == ["searching", "searching"]
    answer = order(guidance, OperatorCommand(command="approach", chaser=0), 2.0)
    assert not answer.accepted
    guidance.follow_target(3.0, [known(3.0)] * 2, seen=True, settled=False)
    assert guidance.chasers[0].phase == "searching"  # until the target motion is known
    here = known(4.0, offset_m=np.array([-1.2, 0.3, 0.1]))
    guidance.follow_target(4.0, [here, known(4.0, own=None)], seen=True, settled=True)
    c = guidance.chasers[0].state
    assert (c.phase, c.faces) == ("goto", True)
    np.testing.assert_allclose(c.move.at([4.0])[0][0], [-1.2, 0.3, 0.1])
    step(guidance.chasers[0], 100.0, 0.0, 0.0)
    assert (guidance.chasers[0].phase, guidance.chasers[0].state.faces) == ("hold", False)
    assert guidance.chasers[1].phase == "searching"


def test_controller_without_sightings_searches_and_reports_it() -> None:
    # The chasers do not move as commanded, which the joint filter would report.
    s = scenario(estimator={"name": "paper"})
    flight = ControllerCore(s, lambda: 0.0)
    events, modes, torque = [], [], ()
    for k in range(40):
        places = [s.start_pose(i) for i in range(2)]
        now = {
            i: _odometry(i, k, np.concatenate([p, np.zeros(3), q, np.zeros(3)]))
            for i, (p, q) in enumerate(places)
        }
        out = flight.step(tick_inputs(k, now[0].sim_time_ns, now, ()))
        events += [e.what for e in out.events]
        modes.append(out.wrenches[0].mode)
        torque = out.wrenches[0].torque_N_m
    assert events == ["chaser 0: searching (from acquire)", "chaser 1: searching (from acquire)"]
    assert modes[0] == "brake"
    assert modes[-1] == "search"
    assert any(torque)


# --- calibration ----------------------------------------------------------------------------------


def test_calibration_manoeuvre_starts_and_ends_at_rest_with_target_in_view() -> None:
    t = np.arange(-1.0, CALIBRATION_S + 1.0, 0.02)
    turns = calibration_turns(t)
    for k in (0, 25, 50, -1, -50):
        assert float(rotations.angle_between(turns[k], rotations.IDENTITY)) < 1e-3
    ahead = rotations.rotate(rotations.conjugate(turns), [1.0, 0.0, 0.0])
    assert np.abs(np.arctan2(ahead[:, 1], ahead[:, 0])).max() < WIDTH / 2 - math.radians(10.0)
    assert np.abs(np.arctan2(ahead[:, 2], ahead[:, 0])).max() < HEIGHT / 2 - math.radians(10.0)
    rates = rotations.log(rotations.multiply(rotations.conjugate(turns[:-1]), turns[1:])) / 0.02
    accelerations = np.diff(rates, axis=0) / 0.02
    body = scenario().chaser
    assert np.abs(accelerations * body.inertia).max() < 0.8 * body.torque_max_N_m


def test_calibrate_is_rejected_without_target_without_bias_states_and_outside_hold() -> None:
    def reply(guidance: ChaserFleet, now_s: float) -> str:
        return order(guidance, OperatorCommand(command="calibrate", chaser=0), now_s).reason

    exact = fleet_of(scenario())
    assert "not been found" in reply(exact, 0.0)
    for chaser in exact.chasers:
        chaser.fire(Trigger.TARGET_ACQUIRED, 1.0)
    assert "taken as exact" in reply(exact, 2.0)
    guidance = fleet_of(
        scenario(navigation={"grade": "exact", "camera_turn_deg": 0.3}), acquired_s=1.0
    )
    order(guidance, OperatorCommand(command="approach", chaser=0), 2.0)
    assert "hold first" in reply(guidance, 3.0)
