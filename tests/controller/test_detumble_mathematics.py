# SPDX-License-Identifier: Apache-2.0
"""Mathematics of detumbling: momentum of a stack, wrenches of its thrusters, and their
allocation.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_controller.bodies.target_body import attach_bodies
from chaserdock_controller.guidance.detumble.allocation import (
    allocate,
    feedback,
    minimum_time,
    spans_all_directions,
)
from chaserdock_controller.guidance.detumble.stack import thruster_wrenches
from chaserdock_models import rotations
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.wrench_set import wrench_matrix
from detumble_cases import BODY, mounted, stack_of, stack_thrusters, target_alone, tumble
from flights.latched_stack import stack_motion
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

SEEDS = st.integers(0, 2**32 - 1)
SETS = st.sampled_from([(0, 1, 2, 3), (0, 1, 3), (0, 3), (0, 1), (0,)])


@settings(deadline=None)
@given(SEEDS)
def test_the_momentum_of_a_stack_is_that_of_its_parts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chasers, target = mounted((0, 1, 3)), target_alone()
    body = stack_of(chasers)
    velocity, omega = rng.normal(size=3), rng.normal(size=3)
    q = rotations.normalize(rng.normal(size=4))
    motion = stack_motion(body, velocity, q, omega)
    # Each part moves with the origin's velocity and the common rate; all in TRF axes.
    origin = rotations.rotate_inverse(q, velocity)
    parts = [(target.mass_kg, target.inertia_kg_m2, target.centre_trf_m)]
    for c in chasers.values():
        turn = rotations.to_matrix(c.q_wxyz)
        parts.append((BODY.mass_kg, turn @ np.diag(BODY.inertia) @ turn.T, c.position_m))
    linear, angular = np.zeros(3), np.zeros(3)
    for mass, inertia, centre in parts:
        p = mass * (origin + np.cross(omega, centre))
        linear += p
        angular += inertia @ omega + np.cross(centre - body.centre_trf_m, p)
    assert motion.linear_N_s == pytest.approx(linear, abs=1e-9)
    assert motion.angular_N_m_s == pytest.approx(angular, abs=1e-9)
    speed, rate = motion.rates(body)
    assert rate == pytest.approx(np.linalg.norm(omega))
    assert speed == pytest.approx(np.linalg.norm(linear) / body.mass_kg)


@settings(deadline=None)
@given(SEEDS)
def test_thrusters_change_the_momentum_by_the_wrench_of_their_forces(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chasers = mounted((0, 1, 2))
    body = stack_of(chasers)
    thrusts = rng.uniform(0.0, 1.5, 36)
    force, torque = np.zeros(3), np.zeros(3)
    for k, c in enumerate(chasers.values()):
        for j, t in enumerate(BODY.thrusters):
            f = rotations.rotate(c.q_wxyz, thrusts[12 * k + j] * np.array(t.direction))
            at = c.position_m + rotations.rotate(c.q_wxyz, np.array(t.position_m))
            force += f
            torque += np.cross(at - body.centre_trf_m, f)
    wrench = thruster_wrenches(body, chasers, BODY.thrusters) @ thrusts
    assert wrench == pytest.approx(np.concatenate([force, torque]), abs=1e-12)


@settings(deadline=None)
@given(SEEDS)
def test_a_stack_turned_and_shifted_in_trf_has_turned_wrenches(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, shift = rotations.normalize(rng.normal(size=4)), rng.normal(size=3)
    turn = rotations.to_matrix(q)
    chasers = mounted((0, 3))
    moved = {
        i: MountedChaser(turn @ c.position_m + shift, rotations.multiply(q, c.q_wxyz))
        for i, c in chasers.items()
    }
    body = stack_of(chasers)
    there = attach_bodies(body, [])
    there = type(there)(
        body.mass_kg, turn @ body.inertia_kg_m2 @ turn.T, turn @ body.centre_trf_m + shift
    )
    w, v = (thruster_wrenches(b, c, BODY.thrusters) for b, c in ((body, chasers), (there, moved)))
    assert v[:3] == pytest.approx(turn @ w[:3], abs=1e-12)
    assert v[3:] == pytest.approx(turn @ w[3:], abs=1e-12)


@pytest.mark.slow
@settings(deadline=None, derandomize=True)
@given(SETS, SEEDS)
@example((0, 1), 467506)
@example((0, 1, 3), 139313)
def test_allocation_solves_the_linear_programme(chasers: tuple[int, ...], seed: int) -> None:
    """Shortest time, and the least impulse within it, as by a simplex method; a little time is
    given up for much less thrust.

    The examples are always the same: on the border of what is possible, the two methods decide
    differently.
    """
    body, wrenches, limits = stack_thrusters(chasers)
    momentum = tumble(seed, body)
    n = len(limits)
    shortest = linprog(
        np.r_[np.zeros(n), 1.0],
        A_ub=np.c_[np.eye(n), -limits],
        b_ub=np.zeros(n),
        A_eq=np.c_[wrenches, np.zeros(6)],
        b_eq=-momentum,
    )
    found = minimum_time(wrenches, momentum, limits)
    assert (found is None) == (shortest.status != 0)
    if found is None:
        return
    assert found.time_s == pytest.approx(shortest.fun, rel=2e-3)
    within_s = max(found.time_s, shortest.fun) * (
        1.0 + 1e-6
    )  # the allocation's time may be shorter by its tolerance
    cheapest = linprog(
        np.ones(n), A_eq=wrenches, b_eq=-momentum, bounds=[(0.0, m * within_s) for m in limits]
    )
    assert cheapest.status == 0
    assert found.impulse_N_s == pytest.approx(cheapest.fun, rel=1e-3)


@pytest.mark.slow
@settings(deadline=None)
@given(SETS, SEEDS, st.floats(1e-4, 10.0))
def test_feedback_is_exact_in_direction_and_within_limits(
    chasers: tuple[int, ...], seed: int, size: float
) -> None:
    body, wrenches, limits = stack_thrusters(chasers)
    momentum = size * tumble(seed, body)
    found = feedback(wrenches, momentum, limits, 0.5)
    assert np.all(found.thrusts_N >= 0.0)
    assert np.all(found.thrusts_N <= limits)
    asked = -momentum / 0.5
    assert wrenches @ found.thrusts_N == pytest.approx(
        found.scale * asked, abs=1e-6 * (1.0 + np.abs(asked).max())
    )
    shortest = minimum_time(wrenches, momentum, limits)
    if shortest is None:
        # What is given in a direction that cannot be served is within the tolerance of the solver.
        assert found.scale * np.linalg.norm(asked) <= 1e-5
    else:
        assert found.scale == pytest.approx(min(1.0, 0.5 / shortest.time_s), rel=1e-3)


@pytest.mark.slow
@settings(deadline=None)
@given(SEEDS)
def test_allocation_does_not_depend_on_the_order_of_the_thrusters(seed: int) -> None:
    body, wrenches, limits = stack_thrusters((0, 1, 2, 3))
    momentum = tumble(seed, body)
    order = np.random.default_rng(seed).permutation(len(limits))
    direct, permuted = (
        feedback(wrenches, momentum, limits, 0.5),
        feedback(wrenches[:, order], momentum, limits[order], 0.5),
    )
    assert permuted.thrusts_N == pytest.approx(direct.thrusts_N[order], abs=1e-6)


def test_a_stack_without_momentum_needs_no_thrust() -> None:
    _, wrenches, limits = stack_thrusters((0, 3))
    assert feedback(wrenches, np.zeros(6), limits, 0.5).thrusts_N.sum() == 0.0
    found = minimum_time(wrenches, np.zeros(6), limits)
    assert found is not None
    assert found.time_s == 0.0


@pytest.mark.parametrize(
    ("chasers", "spans"),
    [((0, 1, 2, 3), True), ((0, 1, 3), True), ((0, 3), True), ((0, 1), False), ((2,), False)],
)
def test_one_chaser_and_two_beside_each_other_cannot_push_in_every_direction(
    chasers: tuple[int, ...], spans: bool
) -> None:
    _, wrenches, limits = stack_thrusters(chasers)
    assert spans_all_directions(wrenches, limits) is spans


def test_a_free_chaser_spans_all_directions_until_two_thrusters_are_lost_side_by_side() -> None:
    wrenches, limits = wrench_matrix(BODY.thrusters), np.full(12, 1.5)
    assert spans_all_directions(wrenches, limits)
    limits[:6] = 0.0
    assert not spans_all_directions(wrenches, limits)


@pytest.mark.parametrize("chasers", [(0, 1, 2, 3), (0, 3)])
def test_thrusters_towards_the_target_are_masked(chasers: tuple[int, ...]) -> None:
    _, _, limits = stack_thrusters(chasers)
    per_chaser = (limits > 0.0).reshape(-1, 12).sum(axis=1)
    assert per_chaser.tolist() == [6] * len(chasers)
    # What may fire pushes its own chaser towards its port.
    for i, free in zip(chasers, (limits > 0.0).reshape(-1, 12), strict=True):
        assert all(BODY.thrusters[j].direction[0] > 0.0 for j in np.flatnonzero(free)), i


def test_invalid_figures_are_refused() -> None:
    _, wrenches, limits = stack_thrusters((0, 3))
    with pytest.raises(ValueError, match="finite"):
        allocate(wrenches, np.full(6, math.nan), limits)
    with pytest.raises(ValueError, match="positive"):
        feedback(wrenches, np.ones(6), limits, 0.0)
