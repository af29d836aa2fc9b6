# SPDX-License-Identifier: Apache-2.0
"""The chaser's prediction model: CasADi's and the compiled one, against each other and against
physics.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from chaserdock_controller.guidance.reference import (
    feed_forward,
    predict_target,
    reference_state,
    reference_trajectory,
)
from chaserdock_controller.nmpc import NmpcParameters
from chaserdock_controller.nmpc.casadi_model import derivative, dynamics
from chaserdock_controller.nmpc.kernels import roll
from chaserdock_controller.nmpc.problem import model_of
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from hypothesis import given, settings
from hypothesis import strategies as st
from nmpc_cases import SETTINGS
from nmpc_kernels import roll_linearized

MASS_KG = 30.0
INERTIA = ((0.9, 0.02, -0.03), (0.02, 1.3, 0.05), (-0.03, 0.05, 1.7))
MATRIX = np.array(INERTIA)


def params(integrator: str = "rk4", dt_s: float = 0.1) -> NmpcParameters:
    return NmpcParameters(
        mass_kg=MASS_KG,
        inertia_kg_m2=INERTIA,
        force_max_N=2.0,
        torque_max_N_m=0.05,
        **{**SETTINGS, "dt_s": dt_s, "integrator": integrator},
    )


def c_step(x: Array, u: Array, h: float, integrator: str) -> Array:
    states = np.tile(x, (1, 2, 1))
    roll(model_of(params(integrator), h), states, np.ascontiguousarray(u[None, None]))
    return states[0, 1]


def c_jacobians(x: Array, u: Array, h: float, integrator: str) -> tuple[Array, Array, Array]:
    """x_next (13,), A (12, 12), B (12, 6)."""
    states, mats = np.tile(x, (1, 2, 1)), np.empty((1, 1, 12, 12))
    roll_linearized(
        model_of(params(integrator), h),
        states,
        np.ascontiguousarray(u[None, None]),
        np.ones((1, 6)),
        mats,
    )
    return states[0, 1], full_a(mats[0, 0, :, :6], h), mats[0, 0, :, 6:]


def random_point(seed: int, rate: float = 1.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=13)
    x[6:10] = rotations.normalize(x[6:10])
    x[10:] *= rate
    return x, rng.normal(size=6)


def perturb(x: Array, delta: Array) -> Array:
    """x (13,) moved by a tangent vector (12,): q (x) exp(dtheta)."""
    moved = np.concatenate([x[:6] + delta[:6], x[6:10], x[10:] + delta[9:]])
    moved[6:10] = rotations.multiply(x[6:10], rotations.exp(delta[6:9]))
    return moved


def difference(a: Array, b: Array) -> Array:
    """Tangent vector (12,) from b to a."""
    turn = rotations.log(rotations.multiply(rotations.conjugate(b[6:10]), a[6:10]))
    return np.concatenate([a[:6] - b[:6], turn, a[10:] - b[10:]])


def full_a(c_mat: Array, h: float) -> Array:
    a = np.zeros((12, 12))
    a[:6, :6] = np.eye(6)
    a[:3, 3:6] = h * np.eye(3)
    a[:, 6:] = c_mat
    return a


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("seed", range(5))
def test_c_step_equals_casadi(integrator: str, seed: int) -> None:
    x, u = random_point(seed)
    expected = np.array(dynamics(params(integrator))(x, u)).ravel()
    np.testing.assert_allclose(c_step(x, u, 0.1, integrator), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("seed", range(5))
def test_jacobians_equal_casadis_in_the_tangent_space(integrator: str, seed: int) -> None:
    x, u = random_point(seed)
    function = dynamics(params(integrator))
    xs, us = ca.SX.sym("x", 13), ca.SX.sym("u", 6)
    jac_x = ca.Function("a", [xs, us], [ca.jacobian(function(xs, us), xs)])
    jac_u = ca.Function("b", [xs, us], [ca.jacobian(function(xs, us), us)])
    x_next = np.array(function(x, u)).ravel()

    def tangent(q: Array) -> Array:  # d q / d theta (4, 3)
        return 0.5 * rotations.multiply(q, np.eye(4)[1:]).T

    lift = np.zeros((13, 12))
    lift[:6, :6], lift[6:10, 6:9], lift[10:, 9:] = np.eye(6), tangent(x[6:10]), np.eye(3)
    lower = np.zeros((12, 13))
    lower[:6, :6], lower[6:9, 6:10], lower[9:, 10:] = (
        np.eye(6),
        4.0 * tangent(x_next[6:10]).T,
        np.eye(3),
    )
    out, a_mat, b_mat = c_jacobians(x, u, 0.1, integrator)
    np.testing.assert_allclose(out, x_next, rtol=0, atol=1e-13)
    np.testing.assert_allclose(a_mat, lower @ np.array(jac_x(x, u)) @ lift, rtol=0, atol=1e-12)
    np.testing.assert_allclose(b_mat, lower @ np.array(jac_u(x, u)), rtol=0, atol=1e-12)


@settings(derandomize=True, deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.sampled_from(["euler", "rk4"]))
def test_jacobians_equal_finite_differences(seed: int, integrator: str) -> None:
    x, u = random_point(seed)
    _, a_mat, b_mat = c_jacobians(x, u, 0.1, integrator)
    e = 1e-6
    for j in range(12):
        plus = c_step(perturb(x, e * np.eye(12)[j]), u, 0.1, integrator)
        minus = c_step(perturb(x, -e * np.eye(12)[j]), u, 0.1, integrator)
        np.testing.assert_allclose(
            a_mat[:, j], difference(plus, minus) / (2 * e), rtol=0, atol=2e-8
        )
    for j in range(6):
        plus = c_step(x, u + e * np.eye(6)[j], 0.1, integrator)
        minus = c_step(x, u - e * np.eye(6)[j], 0.1, integrator)
        np.testing.assert_allclose(
            b_mat[:, j], difference(plus, minus) / (2 * e), rtol=0, atol=2e-8
        )


def newton_euler(x: Array, u: Array) -> Array:
    """x' written independently of the package, from rotation matrices."""
    q, omega = x[6:10], x[10:]
    w, v = q[0], q[1:]
    q_dot = 0.5 * np.concatenate([[-v @ omega], w * omega + np.cross(v, omega)])
    torque = u[3:] - np.cross(omega, MATRIX @ omega)
    acceleration = rotations.to_matrix(q) @ u[:3] / MASS_KG
    omega_dot: Array = np.linalg.solve(MATRIX, torque).astype(np.float64)
    return np.concatenate([x[3:6], acceleration, q_dot, omega_dot])


