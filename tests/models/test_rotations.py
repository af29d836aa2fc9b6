# SPDX-License-Identifier: Apache-2.0
"""Rotations: the group's axioms, the two ways of writing it, and the conventions (Hamilton, body to
world).
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from runge_kutta import rk4

quick = settings(derandomize=True, deadline=None, max_examples=60)

coordinates = st.floats(-1.0, 1.0, allow_subnormal=False)
vectors = hnp.arrays(np.float64, 3, elements=st.floats(-10.0, 10.0, allow_subnormal=False))
quaternions = (
    hnp.arrays(np.float64, 4, elements=coordinates)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)


@st.composite
def rotation_vectors(draw: st.DrawFn, longest: float = np.pi - 1e-6) -> Array:
    """Any axis, and an angle from 0 to ``longest``, tiny ones among them."""
    q = draw(quaternions)
    axis = q[1:] / n if (n := np.linalg.norm(q[1:])) > 1e-3 else np.array([0.0, 0.0, 1.0])
    tiny = st.sampled_from([0.0, 1e-300, 1e-18, 1e-12, 1e-9, 2e-9, 1e-6])
    return axis * draw(st.one_of(st.floats(0.0, longest, allow_subnormal=False), tiny))


def close(a: object, b: object, atol: float = 1e-13) -> None:
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=0, atol=atol)


def same_rotation(a: Array, b: Array, atol: float = 1e-13) -> None:
    """q and -q are the same rotation."""
    close(a if a @ b > 0 else -a, b, atol)


# -- the group -------------------------------------------------------------------------------------


@given(quaternions, quaternions, quaternions)
@quick
def test_product_is_associative_and_stays_on_the_sphere(a: Array, b: Array, c: Array) -> None:
    close(
        rotations.multiply(rotations.multiply(a, b), c),
        rotations.multiply(a, rotations.multiply(b, c)),
        1e-14,
    )
    assert abs(np.linalg.norm(rotations.multiply(a, b)) - 1.0) < 1e-14


@given(quaternions)
@quick
def test_identity_and_inverse(q: Array) -> None:
    close(rotations.multiply(q, rotations.IDENTITY), q, 0)
    close(rotations.multiply(rotations.IDENTITY, q), q, 0)
    close(rotations.multiply(q, rotations.conjugate(q)), rotations.IDENTITY, 1e-15)
    close(rotations.multiply(rotations.conjugate(q), q), rotations.IDENTITY, 1e-15)


@given(quaternions, quaternions)
@quick
def test_conjugate_of_a_product_turns_the_order_round(a: Array, b: Array) -> None:
    swapped = rotations.multiply(rotations.conjugate(b), rotations.conjugate(a))
    close(rotations.conjugate(rotations.multiply(a, b)), swapped, 1e-15)


def test_product_is_hamiltons() -> None:
    i, j, k = np.eye(4)[1:]
    close(rotations.multiply(i, j), k, 0)
    close(rotations.multiply(j, k), i, 0)
    close(rotations.multiply(k, i), j, 0)
    for unit in (i, j, k):
        close(rotations.multiply(unit, unit), -rotations.IDENTITY, 0)


def test_quarter_turn_about_z_takes_body_x_to_world_y() -> None:
    q = rotations.exp([0.0, 0.0, np.pi / 2])
    close(rotations.rotate(q, [1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], 1e-15)
    close(rotations.rotate_inverse(q, [0.0, 1.0, 0.0]), [1.0, 0.0, 0.0], 1e-15)


# -- the action on vectors -------------------------------------------------------------------------


@given(quaternions, quaternions, vectors)
@quick
def test_rotation_is_a_homomorphism(a: Array, b: Array, v: Array) -> None:
    one_by_one = rotations.rotate(a, rotations.rotate(b, v))
    close(rotations.rotate(rotations.multiply(a, b), v), one_by_one, 1e-13)


@given(quaternions, vectors, vectors)
@quick
def test_rotation_keeps_lengths_angles_and_handedness(q: Array, v: Array, w: Array) -> None:
    rv, rw = rotations.rotate(q, v), rotations.rotate(q, w)
    assert abs(rv @ rw - v @ w) < 1e-12
    close(np.cross(rv, rw), rotations.rotate(q, np.cross(v, w)), 1e-12)
    close(rotations.rotate_inverse(q, rv), v, 1e-13)


@given(quaternions, vectors)
@quick
def test_rotation_is_the_sandwich_product(q: Array, v: Array) -> None:
    pure = np.array([0.0, *v])
    sandwich = rotations.multiply(rotations.multiply(q, pure), rotations.conjugate(q))
    close(sandwich, [0.0, *rotations.rotate(q, v)], 1e-13)


@given(quaternions, vectors)
@quick
def test_both_signs_are_the_same_rotation(q: Array, v: Array) -> None:
    close(rotations.rotate(-q, v), rotations.rotate(q, v), 0)
    close(rotations.to_matrix(-q), rotations.to_matrix(q), 0)
    # At half a turn the axis' sign is open as well: compare what the vectors do.
    same_rotation(rotations.exp(rotations.log(-q)), rotations.exp(rotations.log(q)), 1e-12)
    assert rotations.angle_between(q, -q) < 1e-7


# -- matrices --------------------------------------------------------------------------------------


@given(quaternions, quaternions, vectors)
@quick
def test_matrix_is_the_same_rotation(a: Array, b: Array, v: Array) -> None:
    matrix = rotations.to_matrix(a)
    close(matrix @ v, rotations.rotate(a, v), 1e-13)
    close(matrix @ matrix.T, np.eye(3), 1e-14)
    assert abs(np.linalg.det(matrix) - 1.0) < 1e-14
    close(rotations.to_matrix(rotations.multiply(a, b)), matrix @ rotations.to_matrix(b), 1e-14)


@given(quaternions)
@quick
def test_matrix_round_trip(q: Array) -> None:
    back = rotations.from_matrix(rotations.to_matrix(q))
    assert back[0] >= 0.0
    same_rotation(back, q, 1e-14)


# The four pivots of Shepperd's method, turns of half a circle, and the borders between pivots.
PIVOTS = [
    (0.9, 0.3, -0.2, 0.1),
    (0.1, 0.9, 0.3, -0.2),
    (-0.1, 0.2, 0.9, 0.3),
    (0.1, -0.3, 0.2, -0.9),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.0, 0.6, -0.8, 0.0),
    (0.5, 0.5, 0.5, 0.5),
    (0.5, -0.5, 0.5, -0.5),
    (1e-9, 1.0, 0.0, 0.0),
    (-1e-9, 0.0, 0.0, -1.0),
]


@pytest.mark.parametrize("q", PIVOTS)
def test_matrix_round_trip_at_every_pivot(q: tuple[float, ...]) -> None:
    unit = rotations.normalize(q)
    back = rotations.from_matrix(rotations.to_matrix(unit))
    assert back[0] >= 0.0
    same_rotation(back, unit, 1e-15)


# -- exponential and logarithm ---------------------------------------------------------------------


@given(rotation_vectors())
@quick
def test_log_undoes_exp(phi: Array) -> None:
    q = rotations.exp(phi)
    assert abs(np.linalg.norm(q) - 1.0) < 1e-15
    # Near half a turn rounding of the scalar part moves the angle by less than 1e-15 still.
    close(rotations.log(q), phi, 1e-14)


@given(rotation_vectors(1e-4).filter(lambda phi: bool(np.linalg.norm(phi) > 1e-250)))
@quick
def test_log_of_small_rotations_keeps_its_relative_accuracy(phi: Array) -> None:
    error = np.linalg.norm(rotations.log(rotations.exp(phi)) - phi)
    assert error <= 1e-14 * np.linalg.norm(phi)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "q", [(0.0, 0.6, -0.8, 0.0), (-0.0, 0.0, 0.0, 1.0), (1.0, 0, 0, 0), (-1.0, 0, 0, 0)]
)
def test_log_at_half_a_turn_and_at_none(q: tuple[float, ...]) -> None:
    phi = rotations.log(q)
    close(np.linalg.norm(phi), np.pi if q[0] == 0.0 else 0.0, 1e-15)
    same_rotation(rotations.exp(phi), np.array(q), 1e-15)


@given(quaternions)
@quick
def test_exp_undoes_log(q: Array) -> None:
    phi = rotations.log(q)
    assert np.linalg.norm(phi) <= np.pi + 1e-15
    same_rotation(rotations.exp(phi), q, 1e-14)


@given(rotation_vectors(20.0))
@quick
def test_log_finds_the_shortest_rotation(phi: Array) -> None:
    shortest = rotations.log(rotations.exp(phi))
    assert np.linalg.norm(shortest) <= np.pi + 1e-15
    same_rotation(rotations.exp(shortest), rotations.exp(phi), 1e-14)


@given(quaternions, rotation_vectors())
@quick
def test_exp_is_equivariant(q: Array, phi: Array) -> None:
    turned = rotations.multiply(rotations.multiply(q, rotations.exp(phi)), rotations.conjugate(q))
    close(rotations.exp(rotations.rotate(q, phi)), turned, 1e-14)


@given(rotation_vectors(0.1))
@quick
def test_matrix_of_exp_is_the_matrix_exponential(phi: Array) -> None:
    series, term = np.eye(3), np.eye(3)
    for k in range(1, 15):
        term = term @ rotations.skew(phi) / k
        series = series + term
    close(rotations.to_matrix(rotations.exp(phi)), series, 1e-14)


# -- angles ----------------------------------------------------------------------------------------


@given(quaternions, rotation_vectors())
@quick
def test_angle_between_is_the_angle_turned(q: Array, phi: Array) -> None:
    turned = rotations.multiply(q, rotations.exp(phi))
    assert abs(rotations.angle_between(q, turned) - np.linalg.norm(phi)) < 1e-14
    assert abs(rotations.angle_between(-q, turned) - np.linalg.norm(phi)) < 1e-14
    assert abs(rotations.angle_between(turned, q) - np.linalg.norm(phi)) < 1e-14


@given(quaternions, quaternions, quaternions)
@quick
def test_angle_between_is_a_metric(a: Array, b: Array, c: Array) -> None:
    ab, bc, ac = (rotations.angle_between(x, y) for x, y in ((a, b), (b, c), (a, c)))
    assert 0.0 <= ab <= np.pi + 1e-15
    assert ac <= ab + bc + 1e-13
    left = rotations.angle_between(rotations.multiply(c, a), rotations.multiply(c, b))
    assert abs(left - ab) < 1e-13


# -- integration -----------------------------------------------------------------------------------


@given(quaternions, vectors, st.floats(0.0, 2.0))
@settings(quick, max_examples=15)
def test_integrate_agrees_with_the_kinematic_equation(q: Array, omega: Array, dt_s: float) -> None:
    """RK4 on q' = 1/2 q (0, omega), in steps of a hundredth of a radian at most."""
    steps = max(1, int(np.ceil(np.linalg.norm(omega) * dt_s / 0.01)))
    rate = np.array([0.0, *omega])

    def slope(at: Array) -> Array:
        return 0.5 * rotations.multiply(at, rate)

    close(rotations.integrate(q, omega, dt_s), rk4(slope, q, dt_s / steps, steps), 1e-9)


