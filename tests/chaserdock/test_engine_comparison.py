# SPDX-License-Identifier: Apache-2.0
"""The physics engines agree in free flight, with thrusters and over a capture, and each is
deterministic.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from engine_cases import ENGINES
from flights.engine_comparison import CASES, EngineFlight, difference, fly_case

NANO, MICRO = 1e-9, 1e-6


@functools.cache
def flights(case: str, duration_s: float) -> tuple[EngineFlight, EngineFlight]:
    first, second = (fly_case(CASES[case](1), engine, duration_s) for engine in ENGINES)
    return first, second


def distance_m(flight: EngineFlight, name: str) -> float:
    """How far a body has moved."""
    return float(
        np.linalg.norm(flight.states[-1][name].position_m - flight.states[0][name].position_m)
    )


@pytest.mark.slow
def test_engines_agree_over_30_s_of_free_flight() -> None:
    bullet, mujoco = flights("free", 30.0)
    apart = difference(bullet, mujoco)
    assert apart.position_m < NANO
    assert apart.angle_rad < NANO
    for flight in (bullet, mujoco):
        assert 0.0 <= flight.momentum_error < 1e-12
        assert 0.0 < flight.angular_momentum_error < 1e-4
        assert rate_change(flight, "target") > 0.03  # it tumbles: its rate is not constant


def rate_change(flight: EngineFlight, name: str) -> float:
    rates = np.array([states[name].omega_rad_s for states in flight.states])
    return float(np.linalg.norm(rates - rates[0], axis=1).max())


@pytest.mark.slow
def test_engines_agree_with_thrusters() -> None:
    bullet, mujoco = flights("thrusters", 8.0)
    apart = difference(bullet, mujoco)
    assert apart.position_m < NANO
    assert apart.angle_rad < NANO
    assert min(distance_m(bullet, f"chaser/{i}") for i in range(4)) > 0.1


@pytest.mark.slow
def test_engines_agree_over_a_capture_and_30_s_after_it() -> None:
    """The joint stops the same closing speed; without loads the stack then moves alike."""
    bullet, mujoco = flights("capture", 30.0)
    assert bullet.latched_ticks == mujoco.latched_ticks
    assert list(bullet.latched_ticks) == ["chaser/0"]
    assert 0 < bullet.latched_ticks["chaser/0"] < 8  # 2 mm at 1 cm/s
    apart = difference(bullet, mujoco)
    assert apart.position_m < 10 * MICRO
    assert apart.angle_rad < math.radians(1e-3)
    assert apart.force_N < 0.01
    closing = [
        sum(tick["chaser/0"].closing_impulse_N_s for tick in f.loads) for f in (bullet, mujoco)
    ]
    assert closing[0] == pytest.approx(
        closing[1], rel=0.02
    )  # and the touch before it, against a spring
    assert closing[0] > 0.05
    for flight in (bullet, mujoco):
        assert 0.0 <= flight.momentum_error < 1e-12
        assert 0.0 < flight.angular_momentum_error < 1e-4


@pytest.mark.slow
def test_engines_agree_on_a_stack_that_fires_its_thrusters() -> None:
    bullet, mujoco = flights("stack", 3.0)
    apart = difference(bullet, mujoco)
    assert apart.position_m < 10 * MICRO
    assert apart.angle_rad < math.radians(1e-3)
    peak_N = max(load.peak_force_N for tick in bullet.loads for load in tick.values())
    assert peak_N > 0.5
    assert apart.force_N < 0.05 * peak_N


def test_a_capture_on_mujoco_is_the_same_bit_by_bit() -> None:
    first, second = (fly_case(CASES["capture"](1), "mujoco", 2.0) for _ in range(2))
    assert list(first.latched_ticks) == ["chaser/0"]
    for a, b in zip(first.states, second.states, strict=True):
        for name, state in a.items():
            for field in ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s"):
                np.testing.assert_array_equal(getattr(state, field), getattr(b[name], field))
