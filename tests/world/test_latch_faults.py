# SPDX-License-Identifier: Apache-2.0
"""Strength, play and faults of latches in the simulation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_world.physics.compliant_latch import ENGAGED_M
from chaserdock_world.physics.simulation import TARGET, Physics
from docking_cases import CHASER_KG, HZ, TARGET_KG, balance, latch, momenta
from engine_cases import both

PULL = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
TARGET_SHARE = TARGET_KG / (TARGET_KG + CHASER_KG)
STILL = (0.0, 0.0, 0.0)


def fault(kind: str, at_s: float, duration_s: float, **more: float) -> dict[str, Any]:
    return {"kind": kind, "at_s": at_s, "duration_s": duration_s, "process": "chaser/0", **more}


def latched(physics: Physics) -> bool:
    return physics.latches["chaser/0"].latched


def place(physics: Physics) -> Array:
    """Pose of the chaser's centre in TRF."""
    a, b = physics.state(TARGET), physics.state("chaser/0")
    return rotations.rotate_inverse(a.q_wxyz, b.position_m - a.position_m)


def turn_deg(physics: Physics) -> float:
    a, b = physics.state(TARGET), physics.state("chaser/0")
    return math.degrees(rotations.angle_between(a.q_wxyz, b.q_wxyz))


def total(physics: Physics) -> tuple[Array, Array]:
    parts = [momenta(physics, name) for name in (TARGET, "chaser/0")]
    return parts[0][0] + parts[1][0], parts[0][1] + parts[1][1]


# -- strength --------------------------------------------------------------------------------------


