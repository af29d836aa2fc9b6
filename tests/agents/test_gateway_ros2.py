# SPDX-License-Identifier: Apache-2.0
"""Devices of the gateway on ROS 2 and PX4, with zenoh-ros2-sdk, an independent implementation of
rmw_zenoh's protocol, as the robot, the camera and the motion capture.
"""

from __future__ import annotations

import math
import re
import threading
import time
import tomllib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from chaserdock_agents.gateway import devices
from chaserdock_agents.gateway.devices import DeviceError, DeviceHost, LatchReading
from chaserdock_agents.gateway.drivers import command_stream, ros2_camera, ros2_network, ros2_poses
from chaserdock_agents.gateway.images import BadImageMessage
from chaserdock_agents.ros2.types import TYPES, type_hash
from chaserdock_models.camera import Camera
from chaserdock_protocol.transport.zenoh_network import PlainSession
from device_cases import (
    Clock,
    command,
    complains,
    open_device,
    poll_until,
    use_entry_points,
    wait_for,
)
from general_position import matrix
from harness import ROOT, free_port
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

DOMAIN = 9
ODOMETRY, POSE, POSE_COV, PX4 = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "px4_msgs/msg/VehicleOdometry",
)
BOOL = "std_msgs/msg/Bool"
Q = np.array([0.5417, -0.3214, 0.6109, 0.4791]) / np.linalg.norm([0.5417, -0.3214, 0.6109, 0.4791])
POSITION, LINEAR, ANGULAR = (0.31, -1.7, 2.9), (0.11, -0.22, 0.37), (0.021, 0.043, -0.035)
STAMP_NS = 1_764_000_123_456_789_012


def ros_class(name: str) -> Any:
    """Return a message class of the peer's own store, or else of rosbags'."""
    return TYPES.types[name]


def vector(values: Any, name: str = "geometry_msgs/msg/Vector3") -> Any:
    return ros_class(name)(*map(float, values))


def header(stamp_ns: int = STAMP_NS, frame: str = "map") -> Any:
    stamp = ros_class("builtin_interfaces/msg/Time")(stamp_ns // 10**9, stamp_ns % 10**9)
    return ros_class("std_msgs/msg/Header")(stamp, frame)


def pose(q_wxyz: Any = Q, position: Any = POSITION) -> Any:
    w, x, y, z = map(float, q_wxyz)
    return ros_class("geometry_msgs/msg/Pose")(
        vector(position, "geometry_msgs/msg/Point"),
        ros_class("geometry_msgs/msg/Quaternion")(x, y, z, w),
    )


def covariance() -> np.ndarray[Any, Any]:
    a = np.random.default_rng(3).normal(size=(6, 6))
    return a @ a.T * 1e-4


def odometry(cov: Any = None, linear: Any = LINEAR, stamp_ns: int = STAMP_NS) -> dict[str, Any]:
    cov = covariance() if cov is None else cov
    twist = ros_class("geometry_msgs/msg/Twist")(vector(linear), vector(ANGULAR))
    return {
        "header": header(stamp_ns),
        "child_frame_id": "atmos",
        "pose": ros_class("geometry_msgs/msg/PoseWithCovariance")(pose(), np.ravel(cov)),
        "twist": ros_class("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36)),
    }


def vehicle_odometry(**changes: Any) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "timestamp": 20_000_900,
        "timestamp_sample": 20_000_123,
        "pose_frame": 1,
        "position": np.array(POSITION, np.float32),
        "q": Q.astype(np.float32),
        "velocity_frame": 3,
        "velocity": np.array(LINEAR, np.float32),
        "angular_velocity": np.array(ANGULAR, np.float32),
        "position_variance": np.array([1e-4, 2e-4, 3e-4], np.float32),
        "orientation_variance": np.array([4e-5, 5e-5, 6e-5], np.float32),
        "velocity_variance": np.full(3, np.nan, np.float32),
        "reset_counter": 0,
        "quality": 0,
    }
    return {**fields, **changes}


def message_of(type_name: str, fields: dict[str, Any]) -> Any:
    return ros_class(type_name)(**fields)


# -- conversion of messages ------------------------------------------------------------------------


def test_odometry_is_passed_on_in_its_axes_with_the_velocity_in_the_world() -> None:
    sample: Any = ros2_poses.of_odometry(message_of(ODOMETRY, odometry()), 7)
    assert (sample.body, sample.stamp_ns, sample.arrived_ns) == ("atmos", STAMP_NS, 7)
    np.testing.assert_array_equal(sample.position_m, POSITION)
    np.testing.assert_array_equal(sample.q_wxyz, Q)
    np.testing.assert_allclose(sample.velocity_m_s, matrix(Q) @ LINEAR, atol=1e-15)
    np.testing.assert_array_equal(sample.omega_rad_s, ANGULAR)


def test_covariance_of_ros_has_its_rotation_turned_into_the_body() -> None:
    """A rotation by theta about world axes is one by R^T theta about the body's."""
    cov = covariance()
    sample: Any = ros2_poses.of_odometry(message_of(ODOMETRY, odometry(cov)), 0)
    assert sample.covariance is not None
    rng = np.random.default_rng(8)
    for _ in range(5):
        weights = rng.normal(size=6)  # of any position and body rotation
        turned = np.concatenate([weights[:3], matrix(Q) @ weights[3:]])
        assert weights @ sample.covariance @ weights == pytest.approx(turned @ cov @ turned)


@pytest.mark.parametrize("twist", ["world", "none"])
def test_twist_of_other_axes_is_declared(twist: Any) -> None:
    sample: Any = ros2_poses.of_odometry(message_of(ODOMETRY, odometry()), 0, twist)
    if twist == "none":
        assert sample.velocity_m_s is None
        assert sample.omega_rad_s is None
        return
    assert sample.omega_rad_s is not None
    np.testing.assert_array_equal(sample.velocity_m_s, LINEAR)
    np.testing.assert_allclose(matrix(Q) @ sample.omega_rad_s, ANGULAR, atol=1e-15)


def test_what_is_not_stated_is_none() -> None:
    unknown = odometry(np.zeros((6, 6)), (0.1, math.nan, 0.2), stamp_ns=0)
    sample: Any = ros2_poses.of_odometry(message_of(ODOMETRY, unknown), 0)
    assert (sample.stamp_ns, sample.velocity_m_s, sample.covariance) == (None, None, None)
    minus_one = covariance()
    minus_one[0, 0] = -1.0
    assert ros2_poses.of_odometry(message_of(ODOMETRY, odometry(minus_one)), 0).covariance is None
    plain: Any = ros2_poses.of_pose(message_of(POSE, {"header": header(), "pose": pose()}), 0)
    assert (plain.body, plain.velocity_m_s, plain.omega_rad_s, plain.covariance) == (
        "",
        None,
        None,
        None,
    )


def test_vehicle_odometry_keeps_ned_and_frd_and_the_time_of_the_sample() -> None:
    sample: Any = ros2_poses.of_vehicle_odometry(message_of(PX4, vehicle_odometry()), 3)
    assert sample.stamp_ns == 20_000_123_000
    np.testing.assert_allclose(sample.position_m, POSITION, rtol=1e-7)
    np.testing.assert_allclose(sample.velocity_m_s, matrix(Q) @ LINEAR, atol=1e-7)
    np.testing.assert_allclose(sample.omega_rad_s, ANGULAR, rtol=1e-7)
    assert sample.covariance is not None
    expected = [1e-4, 2e-4, 3e-4, 4e-5, 5e-5, 6e-5]
    np.testing.assert_allclose(sample.covariance, np.diag(expected), rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "velocity"),
    [
        ({"velocity_frame": 1}, LINEAR),
        ({"velocity_frame": 2, "pose_frame": 2}, LINEAR),
        ({"velocity_frame": 1, "pose_frame": 2}, None),  # its heading is unknown
        ({"velocity_frame": 0, "pose_frame": 0}, None),
        ({"velocity": np.array([0.1, np.nan, 0.1], np.float32)}, None),
    ],
)
def test_velocity_of_px4_is_in_the_frame_that_it_states(changes: Any, velocity: Any) -> None:
    sample: Any = ros2_poses.of_vehicle_odometry(message_of(PX4, vehicle_odometry(**changes)), 0)
    if velocity is None:
        assert sample.velocity_m_s is None
    else:
        np.testing.assert_allclose(sample.velocity_m_s, velocity, rtol=1e-7)