def integrate_finely(x: Array, u: Array, duration_s: float, steps: int) -> Array:
    """Gragg's modified midpoint rule with Richardson extrapolation: another method than the
    package's.
    """

    def midpoint(n: int) -> Array:
        h = duration_s / n
        before, now = x, x + h * newton_euler(x, u)
        for _ in range(n - 1):
            before, now = now, before + 2 * h * newton_euler(now, u)
        return 0.5 * (before + now + h * newton_euler(now, u))

    return (4.0 * midpoint(2 * steps) - midpoint(steps)) / 3.0


@pytest.mark.parametrize("seed", range(3))
def test_derivative_equals_an_independent_one(seed: int) -> None:
    x, u = random_point(seed)
    value = np.array(ca.DM(derivative(ca.DM(x), ca.DM(u), params()))).ravel()
    np.testing.assert_allclose(value, newton_euler(x, u), rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_rk4_is_of_fourth_and_euler_of_first_order(seed: int) -> None:
    x, u = random_point(seed, rate=0.5)
    exact = integrate_finely(x, u, 0.4, 4000)
    for integrator, order in (("rk4", 4), ("euler", 1)):
        errors = []
        for n in (4, 8, 16):
            state = x
            for _ in range(n):
                state = c_step(state, u, 0.4 / n, integrator)
            errors.append(np.max(np.abs(difference(state, exact))))
        rates = np.log2(np.array(errors[:-1]) / errors[1:])
        np.testing.assert_allclose(rates, order, atol=0.35)


@settings(derandomize=True, deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.sampled_from(["euler", "rk4"]))
def test_quaternion_stays_of_unit_length(seed: int, integrator: str) -> None:
    x, u = random_point(seed)
    for _ in range(50):
        x = c_step(x, u, 0.1, integrator)
    assert abs(np.linalg.norm(x[6:10]) - 1.0) < 1e-12


def test_torque_free_motion_conserves_angular_momentum_and_energy() -> None:
    x, _ = random_point(7, rate=0.3)
    momentum = rotations.rotate(x[6:10], MATRIX @ x[10:])
    energy = x[10:] @ MATRIX @ x[10:]
    for _ in range(600):
        x = c_step(x, np.zeros(6), 0.1, "rk4")
    np.testing.assert_allclose(
        rotations.rotate(x[6:10], MATRIX @ x[10:]), momentum, rtol=0, atol=1e-6
    )
    assert x[10:] @ MATRIX @ x[10:] == pytest.approx(energy, abs=1e-6)


def test_force_acts_in_body_axes() -> None:
    x = np.zeros(13)
    x[6:10] = rotations.exp([0.0, 0.0, np.pi / 2])
    x = c_step(x, np.array([3.0, 0, 0, 0, 0, 0]), 0.1, "rk4")
    np.testing.assert_allclose(x[3:6], [0.0, 0.01, 0.0], atol=1e-15)


def test_unknown_integrator_is_refused() -> None:
    with pytest.raises(ValueError, match="integrator"):
        dynamics(params(), "midpoint")


# The target's motion and the feed-forward

P0 = np.array([0.3, -0.2, 0.5])
V0 = np.array([1.5e-2, 0.75e-2, 3e-2])
Q0 = rotations.exp([0.4, -0.3, 0.8])
OMEGA = np.array([1.5e-2, 4.5e-2, 3e-2])
Q_OFF = rotations.exp([0.2, 0.1, 1.5])


def test_prediction_is_exact_at_constant_rates() -> None:
    positions, attitudes = predict_target(P0, V0, Q0, OMEGA, [0.0, 2.0, 7.0])
    np.testing.assert_allclose(positions, P0 + np.outer([0.0, 2.0, 7.0], V0), atol=1e-15)
    np.testing.assert_allclose(attitudes[0], Q0, atol=1e-15)
    q = Q0
    for _ in range(70):
        q = rotations.integrate(q, OMEGA, 0.1)
    assert rotations.angle_between(q, attitudes[2]) < 1e-7
    with pytest.raises(ValueError, match="quaternion"):
        predict_target(P0, V0, np.zeros(4), OMEGA, [0.0])


def test_reference_keeps_its_pose_relative_to_the_target() -> None:
    offset, times = np.array([-1.0, 0.2, 0.3]), np.array([0.0, 3.0, 30.0])
    references = reference_trajectory(P0, V0, Q0, OMEGA, offset, Q_OFF, times)
    positions, attitudes = predict_target(P0, V0, Q0, OMEGA, times)
    back = rotations.rotate_inverse(attitudes, references[:, :3] - positions)
    np.testing.assert_allclose(back, np.tile(offset, (3, 1)), atol=1e-14)
    turned = rotations.multiply(rotations.conjugate(attitudes), references[:, 3:])
    assert np.max(rotations.angle_between(turned, Q_OFF)) < 1e-7


@pytest.mark.parametrize("omega", [OMEGA, 10 * OMEGA])
@pytest.mark.parametrize("closing", [0.0, 0.07])
def test_feed_forward_alone_holds_the_reference(omega: Array, closing: float) -> None:
    """Offsets shrink as o(t) = o(0) exp(-closing t); a chaser on the reference is flown open loop
    for 10 s.
    """
    offset, h, n = np.array([-1.0, 0.2, 0.3]), 0.02, 500

    def offsets(t: Array) -> Array:
        return np.exp(-closing * t)[:, None] * offset

    middle = np.arange(0.5, n, dtype=np.float64) * h
    held = offsets(middle)
    inputs = feed_forward(omega, held, -closing * held, closing**2 * held, Q_OFF, MASS_KG, INERTIA)
    x = reference_state(P0, V0, Q0, omega, offset, -closing * offset, Q_OFF)
    for u in inputs:
        x = c_step(x, u, h, "rk4")
    end = np.array([h * n])
    goal = reference_trajectory(P0, V0, Q0, omega, offsets(end), Q_OFF, end)[0]
    assert np.linalg.norm(x[:3] - goal[:3]) < 1e-4
    assert rotations.angle_between(x[6:10], goal[3:]) < 1e-4
    drifted = reference_state(P0, V0, Q0, omega, offset, -closing * offset, Q_OFF)
    for _ in range(n):
        drifted = c_step(drifted, np.zeros(6), h, "rk4")
    assert np.linalg.norm(drifted[:3] - goal[:3]) > 1e-2  # without it, the reference is lost


def test_feed_forward_refuses_a_massless_chaser() -> None:
    with pytest.raises(ValueError, match="mass_kg"):
        feed_forward(
            OMEGA, np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)), Q_OFF, 0.0, INERTIA
        )
