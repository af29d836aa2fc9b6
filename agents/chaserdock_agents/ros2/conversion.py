# SPDX-License-Identifier: Apache-2.0
"""Convert messages of a mission to messages of ROS 2: pure functions, without network or files.

ROS states poses and their covariances in the parent frame, twists in the child frame, and
quaternions scalar last (REP 103, REP 105, nav_msgs/Odometry). Frames: ``world`` (WRF), ``target``
(TRF), ``chaser_N`` (CRF) and ``chaser_N_camera`` (IRF, which is an optical frame of ROS). Time
stamps are simulated time; those of images are the middle of the exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, Quaternion, Vector3
from chaserdock_models.camera import Camera
from chaserdock_protocol import messages as m
from chaserdock_protocol.scenario import FlightScenario
from rosbags.typesys.stores import ros2_jazzy as ros

WORLD, TARGET_FRAME = "world", "target"
# Colours, 0 to 1, as those of the viewer.
_TARGET_RGB, _CHASER_RGB, _PLAN_RGB = (
    (0.875, 0.625, 0.25),
    (0.375, 0.5, 0.875),
    (0.375, 0.875, 0.375),
)
# visualization_msgs/Marker
_CUBE, _LINE_STRIP, _ADD, _DELETE = 1, 4, 0, 2
# Origin and no rotation (scalar first).
_ZERO, _IDENTITY = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)


class InvalidImage(ValueError):
    """An image whose bytes are not as its header states."""


@dataclass(frozen=True)
class RosMessage:
    """A message of ROS 2, the topic that it belongs to (absolute name) and its time."""

    topic: str
    message: Any
    time_ns: int

    @property
    def type_name(self) -> str:
        """Name of the type, such as ``nav_msgs/msg/Odometry``."""
        return self.message.__msgtype__


# -- parts -----------------------------------------------------------------------------------------


def chaser_frame(chaser: int) -> str:
    """Return the name of a chaser's frame."""
    return f"chaser_{chaser}"


def camera_frame(chaser: int) -> str:
    """Return the name of the optical frame of a chaser's camera."""
    return f"chaser_{chaser}_camera"