@pytest.mark.parametrize(
    ("name", "digits"),
    [
        # By zenoh-ros2-sdk from the files of PX4/px4_msgs, tag v1.17.0.
        ("VehicleOdometry", "4295b96ad312084aa35c84bdcec65ba2f57eb4f6a293d57d52d95acbe99ff817"),
        ("OffboardControlMode", "e87463f252f320d2f197d1feadd643b8645e5ef53a2b158dccfdf11372e00f9f"),
        (
            "VehicleThrustSetpoint",
            "5b8b4a61e95ed82423c5fc0f84ecf29f9826a133865b9ffffa1be73977bff738",
        ),
        (
            "VehicleTorqueSetpoint",
            "d7b656099f58e33581992e4935818baf4ae9d7b0b2d28e03e9a67a21c8e1cb0e",
        ),
        ("ActuatorMotors", "78573ab1d26b08f3f494a16476cc896af5f8dceb64f6f723b4a2533ff2fbd321"),
        ("VehicleCommand", "1f0ab537807e2e20e04826633ea2c52e5431bea8eb0187152ff23bd07f1dd30b"),
        ("VehicleCommandAck", "36038d69f9db90980fb8fe154f27f22dffed0c35e530b32413cf0456aa8a29e2"),
    ],
)
def test_types_of_px4_have_the_hashes_of_1_17(name: str, digits: str) -> None:
    assert type_hash(f"px4_msgs/msg/{name}") == f"RIHS01_{digits}"


# -- images ----------------------------------------------------------------------------------------

GREY = np.random.default_rng(5).integers(0, 256, (12, 20), np.uint8)


def image(encoding: str, rows: np.ndarray[Any, Any], width: int = 20, **changes: Any) -> Any:
    rows = np.ascontiguousarray(rows).reshape(12, -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, 5)))  # rows may be longer than their pixels
    fields = {
        "header": header(),
        "height": 12,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": padded.shape[1],
        "data": padded.ravel(),
    }
    return message_of("sensor_msgs/msg/Image", {**fields, **changes})


