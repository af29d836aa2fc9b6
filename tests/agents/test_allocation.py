# SPDX-License-Identifier: Apache-2.0
"""Thruster selection: exact where that is possible, closest where not, cheap, and within limits
that change.
"""

from __future__ import annotations

import numpy as np
import planar_cases
import pytest
from chaserdock_agents.chaser.thrusters.allocation import Allocator, allocator_of
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario.thrusters import thrusts_max
from hypothesis import given, settings
from hypothesis import strategies as st
from thruster_cases import box, mission

BODIES = ("tetra12", "slider")
quick = settings(derandomize=True, deadline=None, max_examples=100)
CASES = {
    b: (allocator_of(mission(b).chaser), thrusts_max(mission(b).chaser.thrusters), box(mission(b)))
    for b in BODIES
}


@pytest.mark.parametrize("body", BODIES)
def test_exact_to_a_billionth_inside_the_feasible_set(body: str) -> None:
    allocator, full, limits = CASES[body]
    rng = np.random.default_rng(1)
    for k in range(2000):
        feasible = (
            full
            * rng.uniform(0.0, 1.0, len(full))
            * (rng.uniform(size=len(full)) < (k % 4 + 1) / 4)
        )
        wrench = allocator.matrix @ feasible
        got = allocator.allocate(wrench, full)
        assert got.exact
        assert np.all((got.thrusts_N >= 0.0) & (got.thrusts_N <= full))
        error = (allocator.matrix @ got.thrusts_N - wrench) / limits
        assert np.abs(error).max() <= 1e-9 * np.abs(wrench / limits).max() + 1e-12
        # No dearer than the thrusts that the wrench was made of.
        assert got.thrusts_N.sum() <= feasible.sum() * (1 + 1e-9) + 1e-12


@pytest.mark.parametrize("times", [1e2, 1e4, 1e9, 1e12])
def test_a_main_engine_beside_small_thrusters_is_allocated_like_them(times: float) -> None:
    """Whichever it is, and with one thruster out; wrenches that are feasible are exact."""
    body, rng = mission("tetra12").chaser, np.random.default_rng(2)
    for k in range(len(body.thrusters)):
        strong = [
            t.model_copy(update={"thrust_N": t.thrust_N * (times if j == k else 1.0)})
            for j, t in enumerate(body.thrusters)
        ]
        allocator = Allocator(strong, body.wrench_max)
        for _ in range(20):
            allowed = thrusts_max(strong) * rng.uniform(0.2, 1.0, len(strong))
            allowed[rng.integers(len(strong))] = 0.0
            small = np.minimum(allowed, 1.5) * rng.uniform(0.0, 1.0, len(strong))
            wrench = allocator.matrix @ small
            got = allocator.allocate(wrench, allowed)
            assert got.exact
            assert np.abs(allocator.matrix @ got.thrusts_N - wrench).max() < 1e-7
            allocator.allocate(rng.normal(size=6) * body.wrench_max, allowed)  # raises nothing


@given(st.sampled_from(BODIES), st.integers(0, 2**31), st.sets(st.integers(0, 11), max_size=2))
@quick
def test_closest_outside_and_thrusters_that_are_out_stay_out(
    body: str, seed: int, out: set[int]
) -> None:
    """The optimality conditions of the closest point: no thruster that could still give more, or
    less, would help.
    """
    allocator, full, limits = CASES[body]
    allowed = full.copy()
    allowed[list(out)] = 0.0
    rng = np.random.default_rng(seed)
    wrench = limits * rng.normal(size=6) * rng.uniform(0.5, 10.0)
    got = allocator.allocate(wrench, allowed)
    f = got.thrusts_N
    assert np.all((f >= 0.0) & (f <= allowed))
    rows = allocator.matrix / limits[:, None]
    short = wrench / limits - rows @ f
    if got.exact:
        assert np.abs(short).max() <= 1e-9 * np.abs(wrench / limits).max() + 1e-12
        return
    assert np.linalg.norm(short) > 1e-6
    helps = rows.T @ short / np.linalg.norm(short)
    assert np.all(helps[f < allowed - 1e-6] <= 1e-5)
    assert np.all(helps[f > 1e-6] >= -1e-5)


@given(st.sampled_from(BODIES), st.integers(0, 2**31))
@quick
def test_equal_wrenches_have_equal_answers_and_near_ones_near(body: str, seed: int) -> None:
    allocator, full, limits = CASES[body]
    rng = np.random.default_rng(seed)
    wrench = limits * rng.uniform(-1.0, 1.0, 6)
    first = allocator.allocate(wrench, full).thrusts_N
    allocator.allocate(-wrench, full)
    np.testing.assert_array_equal(allocator.allocate(wrench, full).thrusts_N, first)
    near = allocator.allocate(wrench * (1 + 1e-9), full).thrusts_N
    np.testing.assert_allclose(near, first, atol=1e-5)


def test_nothing_asked_nothing_given() -> None:
    for allocator, full, _ in CASES.values():
        assert allocator.allocate(np.zeros(6), full).thrusts_N.max() < 1e-9
        assert not allocator.allocate(np.ones(6), np.zeros(len(full))).thrusts_N.any()


def test_numbers_that_are_none_are_refused() -> None:
    allocator, full, _ = CASES["tetra12"]
    for wrench, limits in (
        (np.full(6, np.nan), full),
        (np.zeros(6), -full),
        (np.zeros(6), full * np.inf),
    ):
        with pytest.raises(ValueError, match="finite"):
            allocator.allocate(wrench, limits)


def test_a_lost_thruster_costs_its_share_of_the_box_only() -> None:
    """Every corner of the limits that the chaser would report to the controller is still given
    exactly.
    """
    allocator, full, limits = CASES["slider"]
    corners: Array = np.array(np.meshgrid(*[[-1.0, 1.0]] * 6)).reshape(6, -1).T * limits
    for lost in (0, 2):
        allowed = np.where(np.arange(len(full)) == lost, 0.0, full)
        assert all(allocator.allocate(corner, allowed).exact for corner in corners)


def test_a_planar_body_gets_its_wrench_in_the_plane_and_ignores_the_rest() -> None:
    body = planar_cases.scenario().chaser
    allocator, full = allocator_of(body), thrusts_max(body.thrusters)
    rng = np.random.default_rng(4)
    for _ in range(200):
        wrench = rng.uniform(-1.0, 1.0, 6) * [1.5, 1.5, 1.5, 0.15, 0.15, 0.15]
        got = allocator.allocate(wrench, full)
        assert got.exact
        given = allocator.matrix @ got.thrusts_N
        assert given[[0, 1, 5]] == pytest.approx(wrench[[0, 1, 5]], abs=1e-9)
        assert given[[2, 3, 4]] == pytest.approx(np.zeros(3), abs=1e-12)
    left = np.where(np.arange(8) == 3, 0.0, full)
    far = allocator.allocate(np.array([9.0, 0.0, 5.0, 1.0, 1.0, 0.0]), left)
    assert not far.exact
    assert far.thrusts_N[3] == 0.0
    assert (allocator.matrix @ far.thrusts_N)[0] == pytest.approx(3.0, abs=0.2)
