# SPDX-License-Identifier: Apache-2.0
"""Planar motion: levelled attitudes, vectors in the plane, and wrenches of a layout in it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.plane import AXES, UP, across, flattened, lean_rad, levelled
from chaserdock_models.wrench_set import wrench_matrix, wrench_set
from chaserdock_protocol.scenario.thrusters import thrusts_max
from general_position import attitude, matrix
from planar_cases import LEVEL_TO_TRF, UP_TRF, scenario

SEEDS = pytest.mark.parametrize("seed", range(4))


@SEEDS
def test_a_levelled_attitude_is_upright_and_nearer_than_any_other_upright_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, up = attitude(rng), rotations.rotate(attitude(rng), UP)
    level = levelled(q, up)
    assert matrix(level) @ up == pytest.approx(UP, abs=1e-12)
    off = rotations.angle_between(level, q)
    assert off == pytest.approx(lean_rad(q, up), abs=1e-9)
    for turn in (-0.3, 0.2):
        other = rotations.multiply(rotations.exp((0.0, 0.0, turn)), level)
        assert rotations.angle_between(other, q) > off


@SEEDS
def test_a_flattened_vector_keeps_its_parts_in_the_plane_and_gets_the_height(seed: int) -> None:
    rng = np.random.default_rng(seed)
    up, vectors = rotations.rotate(attitude(rng), UP), rng.normal(size=(2, 5, 3))
    flat, sides = flattened(vectors, up, -0.3), across(up)
    assert flat @ up == pytest.approx(np.full((2, 5), -0.3))
    assert flat @ sides.T == pytest.approx(vectors @ sides.T)
    assert np.vstack([sides, up]) @ np.vstack([sides, up]).T == pytest.approx(np.eye(3), abs=1e-12)


@SEEDS
def test_a_chaser_on_a_floor_faces_the_target_by_yaw_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s, offsets = scenario(), rng.normal(size=(6, 3))
    c = s.chasers[0]
    offsets[0] = -np.array(c.position_m)
    facing = facing_attitudes(c.position_m, c.q_wxyz, offsets, UP_TRF)
    for q, offset in zip(facing, offsets, strict=True):
        assert rotations.rotate(q, UP) == pytest.approx(UP_TRF, abs=1e-12)
        ahead = rotations.rotate(q, (1.0, 0.0, 0.0))
        inward = -flattened(offset, UP_TRF)
        assert ahead == pytest.approx(inward / np.linalg.norm(inward), abs=1e-9)


def test_a_planar_layout_gives_the_largest_box_of_wrenches_that_its_thrusters_can() -> None:
    """Every corner of the box is a sum of thrusts within their limits; of a larger one, some are
    not: a support function in many directions says how far the set reaches.
    """
    s = scenario()
    matrix_6, full = wrench_matrix(s.chaser.thrusters), thrusts_max(s.chaser.thrusters)
    limits = s.chaser.wrench_max
    scale = wrench_set(matrix_6, AXES).box_scale(full, limits)
    rows = matrix_6[list(AXES)]
    rng, corners = np.random.default_rng(1), np.array(list(itertools.product((-1, 1), repeat=3)))
    directions = rng.normal(size=(20000, 3)) / limits[list(AXES)]
    reach = np.maximum(directions @ rows * full, 0.0).sum(axis=1)
    needs = (directions @ (corners * limits[list(AXES)]).T).max(axis=1)
    assert scale <= float((reach / needs).min()) <= scale * 1.02
    assert scale > 1.0
    assert wrench_set(matrix_6).box_scale(full, np.ones(6)) == 0.0


def test_any_one_thruster_of_atmos_can_be_lost() -> None:
    s = scenario()
    wrenches = wrench_set(wrench_matrix(s.chaser.thrusters), AXES)
    full = thrusts_max(s.chaser.thrusters)
    for k in range(len(full)):
        left = np.where(np.arange(len(full)) == k, 0.0, full)
        assert wrenches.box_scale(left, s.chaser.wrench_max) > 0.7


def test_the_level_axes_of_the_cases_lean() -> None:
    assert 0.5 < lean_rad(rotations.conjugate(LEVEL_TO_TRF), UP) < 1.2