def time_of(time_ns: int) -> ros.builtin_interfaces__msg__Time:
    """Return a time stamp."""
    return ros.builtin_interfaces__msg__Time(time_ns // 1_000_000_000, time_ns % 1_000_000_000)


def _header(time_ns: int, frame: str) -> ros.std_msgs__msg__Header:
    return ros.std_msgs__msg__Header(time_of(time_ns), frame)


def _vector(v: Sequence[float]) -> ros.geometry_msgs__msg__Vector3:
    return ros.geometry_msgs__msg__Vector3(*v)


def _quaternion(q_wxyz: Sequence[float]) -> ros.geometry_msgs__msg__Quaternion:
    w, x, y, z = q_wxyz
    return ros.geometry_msgs__msg__Quaternion(x, y, z, w)


def _pose(position_m: Sequence[float], q_wxyz: Sequence[float]) -> ros.geometry_msgs__msg__Pose:
    return ros.geometry_msgs__msg__Pose(
        ros.geometry_msgs__msg__Point(*position_m), _quaternion(q_wxyz)
    )


def _pose_stamped(
    header: ros.std_msgs__msg__Header, position_m: Sequence[float], q_wxyz: Sequence[float]
) -> ros.geometry_msgs__msg__PoseStamped:
    return ros.geometry_msgs__msg__PoseStamped(header, _pose(position_m, q_wxyz))


def _transform(
    time_ns: int, parent: str, child: str, position_m: Vector3, q_wxyz: Quaternion
) -> ros.geometry_msgs__msg__TransformStamped:
    transform = ros.geometry_msgs__msg__Transform(_vector(position_m), _quaternion(q_wxyz))
    return ros.geometry_msgs__msg__TransformStamped(_header(time_ns, parent), child, transform)


def pose_covariance(position: Array, attitude: Array, cross: Array, to_world: Array) -> Array:
    """Return the covariance (36,) of a pose, row-major over (x, y, z, rotations about parent axes).

    ``position`` (3, 3) in parent axes; ``attitude`` (3, 3) of dtheta with q_true = q (x)
    exp(dtheta), hence in the axes of the body; ``cross`` (3, 3) of position (rows) with dtheta;
    ``to_world`` (3, 3) rotates from body to parent.
    """
    whole = np.empty((6, 6))
    whole[:3, :3] = position
    whole[:3, 3:] = cross @ to_world.T
    whole[3:, :3] = whole[:3, 3:].T
    whole[3:, 3:] = to_world @ attitude @ to_world.T
    return whole.ravel()


def twist_covariance(velocity: Array, rate: Array, cross: Array, to_world: Array) -> Array:
    """Return the covariance (36,) of a twist, row-major over (velocity, angular rate), both in the
    axes of the body.

    ``velocity`` (3, 3) in parent axes, ``rate`` (3, 3) in body axes, ``cross`` (3, 3) of velocity
    (rows) with rate.
    """
    whole = np.empty((6, 6))
    whole[:3, :3] = to_world.T @ velocity @ to_world
    whole[:3, 3:] = to_world.T @ cross
    whole[3:, :3] = whole[:3, 3:].T
    whole[3:, 3:] = rate
    return whole.ravel()


def _odometry(
    time_ns: int,
    child: str,
    state: m.Odometry | m.BodyTruth | m.TargetEstimate,
    pose_cov: Array,
    twist_cov: Array,
) -> ros.nav_msgs__msg__Odometry:
    velocity = rotations.rotate_inverse(state.q_wxyz, state.velocity_m_s).tolist()
    twist = ros.geometry_msgs__msg__Twist(_vector(velocity), _vector(state.omega_rad_s))
    return ros.nav_msgs__msg__Odometry(
        _header(time_ns, WORLD),
        child,
        ros.geometry_msgs__msg__PoseWithCovariance(_pose(state.position_m, state.q_wxyz), pose_cov),
        ros.geometry_msgs__msg__TwistWithCovariance(twist, twist_cov),
    )


# -- messages --------------------------------------------------------------------------------------


def clock(tick: m.Tick) -> ros.rosgraph_msgs__msg__Clock:
    """Return simulated time."""
    return ros.rosgraph_msgs__msg__Clock(time_of(tick.sim_time_ns))


def image(message: m.Image) -> ros.sensor_msgs__msg__Image:
    """Return an image with grey levels of 8 bits, decoded if it is compressed. Raises
    InvalidImage.
    """
    data = np.frombuffer(message.data, np.uint8)
    if message.encoding == "jpeg":
        pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        data = np.zeros(0, np.uint8) if pixels is None else np.asarray(pixels, np.uint8)
        if data.shape != (message.height_px, message.width_px):
            raise InvalidImage(f"no JPEG image of {message.width_px} x {message.height_px} pixels")
    elif data.size != message.width_px * message.height_px:
        raise InvalidImage(f"{data.size} bytes for {message.width_px} x {message.height_px} pixels")
    return ros.sensor_msgs__msg__Image(
        _header(message.sim_time_ns, camera_frame(message.chaser)),
        message.height_px,
        message.width_px,
        "mono8",
        0,
        message.width_px,
        data.ravel(),
    )


def camera_info(message: m.Image, camera: Camera) -> ros.sensor_msgs__msg__CameraInfo:
    """Return the calibration that belongs to an image (distortion model ``plumb_bob``,
    ``rational_polynomial`` or ``equidistant``).
    """
    k = camera.matrix()
    model, coefficients = camera.ros_distortion()
    return ros.sensor_msgs__msg__CameraInfo(
        _header(message.sim_time_ns, camera_frame(message.chaser)),
        camera.height_px,
        camera.width_px,
        model,
        np.array(coefficients),
        k.ravel(),
        np.eye(3).ravel(),
        np.column_stack([k, np.zeros(3)]).ravel(),
        0,
        0,
        ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False),
    )