def test_every_encoding_becomes_the_same_grey_levels() -> None:
    colour = np.repeat(GREY[..., None], 3, axis=2)
    opaque = np.concatenate([colour, np.full((12, 20, 1), 255, np.uint8)], axis=2)
    wide = (GREY.astype("<u2") << 8) + 77
    for encoding, rows, changes in [
        ("mono8", GREY, {}),
        ("rgb8", colour, {}),
        ("bgr8", colour, {}),
        ("rgba8", opaque, {}),
        ("bgra8", opaque, {}),
        ("mono16", wide, {}),
        ("mono16", wide.astype(">u2"), {"is_bigendian": 1}),
        ("16UC1", wide, {}),
        ("yuyv", np.stack([GREY, np.full_like(GREY, 128)], axis=2), {}),
        ("uyvy", np.stack([np.full_like(GREY, 128), GREY], axis=2), {}),
    ]:
        grey = ros2_camera.grey_of_image(image(encoding, rows, **changes))
        np.testing.assert_array_equal(grey, GREY, err_msg=encoding)


@pytest.mark.parametrize(
    ("pattern", "red", "blue"),
    [("rggb", (0, 0), (1, 1)), ("bggr", (1, 1), (0, 0)), ("grbg", (0, 1), (1, 0)),
     ("gbrg", (1, 0), (0, 1))],
)  # fmt: skip
def test_pattern_of_a_sensor_has_its_red_and_blue_where_ros_has_them(
    pattern: str, red: Any, blue: Any
) -> None:
    mosaic = np.zeros((12, 20), np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2] = 200
    reddish = ros2_camera.grey_of_image(image(f"bayer_{pattern}8", mosaic))[4:8, 4:8].mean()
    mosaic[:] = 0
    mosaic[blue[0] :: 2, blue[1] :: 2] = 200
    bluish = ros2_camera.grey_of_image(image(f"bayer_{pattern}8", mosaic))[4:8, 4:8].mean()
    assert reddish == pytest.approx(0.299 * 200, abs=2.0)
    assert bluish == pytest.approx(0.114 * 200, abs=2.0)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"encoding": "32FC1"}, "encoding '32FC1' is unknown; known: mono8"),
        ({"height": 13}, "300 bytes, 25 a row; 20 x 13 pixels of mono8 have 20 a row"),
        ({"width": 26}, "25 a row; 26 x 12 pixels of mono8 have 26 a row"),
    ],
)
def test_image_that_its_header_does_not_fit_is_refused(changes: Any, said: str) -> None:
    message = image("mono8", GREY)
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(BadImageMessage, match=said):
        ros2_camera.grey_of_image(message)


LENS = (-0.21, 0.08, 0.001, -0.002, 0.01)
CAMERA = Camera(20, 12, 31.0, 32.0, 9.7, 5.6, LENS)


def camera_info(**changes: Any) -> Any:
    k = CAMERA.matrix()
    fields = {
        "header": header(),
        "height": 12,
        "width": 20,
        "distortion_model": "plumb_bob",
        "d": np.array(LENS),
        "k": k.ravel(),
        "r": np.eye(3).ravel(),
        "p": np.column_stack([k, np.zeros(3)]).ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": ros_class("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False),
    }
    return message_of("sensor_msgs/msg/CameraInfo", {**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        ({"distortion_model": "rational_polynomial", "d": np.pad(LENS, (0, 3))}, None),
        ({"k": np.zeros(9), "d": np.zeros(0)}, None),  # not calibrated
        ({"width": 40, "height": 24}, "40 x 24 px, the scenario's calibration is of 20 x 12 px"),
        ({"k": np.array([31.0, 0, 9.7, 0, 33.0, 5.6, 0, 0, 1])}, "fx, fy, cx, cy"),
        ({"d": np.array([*LENS[:4], 0.02])}, "plumb_bob"),
        ({"distortion_model": "equidistant", "d": np.array(LENS[:4])}, "equidistant"),
        ({"k": np.full(9, math.nan)}, "fx, fy, cx, cy"),
    ],
)
def test_calibration_on_the_network_must_be_the_scenarios(changes: Any, said: str | None) -> None:
    difference = ros2_camera.difference_of_calibration(camera_info(**changes), CAMERA)
    assert difference is None if said is None else said in (difference or "")


# -- on the network --------------------------------------------------------------------------------


class Peer:
    """zenoh-ros2-sdk beside a router of its own."""

    def __init__(self) -> None:
        self.port = free_port()
        self._router = PlainSession((), (f"tcp/127.0.0.1:{self.port}",), "router")
        self._session = ZenohSession.get_instance("127.0.0.1", self.port)
        self._made: list[Any] = []
        self._number = 0

    @property
    def options(self) -> dict[str, Any]:
        return {"connect": [f"tcp/127.0.0.1:{self.port}"], "domain": DOMAIN}

    def topic(self) -> str:
        """Return a topic that no test has used."""
        self._number += 1
        return f"/robot{self._number}/topic"

    def publisher(self, topic: str, kind: str, digest: str | None = None) -> ROS2Publisher:
        made = ROS2Publisher(topic, kind, **self._arguments(kind, digest))
        self._made.append(made)
        return made

    def subscribe(self, topic: str, kind: str) -> list[Any]:
        read: list[Any] = []
        self._made.append(ROS2Subscriber(topic, kind, read.append, **self._arguments(kind, None)))
        return read

    def _arguments(self, kind: str, digest: str | None) -> dict[str, Any]:
        text, _ = TYPES.generate_msgdef(kind, ros_version=2)
        return {
            "msg_definition": text,
            "domain_id": DOMAIN,
            "router_port": self.port,
            "type_hash": digest or type_hash(kind),
        }

    def end_test(self) -> None:
        while self._made:
            self._made.pop().close()

    def close(self) -> None:
        self._session.close()
        self._router.close()


@pytest.fixture(scope="module")
def network() -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.close()


