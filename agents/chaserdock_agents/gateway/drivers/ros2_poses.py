# SPDX-License-Identifier: Apache-2.0
"""Read poses from topics of ROS 2: odometry and motion capture.

Native axes: those of REP 103 (``enu``, ``flu``) for messages of ROS, ``ned`` and ``frd`` for
PX4's. Every message is passed on, with NaN where it states NaN.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array

from ..devices import DeviceError, DeviceHost, PoseSample
from ..options import read_options
from .pose_samples import KEPT, is_finite, is_pose, stated, to_body_rotation, turned
from .ros2_network import RosEndpoints, RosOptions, absolute_name

Twist = Literal["child", "world", "none"]
SampleReader = Callable[[Any, int, Twist], PoseSample]

# px4_msgs/msg/VehicleOdometry
_UNKNOWN, _NED, _FRD, _BODY_FRD = 0, 1, 2, 3


class RosPoseOptions(RosOptions, frozen=True, kw_only=True):
    """Options of a source of poses on ROS 2.

    ``type``: message type. ``twist``: axes in which odometry states its velocity: ``child``, as ROS
    has it; ``world``, as some publishers do; or ``none``, for publishers that leave it zero.
    """

    type: str = "nav_msgs/msg/Odometry"
    twist: Twist = "child"


# -- messages --------------------------------------------------------------------------------------


def stamp_of(header: Any) -> int | None:
    """Return the stamp of a header, ns; None for 0, which is none."""
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec or None


def _xyz(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z], dtype=float)


def _sample(
    header: Any,
    pose: Any,
    arrived_ns: int,
    *,
    body: str = "",
    covariance: Any = None,
    **motion: Any,
) -> PoseSample:
    q = pose.orientation
    sample = PoseSample(
        body,
        stamp_of(header),
        arrived_ns,
        _xyz(pose.position),
        np.array([q.w, q.x, q.y, q.z], dtype=float),
        **motion,
    )
    matrix = None if covariance is None else np.reshape(np.asarray(covariance, float), (6, 6))
    if matrix is None or not stated(matrix) or not is_pose(sample):
        return sample
    return PoseSample(**{**vars(sample), "covariance": to_body_rotation(matrix, sample.q_wxyz)})


def of_odometry(message: Any, arrived_ns: int, twist: Twist = "child") -> PoseSample:
    """Read ``nav_msgs/msg/Odometry``: pose in the parent frame, twist in the child frame."""
    pose, velocity = message.pose.pose, message.twist.twist
    sample = _sample(
        message.header,
        pose,
        arrived_ns,
        body=message.child_frame_id,
        covariance=message.pose.covariance,
    )
    if twist == "none" or not is_pose(sample):
        return sample
    linear, angular = _xyz(velocity.linear), _xyz(velocity.angular)
    if twist == "world":
        world = linear if is_finite(linear) else None
        body = rotations.rotate_inverse(rotations.normalize(sample.q_wxyz), angular)
    else:
        world, body = turned(sample.q_wxyz, linear), angular
    motion = {"velocity_m_s": world, "omega_rad_s": body if is_finite(body) else None}
    return PoseSample(**{**vars(sample), **motion})


def of_pose(message: Any, arrived_ns: int, twist: Twist = "child") -> PoseSample:
    """Read ``geometry_msgs/msg/PoseStamped``, which has no velocity."""
    return _sample(message.header, message.pose, arrived_ns)


def of_pose_with_covariance(message: Any, arrived_ns: int, twist: Twist = "child") -> PoseSample:
    """Read ``geometry_msgs/msg/PoseWithCovarianceStamped``, which has no velocity."""
    pose = message.pose
    return _sample(message.header, pose.pose, arrived_ns, covariance=pose.covariance)


def of_vehicle_odometry(message: Any, arrived_ns: int, twist: Twist = "child") -> PoseSample:
    """Read ``px4_msgs/msg/VehicleOdometry``: microseconds since boot, NED or another world frame
    with Z down, FRD; NaN where nothing is known. The frame of the velocity is in the message.
    """
    position, q, velocity, omega = (
        np.asarray(v, dtype=float)
        for v in (message.position, message.q, message.velocity, message.angular_velocity)
    )
    if message.velocity_frame == _BODY_FRD and is_finite(q) and np.any(q):
        velocity = turned(q, velocity)
    elif message.velocity_frame != message.pose_frame or message.velocity_frame == _UNKNOWN:
        velocity = None  # its heading is unknown
    variances = np.asarray([*message.position_variance, *message.orientation_variance], dtype=float)
    return PoseSample(
        "",
        1000 * int(message.timestamp_sample or message.timestamp) or None,
        arrived_ns,
        position,
        q,
        velocity if twist != "none" and velocity is not None and is_finite(velocity) else None,
        omega if twist != "none" and is_finite(omega) else None,
        np.diag(variances) if stated(variances) else None,
    )


READERS: dict[str, SampleReader] = {
    "nav_msgs/msg/Odometry": of_odometry,
    "geometry_msgs/msg/PoseStamped": of_pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": of_pose_with_covariance,
    "px4_msgs/msg/VehicleOdometry": of_vehicle_odometry,
}


# -- source ----------------------------------------------------------------------------------------


class RosPoses:
    """Poses of one topic."""

    def __init__(self, topic: str, options: RosPoseOptions, host: DeviceHost) -> None:
        self._read = READERS[options.type]
        self._twist: Twist = options.twist
        px4 = options.type.startswith("px4_msgs/")
        self.world_axes, self.body_axes = ("ned", "frd") if px4 else ("enu", "flu")
        self._arrived: deque[tuple[Any, int]] = deque(maxlen=KEPT)
        self._endpoints = RosEndpoints(options)
        try:
            self._endpoints.subscribe(
                topic, options.type, lambda m: self._arrived.append((m, host.now_ns()))
            )
        except BaseException:
            self._endpoints.close()
            raise

    def poll(self) -> Sequence[PoseSample]:
        """See `PoseSource`."""
        samples: list[PoseSample] = []
        while self._arrived:
            samples.append(self._read(*self._arrived.popleft(), self._twist))
        if not samples:
            self._endpoints.check()
        return samples

    def close(self) -> None:
        """See `PoseSource`."""
        self._endpoints.close()


def open_poses(address: str, options: Mapping[str, Any], host: DeviceHost) -> RosPoses:
    """Open a source of poses: ``ros2:/robot0/odom``."""
    topic, read = absolute_name(address), read_options(RosPoseOptions, options)
    if read.type not in READERS:
        raise DeviceError(f"type {read.type!r} is not one of: {', '.join(READERS)}")
    return RosPoses(topic, read, host)
