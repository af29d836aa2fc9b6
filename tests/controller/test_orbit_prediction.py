# SPDX-License-Identifier: Apache-2.0
"""Clohessy-Wiltshire in the joint filter's prediction, and the wrench of an orbit that planning
cancels.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from chaserdock_controller.estimation.estimators import make_estimator
from chaserdock_controller.estimation.joint import parameters_of
from chaserdock_controller.estimation.joint.prediction import predict
from chaserdock_controller.estimation.joint.state import (
    POSITION,
    VELOCITY,
    JointState,
    block,
    empty_state,
)
from chaserdock_controller.estimation.stage import EstimationStage
from chaserdock_controller.interfaces import AppliedImpulse
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.relative_motion import cw_acceleration, cw_transition, cw_wrench
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario, flight_scenario, parse_scenario
from flight_cases import observation_of

STATE = np.array([80.0, -60.0, 20.0, 0.02, -0.15, 0.01, 0.8, 0.0, 0.6, 0.0, 0.0, 0.0, 0.0])


def mission(*, in_orbit: bool = True) -> FlightScenario:
    values = {
        "name": "test",
        "duration_s": 10.0,
        "navigation": {"grade": "exact"},
        "target": {"velocity_m_s": [0.0, 0.0, 0.0]},
        "chasers": [{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return flight_scenario(
        parse_scenario(values | ({"orbit": {"altitude_m": 4e5}} if in_orbit else {}), "x")
    )


def state_at(row: Array) -> JointState:
    position, velocity, q, omega = row[None, :3], row[None, 3:6], row[None, 6:10], row[None, 10:]
    known = np.ones(1, dtype=bool)
    return msgspec.structs.replace(
        empty_state(0, 1), positions_m=position, velocities_m_s=velocity, attitudes_wxyz=q,
        omegas_rad_s=omega,
        alive=known,
    )  # fmt: skip


def predicted(
    scenario: FlightScenario, state: JointState, ticks: int, period_s: float
) -> JointState:
    parameters = parameters_of(scenario)
    for k in range(1, ticks + 1):
        state = predict(
            state, round(k * period_s * 1e9), [AppliedImpulse.steady(np.zeros(6))], parameters
        )
    return state


def test_prediction_of_a_coasting_chaser_is_clohessy_wiltshire() -> None:
    scenario = mission()
    assert scenario.orbit is not None
    expected = cw_transition(scenario.orbit.elements.mean_motion_rad_s, 60.0) @ STATE[:6]
    end = predicted(scenario, state_at(STATE), 600, 0.1)
    assert end.positions_m[0] == pytest.approx(expected[:3], abs=1e-4)
    assert end.velocities_m_s[0] == pytest.approx(expected[3:], abs=1e-6)
    free = predicted(mission(in_orbit=False), state_at(STATE), 600, 0.1)
    assert np.linalg.norm(free.positions_m[0] - expected[:3]) > 0.1


def test_covariance_grows_with_the_transition_of_clohessy_wiltshire() -> None:
    """Errors of the prediction, by finite differences, are those of its transition matrix."""
    scenario, seconds = mission(), 1.0
    assert scenario.orbit is not None
    start = state_at(STATE)
    start.covariance[block(0), block(0)][VELOCITY, VELOCITY] = 1e4 * np.eye(
        3
    )  # outweighs the noise
    end = predicted(scenario, start, 1, seconds)
    phi = cw_transition(scenario.orbit.elements.mean_motion_rad_s, seconds)
    found = end.covariance[block(0), block(0)]
    assert found[POSITION, VELOCITY] == pytest.approx(1e4 * phi[:3, 3:] @ phi[3:, 3:].T, abs=0.02)
    assert abs(found[0, 4] / 1e4) > 5e-4  # the Coriolis term, which free motion does not have


def test_orbital_wrench_moves_a_free_body_by_clohessy_wiltshire() -> None:
    n, inertia = 1.1e-3, (0.3, 0.4, 0.5)
    body = parse_scenario(
        {
            "name": "b", "duration_s": 1.0, "chaser": {"inertia_kg_m2": inertia},
            "chasers": [{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
        },
        "x",
    ).chaser  # fmt: skip
    wrench = cw_wrench(n, STATE, body.mass_kg, body.inertia)
    force = rotations.rotate(STATE[6:10], wrench[:3])
    assert force / body.mass_kg == pytest.approx(
        cw_acceleration(n, STATE[:3], STATE[3:6]), abs=1e-15
    )
    end = propagate(STATE, wrench, body, 0.1)
    assert end[:6] == pytest.approx(cw_transition(n, 0.1) @ STATE[:6], abs=1e-8)


def odometry(row: Array) -> Odometry:
    zeros = (0.0,) * 9
    return Odometry(
        tick=0, sim_time_ns=0, chaser=0, position_m=vector(row[:3]), velocity_m_s=vector(row[3:6]),
        q_wxyz=vector(row[6:10]), omega_rad_s=vector(row[10:]), position_covariance_m2=zeros,
        velocity_covariance_m2_s2=zeros, attitude_covariance_rad2=zeros,
        omega_covariance_rad2_s2=zeros,
    )  # fmt: skip


def test_planning_cancels_the_wrench_of_the_orbit() -> None:
    scenario = mission()
    assert scenario.orbit is not None
    observation = observation_of(0, {0: odometry(STATE)}, chasers=1)
    stage = EstimationStage(scenario, make_estimator("joint", scenario))
    own = stage.run(observation).chasers[0].own
    assert own is not None
    found = own.disturbance
    body = scenario.chaser
    mean_motion = scenario.orbit.elements.mean_motion_rad_s
    assert found == pytest.approx(
        cw_wrench(mean_motion, STATE, body.mass_kg, body.inertia), rel=1e-6
    )
    assert np.linalg.norm(found[:3]) > 5e-4
