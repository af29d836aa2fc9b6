# SPDX-License-Identifier: Apache-2.0
"""The braking wrench: opposes the motion, in body axes, within the limits of force and torque per
axis.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from chaserdock_models.arrays import Array
from chaserdock_models.braking import BRAKE_TIME_S, brake_wrench

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Moving:
    velocity_m_s: Vector
    omega_rad_s: Vector
    q_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Actuated:
    mass_kg: float = 6.0
    inertia: Vector = (0.3, 0.6, 0.9)
    wrench_max: Array = field(default_factory=lambda: np.array([0.5] * 3 + [0.02] * 3))


def test_slow_motion_decays_with_the_time_constant() -> None:
    body = Actuated()
    wrench = brake_wrench(Moving((0.1, -0.2, 0.05), (0.03, -0.02, 0.01)), body)
    assert wrench[:3] == pytest.approx(-body.mass_kg / BRAKE_TIME_S * np.array([0.1, -0.2, 0.05]))
    assert wrench[3:] == pytest.approx([-0.003, 0.004, -0.003])


def test_each_axis_of_fast_motion_is_limited_on_its_own() -> None:
    wrench = brake_wrench(Moving((9.0, -9.0, 0.1), (-9.0, 0.01, 9.0)), Actuated())
    assert wrench == pytest.approx([-0.5, 0.5, -0.2, 0.02, -0.002, -0.02])


def test_velocity_is_relative_and_in_body_axes() -> None:
    quarter_turn_z = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    moving = Moving((0.2, 0.0, 0.0), (0.0, 0.0, 0.0), quarter_turn_z)
    assert brake_wrench(moving, Actuated(), (0.1, 0.0, 0.0))[:3] == pytest.approx([0.0, 0.2, 0.0])


def test_an_axis_without_authority_gets_no_command() -> None:
    body = Actuated(wrench_max=np.array([0.5, 0.5, 0.0, 0.0, 0.0, 0.02]))
    wrench = brake_wrench(Moving((0.1, -0.2, 0.05), (0.03, -0.02, 0.01)), body)
    assert np.flatnonzero(wrench).tolist() == [0, 1, 5]