@given(quaternions, vectors, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
@quick
def test_integrate_is_a_one_parameter_group(q: Array, omega: Array, s: float, t: float) -> None:
    at_once = rotations.integrate(q, omega, s + t)
    close(rotations.integrate(rotations.integrate(q, omega, s), omega, t), at_once, 1e-13)
    close(rotations.integrate(q, omega, 0.0), q, 0)


# -- vectors, arrays, errors -----------------------------------------------------------------------


@given(vectors, vectors)
@quick
def test_skew_and_cross(v: Array, w: Array) -> None:
    close(rotations.skew(v) @ w, np.cross(v, w), 1e-13)
    close(rotations.cross(v, w), np.cross(v, w), 1e-13)
    close(rotations.skew(v), -rotations.skew(v).T, 0)


@pytest.mark.parametrize("shape", [(1,), (7,), (2, 3)])
def test_arrays_give_bit_for_bit_what_single_ones_give(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    a, b = (rotations.normalize(rng.normal(size=(*shape, 4))) for _ in range(2))
    v = rng.normal(size=(*shape, 3))
    for place in np.ndindex(shape):
        close(rotations.multiply(a, b)[place], rotations.multiply(a[place], b[place]), 0)
        close(rotations.rotate(a, v)[place], rotations.rotate(a[place], v[place]), 0)
        close(
            rotations.rotate_inverse(a, v)[place], rotations.rotate_inverse(a[place], v[place]), 0
        )
        close(rotations.to_matrix(a)[place], rotations.to_matrix(a[place]), 0)
        close(rotations.cross(v, a[..., 1:])[place], rotations.cross(v[place], a[place][1:]), 0)
        close(rotations.skew(v)[place], rotations.skew(v[place]), 0)
        close(rotations.exp(v)[place], rotations.exp(v[place]), 0)
        close(rotations.log(a)[place], rotations.log(a[place]), 0)
        close(rotations.angle_between(a, b)[place], rotations.angle_between(a[place], b[place]), 0)


@quick
@given(rotation_vectors(), quaternions)
def test_exp_and_log_of_one_are_bit_for_bit_those_of_many(phi: Array, q: Array) -> None:
    close(rotations.exp(phi), rotations.exp(phi[None])[0], 0)
    for turn in (q, -q, rotations.exp(phi)):
        close(rotations.log(turn), rotations.log(turn[None])[0], 0)


def test_one_rotation_turns_many_vectors_and_many_rotations_one() -> None:
    rng = np.random.default_rng(4)
    q, v = rotations.normalize(rng.normal(size=(5, 4))), rng.normal(size=(5, 3))
    for i in range(5):
        close(rotations.rotate(q[0], v)[i], rotations.rotate(q[0], v[i]), 0)
        close(rotations.rotate(q, v[0])[i], rotations.rotate(q[i], v[0]), 0)
        close(rotations.multiply(q[0], q)[i], rotations.multiply(q[0], q[i]), 0)


@given(quaternions, st.floats(1e-150, 1e150))
@quick
def test_normalize_keeps_the_direction(q: Array, scale: float) -> None:
    close(rotations.normalize(q * scale), q, 1e-15)


@pytest.mark.parametrize(
    "q",
    [
        np.zeros(4),
        np.zeros((2, 4)),
        np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]),
        np.array([np.nan, 0.0, 0.0, 1.0]),
        np.array([np.inf, 0.0, 0.0, 0.0]),
        np.array([[1.0, 0.0, 0.0, np.inf]]),
        np.array([np.inf, np.nan, 0.0, 0.0]),
    ],
)
def test_invalid_quaternion_cannot_be_normalized(q: Array) -> None:
    with pytest.raises(ValueError, match="cannot be normalized"):
        rotations.normalize(q)


