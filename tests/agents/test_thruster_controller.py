# SPDX-License-Identifier: Apache-2.0
"""Thruster controller of a chaser: failures, isolation, reported force limits and impulses; the
controller's use of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import planar_cases
import pytest
from chaserdock_agents.chaser.command_gate import passed_on
from chaserdock_agents.chaser.thrusters.controller import ThrusterController
from chaserdock_agents.chaser.thrusters.failure_reports import FailureReports
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.thruster_commands import ThrusterCommands
from chaserdock_controller.ingest.latency_compensation import (
    CommandHistory,
    predict_state,
)
from chaserdock_models.rigid_body import propagate
from chaserdock_models.thruster_model import Valves
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry, OperatorCommand, ThrusterReport
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.faults import faults_of
from flight_cases import fleet_of, odometry, order, tick_inputs
from flights.measured_poses import measurement_model
from thruster_cases import at_rest, box, mission, wrench

from chaserdock.experiments.flight_record import record_flight


def limits(report: ThrusterReport) -> np.ndarray:
    return np.array([*report.force_max_N, *report.torque_max_N_m])


def reporting(s: Scenario) -> tuple[ThrusterController, Callable[[Odometry], ThrusterReport]]:
    """Chaser 0's thrusters, and their ``observe`` after the test bed's reports."""
    pilot = ThrusterController(s, 0)
    reports = FailureReports(faults_of(s, "chaser/0").reported_failures)

    def observe(odometry: Odometry) -> ThrusterReport:
        reports.deliver(pilot, odometry.sim_time_ns)
        return pilot.observe(odometry)

    return pilot, observe


def test_a_planar_chaser_reports_no_limits_out_of_the_plane_and_less_without_a_thruster() -> None:
    s = planar_cases.scenario()
    thrusters, observe = reporting(s)
    assert limits(observe(at_rest(s, 0))) == pytest.approx([1.5, 1.5, 0.0, 0.0, 0.0, 0.15])
    thrusters.report_failure(2, "stuck_off", 0.0, 0)
    assert limits(thrusters.observe(at_rest(s, 1))) == pytest.approx(
        0.7727 * np.array([1.5, 1.5, 0.0, 0.0, 0.0, 0.15]), rel=1e-3
    )


def test_a_report_states_impulse_moment_and_magnitude_of_the_pulses_since_the_last_one() -> None:
    """Pulses of a wrench in general position, summed in small steps."""
    s = mission()
    thrusters, valves = ThrusterController(s, 0), Valves(s.chaser.thrusters)
    matrix = wrench_matrix(s.chaser.thrusters)
    thrusts_N = np.linspace(0.2, 1.3, 12)
    for tick in range(3):
        thrusters.observe(at_rest(s, tick))
        command = thrusters.add_pulses(passed_on(wrench(s, tick)), thrusts_N)
        for pulse in command.pulses:
            valves.pulse(pulse.thruster, pulse.open_ns, pulse.close_ns)
    report = thrusters.observe(at_rest(s, 3))
    before_ns, now_ns = s.timing.tick_time_ns(2), s.timing.tick_time_ns(3)
    edges = np.linspace(before_ns, now_ns, 5001)
    given = valves.impulses(edges)
    early_s = ((before_ns + now_ns) / 2 - (edges[1:] + edges[:-1]) / 2) * 1e-9
    for expected, force, torque in (
        (matrix @ given.sum(axis=0), report.given_impulse_N_s, report.given_angular_impulse_N_m_s),
        (matrix @ (early_s @ given), report.given_moment_N_s2, report.given_angular_moment_N_m_s2),
        (
            np.abs(matrix) @ given.sum(axis=0),
            report.given_magnitude_N_s,
            report.given_angular_magnitude_N_m_s,
        ),
    ):
        assert np.abs(expected).max() > 1e-4
        np.testing.assert_allclose([*force, *torque], expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("kind", ["stuck_off", "stuck_on", "weak"])
def test_reported_failure_takes_effect_immediately(kind: str) -> None:
    factor = {"factor": 0.5} if kind == "weak" else {}
    s = mission(
        thruster_failure=[
            {"chaser": 0, "thruster": 4, "at_s": 0.1, "kind": kind, "reported": True, **factor}
        ]
    )
    thrusters, observe = reporting(s)
    np.testing.assert_allclose(limits(observe(at_rest(s, 0))), box(s))
    assert observe(at_rest(s, 1)).thrusters == ("healthy",) * 12
    report = observe(at_rest(s, 2))
    assert report.thrusters[4] == kind
    assert report.isolated == (() if kind == "weak" else (4,))
    scale = limits(report) / box(s)
    assert np.ptp(scale) < 1e-12
    assert 0.5 < scale[0] < 1.0 or kind == "weak"
    assert any(
        f"thruster 4 {kind.replace('_', ' ')}" in what for _, what, _ in thrusters.drain_events()
    )
    command = thrusters.add_pulses(passed_on(wrench(s, 2, 1.0)))
    assert (4 in {p.thruster for p in command.pulses}) is False or kind == "weak"
    assert command.isolated == report.isolated


def test_unreported_failure_is_unknown_at_first() -> None:
    s = mission(thruster_failure=[{"chaser": 0, "thruster": 4, "at_s": 0.0, "kind": "stuck_on"}])
    _, observe = reporting(s)
    assert observe(at_rest(s, 0)).isolated == ()


def test_operator_isolates_and_restores_thruster() -> None:
    s = mission()
    thrusters = ThrusterController(s, 0)
    thrusters.observe(at_rest(s, 0))
    thrusters.apply_command(
        wrench(s, 0, isolated=(3, 200))
    )  # thruster 200 does not exist and is ignored
    command = thrusters.add_pulses(passed_on(wrench(s, 0, 1.5)))
    assert command.isolated == (3,)
    assert 3 not in {p.thruster for p in command.pulses}
    report = thrusters.observe(at_rest(s, 1))
    assert report.isolated == (3,)
    assert np.all(limits(report) < box(s))
    thrusters.apply_command(wrench(s, 1, trusted=(3,)))
    assert thrusters.add_pulses(passed_on(wrench(s, 1))).isolated == ()
    np.testing.assert_allclose(limits(thrusters.observe(at_rest(s, 2))), box(s))


def test_operator_restores_thruster_that_the_chaser_isolated() -> None:
    s = mission(
        thruster_failure=[
            {"chaser": 0, "thruster": 4, "at_s": 0.0, "kind": "stuck_off", "reported": True}
        ]
    )
    thrusters, observe = reporting(s)
    assert observe(at_rest(s, 0)).isolated == (4,)
    thrusters.apply_command(wrench(s, 0, trusted=(4,)))
    thrusters.add_pulses(passed_on(wrench(s, 0)))
    report = thrusters.observe(at_rest(s, 1))
    assert report.isolated == ()
    assert report.thrusters[4] == "healthy"


def test_failure_detection_is_off_while_held() -> None:
    """Pulses without motion are a thruster failure in free flight, but not for a chaser that is
    held.
    """
    for free in (True, False):
        s = mission()
        thrusters = ThrusterController(s, 0)
        for tick in range(40):
            thrusters.observe(at_rest(s, tick))
            push = wrench(s, tick, free=free, force_N=(1.5 if tick % 10 < 4 else 0.0))
            thrusters.apply_command(push)
            thrusters.add_pulses(passed_on(push))
        assert free or not thrusters.drain_events()


def test_contact_force_is_not_attributed_to_thrusters() -> None:
    """A force like that of the idle thruster 3 counts as its failure in free flight, but not during
    contact.
    """
    for touched in (False, True):
        s = mission()
        thrusters = ThrusterController(s, 0)
        push = wrench_matrix(s.chaser.thrusters)[:, 3] * s.chaser.thrusters[3].thrust_N
        for tick in range(10):
            time_ns = s.timing.tick_time_ns(tick)
            rates = push * (time_ns / 1e9) / ([s.chaser.mass_kg] * 3 + list(s.chaser.inertia))
            linear, angular = tuple(rates[:3].tolist()), tuple(rates[3:].tolist())
            still: Any = (1.0, 0.0, 0.0, 0.0)
            moved = odometry(
                tick=tick, time_ns=time_ns, velocity_m_s=linear, q_wxyz=still, omega_rad_s=angular
            )
            thrusters.observe(moved, touched)
            thrusters.apply_command(wrench(s, tick))
            thrusters.add_pulses(passed_on(wrench(s, tick)))
        assert thrusters.health.isolated == (() if touched else (3,))


def test_reported_impulse_equals_commanded_impulse() -> None:
    s = mission()
    thrusters = ThrusterController(s, 0)
    total = np.zeros(3)
    for tick in range(31):
        total += thrusters.observe(at_rest(s, tick), touched=True).given_impulse_N_s
        thrusters.add_pulses(passed_on(wrench(s, tick, 0.5 if tick < 15 else 0.0)))
    # 0.5 N for 1 s; each of the two firing thrusters is quantized to half its minimum impulse bit,
    # 15 mN s.
    np.testing.assert_allclose(total, [0.5, 0.0, 0.0], atol=0.03)


def test_pending_impulse_is_reported() -> None:
    s = mission(time={"rate_hz": 10, "image_hz": 10})
    thrusters = ThrusterController(s, 0)
    assert limits(thrusters.observe(at_rest(s, 0))).any()
    thrusters.add_pulses(passed_on(wrench(s, 0, 1.0)))
    # The command is in effect from 33 ms to 133 ms.
    pending = thrusters.observe(at_rest(s, 1)).coming_impulse_N_s
    assert 0.0 < pending[0] < 0.1


def test_prediction_by_impulse_equals_prediction_by_wrench() -> None:
    s = mission()
    o, history = odometry(velocity_m_s=(0.1, 0.0, 0.0)), CommandHistory()
    commanded = np.array([1.0, -0.5, 0.2, 0.01, 0.02, -0.03])
    history.add(0, commanded)
    still = np.zeros(6)
    expected = predict_state(o, history.ahead(0, 50_000_000), still, s.chaser)
    by_impulse = predict_state(o, ((0.05, commanded * 0.05 / 0.05),), still, s.chaser)
    np.testing.assert_allclose(by_impulse, expected, atol=1e-12)
    np.testing.assert_allclose(
        predict_state(o, ((0.05, still),), commanded, s.chaser), expected, atol=1e-12
    )
    assert predict_state(o, (), still, s.chaser)[3] == 0.1


def test_commanded_force_respects_reported_limits() -> None:
    s = mission()
    flight = ControllerCore(s, lambda: 0.0)
    o = odometry(velocity_m_s=(5.0, -5.0, 5.0))
    free = flight.step(tick_inputs(0, 0, {0: o}, ())).wrenches[0]
    report = ThrusterReport(
        chaser=0,
        tick=1,
        force_max_N=(0.5, 0.5, 0.5),
        torque_max_N_m=(0.05, 0.05, 0.05),
        coming_impulse_N_s=(0.0, 0.0, 0.0),
        coming_angular_impulse_N_m_s=(0.0, 0.0, 0.0),
        thrusters=("healthy",) * 12,
    )
    bound = flight.step(tick_inputs(1, 0, {0: o}, (), thrusters={0: report})).wrenches[0]
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
def test_operator_gets_reply_with_reason(
    command: dict[str, Any], accepted: bool, reason: str
) -> None:
    answer = order(fleet_of(mission()), OperatorCommand(command="isolate", **command), 2.0)
    assert (answer.accepted, reason in answer.reason) == (accepted, True)


def test_operator_commands_reach_the_chaser_and_persist() -> None:
    s = mission(timeline=[{"at_s": 0.0, "command": "isolate", "chasers": [0], "thruster": 2}])
    flight = ControllerCore(s, lambda: 0.0)
    out = flight.step(tick_inputs(0, 0, {0: odometry()}, ()))
    assert out.replies[0].accepted
    assert out.wrenches[0].isolated == (2,)
    back = OperatorCommand(command="restore", chaser=0, thruster=2)
    out = flight.step(tick_inputs(1, 66_666_666, {0: odometry(tick=1)}, (), (back, back)))
    assert [r.reason for r in out.replies] == [
        "thruster 2 restored",
        "thruster 2 is already restored",
    ]
    assert (out.wrenches[0].isolated, out.wrenches[0].trusted) == ((), (2,))
    ideal = ThrusterCommands(mission(chaser={"actuation": "ideal"}).chaser)
    assert not ideal.command(OperatorCommand(command="isolate", chaser=0, thruster=2), 0.0).accepted


@pytest.mark.slow
@pytest.mark.parametrize("thruster", [1, 6])
def test_stuck_thruster_is_isolated_within_half_a_second(thruster: int) -> None:
    """Closed loop without images: the thruster is isolated and tracking recovers."""
    failure = {"chaser": 0, "thruster": thruster, "at_s": 8.0, "kind": "stuck_on"}
    scenario = mission(duration_s=18.0, thruster_failure=[failure])
    record = record_flight(scenario, measurement_model(scenario, 0))
    isolated_s = [
        c.effective_time_ns / 1e9 - 8.0 for c in record.commands_of(0) if c.isolated == (thruster,)
    ]
    assert 0.0 < isolated_s[0] <= 0.5
    assert not [c for c in record.commands_of(0) if c.isolated not in ((), (thruster,))]
    late = record.time_s >= 8.0
    assert record.position_error_m[late, 0].max() < 0.05
    assert record.rms(16.0)[0] < 0.01
    assert math.degrees(record.rms(16.0)[1]) < 2.0


def test_a_weak_thruster_that_dies_later_is_isolated() -> None:
    """Closed loop of pulses and motion, random commands: weak from 1 s on, dead from 9 s on."""
    s, rng = mission(), np.random.default_rng(3)
    pilot, valves = ThrusterController(s, 0), Valves(s.chaser.thrusters)
    matrix, state = wrench_matrix(s.chaser.thrusters), np.eye(13)[6]
    reports: list[tuple[float, str]] = []
    isolated: tuple[int, ...] = ()
    tick = 0
    while not isolated and tick < 400:
        now_ns, next_ns = (s.timing.tick_time_ns(tick + k) for k in (0, 1))
        if tick == 15:
            valves.fail(4, "weak", now_ns, 0.5)
        if tick == 135:
            valves.fail(4, "stuck_off", now_ns)
        x, v, q, omega = np.split(state, [3, 6, 10])
        pilot.observe(
            odometry(
                tick=tick,
                time_ns=now_ns,
                position_m=vector(x),
                velocity_m_s=vector(v),
                q_wxyz=vector(q),
                omega_rad_s=vector(omega),
            )
        )
        reports += [
            (now_ns / 1e9, what) for _, what, _ in pilot.drain_events() if "limits" not in what
        ]
        asked = rng.uniform(-0.3, 0.3, 6) * box(s)
        command = msgspec.structs.replace(
            wrench(s, tick), force_N=vector(asked[:3]), torque_N_m=vector(asked[3:])
        )
        pilot.apply_command(command)
        done = pilot.add_pulses(passed_on(command))
        for p in done.pulses:
            valves.pulse(p.thruster, p.open_ns, p.close_ns)
        valves.set_shut(done.isolated, done.effective_time_ns)
        edges_ns = np.linspace(now_ns, next_ns, 5)
        for impulse, step_s in zip(valves.impulses(edges_ns), np.diff(edges_ns) / 1e9, strict=True):
            state = propagate(state, matrix @ impulse / step_s, s.chaser, float(step_s))
        valves.forget_before(now_ns)
        isolated, tick = done.isolated, tick + 1
    failures = [(what, time_s) for time_s, what in reports if what != "thrusters changed"]
    assert [what for what, _ in failures] == ["thruster 4 weak", "thruster 4 stuck off"]
    assert 9.0 < failures[1][1] < 11.0
    assert isolated == (4,)


def test_commanded_thrusts_replace_the_allocation_except_of_isolated_thrusters() -> None:
    s = mission(
        thruster_failure=[
            {"chaser": 0, "thruster": 4, "at_s": 0.0, "kind": "stuck_off", "reported": True}
        ]
    )
    thrusters, observe = reporting(s)
    observe(at_rest(s, 0))
    observe(at_rest(s, 1))
    thrusts = np.zeros(12)
    thrusts[[1, 4]] = 0.75
    fired: set[int] = set()
    for tick in range(1, 7):
        command = passed_on(wrench(s, tick))
        fired |= {p.thruster for p in thrusters.add_pulses(command, thrusts).pulses}
    assert fired == {1}
