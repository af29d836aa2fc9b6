# SPDX-License-Identifier: Apache-2.0
"""Nothing moves that must not, and limits hold whatever is commanded."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from chaserdock_agents.gateway.actuation import RobotActuation
from chaserdock_agents.gateway.arming import ArmingRequests
from chaserdock_agents.gateway.safety import (
    Obedience,
    RobotSight,
    SafetyGate,
    limited_duty,
    limited_wrench,
    violations,
)
from chaserdock_models.clock import Timing
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import ActuatorCommand, ArmingCommand, ArmingReply, ThrusterPulse
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.lab import LabSafety

LIMITS = LabSafety.model_validate(
    {
        "volume": {"lower_m": (-1.0, -2.0, 0.0), "upper_m": (3.0, 2.0, 1.5)},
        "max_speed_m_s": 0.3,
        "max_rate_deg_s": 20.0,
        "max_force_N": 2.0,
        "max_torque_N_m": 0.1,
    }
)
GOOD = RobotSight(1, 0.02, 0.05, np.array([2.9, -1.9, 0.1]), 0.29, math.radians(19.0))


def test_a_robot_within_all_limits_may_move() -> None:
    assert violations(GOOD, LIMITS) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"odometry_age_s": 0.21}, "odometry lost (0.21 s old"),
        ({"odometry_age_s": math.nan}, "odometry lost"),
        ({"position_m": None}, "odometry lost"),
        ({"position_m": np.array([3.01, 0.0, 0.5])}, "left the volume, at (3.010, 0.000, 0.500)"),
        ({"position_m": np.array([0.0, -2.1, 0.5])}, "left the volume"),
        ({"position_m": np.array([0.0, np.nan, 0.5])}, "left the volume"),
        ({"speed_m_s": 0.31}, "too fast, 0.310 m/s"),
        ({"speed_m_s": math.nan}, "too fast"),
        ({"rate_rad_s": math.radians(21.0)}, "turns too fast, 21.0 deg/s"),
        ({"command_age_s": 0.25}, "command stale (0.25 s old"),
        ({"jumped_m": 0.3}, "odometry jumped by 0.30 m"),
        ({"unexplained_m_s2": 0.06}, "does not obey, 0.060 m/s²"),
        ({"unexplained_m_s2": math.nan}, "does not obey"),
    ],
)
def test_what_must_not_happen_disarms_all_with_a_named_reason(change: dict, said: str) -> None:
    gate = SafetyGate(LIMITS)
    assert gate.request("arm", "me", (GOOD,)) == (True, "armed by me")
    other = dataclasses.replace(GOOD, chaser=0)
    assert gate.check((other, GOOD)) == ""
    reason = gate.check((other, dataclasses.replace(GOOD, **change)))
    assert "chaser 1: " in reason
    assert said in reason
    assert not gate.is_armed
    assert gate.reason == reason
    assert gate.check((other, GOOD)) == ""
    assert not gate.is_armed  # until a person arms again
    assert gate.request("arm", "me", (other, GOOD))[0]


def test_robots_that_must_not_move_are_not_armed() -> None:
    gate = SafetyGate(LIMITS)
    lost = dataclasses.replace(GOOD, odometry_age_s=math.inf, position_m=None)
    accepted, reason = gate.request("arm", "me", (GOOD, lost))
    assert not accepted
    assert "odometry lost (none" in reason
    assert not gate.is_armed


def test_acceleration_that_no_command_explains_is_found() -> None:
    """A robot of 18 kg obeys a changing force; then a constant force of 2 N is added."""
    rng, mass_kg = np.random.default_rng(3), 18.0
    obedience, velocity = Obedience(mass_kg), np.array([0.1, -0.05, 0.02])
    seen = []
    for k in range(1500):
        force = np.array([math.sin(k / 70), math.cos(k / 40), 0.3])
        pushed = np.array([1.2, -1.6, 0.0]) if k >= 1000 else np.zeros(3)
        obedience.observe(k * 10_000_000, velocity + rng.normal(0, 0.005, 3))
        obedience.command(force)
        velocity = velocity + (force + pushed) / mass_kg * 0.01
        seen.append(obedience.unexplained_m_s2)
    assert max(seen[:1000]) < 0.015
    assert abs(np.mean(seen[-50:]) - 2.0 / mass_kg) < 0.03


def test_before_the_first_command_none_is_stale() -> None:
    gate = SafetyGate(LIMITS)
    gate.request("arm", "me", (GOOD,))
    assert gate.check((dataclasses.replace(GOOD, command_age_s=math.inf),)) == ""


def test_kill_is_final() -> None:
    gate = SafetyGate(LIMITS)
    gate.request("arm", "me", (GOOD,))
    assert gate.request("kill", "a button", (GOOD,)) == (True, "killed by a button")
    accepted, reason = gate.request("arm", "me", (GOOD,))
    assert not accepted
    assert "start the gateway again" in reason
    gate.trip("odometry")
    assert gate.state == "killed"


def test_requests_that_stop_come_first() -> None:
    requests = ArmingRequests()
    requests.not_yet = ""
    said: list[ArmingReply] = []
    for action in ("arm", "disarm", "kill"):
        requests.add(action, "me", said.append)
    assert [action for action, _, _ in requests.take()] == ["kill", "disarm", "arm"]
    assert requests.take() == []


def test_wrenches_are_scaled_to_the_limits_and_keep_their_direction() -> None:
    force, torque = limited_wrench(np.array([3.0, -4.0, 12.0]), np.array([0.01, 0, 0]), LIMITS)
    np.testing.assert_allclose(force, np.array([3.0, -4.0, 12.0]) * 2.0 / 13.0)
    np.testing.assert_allclose(torque, [0.01, 0, 0])
    bad = limited_wrench(np.array([np.nan, 0.0, 0.0]), np.array([0.01, 0, 0]), LIMITS)
    assert not np.any(bad)


BODY = Body.model_validate({"body": "tetra12", "actuation": "thrusters"})


def test_duty_is_scaled_until_its_wrench_is_within_the_limits() -> None:
    matrix = wrench_matrix(BODY.thrusters)
    rng = np.random.default_rng(1)
    for _ in range(50):
        asked = rng.uniform(-0.5, 1.5, len(BODY.thrusters))
        duty = limited_duty(asked, matrix, LIMITS)
        wrench = matrix @ duty
        assert np.linalg.norm(wrench[:3]) <= 2.0 + 1e-9
        assert np.linalg.norm(wrench[3:]) <= 0.1 + 1e-9
        assert (duty >= 0.0).all()
        assert (duty <= 1.0).all()


TIMING = Timing(physics_hz=960, rate_hz=15, image_hz=15, latency_steps=32)


def command(tick: int, **fields: object) -> ActuatorCommand:
    values = {
        "tick": tick,
        "sim_time_ns": TIMING.tick_time_ns(tick),
        "chaser": 0,
        "effective_time_ns": TIMING.effective_ns(tick),
        "source": "command",
        "force_N": (0.1, 0.2, 0.3),
        "torque_N_m": (0.01, 0.02, 0.03),
    }
    return ActuatorCommand(**{**values, **fields})  # type: ignore[arg-type]


def test_a_wrench_acts_from_its_effective_time_on() -> None:
    ideal = Body.model_validate({"actuation": "ideal"})
    actuation = RobotActuation(ideal, TIMING)
    step = TIMING.step_of_time(TIMING.effective_ns(3))
    actuation.command(command(3), step, TIMING.step_of_tick(3))
    due_ns = TIMING.time_ns(step)
    assert actuation.take(due_ns - 1) is None
    output = actuation.take(due_ns)
    assert output is not None
    np.testing.assert_array_equal(output[0], [0.1, 0.2, 0.3])
    assert actuation.take(due_ns + 1) is None
    actuation.stop(step)
    output = actuation.take(due_ns + 2)
    assert output is not None
    assert not output[0].any()


PERIOD_NS = 1_000_000_000 // BODY.modulation.carrier_hz
FIRST_NS = TIMING.effective_ns(0)
"""When the first carrier period begins."""


def pulse(thruster: int, begin_ns: int, share: float) -> ThrusterPulse:
    """Return a pulse in the middle of a carrier period."""
    width_ns = round(share * PERIOD_NS)
    open_ns = begin_ns + (PERIOD_NS - width_ns) // 2
    return ThrusterPulse(thruster=thruster, open_ns=open_ns, close_ns=open_ns + width_ns)


def duties(actuation: RobotActuation, begin_ns: int, end_ns: int) -> list[tuple[int, np.ndarray]]:
    """Return times and duties of the outputs between two times, looked for each 2 ms."""
    outputs = ((t, actuation.take(t)) for t in range(begin_ns, end_ns, 2_000_000))
    return [(t, output[2]) for t, output in outputs if output is not None]


def test_duty_of_a_carrier_period_is_the_share_of_its_pulses() -> None:
    actuation = RobotActuation(BODY, TIMING)
    begin_ns = FIRST_NS + 10 * PERIOD_NS
    pulses = (pulse(2, begin_ns, 0.25), pulse(5, begin_ns, 0.5), pulse(7, begin_ns, 0.5))
    step = TIMING.step_of_time(begin_ns)
    actuation.command(command(9, pulses=pulses, isolated=(7,)), step, step)
    output = actuation.take(TIMING.time_ns(step))
    assert output is not None
    force, torque, duty = output
    expected = np.zeros(len(BODY.thrusters))
    expected[2], expected[5] = 0.25, 0.5
    np.testing.assert_allclose(duty, expected, atol=1e-6)
    np.testing.assert_allclose(
        np.concatenate([force, torque]), wrench_matrix(BODY.thrusters) @ expected, atol=1e-6
    )
    assert actuation.take(TIMING.time_ns(step) + 1000) is None
    after = actuation.take(begin_ns + PERIOD_NS + 1000)
    assert after is not None
    assert not after[2].any()


@pytest.mark.parametrize("late_ms", [0, 30])
def test_duty_of_every_period_is_held_for_a_period_though_commands_are_late(late_ms: int) -> None:
    actuation, sent = RobotActuation(BODY, TIMING), []
    for k in range(5):
        begin_ns = FIRST_NS + k * PERIOD_NS
        arrived_ns = begin_ns + late_ms * 1_000_000
        sent += duties(actuation, begin_ns, arrived_ns)
        step = TIMING.step_of_time(begin_ns)
        changed = command(k, pulses=(pulse(3, begin_ns, 0.1 * (k + 1)),))
        actuation.command(changed, step, TIMING.step_of_time(arrived_ns))
        sent += duties(actuation, arrived_ns + 2_000_000, begin_ns + PERIOD_NS)
    sent += duties(actuation, FIRST_NS + 5 * PERIOD_NS, FIRST_NS + 7 * PERIOD_NS)
    assert [round(float(duty[3]), 3) for _, duty in sent] == [0.1, 0.2, 0.3, 0.4, 0.5, 0.0]
    times_ns = np.array([t for t, _ in sent])
    assert np.abs(np.diff(times_ns) - PERIOD_NS).max() <= 4_000_000


def test_arm_is_refused_at_once_before_the_mission_begins() -> None:
    requests, replies = ArmingRequests(), []
    requests.submit(ArmingCommand(action="arm", operator="one"), replies.append)
    requests.submit(ArmingCommand(action="kill", operator="two"), replies.append)
    assert [(r.accepted, r.reason) for r in replies] == [(False, "the mission has not begun")]
    requests.not_yet = ""
    requests.submit(ArmingCommand(action="arm", operator="three"), replies.append)
    assert [(action, by) for action, by, _ in requests.take()] == [
        ("kill", "two"),
        ("arm", "three"),
    ]