def test_functions_leave_their_arguments_alone() -> None:
    q, v = np.array([0.5, 0.5, -0.5, 0.5]), np.array([1.0, 2.0, 3.0])
    before = q.copy(), v.copy()
    rotations.normalize(q)[0] = 9.0
    rotations.conjugate(q)[0] = 9.0
    rotations.multiply(q, rotations.IDENTITY)[0] = 9.0
    rotations.rotate(q, v)[0] = 9.0
    rotations.log(q)[0] = 9.0
    rotations.exp(v)[0] = 9.0
    close(q, before[0], 0)
    close(v, before[1], 0)


def test_arrays_that_are_read_only_or_repeated_are_operands() -> None:
    q = rotations.normalize(np.random.default_rng(5).standard_normal((3, 2, 4)))
    v = np.arange(6.0).reshape(2, 3)
    whole = np.broadcast_arrays(v, np.zeros((3, 2, 3)))[0]
    frozen = q.copy()
    frozen.flags.writeable = False
    rotated = np.array([[rotations.rotate(q[i, k], v[k]) for k in range(2)] for i in range(3)])
    for operand in (v, whole):
        np.testing.assert_array_equal(rotations.rotate(frozen, operand), rotated)
    np.testing.assert_array_equal(rotations.normalize(frozen[::-1]), rotations.normalize(q)[::-1])
    np.testing.assert_array_equal(rotations.cross(whole, v[:, ::-1]), np.cross(whole, v[:, ::-1]))