def odometry(message: m.Odometry) -> ros.nav_msgs__msg__Odometry:
    """Return a chaser's navigation solution."""
    to_world = rotations.to_matrix(message.q_wxyz)
    none = np.zeros((3, 3))
    position, velocity, attitude, rate = (
        np.reshape(c, (3, 3))
        for c in (
            message.position_covariance_m2,
            message.velocity_covariance_m2_s2,
            message.attitude_covariance_rad2,
            message.omega_covariance_rad2_s2,
        )
    )
    pose_cov = pose_covariance(position, attitude, none, to_world)
    twist_cov = twist_covariance(velocity, rate, none, to_world)
    return _odometry(
        message.sim_time_ns, chaser_frame(message.chaser), message, pose_cov, twist_cov
    )


def body_odometry(message: m.BodyTruth) -> ros.nav_msgs__msg__Odometry:
    """Return a true state, which has no covariance."""
    frame = message.body.replace("/", "_")
    return _odometry(message.sim_time_ns, frame, message, np.zeros(36), np.zeros(36))


def measured_pose(message: m.BodyReference) -> ros.geometry_msgs__msg__PoseWithCovarianceStamped:
    """Return a measured pose with its covariance."""
    variances = [message.sigma_m**2] * 3 + [message.sigma_rad**2] * 3
    pose = ros.geometry_msgs__msg__PoseWithCovariance(
        _pose(message.position_m, message.q_wxyz), np.diag(variances).ravel()
    )
    return ros.geometry_msgs__msg__PoseWithCovarianceStamped(
        _header(message.sim_time_ns, WORLD), pose
    )


def target_odometry(message: m.TargetEstimate) -> ros.nav_msgs__msg__Odometry:
    """Return the estimated pose and twist of the target with their covariances."""
    to_world = rotations.to_matrix(message.q_wxyz)
    p = np.reshape(message.covariance, (12, 12))
    pose_cov = pose_covariance(p[:3, :3], p[6:9, 6:9], p[:3, 6:9], to_world)
    twist_cov = twist_covariance(p[3:6, 3:6], p[9:, 9:], p[3:6, 9:], to_world)
    return _odometry(message.sim_time_ns, TARGET_FRAME, message, pose_cov, twist_cov)


def target_pose(
    estimate: ros.nav_msgs__msg__Odometry,
) -> ros.geometry_msgs__msg__PoseWithCovarianceStamped:
    """Return the pose of an estimated odometry."""
    return ros.geometry_msgs__msg__PoseWithCovarianceStamped(estimate.header, estimate.pose)


def wrench(message: m.WrenchCommand) -> ros.geometry_msgs__msg__WrenchStamped:
    """Return a commanded wrench, in the chaser's axes, with the time from which it acts."""
    return ros.geometry_msgs__msg__WrenchStamped(
        _header(message.effective_time_ns, chaser_frame(message.chaser)),
        ros.geometry_msgs__msg__Wrench(_vector(message.force_N), _vector(message.torque_N_m)),
    )


