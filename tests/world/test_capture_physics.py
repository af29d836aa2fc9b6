# SPDX-License-Identifier: Apache-2.0
"""Contact, latch and capture in the simulation, and conservation of momentum."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import view_of
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario.docking import Port
from chaserdock_world.physics.latch import ProbeLatch
from chaserdock_world.physics.simulation import TARGET, Physics
from docking_cases import CHASER_INERTIA, CHASER_KG, REACH_M, TARGET_INERTIA, TARGET_KG, scenario
from engine_cases import both

HZ = 960


def momentum(physics: Physics) -> tuple[Array, Array]:
    """Momentum and angular momentum about WRF's origin of chaser and target, (3,) each."""
    linear, angular = np.zeros(3), np.zeros(3)
    for name, mass, inertia in (
        (TARGET, TARGET_KG, TARGET_INERTIA),
        ("chaser/0", CHASER_KG, CHASER_INERTIA),
    ):
        s = physics.state(name)
        linear += mass * s.velocity_m_s
        angular += np.cross(s.position_m, mass * s.velocity_m_s)
        angular += rotations.rotate(s.q_wxyz, np.array(inertia) * s.omega_rad_s)
    return linear, angular


def relative(physics: Physics) -> tuple[Array, Array]:
    """Pose of the chaser in TRF."""
    a, b = physics.state(TARGET), physics.state("chaser/0")
    return (
        rotations.rotate_inverse(a.q_wxyz, b.position_m - a.position_m),
        rotations.multiply(rotations.conjugate(a.q_wxyz), b.q_wxyz),
    )


def latch_of(physics: Physics) -> ProbeLatch:
    return physics.latches["chaser/0"]


def test_a_view_states_how_the_tip_was_placed_before_an_oblique_port() -> None:
    """Tip 60 mm before the port, 25 mm beside its axis, approaching, sliding and turning."""
    axis = np.array([-2.0, 6.0, 3.0]) / 7.0
    side, across = np.array([6.0, 3.0, -2.0]) / 7.0, np.array([-3.0, 2.0, -6.0]) / 7.0
    port = Port(chaser=0, position_m=(0.21, -0.17, 0.13), axis=(axis[0], axis[1], axis[2]))
    reach_m, q_off = 0.35, rotations.exp((0.4, -1.1, 0.7))
    target = BodyState(
        np.array([3.0, -2.0, 5.0]),
        np.array([0.04, 0.07, -0.02]),
        rotations.exp((-0.9, 0.5, 1.3)),
        np.array([0.05, -0.08, 0.11]),
    )
    attitude = rotations.multiply(q_off, rotations.exp(0.06 * across))  # CRF to TRF
    tip = np.asarray(port.position_m) + 0.06 * axis + 0.025 * side
    tip_velocity = -0.012 * axis + 0.005 * across
    turning = target.omega_rad_s + 0.03 * side  # TRF
    arm = rotations.rotate(attitude, (reach_m, 0.0, 0.0))
    velocity = np.cross(target.omega_rad_s, tip) + tip_velocity - np.cross(turning, arm)
    chaser = BodyState(
        target.position_m + rotations.rotate(target.q_wxyz, tip - arm),
        target.velocity_m_s + rotations.rotate(target.q_wxyz, velocity),
        rotations.multiply(target.q_wxyz, attitude),
        rotations.rotate_inverse(attitude, turning),
    )
    view = view_of(port, reach_m, q_off, chaser, target)
    assert dataclasses.astuple(view) == pytest.approx((0.06, 0.025, 0.06, 0.012, 0.005, 0.03))


@both
@pytest.mark.parametrize("omega", [(0.0, 0.0, 0.0), (0.015, 0.045, 0.03), (0.045, 0.135, 0.09)])
def test_armed_latch_closes_holds_and_conserves_momentum(
    worlds: Any, omega: tuple[float, float, float]
) -> None:
    """Through the touch, the capture and 20 s after: momentum to 1e-4, nothing slips by more than 5
    um.
    """
    physics = worlds(omega_rad_s=omega)
    before = momentum(physics)
    physics.command_latch(0, "arm", 0)
    touched = physics.advance(HZ, {})
    assert latch_of(physics).latched
    held = relative(physics)
    for _ in range(4):
        touched |= physics.advance(5 * HZ, {})
    after = momentum(physics)
    for a, b in zip(before, after, strict=True):
        assert np.linalg.norm(b - a) <= 1e-4 * np.linalg.norm(a)
    now = relative(physics)
    assert np.linalg.norm(now[0] - held[0]) < 5e-6
    assert rotations.angle_between(now[1], held[1]) < 1e-5
    assert touched == set()
    (touch,) = latch_of(physics).take_touches()
    assert touch.latched
    assert touch.refused == ""
    assert touch.lateral_m < 1e-3
    assert 0.004 < touch.closing_m_s < 0.012


