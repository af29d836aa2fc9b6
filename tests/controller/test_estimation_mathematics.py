# SPDX-License-Identifier: Apache-2.0
"""Estimation mathematics: Jacobians by differences, motion models, covariances, geometry."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from chaserdock_controller.estimation import CameraPose, MekfParameters, PoseHypothesis, to_world
from chaserdock_controller.estimation import motion_models as motion
from chaserdock_controller.estimation.camera_calibration import predict_measurement
from chaserdock_controller.estimation.hypothesis import StateHypothesis, correct, innovate
from chaserdock_controller.estimation.parameters import GATE_CHI_SQUARE, MODELS
from chaserdock_models import rotations as rot
from chaserdock_models import scalar_rotations as scalar
from chaserdock_models.camera import Camera
from estimation_cases import (
    Q0,
    R,
    V,
    W,
    deterministic,
    rotation_vectors,
    vectors,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

# --- mathematics ----------------------------------------------------------------------------------


@deterministic
@given(rotation_vectors, rotation_vectors)
def test_scalar_rotations_equal_the_shared_ones(a: np.ndarray, b: np.ndarray) -> None:
    qa, qb = rot.exp(a), rot.exp(b)
    np.testing.assert_allclose(scalar.exp(a), qa, atol=1e-14)
    np.testing.assert_allclose(scalar.multiply(qa, qb), rot.multiply(qa, qb), atol=1e-14)
    np.testing.assert_allclose(
        scalar.inverse_multiply(qa, qb), rot.multiply(rot.conjugate(qa), qb), atol=1e-14
    )
    np.testing.assert_allclose(scalar.log(qb), rot.log(qb), atol=1e-12)
    np.testing.assert_allclose(scalar.to_matrix(qa), rot.to_matrix(qa), atol=1e-14)
    np.testing.assert_array_equal(scalar.skew(a), rot.skew(a))


@deterministic
@given(rotation_vectors, vectors)
def test_right_jacobian_by_differences(phi: np.ndarray, d: np.ndarray) -> None:
    h = 1e-6
    moved = [
        rot.multiply(rot.conjugate(rot.exp(phi)), rot.exp(phi + s * h * d)) for s in (1.0, -1.0)
    ]
    numeric = (rot.log(moved[0]) - rot.log(moved[1])) / (2 * h)
    np.testing.assert_allclose(scalar.right_jacobian(phi) @ d, numeric, atol=1e-8)


def test_small_angles_lose_nothing() -> None:
    for size in (0.0, 1e-12, 1e-6, 9.9e-5, 1.01e-4):
        phi = np.array([0.6, -0.8, 0.0]) * size
        np.testing.assert_allclose(scalar.log(scalar.exp(phi)), phi, rtol=1e-9, atol=1e-300)
        np.testing.assert_allclose(
            scalar.right_jacobian(phi), np.eye(3) - 0.5 * rot.skew(phi), atol=1e-8
        )


INERTIA = np.array([[2.0, 0.1, 0.0], [0.1, 3.0, -0.2], [0.0, -0.2, 4.0]])


@pytest.mark.parametrize("model", MODELS)
def test_transition_by_differences(model: str) -> None:
    w, dt, h = np.array([0.4, -0.9, 0.3]), 0.7, 1e-6

    def step(d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q = rot.multiply(Q0, rot.exp(d[:3]))
        if model == "constant_rates":
            return motion.constant_rates(q, w + d[3:], dt)
        return motion.torque_free(q, w + d[3:], dt, INERTIA, np.linalg.inv(INERTIA))

    q, _, transition = step(np.zeros(6))
    for i in range(6):
        d = h * np.eye(6)[i]
        (qa, wa, _), (qb, wb, _) = step(d), step(-d)
        back = rot.conjugate(q)
        dtheta = rot.log(rot.multiply(back, qa)) - rot.log(rot.multiply(back, qb))
        np.testing.assert_allclose(
            transition[:, i], np.concatenate([dtheta, wa - wb]) / (2 * h), atol=2e-6
        )


def test_torque_free_against_a_fine_integration() -> None:
    inertia = np.diag([1.0, 2.0, 2.5])
    q, w, n = np.array(Q0), np.array([0.05, 0.6, 0.1]), 4_000
    dt = 4.0 / n
    inverse = np.diag(1.0 / np.diag(inertia))
    for _ in range(n):  # explicit midpoint on small steps; attitude by the exponential map
        middle = w + 0.5 * dt * inverse @ -np.cross(w, inertia @ w)
        q = scalar.multiply(q, scalar.exp(middle * dt))
        w = w + dt * inverse @ -np.cross(middle, inertia @ middle)
    got_q, got_w, _ = motion.torque_free(
        Q0, np.array([0.05, 0.6, 0.1]), 4.0, inertia, np.linalg.inv(inertia)
    )
    assert float(rot.angle_between(q, got_q)) < 2e-6
    np.testing.assert_allclose(got_w, w, atol=2e-6)
    assert np.linalg.norm(got_w - [0.05, 0.6, 0.1]) > 0.02  # the rates did move


def test_torque_free_of_a_ball_is_constant_rates() -> None:
    a = motion.torque_free(Q0, W, 2.0, np.eye(3), np.eye(3))
    b = motion.constant_rates(Q0, W, 2.0)
    for x, y in zip(a, b, strict=True):
        np.testing.assert_allclose(x, y, atol=2e-8)


def test_process_noise_composes_and_is_positive() -> None:
    whole = motion.process_noise(0.5, 1e-8, 4e-8)
    f = np.eye(12)
    f[0:3, 3:6] = f[6:9, 9:12] = 0.3 * np.eye(3)
    parts = f @ motion.process_noise(0.2, 1e-8, 4e-8) @ f.T + motion.process_noise(0.3, 1e-8, 4e-8)
    np.testing.assert_allclose(whole, parts, atol=1e-20)
    assert np.linalg.eigvalsh(whole)[0] > 0.0


def _branch(bias: np.ndarray, covariance: np.ndarray) -> StateHypothesis:
    return StateHypothesis(
        time_ns=0,
        position_m=np.array([1.0, 2.0, 3.0]),
        velocity_m_s=V,
        q_wxyz=Q0,
        omega_rad_s=W,
        covariance=covariance,
        cameras=(7,),
        bias=bias.reshape(1, 7),
    )


EYE = CameraPose(np.array([0.3, -0.9, 0.2]), rot.normalize([0.6, -0.3, 0.5, -0.4]))


def test_measurement_jacobian_by_differences() -> None:
    p = MekfParameters()
    bias = np.array([0.05, 0.02, -0.04, 0.02, -0.01, 0.03, 0.01])
    branch = _branch(bias, np.eye(19))
    expected = predict_measurement(EYE, branch.position_m, branch.q_wxyz, bias)
    seen = PoseHypothesis(expected.position_m, expected.q_wxyz, np.eye(6))
    at_truth = innovate(branch, 7, EYE, seen, p)
    np.testing.assert_allclose(at_truth.residual, 0.0, atol=1e-12)
    h = 1e-6

    def residual(d: np.ndarray) -> np.ndarray:
        moved = msgspec.structs.replace(
            branch,
            position_m=branch.position_m + d[:3],
            q_wxyz=rot.multiply(Q0, rot.exp(d[6:9])),
            bias=(bias + d[12:]).reshape(1, 7),
        )
        return innovate(moved, 7, EYE, seen, p).residual

    for i in range(19):
        d = h * np.eye(19)[i]
        np.testing.assert_allclose(
            (residual(-d) - residual(d)) / (2 * h),
            at_truth.jacobian[:, i],
            atol=1e-7,
            err_msg=str(i),
        )


def test_a_camera_with_errors_measures_what_its_images_show() -> None:
    """The same points of the target through the true camera, seen through the nominal camera."""
    errors = np.array([0.004, -0.006, 0.005, 0.002, -0.003, 0.001, 0.002])
    nominal = Camera.from_hfov(1280, 720, math.radians(60.0))
    true = replace(
        nominal, fx_px=nominal.fx_px * (1.0 + errors[6]), fy_px=nominal.fy_px * (1.0 + errors[6])
    )
    position, q = EYE.position_m + rot.rotate(EYE.q_wxyz, [0.02, -0.03, 1.1]), Q0
    points = 0.1 * np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float
    )
    q_true = rot.multiply(EYE.q_wxyz, rot.exp(errors[:3]))
    lens = EYE.position_m + rot.rotate(EYE.q_wxyz, errors[3:6])
    pixels = true.project(rot.rotate_inverse(q_true, position + rot.rotate(q, points) - lens))
    seen = predict_measurement(EYE, position, q, errors)
    again = nominal.project(
        rot.rotate_inverse(
            EYE.q_wxyz, seen.position_m + rot.rotate(seen.q_wxyz, points) - EYE.position_m
        )
    )
    wrong = nominal.project(
        rot.rotate_inverse(EYE.q_wxyz, position + rot.rotate(q, points) - EYE.position_m)
    )
    # What is left is the depth within the target that a longer focal length changes: 0.2 % of 0.1
    # m.
    assert np.abs(again - pixels).max() < 0.25
    assert np.abs(wrong - pixels).max() > 5.0


@deterministic
@given(st.integers(0, 2**32 - 1))
def test_correction_keeps_the_covariance_positive_and_shrinks_the_residual(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Within the linear range of attitude, where the residual must shrink: with sigmas up to 0.4 rad
    # it grew in 3 % of seeds.
    a = rng.normal(size=(19, 19)) * 10.0 ** rng.uniform(-4, -2, size=(19, 1))
    covariance = a @ a.T + 1e-12 * np.eye(19)
    branch = _branch(rng.normal(size=7) * 1e-3, covariance)
    pose = PoseHypothesis(
        branch.position_m + rng.normal(size=3) * 0.01,
        rot.multiply(Q0, rot.exp(rng.normal(size=3) * 0.02)),
        R,
    )
    before = innovate(branch, 7, EYE, pose, MekfParameters())
    after = correct(branch, before)
    assert np.array_equal(after.covariance, after.covariance.T)
    assert np.linalg.eigvalsh(after.covariance)[0] > -1e-15
    assert abs(float(after.q_wxyz @ after.q_wxyz) - 1.0) < 1e-14
    assert innovate(after, 7, EYE, pose, MekfParameters()).nis <= before.nis * (1 + 1e-6)


def test_gate_is_the_chi_square_quantile() -> None:
    assert pytest.approx(chi2.ppf(0.9999, 6), rel=1e-12) == GATE_CHI_SQUARE


# --- geometry -------------------------------------------------------------------------------------

CAMERA_P = np.array([0.07, 0.0, 0.075])
CAMERA_Q = rot.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def test_to_world_geometry() -> None:
    # One metre ahead of a camera that looks along the chaser's X, a chaser turned by 90 degrees.
    q = rot.exp([0.0, 0.0, math.pi / 2])
    irf = rot.conjugate(CAMERA_Q)
    h = to_world(
        [5.0, 0.0, 0.0], q, CAMERA_P, CAMERA_Q, [0.0, 0.0, 1.0], irf, np.diag([1.0, 1, 9, 1, 1, 1])
    )
    np.testing.assert_allclose(h.position_m, [5.0, 1.07, 0.075], atol=1e-12)
    assert float(rot.angle_between(h.q_wxyz, q)) < 1e-12
    np.testing.assert_allclose(np.diag(h.covariance), [1, 9, 1, 1, 1, 1], atol=1e-12)


def test_to_world_covariance_by_differences() -> None:
    rng = np.random.default_rng(3)
    p, q = rng.normal(size=3), rot.normalize(rng.normal(size=4))
    pi, qi = np.array([0.2, -0.1, 1.5]), rot.normalize(rng.normal(size=4))
    a, b = rng.normal(size=(6, 6)), rng.normal(size=(6, 6))
    ci, co = a @ a.T, b @ b.T
    h = to_world(p, q, CAMERA_P, CAMERA_Q, pi, qi, ci, co)

    def moved(d: np.ndarray) -> np.ndarray:
        m = to_world(
            p + d[0:3], rot.multiply(q, rot.exp(d[3:6])), CAMERA_P, CAMERA_Q,
            pi + d[6:9], rot.multiply(qi, rot.exp(d[9:12])), ci,
        )  # fmt: skip
        return np.concatenate(
            [m.position_m, rot.log(rot.multiply(rot.conjugate(h.q_wxyz), m.q_wxyz))]
        )

    j = np.column_stack([(moved(1e-6 * e) - moved(-1e-6 * e)) / 2e-6 for e in np.eye(12)])
    both = np.block([[co, np.zeros((6, 6))], [np.zeros((6, 6)), ci]])
    np.testing.assert_allclose(h.covariance, j @ both @ j.T, rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="covariance_irf"):
        to_world(p, q, CAMERA_P, CAMERA_Q, pi, qi, np.eye(5))