@pytest.fixture
def peer(network: Peer, monkeypatch: pytest.MonkeyPatch) -> Iterator[Peer]:
    use_entry_points(monkeypatch)
    yield network
    network.end_test()
    left = list(ros2_network._NETWORKS._users.values())
    ros2_network._NETWORKS._users.clear()
    for shared, _ in left:
        shared.close()  # an open session would keep the process
    assert left == []  # every test closes its devices


@pytest.mark.parametrize(
    ("kind", "fields", "axes"),
    [
        (ODOMETRY, odometry(), ("enu", "flu")),
        (POSE, {"header": header(), "pose": pose()}, ("enu", "flu")),
        (
            POSE_COV,
            {
                "header": header(),
                "pose": ros_class("geometry_msgs/msg/PoseWithCovariance")(
                    pose(), covariance().ravel()
                ),
            },
            ("enu", "flu"),
        ),
        (PX4, vehicle_odometry(), ("ned", "frd")),
    ],
    ids=["Odometry", "PoseStamped", "PoseWithCovarianceStamped", "VehicleOdometry"],
)
def test_poses_of_a_peer_arrive_as_the_conversion_states(
    peer: Peer, kind: str, fields: dict[str, Any], axes: tuple[str, str]
) -> None:
    topic, clock = peer.topic(), Clock()
    publisher = peer.publisher(topic, kind)
    source = open_device("pose", f"ros2:{topic}", {"type": kind, **peer.options}, clock)
    assert (source.world_axes, source.body_axes) == axes
    clock.time_ns += 17
    sample = poll_until(source, 1, lambda: publisher.publish(**fields))[0]
    expected = ros2_poses.READERS[kind](message_of(kind, fields), clock.time_ns, "child")
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(sample, name), value, err_msg=name)
    source.close()


def test_message_without_a_pose_is_passed_on_with_nan() -> None:
    nothing = vehicle_odometry(q=np.full(4, np.nan, np.float32), velocity_frame=3)
    sample: Any = ros2_poses.of_vehicle_odometry(message_of(PX4, nothing), 0)
    assert np.isnan(sample.q_wxyz).all()
    assert sample.velocity_m_s is None
    zero = odometry()
    zero["pose"].pose.orientation.__init__(0.0, 0.0, 0.0, 0.0)
    sample = ros2_poses.of_odometry(message_of(ODOMETRY, zero), 0)
    assert (sample.velocity_m_s, sample.covariance) == (None, None)
    np.testing.assert_array_equal(sample.q_wxyz, np.zeros(4))


def test_another_hash_or_type_is_named_before_and_after_opening(peer: Peer) -> None:
    topic, other = peer.topic(), "RIHS01_" + "ab" * 32
    options = {"type": POSE, **peer.options}
    source = open_device("pose", f"ros2:{topic}", options)  # nobody publishes: mute
    assert source.poll() == []
    wrong = peer.publisher(topic, POSE, other)

    complains(source, f"of hash {other}")
    complains(source, type_hash(POSE))
    said: list[str] = []

    def is_refused() -> bool:
        try:
            open_device("pose", f"ros2:{topic}", options).close()
        except DeviceError as error:
            said.append(str(error))
        return bool(said)

    wait_for(is_refused)  # the answer to the question who publishes may come late
    assert re.search(f"of hash {other}, but .* here has {type_hash(POSE)}", said[0])
    wrong.close()
    peer.publisher(topic, ODOMETRY)
    complains(source, f"with type {ODOMETRY}, but option type is {POSE}")
    source.close()


def test_publisher_that_ends_is_gone_and_may_return(peer: Peer) -> None:
    topic = peer.topic()
    publisher = peer.publisher(topic, ODOMETRY)
    source = open_device("pose", f"ros2:{topic}", peer.options)
    poll_until(source, 1, lambda: publisher.publish(**odometry()))
    publisher.close()

    complains(source, f"nobody publishes {topic} any more")
    again = peer.publisher(topic, ODOMETRY)
    wait_for(lambda: source._endpoints.has_peer)
    poll_until(source, 1, lambda: again.publish(**odometry()))
    source.close()


def test_devices_share_a_session_and_the_last_closes_it(peer: Peer) -> None:
    first, second = (open_device("pose", f"ros2:{peer.topic()}", peer.options) for _ in range(2))
    ((network, users),) = ros2_network._NETWORKS._users.values()
    assert users == 2
    first.close()
    declared = len(network._session._declared)
    second.close()
    assert declared == 4  # node; of the other: watch, subscription and its token
    assert ros2_network._NETWORKS._users == {}
    assert not [t for t in threading.enumerate() if t.name.startswith("service")]


def test_polls_while_messages_arrive_lose_and_double_none(peer: Peer) -> None:
    topic = peer.topic()
    publisher = peer.publisher(topic, POSE)
    source = open_device("pose", f"ros2:{topic}", {"type": POSE, **peer.options})
    poll_until(source, 1, lambda: publisher.publish(header=header(), pose=pose()))
    time.sleep(0.1)
    source.poll()
    numbers = range(1, 301)
    sender = threading.Thread(
        target=lambda: [publisher.publish(header=header(n), pose=pose()) for n in numbers]
    )
    sender.start()
    stamps = [sample.stamp_ns for sample in poll_until(source, len(numbers))]
    sender.join()
    assert stamps == list(numbers)
    source.close()