def path(message: m.Plan) -> ros.nav_msgs__msg__Path:
    """Return a plan's poses, each with its time."""
    p, q, step_ns = message.positions_m, message.quaternions_wxyz, message.step_s * 1e9
    # Without the helpers above, as a plan takes most of the bridge's time.
    stamped, pose = ros.geometry_msgs__msg__PoseStamped, ros.geometry_msgs__msg__Pose
    point, quaternion, header = (
        ros.geometry_msgs__msg__Point,
        ros.geometry_msgs__msg__Quaternion,
        ros.std_msgs__msg__Header,
    )
    times = [time_of(message.sim_time_ns + round(k * step_ns)) for k in range(len(p) // 3)]
    poses = [
        stamped(header(stamp, WORLD), pose(point(x, y, z), quaternion(qx, qy, qz, qw)))
        for stamp, x, y, z, qw, qx, qy, qz in zip(
            times, p[::3], p[1::3], p[2::3], q[::4], q[1::4], q[2::4], q[3::4], strict=True
        )
    ]
    return ros.nav_msgs__msg__Path(_header(message.sim_time_ns, WORLD), poses)


def reference(message: m.Reference) -> ros.geometry_msgs__msg__PoseStamped:
    """Return a chaser's reference pose."""
    return _pose_stamped(_header(message.sim_time_ns, WORLD), message.position_m, message.q_wxyz)


def chaser_transforms(message: m.Odometry, camera: Camera) -> ros.tf2_msgs__msg__TFMessage:
    """Return the frames of a chaser and of its camera.

    The camera's is repeated for readers that join late.
    """
    chaser, time_ns = message.chaser, message.sim_time_ns
    body = _transform(time_ns, WORLD, chaser_frame(chaser), message.position_m, message.q_wxyz)
    mounting = (camera.position_crf_m, camera.q_crf_irf_wxyz)
    eye = _transform(time_ns, chaser_frame(chaser), camera_frame(chaser), *mounting)
    return ros.tf2_msgs__msg__TFMessage([body, eye])


def target_transform(message: m.TargetEstimate) -> ros.tf2_msgs__msg__TFMessage:
    """Return the estimated frame of the target."""
    pose = (message.position_m, message.q_wxyz)
    return ros.tf2_msgs__msg__TFMessage(
        [_transform(message.sim_time_ns, WORLD, TARGET_FRAME, *pose)]
    )


def _marker(
    time_ns: int,
    frame: str,
    number: int,
    shape: int,
    *,
    size_m: Sequence[float] = _ZERO,
    rgb: Vector3 = _ZERO,
    alpha: float = 1.0,
    points: Sequence[ros.geometry_msgs__msg__Point] = (),
    action: int = _ADD,
    namespace: str,
) -> ros.visualization_msgs__msg__Marker:
    none = ros.builtin_interfaces__msg__Time(0, 0)
    return ros.visualization_msgs__msg__Marker(
        _header(time_ns, frame),
        namespace,
        number,
        shape,
        action,
        _pose(_ZERO, _IDENTITY),
        _vector(size_m),
        ros.std_msgs__msg__ColorRGBA(*rgb, a=alpha),
        ros.builtin_interfaces__msg__Duration(0, 0),
        True,
        list(points),
        [],
        "",
        ros.sensor_msgs__msg__CompressedImage(
            ros.std_msgs__msg__Header(none, ""), "", np.zeros(0, np.uint8)
        ),
        [],
        "",
        "",
        ros.visualization_msgs__msg__MeshFile("", np.zeros(0, np.uint8)),
        False,
    )


def body_markers(
    message: m.TargetEstimate, target_size_m: Vector3, chaser_size_m: Vector3, chasers: int
) -> ros.visualization_msgs__msg__MarkerArray:
    """Return target and chasers as boxes in their frames.

    The target is opaque while it is tracked, else transparent; without an estimate its box is
    deleted.
    """
    known = message.is_known
    alpha = 0.875 if message.status == "tracking" else 0.25
    markers: list[Any] = [
        _marker(
            message.sim_time_ns,
            TARGET_FRAME,
            0,
            _CUBE,
            size_m=target_size_m,
            rgb=_TARGET_RGB,
            alpha=alpha,
            action=_ADD if known else _DELETE,
            namespace="target",
        )
    ]
    for i in range(chasers):
        box: dict[str, Any] = {"size_m": chaser_size_m, "rgb": _CHASER_RGB, "namespace": "chasers"}
        markers.append(_marker(message.sim_time_ns, chaser_frame(i), i, _CUBE, **box))
    return ros.visualization_msgs__msg__MarkerArray(markers)


def plan_markers(
    message: m.Plan, plan: ros.nav_msgs__msg__Path
) -> ros.visualization_msgs__msg__MarkerArray:
    """Return a plan, of which ``plan`` is the path, as a line in WRF."""
    line: Any = _marker(
        message.sim_time_ns,
        WORLD,
        message.chaser,
        _LINE_STRIP,
        size_m=(0.01, 0.0, 0.0),
        rgb=_PLAN_RGB,
        points=[pose.pose.position for pose in plan.poses],
        namespace="plans",
    )
    return ros.visualization_msgs__msg__MarkerArray([line])


# -- all of them -----------------------------------------------------------------------------------


def topic_types(chasers: int) -> dict[str, str]:
    """Return the topics of a mission, without ground truth, and their types."""
    of_chaser = {
        "image": "sensor_msgs/msg/Image",
        "camera_info": "sensor_msgs/msg/CameraInfo",
        "odometry": "nav_msgs/msg/Odometry",
        "wrench": "geometry_msgs/msg/WrenchStamped",
        "plan": "nav_msgs/msg/Path",
        "reference": "geometry_msgs/msg/PoseStamped",
    }
    return {
        "/clock": "rosgraph_msgs/msg/Clock",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/markers": "visualization_msgs/msg/MarkerArray",
        "/target/odometry": "nav_msgs/msg/Odometry",
        "/target/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        **{
            f"/{chaser_frame(i)}/{name}": kind
            for i in range(chasers)
            for name, kind in of_chaser.items()
        },
    }


class Converter:
    """Converts messages of one mission. Nothing of one message influences another."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._bodies = (
            scenario.target_model().size_m,
            scenario.chaser.size_m,
            len(scenario.chasers),
        )
        self._camera = scenario.camera_model()
        self._parts: dict[type, Callable[[Any], Iterable[tuple[str, Any]]]] = {
            m.Tick: lambda x: [("/clock", clock(x))],
            m.Image: self._image,
            m.Odometry: self._odometry,
            m.TargetEstimate: self._target,
            m.WrenchCommand: lambda x: [(f"/{chaser_frame(x.chaser)}/wrench", wrench(x))],
            m.Plan: self._plan,
            m.Reference: lambda x: [(f"/{chaser_frame(x.chaser)}/reference", reference(x))],
            m.BodyReference: lambda x: [
                (f"/reference/{x.body.replace('/', '_')}", measured_pose(x))
            ],
            m.BodyTruth: lambda x: [(f"/truth/{x.body.replace('/', '_')}", body_odometry(x))],
        }

    def convert(self, message: m.Message) -> list[RosMessage]:
        """Return a message's counterparts; none for types that ROS 2 has no standard message for.

        Raises InvalidImage for an image that cannot be decoded.
        """
        parts = self._parts.get(type(message))
        found = () if parts is None else parts(message)
        return [RosMessage(topic, part, message.sim_time_ns) for topic, part in found]

    def _image(self, message: m.Image) -> Iterable[tuple[str, Any]]:
        name = f"/{chaser_frame(message.chaser)}"
        yield f"{name}/image", image(message)
        yield f"{name}/camera_info", camera_info(message, self._camera)

    def _odometry(self, message: m.Odometry) -> Iterable[tuple[str, Any]]:
        yield f"/{chaser_frame(message.chaser)}/odometry", odometry(message)
        yield "/tf", chaser_transforms(message, self._camera)

    def _target(self, message: m.TargetEstimate) -> Iterable[tuple[str, Any]]:
        if message.is_known:
            estimate = target_odometry(message)
            yield "/target/odometry", estimate
            yield "/target/pose", target_pose(estimate)
            yield "/tf", target_transform(message)
        yield "/markers", body_markers(message, *self._bodies)

    def _plan(self, message: m.Plan) -> Iterable[tuple[str, Any]]:
        plan = path(message)
        yield f"/{chaser_frame(message.chaser)}/plan", plan
        yield "/markers", plan_markers(message, plan)
