# SPDX-License-Identifier: Apache-2.0
"""Messages as messages of ROS 2: axes, covariances, frames, times, sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from chaserdock_agents.ros2 import conversion
from chaserdock_agents.ros2.conversion import Converter, InvalidImage
from chaserdock_agents.ros2.types import TYPES
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_protocol import messages as m
from chaserdock_protocol.scenario import load_scenario
from message_samples import BY_TYPE, SAMPLES

SCENARIO = Path(__file__).parents[2] / "scenarios" / "two-chaser-tracking.toml"
RNG = np.random.default_rng(4)


def sample(kind: type[Any], **changes: Any) -> Any:
    return msgspec.structs.replace(BY_TYPE[kind], **changes)


def random_covariance(size: int) -> np.ndarray[Any, Any]:
    a = RNG.normal(size=(size, size))
    return a @ a.T


def apply(pose: Any) -> np.ndarray[Any, Any]:
    """Return the rotation matrix of a ROS quaternion."""
    q = pose.orientation
    return rotations.to_matrix((q.w, q.x, q.y, q.z))


@pytest.mark.parametrize(
    "message", [s for s in SAMPLES if isinstance(s, m.Message)], ids=lambda s: type(s).__name__
)
def test_every_counterpart_survives_serialization(message: m.Message) -> None:
    converter = Converter(load_scenario(SCENARIO))
    for part in converter.convert(message):
        data = bytes(TYPES.serialize_cdr(part.message, part.type_name))
        again = TYPES.deserialize_cdr(data, part.type_name)
        assert bytes(TYPES.serialize_cdr(again, part.type_name)) == data
        assert part.topic.startswith("/")


def test_twist_is_in_the_axes_of_the_body_and_quaternion_scalar_last() -> None:
    message = sample(m.Odometry, chaser=3)
    ros = conversion.odometry(message)
    assert (ros.header.frame_id, ros.child_frame_id) == ("world", "chaser_3")
    assert (ros.header.stamp.sec, ros.header.stamp.nanosec) == (0, 800_000_000)
    q = ros.pose.pose.orientation
    assert (q.w, q.x, q.y, q.z) == message.q_wxyz
    v = ros.twist.twist.linear
    assert apply(ros.pose.pose) @ [v.x, v.y, v.z] == pytest.approx(message.velocity_m_s)
    w = ros.twist.twist.angular
    assert (w.x, w.y, w.z) == message.omega_rad_s


def test_covariance_of_the_target_is_that_of_perturbed_poses() -> None:
    """Linear maps of the state error, found by differences of poses and twists, applied to the
    state's covariance.
    """
    p = random_covariance(12)
    q0 = rotations.normalize(RNG.normal(size=4))
    velocity = RNG.normal(size=3)
    message = sample(
        m.TargetEstimate,
        q_wxyz=tuple(q0.tolist()),
        velocity_m_s=tuple(velocity.tolist()),
        covariance=tuple(p.ravel().tolist()),
    )
    ros = conversion.target_odometry(message)

    pose_map, twist_map, step = np.zeros((6, 12)), np.zeros((6, 12)), 1e-6
    body_axes = rotations.to_matrix(q0).T
    for k in range(12):
        error = np.zeros(12)
        error[k] = step
        q = rotations.multiply(q0, rotations.exp(error[6:9]))
        # About the parent's fixed axes: q = exp(world) (x) q0.
        turned = rotations.log(rotations.multiply(q, rotations.conjugate(q0)))
        pose_map[:, k] = np.concatenate([error[:3], turned]) / step
        # Errors of the twist in the axes of the estimated body.
        twist_map[:, k] = np.concatenate([body_axes @ error[3:6], error[9:]]) / step
    pose = np.reshape(ros.pose.covariance, (6, 6))
    assert np.allclose(pose, pose_map @ p @ pose_map.T, rtol=1e-5, atol=1e-6)
    twist = np.reshape(ros.twist.covariance, (6, 6))
    assert np.allclose(twist, twist_map @ p @ twist_map.T, rtol=1e-5, atol=1e-6)
    assert conversion.target_pose(ros).pose is ros.pose


def test_covariance_of_odometry_is_rotated() -> None:
    blocks = [random_covariance(3) for _ in range(4)]
    names = (
        "position_covariance_m2",
        "velocity_covariance_m2_s2",
        "attitude_covariance_rad2",
        "omega_covariance_rad2_s2",
    )
    message = sample(
        m.Odometry, **{n: tuple(b.ravel().tolist()) for n, b in zip(names, blocks, strict=True)}
    )
    r = rotations.to_matrix(message.q_wxyz)
    ros = conversion.odometry(message)
    pose, twist = np.reshape(ros.pose.covariance, (6, 6)), np.reshape(ros.twist.covariance, (6, 6))
    assert np.allclose(pose[:3, :3], blocks[0])
    assert np.allclose(pose[3:, 3:], r @ blocks[2] @ r.T)
    assert np.allclose(twist[:3, :3], r.T @ blocks[1] @ r)
    assert np.allclose(twist[3:, 3:], blocks[3])
    assert not pose[:3, 3:].any()


def test_transforms_chain_from_world_to_camera() -> None:
    camera = Camera.from_hfov(640, 480, 1.0, (0.1, 0.2, 0.3))
    message = sample(m.Odometry, chaser=1)
    body, eye = conversion.chaser_transforms(message, camera).transforms
    assert [t.header.frame_id for t in (body, eye)] == ["world", "chaser_1"]
    assert [t.child_frame_id for t in (body, eye)] == ["chaser_1", "chaser_1_camera"]
    # The optical axis (z) looks along X of the chaser, image rows (y) downwards.
    q = eye.transform.rotation
    turn = rotations.to_matrix((q.w, q.x, q.y, q.z))
    assert np.allclose(turn @ [0, 0, 1], [1, 0, 0])
    assert np.allclose(turn @ [0, 1, 0], [0, 0, -1])
    t = eye.transform.translation
    assert (t.x, t.y, t.z) == (0.1, 0.2, 0.3)


def test_image_is_decoded_and_described() -> None:
    pixels = np.tile(np.arange(0, 64, 2, dtype=np.uint8), (24, 1))
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    message = sample(m.Image, width_px=32, height_px=24, encoding="jpeg", data=data)
    ros = conversion.image(message)
    assert (ros.height, ros.width, ros.step, ros.encoding) == (24, 32, 32, "mono8")
    assert np.abs(ros.data.reshape(24, 32).astype(int) - pixels).max() <= 2
    plain = conversion.image(sample(m.Image))
    assert bytes(plain.data) == sample(m.Image).data
    camera = Camera(32, 24, 30.0, 31.0, 15.5, 11.5, (0.1, 0.2, 0.3, 0.4))
    info = conversion.camera_info(message, camera)
    assert info.header == ros.header
    assert info.d.tolist() == [0.1, 0.2, 0.3, 0.4, 0.0]
    assert info.k.tolist() == [30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0]
    assert info.p.reshape(3, 4)[:, 3].tolist() == [0.0] * 3


@pytest.mark.parametrize("encoding", ["jpeg", "mono8"])
def test_damaged_image_is_refused(encoding: str) -> None:
    with pytest.raises(InvalidImage, match="4 x 2 pixels"):
        conversion.image(sample(m.Image, encoding=encoding, data=b"\xff\xd8 no image"))


def test_plan_has_the_time_of_every_pose() -> None:
    message = sample(
        m.Plan,
        step_s=0.25,
        positions_m=(0.0, 0.0, 0.0, 1.0, 2.0, 3.0),
        quaternions_wxyz=(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
    )
    first, second = conversion.path(message).poses
    assert (first.header.stamp.sec, first.header.stamp.nanosec) == (0, 800_000_000)
    assert (second.header.stamp.sec, second.header.stamp.nanosec) == (1, 50_000_000)
    assert (second.pose.position.x, second.pose.position.y, second.pose.position.z) == (
        1.0,
        2.0,
        3.0,
    )
    assert second.pose.orientation.x == 1.0


def test_unknown_target_has_no_pose_and_its_marker_is_deleted() -> None:
    converter = Converter(load_scenario(SCENARIO))
    known = converter.convert(sample(m.TargetEstimate, status="tracking"))
    assert [part.topic for part in known] == ["/target/odometry", "/target/pose", "/tf", "/markers"]
    (unknown,) = converter.convert(sample(m.TargetEstimate, status="lost"))
    actions = [marker.action for marker in unknown.message.markers]
    assert actions == [2, 0, 0]  # the target's box is deleted, the two chasers remain
    assert known[-1].message.markers[0].action == 0
