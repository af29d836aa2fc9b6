# SPDX-License-Identifier: Apache-2.0
"""A chaser's thrusters in flight: what it is told, finds and tells, and what the controller makes of that."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.chaser.command_gate import passed_on
from chaserdock_agents.chaser.thrusters.controller import ThrusterController
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.thruster_commands import ThrusterCommandHandler
from chaserdock_controller.ingest.latency_compensation import (
    CommandHistory,
    predict_state,
    predict_state_with_impulse,
)
from chaserdock_controller.interfaces import TickInputs
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import OperatorCommand, ThrusterReport
from flight_cases import odometry
from thruster_cases import at_rest, box, mission, wrench

from chaserdock.evaluation.flight_record import record_flight
from chaserdock.evaluation.perception import measurement_model


def limits(report: ThrusterReport) -> np.ndarray:
    return np.array([*report.force_max_N, *report.torque_max_N_m])


@pytest.mark.parametrize("kind", ["stuck_off", "stuck_on", "weak"])
def test_what_it_is_told_it_acts_upon_at_once(kind: str) -> None:
    factor = {"factor": 0.5} if kind == "weak" else {}
    s = mission(
        thruster_failure=[{"chaser": 0, "thruster": 4, "at_s": 0.1, "kind": kind, "reported": True, **factor}]
    )
    pilot = ThrusterController(s, 0)
    np.testing.assert_allclose(limits(pilot.observe(at_rest(s, 0))), box(s))
    assert pilot.observe(at_rest(s, 1)).thrusters == ("healthy",) * 12
    report = pilot.observe(at_rest(s, 2))
    assert report.thrusters[4] == kind
    assert report.isolated == (() if kind == "weak" else (4,))
    scale = limits(report) / box(s)
    assert np.ptp(scale) < 1e-12
    assert 0.5 < scale[0] < 1.0 or kind == "weak"
    assert any(f"thruster 4 {kind.replace('_', ' ')}" in what for _, what, _ in pilot.drain_events())
    given = pilot.add_pulses(passed_on(wrench(s, 2, 1.0)))
    assert (4 in {p.thruster for p in given.pulses}) is False or kind == "weak"
    assert given.isolated == report.isolated


def test_what_nobody_told_it_does_not_know() -> None:
    s = mission(thruster_failure=[{"chaser": 0, "thruster": 4, "at_s": 0.0, "kind": "stuck_on"}])
    pilot = ThrusterController(s, 0)
    assert pilot.observe(at_rest(s, 0)).isolated == ()


def test_an_operator_isolates_and_restores() -> None:
    s = mission()
    pilot = ThrusterController(s, 0)
    pilot.observe(at_rest(s, 0))
    pilot.apply_command(wrench(s, 0, isolated=(3, 200)))  # of a thruster that is not there nothing comes
    given = pilot.add_pulses(passed_on(wrench(s, 0, 1.5)))
    assert given.isolated == (3,)
    assert 3 not in {p.thruster for p in given.pulses}
    report = pilot.observe(at_rest(s, 1))
    assert report.isolated == (3,)
    assert np.all(limits(report) < box(s))
    pilot.apply_command(wrench(s, 1, trusted=(3,)))
    assert pilot.add_pulses(passed_on(wrench(s, 1))).isolated == ()
    np.testing.assert_allclose(limits(pilot.observe(at_rest(s, 2))), box(s))


def test_an_operator_may_trust_a_thruster_that_the_chaser_does_not() -> None:
    s = mission(
        thruster_failure=[{"chaser": 0, "thruster": 4, "at_s": 0.0, "kind": "stuck_off", "reported": True}]
    )
    pilot = ThrusterController(s, 0)
    assert pilot.observe(at_rest(s, 0)).isolated == (4,)
    pilot.apply_command(wrench(s, 0, trusted=(4,)))
    pilot.add_pulses(passed_on(wrench(s, 0)))
    report = pilot.observe(at_rest(s, 1))
    assert report.isolated == ()
    assert report.thrusters[4] == "healthy"


def test_who_is_held_looks_for_no_failures() -> None:
    """Pulses that move nothing: a chaser in flight blames its thrusters, one that is held does not."""
    for free in (True, False):
        s = mission()
        pilot = ThrusterController(s, 0)
        for tick in range(40):
            pilot.observe(at_rest(s, tick))
            push = wrench(s, tick, free=free, force_N=(1.5 if tick % 10 < 4 else 0.0))
            pilot.apply_command(push)
            pilot.add_pulses(passed_on(push))
        assert free or not pilot.drain_events()


def test_what_the_docking_sensor_feels_is_no_thrusters_fault() -> None:
    """Pushed as by thruster 3, which nobody asked: blamed in free flight, and not when the sensor has felt something."""
    for touched in (False, True):
        s = mission()
        pilot = ThrusterController(s, 0)
        push = wrench_matrix(s.chaser.thrusters)[:, 3] * s.chaser.thrusters[3].thrust_N
        for tick in range(10):
            time_ns = s.timing.tick_time_ns(tick)
            rates = push * (time_ns / 1e9) / ([s.chaser.mass_kg] * 3 + list(s.chaser.inertia))
            linear, angular = tuple(rates[:3].tolist()), tuple(rates[3:].tolist())
            still: Any = (1.0, 0.0, 0.0, 0.0)
            moved = odometry(
                tick=tick, time_ns=time_ns, velocity_m_s=linear, q_wxyz=still, omega_rad_s=angular
            )
            pilot.observe(moved, touched)
            pilot.apply_command(wrench(s, tick))
            pilot.add_pulses(passed_on(wrench(s, tick)))
        assert pilot.isolated == (() if touched else (3,))


def test_impulse_given_is_told() -> None:
    s = mission()
    pilot = ThrusterController(s, 0)
    total = np.zeros(3)
    for tick in range(31):
        total += pilot.observe(at_rest(s, tick), touched=True).given_impulse_N_s
        pilot.add_pulses(passed_on(wrench(s, tick, 0.5 if tick < 15 else 0.0)))
    # A second of 0.5 N; each of the thrusters that push within half of its least pulse, 15 mN s.
    np.testing.assert_allclose(total, [0.5, 0.0, 0.0], atol=0.03)


def test_impulse_under_way_is_told() -> None:
    s = mission(time={"rate_hz": 10, "image_hz": 10})
    pilot = ThrusterController(s, 0)
    assert limits(pilot.observe(at_rest(s, 0))).any()
    pilot.add_pulses(passed_on(wrench(s, 0, 1.0)))
    # The period that began at 33 ms goes on until 133 ms, when the next command takes effect.
    half = pilot.observe(at_rest(s, 1)).coming_impulse_N_s
    assert 0.0 < half[0] < 0.1


def test_a_state_with_the_impulse_of_a_command_is_that_with_the_command() -> None:
    s = mission()
    o, history = odometry(velocity_m_s=(0.1, 0.0, 0.0)), CommandHistory()
    given = np.array([1.0, -0.5, 0.2, 0.01, 0.02, -0.03])
    history.add(0, 0, given)
    expected = predict_state(o, history, 50_000_000, s.chaser)
    np.testing.assert_allclose(
        predict_state_with_impulse(o, given * 0.05, 50_000_000, s.chaser), expected, atol=1e-12
    )
    assert predict_state_with_impulse(o, given, 0, s.chaser)[3] == 0.1


def test_the_controller_asks_for_no_more_than_the_thrusters_left_can_give() -> None:
    s = mission()
    flight = ControllerCore(s, lambda: 0.0)
    o = odometry(velocity_m_s=(5.0, -5.0, 5.0))
    free = flight.step(TickInputs(0, 0, {0: o}, ())).wrenches[0]
    report = ThrusterReport(
        chaser=0,
        tick=1,
        force_max_N=(0.5, 0.5, 0.5),
        torque_max_N_m=(0.05, 0.05, 0.05),
        coming_impulse_N_s=(0.0, 0.0, 0.0),
        coming_angular_impulse_N_m_s=(0.0, 0.0, 0.0),
        thrusters=("healthy",) * 12,
    )
    bound = flight.step(TickInputs(1, 0, {0: o}, (), thrusters={0: report})).wrenches[0]
    assert max(map(abs, free.force_N)) == s.chaser.force_max_N
    assert max(map(abs, bound.force_N)) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize(
    ("command", "accepted", "reason"),
    [
        ({"chaser": 0, "thruster": 3}, True, "thruster 3 isolated"),
        ({"chaser": 0, "thruster": 12}, False, "needs a thruster; this body has 0 to 11"),
        ({"chaser": 0}, False, "needs a thruster"),
        ({"chaser": 4, "thruster": 0}, False, "there is no chaser 4"),
        (
            {"chaser": 0, "thruster": 3, "expires_ns": 10**9},
            False,
            "stale: the command expired at 1.00 s, now is 2.00 s",
        ),
    ],
)
def test_operators_are_answered(command: dict[str, Any], accepted: bool, reason: str) -> None:
    answer = ThrusterCommandHandler(mission()).command(OperatorCommand(command="isolate", **command), 2.0)
    assert (answer.accepted, reason in answer.reason) == (accepted, True)


def test_operators_commands_reach_the_chaser_and_stay() -> None:
    s = mission(timeline=[{"at_s": 0.0, "command": "isolate", "chasers": [0], "thruster": 2}])
    flight = ControllerCore(s, lambda: 0.0)
    out = flight.step(TickInputs(0, 0, {0: odometry()}, ()))
    assert out.replies[0].accepted
    assert out.wrenches[0].isolated == (2,)
    back = OperatorCommand(command="restore", chaser=0, thruster=2)
    out = flight.step(TickInputs(1, 66_666_666, {0: odometry(tick=1)}, (), (back, back)))
    assert [r.reason for r in out.replies] == ["thruster 2 restored", "thruster 2 is already restored"]
    assert (out.wrenches[0].isolated, out.wrenches[0].trusted) == ((), (2,))
    ideal = ThrusterCommandHandler(mission(chaser={"actuation": "ideal"}))
    assert not ideal.command(OperatorCommand(command="isolate", chaser=0, thruster=2), 0.0).accepted


@pytest.mark.parametrize("thruster", [1, 6])
def test_a_stuck_thruster_is_isolated_in_flight_within_half_a_second(thruster: int) -> None:
    """The closed loop, without images: found, shut off, and back on the reference."""
    failure = {"chaser": 0, "thruster": thruster, "at_s": 8.0, "kind": "stuck_on"}
    scenario = mission(duration_s=18.0, thruster_failure=[failure])
    record = record_flight(scenario, measurement_model(scenario, 0))
    shut_s = [c.effective_time_ns / 1e9 - 8.0 for c in record.commands_of(0) if c.isolated == (thruster,)]
    assert 0.0 < shut_s[0] <= 0.5
    assert not [c for c in record.commands_of(0) if c.isolated not in ((), (thruster,))]
    late = record.time_s >= 8.0
    assert record.position_error_m[late, 0].max() < 0.05
    assert record.rms(16.0)[0] < 0.01
    assert math.degrees(record.rms(16.0)[1]) < 2.0
