# SPDX-License-Identifier: Apache-2.0
"""Poses of devices in WRF and CRF, against scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_agents.gateway.axes import body_pose, robot_axes, why_unusable
from chaserdock_agents.gateway.devices import PoseSample
from chaserdock_protocol.scenario.lab import LabPose
from scipy.spatial.transform import Rotation

ENU_OF_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_OF_FRD = np.diag([1.0, -1.0, -1.0])
MOUNT = Rotation.from_rotvec([0.3, -0.5, 0.9])
ARM_M = np.array([0.12, -0.05, 0.31])


def wxyz(rotation: Rotation) -> np.ndarray:
    x, y, z, w = rotation.as_quat()
    return np.array([w, x, y, z])


def device(**axes: str) -> LabPose:
    q = tuple(wxyz(MOUNT).tolist())
    return LabPose.model_validate(
        {"address": "x:y", "body": "chaser/0", "position_m": tuple(ARM_M), "q_wxyz": q, **axes}
    )


@pytest.mark.parametrize("world_axes", ["enu", "ned"])
@pytest.mark.parametrize("body_axes", ["flu", "frd"])
def test_pose_and_velocities_are_those_of_crf(world_axes: str, body_axes: str) -> None:
    rng = np.random.default_rng(2)
    body = Rotation.random(rng=rng)  # FLU body of the device to ENU
    place, velocity, omega = rng.normal(size=(3, 3))
    w = ENU_OF_NED if world_axes == "ned" else np.eye(3)
    b = FLU_OF_FRD if body_axes == "frd" else np.eye(3)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([1e-6, 4e-6, 9e-6])
    covariance[3:, 3:] = np.diag([1e-4, 2e-4, 3e-4])
    sample = PoseSample(
        "",
        None,
        0,
        w.T @ place,
        wxyz(Rotation.from_matrix(w.T @ body.as_matrix() @ b)),
        w.T @ velocity,
        b.T @ omega,
        covariance,
    )
    pose = body_pose(sample, device(world_axes=world_axes, body_axes=body_axes), 7)

    np.testing.assert_allclose(pose.position_m, place + body.apply(ARM_M), atol=1e-12)
    expected = body * MOUNT
    got = Rotation.from_quat(np.roll(pose.q_wxyz, -1))
    assert (expected.inv() * got).magnitude() < 1e-12
    assert pose.velocity_m_s is not None
    assert pose.omega_rad_s is not None
    lever = np.cross(body.apply(omega), body.apply(ARM_M))
    np.testing.assert_allclose(pose.velocity_m_s, velocity + lever, atol=1e-12)
    np.testing.assert_allclose(pose.omega_rad_s, MOUNT.inv().apply(omega), atol=1e-12)
    np.testing.assert_allclose(
        pose.position_covariance_m2, w @ covariance[:3, :3] @ w.T, atol=1e-15
    )
    m = MOUNT.inv().as_matrix()
    np.testing.assert_allclose(
        pose.attitude_covariance_rad2, m @ b @ covariance[3:, 3:] @ b.T @ m.T, atol=1e-15
    )


def test_wrenches_turn_to_the_robots_axes() -> None:
    np.testing.assert_array_equal(robot_axes("frd")(np.array([1.0, 2.0, 3.0])), [1.0, -2.0, -3.0])
    np.testing.assert_array_equal(robot_axes("flu")(np.array([1.0, 2.0, 3.0])), [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("place", "q", "said"),
    [
        ([0.0, np.nan, 0.0], [1.0, 0.0, 0.0, 0.0], "finite"),
        ([0.0, 0.0], [1.0, 0.0, 0.0, 0.0], "finite"),
        ([0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], "length 0.5"),
    ],
)
def test_samples_that_are_no_pose_are_named(place: list[float], q: list[float], said: str) -> None:
    assert said in why_unusable(PoseSample("", None, 0, np.array(place), np.array(q)))