@both
@pytest.mark.parametrize("play_m", [0.0, 0.0001], ids=["rigid", "play"])
@pytest.mark.parametrize(
    ("key", "unit", "limit", "axis", "share"),
    [("strength_N", "N", 5.0, 0, TARGET_SHARE), ("strength_N_m", "N m", 0.5, 4, 0.5)],
    ids=["force", "torque"],
)
def test_a_latch_opens_beyond_its_strength(
    worlds: Any, play_m: float, key: str, unit: str, limit: float, axis: int, share: float
) -> None:
    """``share`` of a force or torque on the chaser that reaches the port, about."""
    physics = worlds(omega_rad_s=STILL, truth={"latch": {"play_m": play_m, key: limit}})
    latch(physics)
    weak, strong = np.zeros(6), np.zeros(6)
    weak[axis], strong[axis] = -0.2 * limit, -1.3 * limit / share
    physics.advance(HZ // 2, {"chaser/0": weak})
    assert latched(physics)
    assert physics.take_openings() == []
    physics.advance(HZ // 2, {"chaser/0": strong})
    assert not latched(physics)
    ((chaser, text),) = physics.take_openings()
    assert chaser == 0
    assert text.endswith(f"{unit} on the port, strength {limit:g} {unit}")
    assert physics.take_openings() == []
    physics.advance(HZ, {"chaser/0": 5.0 * PULL})
    assert np.linalg.norm(place(physics) - [-0.55, 0.0, -0.05]) > 0.05  # it is free


def test_closing_does_not_count_for_the_strength(worlds: Any) -> None:
    """The rigid joint stops 1 cm/s in one step: more than 100 N, an artefact of the step."""
    physics = worlds(omega_rad_s=STILL, truth={"latch": {"strength_N": 3.0}})
    latch(physics)
    physics.advance(HZ // 2, {})
    assert latched(physics)


# -- play ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_play_lets_the_chaser_move_that_far_and_no_farther(worlds: Any) -> None:
    physics = worlds(omega_rad_s=STILL, truth={"latch": {"play_m": 0.003}})
    latch(physics)
    begin = place(physics)
    physics.advance(4 * HZ, {"chaser/0": PULL})
    out_m = float((begin - place(physics))[0])
    assert out_m == pytest.approx(0.003, abs=5e-4)
    physics.advance(4 * HZ, {"chaser/0": -PULL})
    in_m = float((place(physics) - begin)[0])
    assert in_m == pytest.approx(0.003, abs=5e-4)


def test_play_of_the_angle(worlds: Any) -> None:
    physics = worlds(omega_rad_s=STILL, truth={"latch": {"play_deg": 1.0}})
    latch(physics)
    begin = turn_deg(physics)
    physics.advance(4 * HZ, {"chaser/0": np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0])})
    assert turn_deg(physics) - begin == pytest.approx(1.0, abs=0.1)


@both
@pytest.mark.parametrize("wrench", [np.zeros(6), np.array([0.3, 0.5, -0.2, 0.05, 0.1, 0.02])])
def test_load_of_a_latch_with_play_is_what_the_chaser_lacks(worlds: Any, wrench: Array) -> None:
    physics = worlds(
        truth={
            "preset": "mismatch",
            "latch": {"play_m": 0.0005},
            "target": {"centre_of_mass_m": 0.05},
        }
    )
    latch(physics)
    physics.advance(300, {"chaser/0": wrench})
    for _ in range(5):
        target = physics.state(TARGET)
        physics.port_loads["chaser/0"].take()
        force, torque = balance(physics, wrench)
        loads = physics.port_loads["chaser/0"].take()
        q_port = rotations.multiply(target.q_wxyz, np.array([0.0, 0.0, 0.0, 1.0]))
        assert np.linalg.norm(rotations.rotate(q_port, loads.force_N) - force) < 1e-6
        assert np.linalg.norm(rotations.rotate(q_port, loads.torque_N_m) - torque) < 1e-4


@pytest.mark.slow
def test_a_stack_with_play_conserves_momentum(worlds: Any) -> None:
    physics = worlds(truth={"latch": {"play_m": 0.001, "play_deg": 0.2}})
    latch(physics)
    before = total(physics)
    physics.advance(10 * HZ, {})
    assert latched(physics)
    for a, b in zip(before, total(physics), strict=True):
        assert np.linalg.norm(b - a) <= 1e-4 * np.linalg.norm(a)


# -- faults ----------------------------------------------------------------------------------------


def test_a_slipping_latch_transmits_its_grip_and_no_more(worlds: Any) -> None:
    """Beyond the grip the chaser slides off its place; below it, and afterwards, it holds."""
    physics = worlds(omega_rad_s=STILL, fault=[fault("latch_slip", 1.0, 2.0, force_N=0.3)])
    latch(physics)
    physics.advance(HZ - physics.step_count, {})
    begin = place(physics)
    physics.advance(HZ // 2, {"chaser/0": 0.3 * PULL})  # 0.2 N at the port
    assert np.linalg.norm(place(physics) - begin) < 1e-4
    physics.port_loads["chaser/0"].take()
    physics.advance(HZ // 4, {"chaser/0": PULL})
    slid_m = float((begin - place(physics))[0])
    # 1 N less 0.3 N on 17.8 kg, and 0.3 N on 40 kg, for a quarter of a second.
    assert slid_m == pytest.approx(0.5 * (0.7 / CHASER_KG - 0.3 / TARGET_KG) * 0.25**2, rel=0.1)
    assert physics.port_loads["chaser/0"].take().peak_force_N == pytest.approx(0.3, rel=0.01)
    physics.advance(HZ // 2, {})  # friction stops it
    rest = place(physics)
    physics.advance(2 * HZ, {"chaser/0": 0.0 * PULL})
    assert np.linalg.norm(place(physics) - rest) < 1e-4
    physics.advance(HZ, {"chaser/0": PULL})  # the fault is over
    assert latched(physics)
    assert np.linalg.norm(place(physics) - rest) < 3e-4


def test_a_latch_that_slips_too_far_is_out_of_its_port(worlds: Any) -> None:
    physics = worlds(omega_rad_s=STILL, fault=[fault("latch_slip", 0.5, 20.0, force_N=0.1)])
    latch(physics)
    physics.advance(2 * HZ, {"chaser/0": PULL})
    assert not latched(physics)
    ((_, text),) = physics.take_openings()
    assert text == f"slipped {ENGAGED_M * 1e3:.0f} mm, out of its port"


@both
def test_a_latch_slips_in_rotation(worlds: Any) -> None:
    physics = worlds(omega_rad_s=STILL, fault=[fault("latch_slip", 0.5, 20.0, torque_N_m=0.01)])
    latch(physics)
    physics.advance(HZ // 2, {})
    begin, at = turn_deg(physics), place(physics)
    physics.advance(HZ, {"chaser/0": np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0])})
    assert turn_deg(physics) - begin > 1.0
    assert np.linalg.norm(place(physics) - at) < 2e-3
    assert latched(physics)


def test_an_opening_fault_releases_the_chaser(worlds: Any) -> None:
    physics = worlds(omega_rad_s=STILL, fault=[fault("latch_open", 1.0, 0.1)])
    latch(physics)
    physics.advance(HZ - physics.step_count, {})
    assert latched(physics)
    physics.advance(1, {})
    assert not latched(physics)
    assert not physics.latches["chaser/0"].armed
    assert physics.take_openings() == [(0, "fault latch_open")]
    physics.advance(HZ, {"chaser/0": PULL})
    assert place(physics)[0] < -0.56


def test_a_stuck_latch_does_not_close(worlds: Any) -> None:
    physics = worlds(gap_m=0.002, omega_rad_s=STILL, fault=[fault("latch_stuck", 0.01, 1.0)])
    physics.command_latch(0, "arm", 0)
    physics.advance(HZ // 2, {})
    assert not latched(physics)
    assert [t.refused for t in physics.latches["chaser/0"].touches] == ["latch stuck"]


@both
def test_a_stuck_latch_opens_when_it_is_free_again(worlds: Any) -> None:
    physics = worlds(omega_rad_s=STILL, fault=[fault("latch_stuck", 1.0, 1.0)])
    latch(physics)
    physics.advance(int(1.2 * HZ) - physics.step_count, {})
    physics.command_latch(0, "release", physics.step_count)
    physics.advance(2 * HZ - physics.step_count, {"chaser/0": PULL})
    assert latched(physics)
    physics.advance(2, {"chaser/0": PULL})
    assert not latched(physics)
    assert physics.take_openings() == []


def test_a_flight_is_the_same_up_to_a_fault(worlds: Any) -> None:
    with_fault = worlds(fault=[fault("latch_slip", 2.0, 1.0, force_N=0.1)])
    without = worlds()
    for physics in (with_fault, without):
        latch(physics)
        physics.advance(2 * HZ - physics.step_count, {"chaser/0": PULL})
    np.testing.assert_array_equal(place(with_fault), place(without))
    for physics in (with_fault, without):
        physics.advance(HZ // 2, {"chaser/0": PULL})
    assert np.linalg.norm(place(with_fault) - place(without)) > 1e-3