def test_camera_passes_images_on_and_refuses_another_calibration(peer: Peer) -> None:
    base = peer.topic()
    images = peer.publisher(f"{base}/image", "sensor_msgs/msg/Image")
    infos = peer.publisher(f"{base}/camera_info", "sensor_msgs/msg/CameraInfo")
    host = DeviceHost(time.monotonic_ns, CAMERA)
    camera = devices.open_device("camera", f"ros2:{base}/image", peer.options, host)
    (frame, *_) = poll_until(camera, 1, lambda: images.publish(**vars(image("mono8", GREY))))
    assert frame.stamp_ns == STAMP_NS
    np.testing.assert_array_equal(frame.image, GREY)
    narrow = vars(image("mono8", GREY[:, :10], 10))
    complains(
        camera,
        "images of 10 x 12; the calibration is for 20 x 12",
        lambda: images.publish(**narrow),
    )
    wide = vars(camera_info(width=41))
    complains(camera, "CameraInfo states 41 x 12 px", lambda: infos.publish(**wide))
    camera.close()


def test_compressed_images_are_decoded(peer: Peer) -> None:
    topic, kind = peer.topic(), "sensor_msgs/msg/CompressedImage"
    png = cv2.imencode(".png", np.repeat(GREY[..., None], 3, axis=2))[1].ravel()
    publisher = peer.publisher(topic, kind)
    camera = open_device("camera", f"ros2:{topic}", {"type": kind, **peer.options})

    def publish(data: Any) -> None:
        publisher.publish(header=header(), format="bgr8; png compressed bgr8", data=data)

    np.testing.assert_array_equal(poll_until(camera, 1, lambda: publish(png))[0].image, GREY)
    complains(
        camera,
        "10 images in a row: 3 bytes are not a JPEG or PNG, or damaged",
        lambda: publish(png[:3]),
    )
    camera.close()


def test_single_damaged_images_are_skipped(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_camera, "KEPT", 100)
    camera = open_device("camera", f"ros2:{peer.topic()}", peer.options)
    damaged, right = image("8UC7", GREY), image("mono8", GREY)
    for _ in range(ros2_camera.UNREADABLE):
        camera._arrived.extend([(damaged, 0)] * (ros2_camera.UNREADABLE - 1) + [(right, 5)])
    assert len(camera.poll()) == ros2_camera.UNREADABLE
    camera._arrived.extend([(damaged, 0)] * ros2_camera.UNREADABLE)
    with pytest.raises(DeviceError, match="10 images in a row: encoding '8UC7'"):
        camera.poll()
    camera.close()


# -- robots ----------------------------------------------------------------------------------------


