# SPDX-License-Identifier: Apache-2.0
"""Shape of a freely rotating body: it stays physical, and its derivatives are those of the
motion.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from chaserdock_controller.bodies.body_shape import (
    INERTIA_ROWS,
    BodyShape,
    mass_covariance,
    shape_covariance,
    shape_of,
)
from chaserdock_controller.bodies.mass_properties import inertia_ratios, prior_of, with_shape
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.joint import motion_models as motion
from chaserdock_models import rotations
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_models.relative_motion import cw_wrench
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.scenario.bodies import Body
from detumble_cases import target_alone
from hypothesis import given, settings
from hypothesis import strategies as st

MOTION = (
    np.array([1.0, 2.0, 3.0]),
    np.array([0.01, 0.02, 0.0]),
    so3.exp(np.array([0.3, -0.2, 0.5])),
    np.array([0.1, 0.2, -0.15]),
)


def client() -> BodyShape:
    body = target_alone()
    return shape_of(body.inertia_kg_m2, body.centre_trf_m)


@settings(deadline=None, max_examples=100)
@given(st.lists(st.floats(-0.5, 0.5), min_size=5, max_size=5), st.integers(0, 2**32 - 1))
def test_corrections_keep_the_inertia_physical(ratios: list[float], seed: int) -> None:
    """A correction beyond what a body can have ends at the limit, and nearer to any inertia that a
    body can have.
    """
    error = np.array([*ratios, 0.01, 0.02, -0.03])
    shape = client().corrected(error)
    moments = np.linalg.eigvalsh(shape.inertia)
    assert moments.sum() == pytest.approx(1.0)
    assert moments[0] > 0.0
    assert moments[2] < moments[0] + moments[1]
    assert shape.centre_m == pytest.approx(client().centre_m + error[5:])
    root = np.random.default_rng(seed).normal(size=(3, 3))
    masses = root @ root.T
    other = shape_of(np.trace(masses) * np.eye(3) - masses, shape.centre_m)
    before = np.linalg.norm(client().error_of(other)[:5] - error[:5])
    assert np.linalg.norm(shape.error_of(other)) <= before + 1e-3


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-0.03, 0.03), min_size=8, max_size=8))
def test_an_error_is_the_difference_of_two_shapes(error: list[float]) -> None:
    shape = client().corrected(np.array(error))
    assert client().error_of(shape) == pytest.approx(np.array(error), abs=1e-12)


def test_covariance_of_a_shape_is_that_of_the_mass_properties() -> None:
    shape, rng = client(), np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(8, 8))
    mapped = mass_covariance(root @ root.T, 60.0)
    assert shape_covariance(60.0 * shape.inertia, mapped) == pytest.approx(root @ root.T, abs=1e-12)
    body, scale = target_alone(), np.repeat([1e-3, 1e-2], [3, 6])
    rows, cloud = [], rng.normal(size=(4000, 9)) * scale
    for x in cloud:
        inertia = body.inertia_kg_m2.copy()
        for (i, j), d in zip(INERTIA_ROWS, x[3:], strict=True):
            inertia[i, j] += d
            inertia[j, i] = inertia[i, j]
        rows.append(shape.error_of(shape_of(inertia, body.centre_trf_m + x[:3])))
    expected = shape_covariance(body.inertia_kg_m2, np.diag(scale**2))
    found = np.cov(np.array(rows).T)
    deviations = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(deviations, deviations),
        expected / np.outer(deviations, deviations),
        atol=0.1,
    )


@pytest.mark.parametrize(("mean_motion_rad_s", "tolerance"), [(0.0, 1e-6), (1.1e-3, 1e-5)])
def test_the_transition_is_the_derivative_of_the_motion(
    mean_motion_rad_s: float, tolerance: float
) -> None:
    shape, dt_s, e = client(), 0.1, 1e-5

    def moved(d: Array) -> tuple[Array, Array, Array, Array]:
        p, v, q, w = MOTION
        begin = (p + d[:3], v + d[3:6], so3.multiply(q, so3.exp(d[6:9])), w + d[9:12])
        return motion.free_shape(begin, dt_s, shape.corrected(d[12:]), mean_motion_rad_s)[0]

    def apart(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
        turn = so3.log(so3.inverse_multiply(b[2], a[2]))
        return np.concatenate([a[0] - b[0], a[1] - b[1], turn, a[3] - b[3]])

    numeric = np.column_stack([apart(moved(e * d), moved(-e * d)) / (2 * e) for d in np.eye(20)])
    transition = motion.free_shape(MOTION, dt_s, shape, mean_motion_rad_s)[1]
    np.testing.assert_allclose(transition, numeric, atol=tolerance)


def test_the_motion_is_that_of_a_fine_integration() -> None:
    """Explicit midpoint on small steps, and the attitude by the exponential map."""
    inertia, seconds, n = np.diag([1.0, 2.0, 2.5]), 4.0, 4_000
    inverse, dt = np.linalg.inv(inertia), seconds / n
    start = np.array([0.05, 0.6, 0.1])
    q, w = MOTION[2], start
    for _ in range(n):
        middle = w + 0.5 * dt * inverse @ -np.cross(w, inertia @ w)
        q = so3.multiply(q, so3.exp(middle * dt))
        w = w + dt * inverse @ -np.cross(middle, inertia @ middle)
    motion_then, _ = motion.free_shape(
        (np.zeros(3), np.zeros(3), MOTION[2], start), seconds, shape_of(inertia, np.zeros(3))
    )
    assert float(rotations.angle_between(q, motion_then[2])) < 2e-6
    np.testing.assert_allclose(motion_then[3], w, atol=2e-6)
    assert np.linalg.norm(w - start) > 0.02  # the rates did move


def test_a_ball_turns_at_constant_rates() -> None:
    centre = np.array([0.1, -0.2, 0.05])
    free = motion.free_shape(MOTION, 0.1, shape_of(np.eye(3), centre))
    steady = motion.steady_motion(MOTION, 0.1, centre)
    for x, y in zip(free[0], steady[0], strict=True):
        np.testing.assert_allclose(x, y, atol=2e-8)
    np.testing.assert_allclose(free[1][:, :12], steady[1], atol=1e-6)


def test_the_motion_in_an_orbit_is_that_by_which_chasers_are_predicted() -> None:
    n, seconds, chaser = 1.1e-3, 10.0, Body(inertia_kg_m2=(1.0, 2.0, 2.5), mass_kg=5.0)
    state = np.concatenate([np.zeros(6), MOTION[2], MOTION[3]])
    for _ in range(1000):
        state = propagate(state, cw_wrench(n, state, 5.0, chaser.inertia), chaser, seconds / 1000)
    at = (np.zeros(3), np.zeros(3), MOTION[2], MOTION[3])
    for _ in range(20):
        at, _ = motion.free_shape(
            at, seconds / 20, shape_of(np.diag(chaser.inertia), np.zeros(3)), n
        )
    np.testing.assert_allclose(at[2], state[6:10], atol=2e-5)
    np.testing.assert_allclose(at[3], state[10:], atol=5e-6)
    free = propagate(
        np.concatenate([np.zeros(6), MOTION[2], MOTION[3]]), np.zeros(6), chaser, seconds
    )
    assert np.abs(free[10:] - state[10:]).max() > 1e-4


def test_a_shape_tells_nothing_of_mass_and_scale() -> None:
    known = prior_of(TargetBody(150.0, 14.0 * np.eye(3), np.zeros(3)), 0.3, 0.3, 0.1)
    found = with_shape(known, client(), 1e-6 * np.eye(8))
    assert found.covariance[0, 0] == known.covariance[0, 0]
    trace = np.repeat([0.0, 1.0, 0.0], [4, 3, 3])
    assert trace @ found.values == pytest.approx(42.0)
    assert np.sqrt(trace @ found.covariance @ trace) == pytest.approx(0.3 * 42.0, rel=1e-3)
    ratios, covariance = inertia_ratios(found)
    assert ratios == pytest.approx([client().inertia[row] for row in INERTIA_ROWS])
    assert all(
        b < a for a, b in pairwise([np.trace(inertia_ratios(known)[1]), np.trace(covariance)])
    )
