# SPDX-License-Identifier: Apache-2.0
"""Estimation mathematics: rotations, Jacobians by differences, process noise, camera errors."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
from chaserdock_controller.estimation.joint import motion_models as motion
from chaserdock_controller.estimation.joint.measurements import mounting_of, predict_sighting
from chaserdock_controller.estimation.joint.state import FOCAL, TURN, empty_state
from chaserdock_models import rotations as rot
from chaserdock_models import scalar_rotations as scalar
from chaserdock_models.camera import Camera
from estimation_cases import Q0, deterministic, rotation_vectors, vectors
from hypothesis import given


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


def test_transition_by_differences() -> None:
    w, dt, h = np.array([0.4, -0.9, 0.3]), 0.7, 1e-6

    def step(d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return motion.constant_rates(rot.multiply(Q0, rot.exp(d[:3])), w + d[3:], dt)

    q, _, transition = step(np.zeros(6))
    for i in range(6):
        d = h * np.eye(6)[i]
        (qa, wa, _), (qb, wb, _) = step(d), step(-d)
        back = rot.conjugate(q)
        dtheta = rot.log(rot.multiply(back, qa)) - rot.log(rot.multiply(back, qb))
        np.testing.assert_allclose(
            transition[:, i], np.concatenate([dtheta, wa - wb]) / (2 * h), atol=2e-6
        )


def test_process_noise_composes_and_is_positive() -> None:
    whole = motion.process_noise(0.5, 1e-8, 4e-8)
    f = np.eye(12)
    f[0:3, 3:6] = f[6:9, 9:12] = 0.3 * np.eye(3)
    parts = f @ motion.process_noise(0.2, 1e-8, 4e-8) @ f.T + motion.process_noise(0.3, 1e-8, 4e-8)
    np.testing.assert_allclose(whole, parts, atol=1e-20)
    assert np.linalg.eigvalsh(whole)[0] > 0.0


def test_a_camera_with_errors_measures_what_its_images_show() -> None:
    """The same points of the target through the true camera, seen through the nominal camera."""
    errors = np.array([0.004, -0.006, 0.005, 0.002, -0.003, 0.001, 0.002])
    nominal = Camera.from_hfov(1280, 720, math.radians(60.0))
    focal = 1.0 + errors[6]
    true = replace(nominal, fx_px=nominal.fx_px * focal, fy_px=nominal.fy_px * focal)
    points = 0.1 * np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float
    )
    lens, q_lens = nominal.irf_pose_in_world(np.array([0.3, -0.9, 0.2]), Q0)
    state = empty_state(0, 1)
    state.extra[0, TURN.start - 12 : FOCAL.stop - 12] = errors
    state = msgspec.structs.replace(
        state,
        position_m=lens + rot.rotate(q_lens, [0.02, -0.03, 1.1]),
        q_wxyz=rot.normalize([0.6, -0.3, 0.5, -0.4]),
        positions_m=np.array([[0.3, -0.9, 0.2]]),
        attitudes_wxyz=np.array([Q0]),
    )
    corners = state.position_m + rot.rotate(state.q_wxyz, points)
    q_true = rot.multiply(q_lens, rot.exp(errors[:3]))
    shifted = lens + rot.rotate(q_lens, errors[3:6])
    pixels = true.project(rot.rotate_inverse(q_true, corners - shifted))
    seen = predict_sighting(state, 0, mounting_of(nominal))
    again = nominal.project(seen.position_m + rot.rotate(seen.q_wxyz, points))
    wrong = nominal.project(rot.rotate_inverse(q_lens, corners - lens))
    # What is left is the depth within the target that a longer focal length changes: 0.2 % of 0.1
    # m.
    assert np.abs(again - pixels).max() < 0.25
    assert np.abs(wrong - pixels).max() > 5.0
