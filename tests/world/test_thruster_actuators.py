# SPDX-License-Identifier: Apache-2.0
"""Thrusters in the world: the body gets what they give at their places, however they fail and
whatever comes late.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import ActuatorCommand, ThrusterPulse
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.actuators.ideal import IdealActuators, fly_to
from chaserdock_world.actuators.thrusters import ThrusterActuators, make_actuators
from chaserdock_world.physics.simulation import Physics
from hypothesis import given, settings
from hypothesis import strategies as st
from thruster_cases import mission

STEP_S = 1.0 / 960
MS = 1_000_000
quick = settings(derandomize=True, deadline=None, max_examples=25)


def command(
    *pulses: tuple[int, int, int], isolated: tuple[int, ...] = (), effective_ns: int = 0
) -> ActuatorCommand:
    return ActuatorCommand(
        chaser=0,
        effective_time_ns=effective_ns,
        source="command",
        force_N=(0.0, 0.0, 0.0),
        torque_N_m=(0.0, 0.0, 0.0),
        pulses=tuple(
            ThrusterPulse(thruster=j, open_ns=a * MS, close_ns=b * MS) for j, a, b in pulses
        ),
        isolated=isolated,
    )


def thrusters_of(s: Scenario) -> ThrusterActuators:
    actuators = make_actuators(s, 0)
    assert isinstance(actuators, ThrusterActuators)
    return actuators


def momentum(physics: Physics, s: Scenario) -> tuple[Array, Array]:
    """Of the chaser, WRF."""
    state = physics.state("chaser/0")
    spin = np.asarray(s.chaser.inertia) * state.omega_rad_s
    return s.chaser.mass_kg * state.velocity_m_s, rotations.rotate(state.q_wxyz, spin)


def test_ideal_actuation_gives_ideal_actuators() -> None:
    assert isinstance(make_actuators(mission(chaser={"actuation": "ideal"}), 0), IdealActuators)


@given(
    st.lists(st.tuples(st.integers(0, 11), st.integers(0, 60), st.integers(10, 60)), max_size=5),
    st.lists(st.integers(1, 119), max_size=4, unique=True),
)
@quick
def test_body_receives_thruster_forces_at_their_positions(
    pulses: list[tuple[int, int, int]], stops: list[int]
) -> None:
    s = mission()
    physics, thrusters = Physics(s), thrusters_of(s)
    thrusters.command(command(*[(j, a, a + w) for j, a, w in pulses]), 0, 0)
    for end in (*sorted(stops), 140):
        fly_to(end, physics, {"chaser/0": thrusters}, STEP_S)
    took = thrusters.take_output(140)
    wrench = wrench_matrix(s.chaser.thrusters) @ np.array(took.thruster_impulse_N_s)
    linear, angular = momentum(physics, s)
    physics.close()
    # Impulse and momentum agree while the body has hardly turned.
    np.testing.assert_allclose(took.impulse, wrench, atol=2e-6)
    np.testing.assert_allclose(
        linear, wrench[:3], atol=0.02 * float(np.linalg.norm(wrench[:3])) + 2e-3
    )
    np.testing.assert_allclose(
        angular, wrench[3:], atol=0.02 * float(np.linalg.norm(wrench[3:])) + 2e-4
    )
    assert took.propellant_kg == pytest.approx(sum(took.thruster_impulse_N_s) / (70.0 * 9.80665))
    assert np.all(
        np.array(took.thruster_open_s) * 1.5 >= np.array(took.thruster_impulse_N_s) - 1e-9
    )


@pytest.mark.parametrize("thruster", range(12))
def test_absolute_impulse_sums_the_sizes_of_the_components(thruster: int) -> None:
    s = mission()
    physics, thrusters = Physics(s), thrusters_of(s)
    thrusters.command(command((thruster, 0, 40)), 0, 0)
    fly_to(140, physics, {"chaser/0": thrusters}, STEP_S)
    took = thrusters.take_output(140)
    physics.close()
    given = wrench_matrix(s.chaser.thrusters)[:3] @ np.array(took.thruster_impulse_N_s)
    assert took.absolute_impulse_N_s == pytest.approx(np.abs(given).sum(), rel=1e-6)


def test_grouping_of_steps_does_not_change_thruster_output() -> None:
    states = []
    for slices in ([200], [7, 50, 51, 100, 200]):
        s = mission()
        physics, thrusters = Physics(s), thrusters_of(s)
        thrusters.command(command((0, 3, 40), (5, 20, 77), (7, 100, 180)), 0, 0)
        for end in slices:
            fly_to(end, physics, {"chaser/0": thrusters}, STEP_S)
        state = physics.state("chaser/0")
        states.append(
            np.concatenate([state.position_m, state.velocity_m_s, state.q_wxyz, state.omega_rad_s])
        )
        physics.close()
    np.testing.assert_array_equal(states[0], states[1])


def test_stuck_thruster_fires_until_isolated() -> None:
    s = mission(thruster_failure=[{"chaser": 0, "thruster": 2, "at_s": 0.05, "kind": "stuck_on"}])
    physics, thrusters = Physics(s), thrusters_of(s)
    fly_to(96, physics, {"chaser/0": thrusters}, STEP_S)
    assert thrusters.take_output(96).thruster_impulse_N_s[2] == pytest.approx(1.5 * 0.049, rel=1e-3)
    thrusters.command(command(isolated=(2,), effective_ns=150 * MS), 144, 96)
    fly_to(960, physics, {"chaser/0": thrusters}, STEP_S)
    assert thrusters.take_output(960).thruster_impulse_N_s[2] == pytest.approx(
        1.5 * 0.051, rel=1e-3
    )
    fly_to(1920, physics, {"chaser/0": thrusters}, STEP_S)
    assert thrusters.take_output(1920).thruster_impulse_N_s[2] == 0.0
    physics.close()


def test_passed_part_of_a_late_pulse_is_lost() -> None:
    s = mission()
    physics, thrusters = Physics(s), thrusters_of(s)
    fly_to(48, physics, {"chaser/0": thrusters}, STEP_S)  # 50 ms
    thrusters.command(command((0, 0, 40), (1, 10, 100), (2, 45, 55)), 10, 48)
    fly_to(192, physics, {"chaser/0": thrusters}, STEP_S)
    took = thrusters.take_output(192)
    assert took.late == 1
    assert not took.saturated
    np.testing.assert_allclose(took.thruster_open_s[:3], [0.0, 0.05, 0.0], atol=1e-6)
    physics.close()


def test_infeasible_pulses_are_reported_as_saturated() -> None:
    for pulse in ((12, 0, 50), (0, 0, 5), (0, 50, 20)):
        thrusters = thrusters_of(mission())
        thrusters.command(command(pulse), 0, 0)
        assert thrusters.take_output(96).saturated is (pulse[2] > pulse[1])
        assert sum(thrusters.take_output(192).thruster_impulse_N_s) == 0.0


def test_lost_chaser_closes_its_valves() -> None:
    s = mission()
    physics, thrusters = Physics(s), thrusters_of(s)
    thrusters.command(command((0, 0, 1000)), 0, 0)
    fly_to(48, physics, {"chaser/0": thrusters}, STEP_S)
    thrusters.stop(48)
    fly_to(960, physics, {"chaser/0": thrusters}, STEP_S)
    assert thrusters.take_output(960).thruster_open_s[0] == pytest.approx(0.05)
    physics.close()
