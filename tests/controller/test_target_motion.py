# SPDX-License-Identifier: Apache-2.0
"""The free target's predicted motion and the estimator's, against PyBullet."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_controller.bodies.body_shape import shape_of
from chaserdock_controller.bodies.target_body import TargetBody, attach_bodies, predict_path
from chaserdock_controller.estimation.composite_body import target_body
from chaserdock_controller.estimation.joint import motion_models as motion
from chaserdock_controller.guidance.reference import feed_forward
from chaserdock_models import rotations
from chaserdock_models import scalar_rotations as so3
from chaserdock_world.physics.simulation import TARGET, Physics
from docking_cases import CHASER_INERTIA, CHASER_KG, scenario, world

HZ = 960


def composite(physics: Physics) -> TargetBody:
    a, b = physics.state(TARGET), physics.state("chaser/0")
    centre = rotations.rotate_inverse(a.q_wxyz, b.position_m - a.position_m)
    q = rotations.multiply(rotations.conjugate(a.q_wxyz), b.q_wxyz)
    return attach_bodies(
        target_body(scenario()), [(CHASER_KG, np.array(CHASER_INERTIA), centre, q)]
    )


@pytest.fixture
def captured() -> Physics:
    physics = world()
    physics.command_latch(0, "arm", 0)
    physics.advance(HZ, {})
    assert physics.latches["chaser/0"].latched
    return physics


def test_a_captured_target_moves_as_predicted(captured: Physics) -> None:
    """3 s ahead, at three times the paper's rates: 0.2 mm and 0.02 degrees; uniform motion is off
    by more than 1 cm.
    """
    begin, body = captured.state(TARGET), composite(captured)
    path = predict_path(
        body, begin.position_m, begin.velocity_m_s, begin.q_wxyz, begin.omega_rad_s, 0.05, 60
    )
    start = (begin.position_m, begin.velocity_m_s, begin.q_wxyz, begin.omega_rad_s)
    shape = shape_of(body.inertia_kg_m2, body.centre_trf_m)
    (position, velocity, _, omega), _ = motion.free_shape(start, 3.0, shape)
    captured.advance(3 * HZ, {})
    end = captured.state(TARGET)
    captured.close()
    assert np.linalg.norm(path.positions_m[-1] - end.position_m) < 2e-4
    assert rotations.angle_between(path.q_wxyz[-1], end.q_wxyz) < np.radians(0.02)
    np.testing.assert_allclose(path.omega_rad_s[-1], end.omega_rad_s, atol=2e-5)
    np.testing.assert_allclose(position, path.positions_m[-1], atol=1e-6)
    np.testing.assert_allclose(omega, path.omega_rad_s[-1], atol=1e-6)
    np.testing.assert_allclose(velocity, end.velocity_m_s, atol=2e-4)
    assert np.linalg.norm(begin.position_m + 3.0 * begin.velocity_m_s - end.position_m) > 0.01


def test_the_path_knows_its_own_accelerations() -> None:
    body = TargetBody(
        50.0, np.array([[1.0, 0.1, 0], [0.1, 2.0, 0], [0, 0, 2.5]]), np.array([-0.2, 0.05, 0.1])
    )
    h = 1e-3
    path = predict_path(body, (0, 0, 0), (0.01, 0, 0), (1, 0, 0, 0), (0.05, 0.1, -0.1), h, 40)
    second = (path.positions_m[2:] - 2 * path.positions_m[1:-1] + path.positions_m[:-2]) / h**2
    np.testing.assert_allclose(
        rotations.rotate_inverse(path.q_wxyz[1:-1], second), path.acceleration_m_s2[1:-1], atol=1e-7
    )
    turning = (path.omega_rad_s[2:] - path.omega_rad_s[:-2]) / (2 * h)
    np.testing.assert_allclose(turning, path.alpha_rad_s2[1:-1], atol=1e-8)


def test_feed_forward_holds_a_place_on_a_body_with_its_centre_elsewhere() -> None:
    """The force is that of the second derivative of the place's own path."""
    body = TargetBody(50.0, np.diag([1.0, 2.0, 2.5]), np.array([-0.2, 0.05, 0.1]))
    h, offset = 1e-3, np.array([0.0, 1.0, 0.2])
    path = predict_path(body, (0, 0, 0), (0.01, 0, 0), (1, 0, 0, 0), (0.05, 0.1, -0.1), h, 2)
    places = path.positions_m + rotations.rotate(path.q_wxyz, np.tile(offset, (3, 1)))
    wanted = 17.8 * rotations.rotate_inverse(
        path.q_wxyz[1], (places[2] - 2 * places[1] + places[0]) / h**2
    )
    inertia = np.diag([0.3, 0.4, 0.5])
    still = np.zeros(3)
    middle = (path.omega_rad_s[1], offset, still, still, (1, 0, 0, 0), 17.8, inertia)
    given = feed_forward(*middle, path.alpha_rad_s2[1], path.acceleration_m_s2[1])[0]
    np.testing.assert_allclose(given[:3], wanted, atol=1e-5)
    w = path.omega_rad_s[1]
    np.testing.assert_allclose(
        given[3:], inertia @ path.alpha_rad_s2[1] + np.cross(w, inertia @ w), atol=1e-12
    )


def test_the_transition_about_another_centre_is_the_derivative() -> None:
    """Central differences of the predicted state, all twelve directions."""
    start = (
        np.zeros(3),
        np.array([0.01, 0.02, 0.0]),
        so3.exp(np.array([0.3, -0.2, 0.5])),
        np.array([0.1, 0.2, -0.1]),
    )
    centre, e = np.array([-0.2, 0.05, 0.1]), 1e-5

    def moved(d: np.ndarray) -> tuple[np.ndarray, ...]:
        p, v, q, w = start
        begin = (p + d[:3], v + d[3:6], so3.multiply(q, so3.exp(d[6:9])), w + d[9:12])
        return motion.steady_motion(begin, 0.5, centre)[0]

    def apart(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> np.ndarray:
        turned = so3.log(so3.inverse_multiply(b[2], a[2]))
        return np.concatenate([a[0] - b[0], a[1] - b[1], turned, a[3] - b[3]])

    numeric = np.column_stack([apart(moved(e * d), moved(-e * d)) / (2 * e) for d in np.eye(12)])
    transition = motion.steady_motion(start, 0.5, centre)[1]
    np.testing.assert_allclose(transition, numeric, atol=2e-6)
