# SPDX-License-Identifier: Apache-2.0
"""Ideal actuators: effective times, limits, and the output they report."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_protocol.messages import ActuatorCommand
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_world.actuators.ideal import IdealActuators, fly_to
from chaserdock_world.physics.simulation import Physics
from hypothesis import given, settings
from hypothesis import strategies as st
from world_cases import HZ, STEP_S, scenario

BODY = Body()


def command(seq: int, fx_N: float, torque_N_m: float = 0.0) -> ActuatorCommand:
    return ActuatorCommand(
        seq=seq,
        tick=seq,
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=(fx_N, 0.0, 0.0),
        torque_N_m=(torque_N_m, 0.0, 0.0),
    )


def test_command_acts_from_its_effective_step_until_the_next() -> None:
    a = IdealActuators(BODY)
    a.command(command(0, 1.0), 10, 0)
    a.command(command(1, 2.0), 20, 0)
    assert a.next_change(0) == 10
    np.testing.assert_array_equal(a.act(0, 10, STEP_S), np.zeros(6))
    assert a.next_change(10) == 20
    assert a.act(10, 10, STEP_S)[0] == 1.0
    assert a.next_change(20) is None
    assert a.act(20, 5, STEP_S)[0] == 2.0
    assert a.act(25, 100, STEP_S)[0] == 2.0  # the last one holds
    assert a.late == 0


def test_commands_act_in_order_of_effective_step_not_of_arrival() -> None:
    a = IdealActuators(BODY)
    for seq, effective in ((2, 30), (0, 10), (1, 20)):
        a.command(command(seq, float(seq) / 2), effective, 0)
    assert [a.act(step, 10, STEP_S)[0] for step in (0, 10, 20, 30)] == [0.0, 0.0, 0.5, 1.0]


def test_higher_sequence_number_wins_at_equal_effective_step() -> None:
    for order in ((0, 1), (1, 0)):
        a = IdealActuators(BODY)
        for seq in order:
            a.command(command(seq, 1.0 + seq / 2), 10, 0)
        assert a.act(10, 1, STEP_S)[0] == 1.5


def test_repeated_sequence_number_is_accepted() -> None:
    """A chaser that restarts counts from zero again."""
    a = IdealActuators(BODY)
    a.command(command(3, 1.0), 10, 0)
    a.command(command(3, 0.5), 10, 0)
    assert a.act(10, 1, STEP_S)[0] in (0.5, 1.0)


def test_late_command_acts_at_once_and_is_counted() -> None:
    a = IdealActuators(BODY)
    a.act(0, 50, STEP_S)
    a.command(command(0, 1.0), 49, 50)
    a.command(command(1, 1.25), 50, 50)  # just in time
    assert a.next_change(50) is None
    assert a.act(50, 1, STEP_S)[0] == 1.25
    assert a.take_output(0)[3] == 1
    assert a.take_output(0)[3] == 0


def test_wrench_is_limited_and_saturation_reported() -> None:
    a = IdealActuators(BODY)
    a.command(command(0, BODY.force_max_N, -BODY.torque_max_N_m), 0, 0)
    a.act(0, 1, STEP_S)
    assert a.take_output(0)[2] is False
    a.command(command(1, -5.0, 1.0), 1, 0)
    np.testing.assert_array_equal(a.act(1, 1, STEP_S), [-2.0, 0.0, 0.0, 0.05, 0.0, 0.0])
    assert a.take_output(0)[2] is True
    assert a.take_output(0)[2] is False


def test_output_integrates_impulse() -> None:
    a = IdealActuators(BODY)
    both = ActuatorCommand(
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=(1.0, -2.0, 0.5),
        torque_N_m=(0.01, 0.0, -0.02),
    )
    a.command(both, HZ, 0)
    a.act(0, HZ, STEP_S)
    a.act(HZ, HZ // 2, STEP_S)
    impulse, absolute, *_ = a.take_output(0)
    np.testing.assert_allclose(impulse, [0.5, -1.0, 0.25, 0.005, 0.0, -0.01], rtol=1e-12)
    assert absolute == pytest.approx(3.5 / 2)
    assert a.take_output(0)[1] == 0.0


def test_stop_clears_wrench_and_queue() -> None:
    a = IdealActuators(BODY)
    a.command(command(0, 1.0), 0, 0)
    a.command(command(1, 2.0), 20, 0)
    a.act(0, 10, STEP_S)
    a.stop(10)
    assert a.next_change(10) is None
    np.testing.assert_array_equal(a.act(20, 10, STEP_S), np.zeros(6))


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(-2, 2)), max_size=6),
    st.lists(st.integers(1, 59), max_size=3, unique=True),
)
@settings(derandomize=True, deadline=None, max_examples=60)
def test_body_receives_the_integral_of_the_commands(
    commands: list[tuple[int, int]], stops: list[int]
) -> None:
    """``fly_to`` splits the flight at every change: the momentum gained is the commands'
    integral.
    """
    physics = Physics(scenario())
    a = IdealActuators(BODY)
    for seq, (step, force) in enumerate(commands):
        a.command(command(seq, float(force)), step, 0)
    for end in (*sorted(stops), 60):
        fly_to(end, physics, {"chaser/0": a}, STEP_S)
        assert physics.step_count == end
    expected, force = 0.0, 0.0
    for step in range(60):
        for seq in [s for s, (effective, _) in enumerate(commands) if effective == step]:
            force = float(commands[seq][1])
        expected += force * STEP_S
    impulse, absolute, saturated, *_ = a.take_output(0)
    velocity = physics.state("chaser/0").velocity_m_s
    physics.close()
    assert impulse[0] == pytest.approx(expected, abs=1e-12)
    assert absolute >= abs(expected) - 1e-12
    assert not saturated
    np.testing.assert_allclose(velocity, [expected / BODY.mass_kg, 0.0, 0.0], rtol=0, atol=1e-12)
