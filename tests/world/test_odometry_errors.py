# SPDX-License-Identifier: Apache-2.0
"""The world's odometry sensor: noise, drift and biases have the stated statistics and depend on the
tick only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_world.sensors.errors import OdometrySensor
from chaserdock_world.sensors.publish import odometry_of
from hypothesis import given, settings
from hypothesis import strategies as st
from world_cases import scenario

STATE = BodyState(
    np.array([1.0, 2.0, 3.0]), np.zeros(3), rotations.normalize([0.4, -0.5, 0.6, 0.2]), np.zeros(3)
)


def sensor(seed: int = 0, **figures: Any) -> OdometrySensor:
    return OdometrySensor(scenario(seed=seed, navigation={"grade": "exact", **figures}))


def offsets(seen: list[BodyState]) -> Array:
    return np.array([s.position_m - STATE.position_m for s in seen])


def turns(seen: list[BodyState]) -> Array:
    return rotations.log(
        [rotations.multiply(rotations.conjugate(STATE.q_wxyz), s.q_wxyz) for s in seen]
    )


def test_exact_odometry_is_the_state_itself() -> None:
    assert sensor().measure(0, 3, STATE) is STATE


def test_drift_has_the_stated_sigma_and_correlation_over_the_seeds() -> None:
    """Two times 5 s apart with a correlation time of 10 s: correlation exp(-1/2)."""
    ticks, first, second = (0, 75), [], []
    for seed in range(400):
        s = sensor(seed, position_drift_m=0.02, position_drift_time_s=10.0)
        a, b = (offsets([s.measure(0, tick, STATE)])[0] for tick in ticks)
        first.append(a)
        second.append(b)
    a, b = np.ravel(first), np.ravel(second)
    assert a.std() == pytest.approx(0.02, rel=0.06)  # 1200 samples: 2 % at one sigma
    assert b.std() == pytest.approx(0.02, rel=0.06)
    assert np.mean(a * b) / 0.02**2 == pytest.approx(np.exp(-0.5), abs=0.1)


def test_drift_of_the_attitude_is_correlated_in_time() -> None:
    s = sensor(attitude_drift_deg=0.5, attitude_drift_time_s=2.0)
    drift = turns([s.measure(0, tick, STATE) for tick in range(6000)])
    assert np.degrees(drift.std()) == pytest.approx(0.5, rel=0.15)
    steps = np.diff(drift, axis=0).std() / drift.std()
    assert steps == pytest.approx(np.sqrt(2.0 * (1.0 - np.exp(-1.0 / 30.0))), rel=0.1)


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.permutations(range(12)), st.integers(0, 50))
def test_measurements_do_not_depend_on_the_order_of_calls(order: list[int], seed: int) -> None:
    mission = scenario(
        seed=seed,
        navigation={"grade": "poor"},
        chasers=[
            {"position_m": [x, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]} for x in (-5.0, -3.0)
        ],
    )
    asked = [(k % 2, k // 2) for k in order]
    one, other = OdometrySensor(mission), OdometrySensor(mission)
    in_order = {key: one.measure(*key, STATE) for key in sorted(asked)}
    for key in asked:
        measured = other.measure(*key, STATE)
        for name in ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s"):
            np.testing.assert_array_equal(getattr(measured, name), getattr(in_order[key], name))


def test_roll_and_cross_axes_have_their_own_noise() -> None:
    s = sensor(attitude_noise_deg=0.01, attitude_roll_noise_deg=0.05)
    sigma = np.degrees(turns([s.measure(0, tick, STATE) for tick in range(2000)])).std(axis=0)
    np.testing.assert_allclose(sigma, [0.05, 0.01, 0.01], rtol=0.06)


def test_gyro_bias_is_constant_in_a_mission_and_differs_between_missions() -> None:
    biases = []
    for seed in range(200):
        s = sensor(seed, gyro_bias_deg_s=0.1)
        first, later = s.measure(0, 0, STATE), s.measure(0, 50, STATE)
        np.testing.assert_array_equal(first.omega_rad_s, later.omega_rad_s)
        biases.append(np.degrees(first.omega_rad_s))
    assert np.std(biases) == pytest.approx(0.1, rel=0.12)


def test_message_states_the_covariance_of_the_white_noise_alone() -> None:
    s = sensor(
        position_noise_m=0.003,
        position_drift_m=0.02,
        velocity_noise_m_s=0.001,
        attitude_noise_deg=0.01,
        attitude_roll_noise_deg=0.05,
        attitude_bias_deg=1.0,
        omega_noise_deg_s=0.02,
    )
    message = odometry_of(s, 0, STATE, 1, 1)
    for name, sigma in (
        ("position_covariance_m2", [0.003] * 3),
        ("velocity_covariance_m2_s2", [0.001] * 3),
        ("attitude_covariance_rad2", np.radians([0.05, 0.01, 0.01])),
        ("omega_covariance_rad2_s2", np.radians([0.02] * 3)),
    ):
        np.testing.assert_allclose(
            np.reshape(getattr(message, name), (3, 3)), np.diag(np.square(sigma)), rtol=1e-12
        )


def test_stated_covariance_is_that_of_the_measurements() -> None:
    s = OdometrySensor(scenario(navigation={"grade": "lab"}))
    seen = [s.measure(0, tick, STATE) for tick in range(2000)]
    stated = np.sqrt(
        np.diag(np.reshape(odometry_of(s, 0, STATE, 0, 0).position_covariance_m2, (3, 3)))
    )
    np.testing.assert_allclose(offsets(seen).std(axis=0), stated, rtol=0.06)
