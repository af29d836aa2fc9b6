# SPDX-License-Identifier: Apache-2.0
"""Invariants and consistency of simulated flights on a floor: what leaves the plane is found, what
the floor carries needs no other cause.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plane import UP
from chaserdock_protocol.messages import BodyTruth, DrawnBody, WorldTruth
from chaserdock_protocol.scenario import Scenario
from general_position import covariance
from planar_cases import HEIGHT_M, RATE_RAD_S, UP_TRF, scenario, target_attitude

from chaserdock.analysis.pose_errors import normalized_square, pose_nees, verticals_of
from chaserdock.simulation.checks.bodies import FreeStep, OnFloor
from chaserdock.simulation.checks.flight_checks import CHECKS, FlightChecks

STEP_S = 1.0 / 15.0
MOMENTS = np.diag([0.3, 0.5, 0.4]) + 0.05 * (np.ones((3, 3)) - np.eye(3))


def judged(s: Scenario, *bodies: BodyTruth, drawn: DrawnBody | None = None) -> list[str]:
    """Return the invariants of bodies that these states of a flight violate."""
    checks = FlightChecks(s)
    view = checks.view
    for kind in CHECKS:
        found = checks.find(kind)
        for read_type, read in found.readers():
            if read_type is BodyTruth and kind is OnFloor:
                for state in bodies:
                    read(state)
            if read_type is FreeStep and len(bodies) == 2:
                read(FreeStep(bodies[0], bodies[1], drawn, STEP_S, view.orbit))
    return [v.invariant for v in checks.violations]


def of_chaser(tick: int, **changes: Any) -> BodyTruth:
    q = rotations.exp((0.0, 0.0, 0.8)).tolist()
    state = {
        "position_m": (1.2, -0.7, 0.25 + HEIGHT_M),
        "velocity_m_s": (0.01, 0.02, 0.0),
        "q_wxyz": tuple(q),
        "omega_rad_s": (0.0, 0.0, 0.05),
    }
    return BodyTruth(body="chaser/0", tick=tick, **(state | changes))


def of_target(tick: int, **changes: Any) -> BodyTruth:
    state = {
        "position_m": (0.4, -0.3, 0.25),
        "velocity_m_s": (0.004, -0.003, 0.0),
        "q_wxyz": tuple(target_attitude().tolist()),
        "omega_rad_s": tuple((RATE_RAD_S * UP_TRF).tolist()),
    }
    return BodyTruth(body="target", tick=tick, **(state | changes))


def test_level_bodies_that_turn_about_the_vertical_are_on_the_floor() -> None:
    s = scenario()
    for body in (of_chaser, of_target):
        assert judged(s, body(0), body(1), body(2)) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"position_m": (1.2, -0.7, 0.25 + HEIGHT_M + 1e-5)},
        {"velocity_m_s": (0.01, 0.02, 1e-5)},
        {"q_wxyz": tuple(rotations.exp((1e-5, 0.0, 0.0)).tolist())},
        {"omega_rad_s": (0.0, 1e-5, 0.05)},
    ],
)
def test_a_chaser_that_leaves_the_floor_is_found(changes: dict[str, Any]) -> None:
    s = scenario()
    assert judged(s, of_chaser(0), of_chaser(1), of_chaser(2, **changes)) == ["on the floor"]


def test_a_target_that_turns_about_its_own_axis_is_found() -> None:
    spinning = of_target(2, omega_rad_s=(0.0, 0.0, 0.05))
    assert judged(scenario(), of_target(0), of_target(1), spinning) == ["on the floor"]


def test_in_space_nobody_is_on_a_floor() -> None:
    tetra = {"body": "tetra12", "actuation": "thrusters", "size_m": [0.14, 0.3, 0.3]}
    s = scenario(chaser=tetra)
    assert judged(s, of_chaser(0), of_chaser(1), of_chaser(2, velocity_m_s=(0.0, 0.0, 1.0))) == []


@pytest.mark.parametrize("along", ["z", "x"])
def test_the_floor_carries_impulses_out_of_the_plane_only(along: str) -> None:
    """An impulse that moves nothing: vertical, and torque about a horizontal axis; or in the
    plane, and torque about the vertical.
    """
    drawn = DrawnBody(body="chaser/0", mass_kg=17.8, inertia_kg_m2=tuple(MOMENTS.ravel().tolist()))
    push = {"z": (0.0, 0.0, 0.5), "x": (0.5, 0.0, 0.0)}[along]
    turn = {"z": (0.3, 0.2, 0.0), "x": (0.0, 0.0, 0.3)}[along]
    impulses = {
        "impulse_N_s": push, "absolute_impulse_N_s": 0.5, "angular_impulse_N_m_s": turn,
    }  # fmt: skip
    before, place = of_chaser(0), np.array(of_chaser(0).position_m)
    moved = tuple((place + STEP_S * np.array(before.velocity_m_s)).tolist())
    q = rotations.multiply(before.q_wxyz, rotations.exp((0.0, 0.0, 0.05 * STEP_S)))
    after = of_chaser(1, position_m=moved, q_wxyz=tuple(q.tolist()), **impulses)
    found = judged(scenario(), before, after, drawn=drawn)
    assert found == ([] if along == "z" else ["momentum", "angular momentum"])


def test_a_target_on_a_floor_keeps_its_angular_momentum_about_the_vertical_only() -> None:
    """With products of inertia, the momentum about horizontal axes turns with it."""
    inertia = tuple(MOMENTS.ravel().tolist())
    drawn = DrawnBody(body="target", mass_kg=40.0, inertia_kg_m2=inertia)
    checks = FlightChecks(scenario())
    for tick in range(6):
        turn = rotations.exp((0.0, 0.0, 0.4 * tick))
        q = tuple(rotations.multiply(turn, target_attitude()).tolist())
        step = FreeStep(of_target(tick), of_target(tick + 1, q_wxyz=q), drawn, STEP_S, None)
        for kind in CHECKS:
            for read_type, read in checks.find(kind).readers():
                if read_type is FreeStep and kind.name == "energy and momentum":
                    read(step)
    assert checks.violations == []
    assert WorldTruth in {k for c in CHECKS for k, _ in checks.find(c).readers()}


@pytest.mark.parametrize("which", [0, 1])
def test_the_nees_of_a_pose_on_a_floor_is_that_of_place_and_yaw(which: int) -> None:
    """Draws of the stated covariance give 6 on average; what the floor knows adds nothing."""
    rng = np.random.default_rng(3)
    verticals = verticals_of(scenario())
    assert verticals is not None
    up, axis = verticals[which]
    stated = covariance(rng, [2e-3] * 3 + [4e-3] * 3)
    draws = rng.multivariate_normal(np.zeros(6), stated, 4000)
    found = pose_nees(draws, np.broadcast_to(stated, (4000, 6, 6)), verticals[which])
    assert float(found.mean()) == pytest.approx(6.0, rel=0.05)

    def moved(error: Array) -> float:
        return float(pose_nees(error, stated, verticals[which]))

    lifted, leaning = (
        np.concatenate([up, np.zeros(3)]),
        np.concatenate([np.zeros(3), np.cross(axis, rng.normal(size=3))]),
    )
    assert moved(draws[0] + 0.1 * lifted + 0.1 * leaning) == pytest.approx(moved(draws[0]))
    turned = np.concatenate([np.zeros(3), 0.1 * axis])
    assert moved(draws[0] + turned) > 10.0 * moved(draws[0])
    assert pose_nees(draws[0], stated) == pytest.approx(normalized_square(draws[0], stated))
    assert {tuple(UP), tuple(UP_TRF)} == {tuple(up), tuple(axis)}