@both
def test_latched_bodies_move_as_one_until_release(worlds: Any) -> None:
    physics = worlds(omega_rad_s=(0.0, 0.0, 0.0))
    physics.command_latch(0, "arm", 0)
    physics.advance(HZ, {})
    held, before = relative(physics), momentum(physics)[0]
    pull = {"chaser/0": np.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0])}
    physics.advance(2 * HZ, pull)
    assert np.linalg.norm(relative(physics)[0] - held[0]) < 2e-5
    assert (
        abs(float((momentum(physics)[0] - before)[0]) + 1.0) < 0.02
    )  # 0.5 N for 2 s, body axes hardly turned
    physics.command_latch(0, "release", physics.step_count)
    physics.advance(2 * HZ, pull)
    assert not latch_of(physics).latched
    # Alone: 0.5 N on 17.8 kg for 2 s, which is 56 mm, less half a millimetre for the parting.
    assert float((relative(physics)[0] - held[0])[0]) == pytest.approx(-0.056, abs=0.005)


@both
@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"closing_m_s": 0.035}, "closing speed"),
        ({"lateral_m": 0.012}, "lateral"),
        ({"turn_rad": math.radians(4.0)}, "angle"),
    ],
)
def test_probe_outside_tolerances_bounces(
    worlds: Any, changes: dict[str, float], reason: str
) -> None:
    physics = worlds(omega_rad_s=(0.0, 0.0, 0.0), **changes)
    physics.command_latch(0, "arm", 0)
    physics.advance(HZ, {})
    latch = latch_of(physics)
    assert not latch.latched
    assert latch.touched
    (touch,) = latch.touches
    assert touch.refused.startswith(reason)
    before = float(relative(physics)[0][0])
    physics.advance(HZ // 4, {})
    assert float(relative(physics)[0][0]) < before  # it moves away


@both
def test_a_touch_is_as_soft_as_the_documentation_states(worlds: Any) -> None:
    """At 1 cm/s: 0.3 mm deep, and back at about a third of the speed (docs/docking.md)."""
    physics = worlds(omega_rad_s=(0.0, 0.0, 0.0))
    depth, speed = 0.0, 0.0
    for _ in range(HZ // 2):
        before = float(relative(physics)[0][0])
        physics.advance(1, {})
        tip = float(relative(physics)[0][0])
        depth, speed = max(depth, tip + REACH_M + 0.2), (tip - before) * HZ
    assert depth == pytest.approx(3e-4, abs=3e-5)
    assert -speed == pytest.approx(0.0035, abs=0.0004)


@both
def test_unarmed_latch_does_not_close(worlds: Any) -> None:
    physics = worlds()
    physics.advance(HZ, {})
    assert [t.refused for t in latch_of(physics).touches] == ["not armed"]


def test_latch_command_acts_at_its_effective_step(worlds: Any) -> None:
    physics = worlds(gap_m=0.5)
    physics.command_latch(0, "arm", 10)
    physics.command_latch(0, "keep", 11)
    physics.command_latch(7, "arm", 0)  # there is no such latch
    physics.advance(10, {})
    assert not latch_of(physics).armed
    physics.advance(1, {})
    assert latch_of(physics).armed
    physics.command_latch(0, "release", 0)
    physics.advance(1, {})
    assert not latch_of(physics).armed


@both
def test_body_contact_is_not_a_probe_touch(worlds: Any) -> None:
    """Sideways on: the chaser's flank meets the target."""
    physics = worlds()
    target = physics.state(TARGET)
    state = physics.state("chaser/0")
    aside = rotations.multiply(target.q_wxyz, rotations.exp((0.0, 0.0, math.pi / 2)))
    offset = np.array([-0.2 - 0.165 - 0.002, 0.0, 0.0])
    moving = rotations.cross(target.omega_rad_s, offset) + np.array([0.02, 0.0, 0.0])
    physics.place(
        "chaser/0",
        type(state)(
            target.position_m + rotations.rotate(target.q_wxyz, offset),
            target.velocity_m_s + rotations.rotate(target.q_wxyz, moving),
            aside,
            rotations.rotate_inverse(rotations.exp((0.0, 0.0, math.pi / 2)), target.omega_rad_s),
        ),
    )
    physics.command_latch(0, "arm", 0)
    assert physics.advance(HZ // 2, {}) == {("chaser/0", TARGET)}
    assert latch_of(physics).touches == []


def test_scenario_without_capture_has_no_latch_and_no_probe() -> None:
    physics = Physics(scenario(docking={"kind": "held"}))
    try:
        assert physics.latches == {}
    finally:
        physics.close()