def components(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def test_wrench_arrives_after_arming_only_and_ceases_with_the_commands(
    peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_stream, "PERIOD_S", 0.02)
    monkeypatch.setattr(command_stream, "HOLD_S", 0.06)
    topic = peer.topic()
    read = peer.subscribe(topic, "geometry_msgs/msg/WrenchStamped")
    robot = open_device("robot", f"ros2:{topic}", {"frame": "base", **peer.options})
    sent = command()

    def forces() -> list[Any]:
        return [components(message.wrench.force) for message in read]

    wait_for(lambda: robot._endpoints.has_peer)
    robot.send(sent)
    robot.stop()
    time.sleep(0.1)
    assert read == []
    robot.arm()
    wait_for(lambda: len(read) >= 5)  # zeros go on without commands
    assert set(forces()) == {(0.0, 0.0, 0.0)}

    def send_until_obeyed() -> None:
        number = len(read)

        def obeys() -> bool:
            robot.send(sent)
            return any(any(force) for force in forces()[number:])

        wait_for(obeys)

    before_ns = time.time_ns()
    send_until_obeyed()
    newest = next(message for message in read if message.wrench.force.x != 0.0)
    assert components(newest.wrench.force) == tuple(sent.force_N)
    assert components(newest.wrench.torque) == tuple(sent.torque_N_m)
    assert newest.header.frame_id == "base"
    stamp_ns = newest.header.stamp.sec * 10**9 + newest.header.stamp.nanosec
    assert abs(stamp_ns - before_ns) < 5_000_000_000  # wall clock
    wait_for(lambda: not any(forces()[-1]))  # by itself
    send_until_obeyed()
    robot.stop()
    wait_for(lambda: not any(forces()[-1]))
    robot.send(sent)
    robot.close()
    number = len(read)
    assert not any(forces()[-1])
    time.sleep(0.1)
    assert len(read) <= number + 1
    with pytest.raises(DeviceError, match="closed"):
        robot.send(sent)


def test_wrench_that_is_not_finite_is_refused(peer: Peer) -> None:
    topic = peer.topic()
    read = peer.subscribe(topic, "geometry_msgs/msg/WrenchStamped")
    robot = open_device("robot", f"ros2:{topic}", peer.options)
    wait_for(lambda: robot._endpoints.has_peer)
    robot.arm()
    with pytest.raises(DeviceError, match="cannot send: force or torque is not finite"):
        robot.send(command(torque=(0.1, np.inf, 0.1)))
    wait_for(lambda: len(read) >= 3)
    assert {components(m.wrench.torque) for m in read} == {(0.0, 0.0, 0.0)}
    robot.close()


def test_robot_without_a_subscription_does_not_arm(peer: Peer) -> None:
    topic = peer.topic()
    robot = open_device("robot", f"ros2:{topic}", peer.options)
    with pytest.raises(DeviceError, match=f"nobody subscribes to {topic}"):
        robot.arm()
    robot.close()


def test_nothing_but_zero_follows_a_stop_whoever_commands() -> None:
    published: list[bool] = []
    stream = command_stream.CommandStream(lambda c: published.append(c is not None), lambda: 0)
    stream.start()
    stream.arm()
    over = threading.Event()

    def send() -> None:
        while not over.is_set():
            stream.put(command())

    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    wait_for(lambda: len(published) > 100)
    stream.disarm()
    number = len(published)
    wait_for(lambda: len(published) > number + 100)
    over.set()
    for thread in threads:
        thread.join()
    stream.close()
    assert any(published[:number])
    assert not any(published[number:])


class EmulatedPx4:
    """Records what arrives, and answers commands."""

    def __init__(self, peer: Peer, namespace: str) -> None:
        where = f"{namespace}/fmu"
        self.read = {
            kind: peer.subscribe(f"{where}/in/{topic}", f"px4_msgs/msg/{kind}")
            for kind, topic in {
                "OffboardControlMode": "offboard_control_mode",
                "VehicleThrustSetpoint": "vehicle_thrust_setpoint",
                "VehicleTorqueSetpoint": "vehicle_torque_setpoint",
                "ActuatorMotors": "actuator_motors",
                "VehicleCommand": "vehicle_command",
            }.items()
        }
        self.results = {176: 0, 400: 0}
        self._ack = peer.publisher(
            f"{where}/out/vehicle_command_ack", "px4_msgs/msg/VehicleCommandAck"
        )
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def commands(self) -> list[tuple[int, float, float]]:
        return [(c.command, c.param1, c.param2) for c in self.read["VehicleCommand"]]

    def _answer(self) -> None:
        answered = 0
        while not self._over.wait(0.005):
            for asked in self.read["VehicleCommand"][answered:]:
                answered += 1
                if asked.command in self.results:
                    self.acknowledge(asked, self.results[asked.command])

    def acknowledge(self, asked: Any, result: int) -> None:
        self._ack.publish(
            timestamp=1,
            command=asked.command,
            result=result,
            result_param1=0,
            result_param2=0,
            target_system=asked.source_system,
            target_component=asked.source_component,
            from_external=False,
        )

    def close(self) -> None:
        self._over.set()
        self._thread.join()


@pytest.fixture
def px4(peer: Peer) -> Iterator[EmulatedPx4]:
    emulated = EmulatedPx4(peer, peer.topic())
    yield emulated
    emulated.close()


WRENCH = {"force_max_N": [3.0, 1.5, 0.0], "torque_max_N_m": [0.0, 0.1, 0.29]}


def open_px4(peer: Peer, **options: Any) -> Any:
    return open_device("robot", f"px4:/robot{peer._number}/topic", {**peer.options, **options})


def test_px4_gets_the_wrench_as_shares_of_the_maxima(peer: Peer, px4: EmulatedPx4) -> None:
    robot = open_px4(peer, **WRENCH, system=3)
    assert (robot.body_axes, robot.thrusters) == ("frd", 0)
    robot.send(command())
    robot.stop()
    time.sleep(0.2)
    assert all(messages == [] for messages in px4.read.values())
    robot.arm()
    assert px4.commands() == [(176, 1.0, 6.0), (400, 1.0, 0.0)]
    asked = px4.read["VehicleCommand"][0]
    assert (asked.target_system, asked.target_component, asked.from_external) == (3, 1, True)
    thrusts = [m.xyz.tolist() for m in px4.read["VehicleThrustSetpoint"]]
    assert len(thrusts) >= 3  # the stream ran for a second before
    assert all(not any(t) for t in thrusts)

    def arrived() -> bool:
        robot.send(command((0.9, -4.0, 0.5), (0.2, 0.05, 0.058)))
        return bool(moving("VehicleTorqueSetpoint") and moving("VehicleThrustSetpoint"))

    def moving(kind: str) -> list[Any]:
        return [message.xyz for message in px4.read[kind] if np.any(message.xyz)]

    wait_for(arrived)
    np.testing.assert_allclose(moving("VehicleThrustSetpoint")[0], [0.3, -1.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(moving("VehicleTorqueSetpoint")[0], [0.0, 0.5, 0.2], rtol=1e-6)
    mode = px4.read["OffboardControlMode"][-1]
    assert (mode.thrust_and_torque, mode.direct_actuator, mode.timestamp) == (True, False, 0)
    robot.stop()
    wait_for(lambda: px4.commands()[-1] == (400, 0.0, 21196.0))
    wait_for(lambda: not np.any(px4.read["VehicleThrustSetpoint"][-1].xyz))
    assert px4.read["ActuatorMotors"] == []
    robot.close()


def test_px4_gets_the_duty_of_each_thruster_at_its_motor(peer: Peer, px4: EmulatedPx4) -> None:
    robot = open_px4(peer, thrusters=[5, 2, 12])
    robot.arm()

    def arrived() -> bool:
        robot.send(command(duty=(0.25, 1.0, 0.625)))
        return bool(moving())

    def moving() -> list[Any]:
        return [m.control for m in px4.read["ActuatorMotors"] if m.control[1] > 0.0]

    wait_for(arrived)
    expected = np.full(12, np.nan)
    expected[[4, 1, 11]] = 0.25, 1.0, 0.625
    np.testing.assert_array_equal(moving()[0], expected)
    mode = px4.read["OffboardControlMode"][-1]
    assert (mode.thrust_and_torque, mode.direct_actuator) == (False, True)
    with pytest.raises(DeviceError, match="2 duties for 3 thrusters"):
        robot.send(command(duty=(0.2, 0.1)))
    with pytest.raises(DeviceError, match="must be from 0 to 1"):
        robot.send(command(duty=(0.2, 0.1, 1.01)))
    robot.close()
    wait_for(lambda: px4.commands()[-1] == (400, 0.0, 21196.0))
    assert not np.any(px4.read["ActuatorMotors"][-1].control[[4, 1, 11]])


def test_px4_that_refuses_or_is_silent_is_named(
    peer: Peer, px4: EmulatedPx4, monkeypatch: pytest.MonkeyPatch
) -> None:
    from chaserdock_agents.gateway.drivers import acknowledgements, px4_robot

    monkeypatch.setattr(px4_robot, "_LEAD_S", 0.0)
    monkeypatch.setattr(acknowledgements, "REPLY_S", 0.2)
    robot = open_px4(peer, **WRENCH)
    px4.results[400] = 2
    with pytest.raises(DeviceError, match=r"^PX4, arming: denied$"):
        robot.arm()
    px4.results.clear()
    with pytest.raises(DeviceError, match=r"offboard mode: no acknowledgement within 0\.8 s"):
        robot.arm()
    asked = [c.confirmation for c in px4.read["VehicleCommand"]][-4:]
    assert asked == [0, 1, 2, 3]
    robot.send(command((3.0, 3.0, 3.0)))
    time.sleep(0.05)
    assert all(not np.any(m.xyz) for m in px4.read["VehicleThrustSetpoint"])
    robot.close()


@pytest.mark.parametrize("waits_for", ["the stream", "an acknowledgement"])
def test_px4_that_is_stopped_while_it_arms_is_not_armed(
    waits_for: str, peer: Peer, px4: EmulatedPx4, monkeypatch: pytest.MonkeyPatch
) -> None:
    from chaserdock_agents.gateway.drivers import acknowledgements, px4_robot

    acknowledged = waits_for == "an acknowledgement"
    monkeypatch.setattr(px4_robot, "_LEAD_S", 0.0 if acknowledged else 30.0)
    monkeypatch.setattr(acknowledgements, "REPLY_S", 0.1)
    px4.results.clear()
    robot = open_px4(peer, **WRENCH)
    errors: list[str] = []

    def arm() -> None:
        try:
            robot.arm()
        except DeviceError as error:
            errors.append(str(error))

    arming = threading.Thread(target=arm)
    arming.start()
    wait_for(lambda: px4.read["VehicleCommand" if acknowledged else "OffboardControlMode"])
    robot.stop()
    arming.join()
    assert errors == ["stopped while it was being armed"]
    wait_for(lambda: (400, 0.0, 21196.0) in px4.commands())
    assert px4.commands()[-1] == (400, 0.0, 21196.0)
    assert not [c for c in px4.commands() if c[:2] == (400, 1.0)]
    px4.results.update({176: 0, 400: 0})
    monkeypatch.setattr(px4_robot, "_LEAD_S", 0.0)
    robot.arm()
    robot.close()


# -- latch -----------------------------------------------------------------------------------------


def test_latch_states_what_its_topics_say_and_takes_commands(peer: Peer) -> None:
    """A touch between two polls is not lost; a command is repeated, as its message may be."""
    name = peer.topic()
    latch = open_device("latch", f"ros2:{name}", peer.options)
    latched, contact = (peer.publisher(f"{name}/{part}", BOOL) for part in ("latched", "contact"))
    assert latch.poll() is None
    wait_for(lambda: latched.publish(data=False) or latch.poll() is not None)
    assert latch.poll() == LatchReading(contact=False, armed=False, latched=False)

    def touched() -> bool:
        contact.publish(data=True)
        contact.publish(data=False)
        return latch.poll().contact

    wait_for(touched)
    wait_for(lambda: not latch.poll().contact)

    read = peer.subscribe(f"{name}/command", BOOL)
    latch.command("keep")
    for _ in range(3):
        latch.poll()
    time.sleep(0.05)
    assert read == []
    for wanted in ("arm", "release"):
        latch.command(wanted)
        wait_for(lambda wanted=wanted: latch.poll() and read and read[-1].data == (wanted == "arm"))
        begun = len(read)
        latch.command("keep")
        wait_for(lambda begun=begun: latch.poll() and len(read) > begun + 2)
        assert {m.data for m in read[begun:]} == {wanted == "arm"}
        assert latch.poll().armed is (wanted == "arm")
    wait_for(lambda: latched.publish(data=True) or latch.poll().latched)
    latched.close()
    complains(latch, f"nobody publishes {name}/latched any more")
    latch.close()
    with pytest.raises(DeviceError, match="cannot send"):
        latch.command("arm")


def test_latch_without_a_docking_sensor_touches_when_it_latches(peer: Peer) -> None:
    name = peer.topic()
    options = {**peer.options, "contact": "", "latched": "closed"}
    latch = open_device("latch", f"ros2:{name}", options)
    closed = peer.publisher(f"{name}/closed", BOOL)
    wait_for(lambda: closed.publish(data=True) or latch.poll() is not None)
    assert latch.poll() == LatchReading(contact=True, armed=False, latched=True)
    latch.close()


def test_latch_of_another_type_is_named(peer: Peer) -> None:
    name = peer.topic()
    peer.publisher(f"{name}/latched", POSE)

    def refused() -> bool:
        try:
            open_device("latch", f"ros2:{name}", peer.options).close()
        except DeviceError as error:
            return f"publishes {name}/latched with type {POSE}" in str(error)
        return False

    wait_for(refused)


def test_gripper_of_px4_grabs_at_the_touch_and_is_latched_when_that_is_acknowledged(
    peer: Peer, px4: EmulatedPx4
) -> None:
    name = f"/robot{peer._number}/topic"
    options = {**peer.options, "contact": "probe/contact", "gripper": 2, "system": 3}
    latch = open_device("latch", f"px4:{name}", options)
    probe = peer.publisher(f"{name}/probe/contact", BOOL)
    px4.results[211] = 5  # in progress
    latch.command("release")
    wait_for(px4.commands)
    assert latch.poll() is None
    asked = px4.read["VehicleCommand"][0]
    assert (asked.target_system, asked.target_component, asked.from_external) == (3, 1, True)
    px4.acknowledge(asked, 0)
    wait_for(lambda: latch.poll() == LatchReading(contact=False, armed=False, latched=False))
    latch.command("arm")

    def touches() -> bool:
        probe.publish(data=True)
        return latch.poll().contact

    wait_for(touches)
    assert px4.commands() == [(211, 2.0, 0.0)]
    latch.command("arm")
    wait_for(lambda: px4.commands()[1:] == [(211, 2.0, 1.0)])
    assert latch.poll() == LatchReading(contact=True, armed=True, latched=False)
    px4.acknowledge(asked, 0)
    wait_for(lambda: latch.poll().latched)
    px4.results[211] = 4
    latch.command("release")
    complains(latch, "PX4, gripper 2, release: failed")
    assert latch.poll().latched
    px4.results[211] = 0
    latch.command("release")
    wait_for(lambda: not latch.poll().latched)
    probe.close()
    complains(latch, f"nobody publishes {name}/probe/contact any more")
    latch.close()
    with pytest.raises(DeviceError, match="cannot send"):
        latch.command("arm")


def test_gripper_of_px4_is_latched_by_its_switch_if_it_has_one(
    peer: Peer, px4: EmulatedPx4
) -> None:
    name = f"/robot{peer._number}/topic"
    options = {**peer.options, "contact": "contact", "latched": "closed"}
    latch = open_device("latch", f"px4:{name}", options)
    contact, closed = (peer.publisher(f"{name}/{part}", BOOL) for part in ("contact", "closed"))
    px4.results[211] = 0
    wait_for(lambda: closed.publish(data=False) or latch.poll())
    wait_for(lambda: contact.publish(data=True) or latch.poll().contact)
    latch.command("arm")
    wait_for(lambda: px4.commands() == [(211, 1.0, 1.0)])
    time.sleep(0.1)
    assert latch.poll() == LatchReading(contact=True, armed=True, latched=False)
    wait_for(lambda: closed.publish(data=True) or latch.poll().latched)
    latch.close()


def test_devices_of_the_docs_are_valid(peer: Peer) -> None:
    page = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
    lab = tomllib.loads(page.split("```toml\n")[1].split("```")[0])["lab"]
    kinds: dict[str, devices.DeviceKind] = {"odometry": "pose", "robot": "robot"}
    for section, kind in kinds.items():
        for device in lab[section]:
            open_device(kind, device["address"], {**device["options"], **peer.options}).close()


# -- invalid input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "address", "options", "said"),
    [
        ("pose", "ros2:robot0/odom", {}, "must be an absolute name of ROS 2"),
        ("pose", "ros2:/robot 0/odom", {}, "must be an absolute name of ROS 2"),
        ("pose", "ros2:/odom", {"rate": 3}, "unknown option 'rate'; must be one of: connect"),
        ("pose", "ros2:/odom", {"domain": "7"}, "expected `int | null`, got `str` in option dom"),
        ("pose", "ros2:/odom", {"domain": 300}, "in option domain"),
        ("pose", "ros2:/odom", {"type": "tf2_msgs/msg/TFMessage"}, "is not one of: nav_msgs/msg/O"),
        ("pose", "ros2:/odom", {"twist": "map"}, "in option twist"),
        ("pose", "ros2:/odom", {"connect": ["tcp/127.0.0.1:1"]}, "no router at tcp/127.0.0.1:1"),
        ("camera", "ros2:/image", {"type": POSE}, "in option type"),
        ("latch", "ros2:latch", {}, "must be an absolute name of ROS 2"),
        ("latch", "ros2:/latch", {"latched": ""}, "latched and command must name a topic each"),
        ("latch", "px4:/robot0", {}, "missing required field `contact`"),
        ("latch", "px4:/robot0", {"contact": ""}, "option contact must name a topic"),
        ("latch", "ros2:/latch", {"state": "x"}, "unknown option 'state'; must be one of: connect"),
        ("robot", "px4:/", {}, "needs either option thrusters, or both"),
        ("robot", "px4:/", {"thrusters": [1], **WRENCH}, "needs either option thrusters, or both"),
        ("robot", "px4:/", {"thrusters": [1, 3, 1]}, "names a motor twice: [1, 3, 1]"),
        ("robot", "px4:/", {"thrusters": [13]}, "in option thrusters"),
        ("robot", "px4:/", {**WRENCH, "force_max_N": [1.0, 2.0]}, "in option force_max_N"),
        ("robot", "px4:/", {**WRENCH, "force_max_N": [1.0, -2.0, 0]}, "in option force_max_N"),
        ("robot", "dds:/odom", {}, "must be SCHEME:ADDRESS with one of the installed drivers"),
    ],
)
def test_invalid_input_gives_one_line(
    kind: Any, address: str, options: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_entry_points(monkeypatch)
    with pytest.raises(DeviceError) as raised:
        open_device(kind, address, options)
    text = str(raised.value)
    assert text.startswith(f"{kind} {address!r}: ")
    assert said in text
    assert "\n" not in text
    assert ros2_network._NETWORKS._users == {}
