# SPDX-License-Identifier: Apache-2.0
"""Plumes of thrusters: the angle to a box is the smallest of all its points, and does not depend on
the frame.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.plume import (
    Panels,
    PlumeFlux,
    angle_to_box,
    angle_to_point,
    panels_of,
    plume_hits,
    plume_wrench,
)
from chaserdock_models.targets import Box
from hypothesis import given, settings
from hypothesis import strategies as st

SEEDS = st.integers(0, 2**32 - 1)


def random_case(seed: int) -> tuple[np.ndarray, np.ndarray, Box]:
    rng = np.random.default_rng(seed)
    q = rotations.normalize(rng.normal(size=4)).tolist()
    box = Box(tuple(rng.uniform(0.1, 1.0, 3)), tuple(rng.uniform(-0.5, 0.5, 3)), tuple(q))
    axis = rng.normal(size=3)
    return rng.uniform(-1.5, 1.5, 3), axis / np.linalg.norm(axis), box


@settings(deadline=None)
@given(SEEDS)
def test_no_point_of_a_box_is_at_a_smaller_angle_than_the_one_returned(seed: int) -> None:
    nozzle, axis, box = random_case(seed)
    smallest = angle_to_box(nozzle, axis, box)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 25)] * 3), axis=-1).reshape(-1, 3)
    points = rotations.rotate(box.q_wxyz, grid * box.size_m) + box.position_m - nozzle
    cosines = points @ axis / np.linalg.norm(points, axis=1)
    sampled = math.acos(min(1.0, float(cosines.max())))
    assert smallest <= sampled + 1e-7
    # The nearest point of the grid is at most half a cell away.
    cell_m = np.linalg.norm(box.size_m) / 48.0
    distance_m = float(np.linalg.norm(points, axis=1).min())
    if distance_m > 4.0 * cell_m:
        assert sampled - smallest <= 2.0 * cell_m / (distance_m - cell_m)


@settings(deadline=None)
@given(SEEDS)
def test_the_angle_is_the_same_in_every_frame(seed: int) -> None:
    nozzle, axis, box = random_case(seed)
    rng = np.random.default_rng([seed, 1])
    q, shift = rotations.normalize(rng.normal(size=4)), rng.normal(size=3)
    moved = Box(
        box.size_m,
        tuple((rotations.rotate(q, box.position_m) + shift).tolist()),
        tuple(rotations.multiply(q, box.q_wxyz).tolist()),
    )
    there = angle_to_box(rotations.rotate(q, nozzle) + shift, rotations.rotate(q, axis), moved)
    assert there == pytest.approx(angle_to_box(nozzle, axis, box), abs=1e-7)


@pytest.mark.parametrize(
    ("nozzle", "axis", "angle"),
    [
        ((2.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 0.0),
        ((0.1, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0),  # inside
        ((2.0, 0.0, 0.0), (0.0, 0.0, 1.0), math.atan2(1.5, 0.5)),  # an edge
        (
            (2.0, 0.0, 0.0),
            (1.0, 0.0, 0.0),
            math.pi - math.atan2(math.hypot(0.5, 0.5), 1.5),
        ),  # behind it
        ((2.0, 0.0, 2.0), (-1.0, 0.0, 0.0), math.atan2(1.5, 2.5)),
    ],
)
def test_angles_to_a_unit_cube(nozzle: tuple, axis: tuple, angle: float) -> None:
    box = Box((1.0, 1.0, 1.0))
    assert angle_to_box(np.array(nozzle), np.array(axis), box) == pytest.approx(angle, abs=1e-9)


def test_a_plume_is_opposite_to_the_force() -> None:
    nozzle, half = np.array([2.0, 0.0, 0.0]), math.radians(20.0)
    assert plume_hits(nozzle, np.array([1.0, 0.0, 0.0]), half, [Box((1.0, 1.0, 1.0))])
    assert not plume_hits(nozzle, np.array([-1.0, 0.0, 0.0]), half, [Box((1.0, 1.0, 1.0))])
    assert plume_hits(nozzle, np.array([-1.0, 0.0, 0.0]), half, [], [np.array([3.0, 0.3, 0.0])])
    assert not plume_hits(nozzle, np.array([-1.0, 0.0, 0.0]), half, [], [np.array([3.0, 0.4, 0.0])])
    assert angle_to_point(nozzle, np.array([1.0, 0.0, 0.0]), nozzle) == 0.0


def test_plate_across_the_whole_cone_takes_up_the_thrust() -> None:
    """Through any surface that closes the cone flows the whole axial momentum, whatever its
    distance.
    """
    flux = PlumeFlux(math.radians(40.0), 5.0)
    for distance in (0.5, 2.0):
        plate = panels_of([Box((0.01, 4.0, 4.0), (distance + 0.005, 0.0, 0.0))], parts=160)
        wrench = plume_wrench(
            flux, plate, np.zeros((1, 3)), np.array([[-1.0, 0, 0]]), np.array([0.7])
        )
        assert wrench[0] == pytest.approx(0.7, rel=5e-3)
        np.testing.assert_allclose(wrench[1:], 0.0, atol=1e-9)


def test_plume_pushes_what_it_faces_and_only_within_its_limits() -> None:
    flux = PlumeFlux(math.radians(40.0), 5.0)
    box = panels_of([Box((0.4, 0.4, 0.4))])
    at, force, thrust = np.array([[-1.0, 0.1, 0.0]]), np.array([[-1.0, 0.0, 0.0]]), np.array([1.0])
    wrench = plume_wrench(flux, box, at, force, thrust)
    assert 0.02 < wrench[0] < 0.7
    assert wrench[5] < 0.0  # above the middle: a torque about -Z
    assert not plume_wrench(flux, box, at, -force, thrust).any()
    assert not plume_wrench(flux, box, at, force, 0.0 * thrust).any()
    assert plume_wrench(flux, box, at - np.array([8.5, 0.0, 0.0]), force, thrust).any()
    assert not plume_wrench(flux, box, at - np.array([9.5, 0.0, 0.0]), force, thrust).any()
    beside = np.array([[-1.0, 1.4, 0.0]])  # 45 degrees off the nearest corner
    assert not plume_wrench(flux, box, beside, force, thrust).any()


@settings(derandomize=True, deadline=None, max_examples=20)
@given(SEEDS)
def test_plume_wrench_turns_with_the_bodies(seed: int) -> None:
    nozzle, axis, box = random_case(seed)
    q = rotations.normalize(np.random.default_rng(seed).normal(size=4))
    flux = PlumeFlux(math.radians(70.0), 3.0)
    panels = panels_of([box], parts=3)
    turned = Panels(
        rotations.rotate(q, panels.centres_m), rotations.rotate(q, panels.normals), panels.areas_m2
    )
    thrust = np.array([1.0])
    plain = plume_wrench(flux, panels, nozzle[None], axis[None], thrust)
    other = plume_wrench(
        flux,
        turned,
        rotations.rotate(q, nozzle)[None],
        rotations.rotate(q, axis)[None],
        thrust,
    )
    np.testing.assert_allclose(rotations.rotate(q, plain[:3]), other[:3], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(rotations.rotate(q, plain[3:]), other[3:], rtol=1e-7, atol=1e-9)
