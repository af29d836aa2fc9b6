# SPDX-License-Identifier: Apache-2.0
"""Sources of images: what they deliver, at which time, and what they say when they cannot."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import foxglove.messages as fox
import numpy as np
import pytest
from chaserdock_agents.gateway.cameras import (
    Captured,
    CapturedImage,
    ImageSourceError,
    UnreadableImage,
    capture,
    open_camera,
    open_driver,
)
from chaserdock_agents.gateway.cameras.files import time_of_name
from chaserdock_agents.gateway.cameras.polled import PolledCamera
from chaserdock_agents.gateway.devices import CameraFrame, DeviceError, DeviceHost
from chaserdock_agents.gateway.images import BadImageMessage, compressed_pixels, raw_pixels
from chaserdock_agents.ros2.types import TYPES
from chaserdock_protocol import codec
from chaserdock_protocol.messages import Image, encoding_of, schema_of
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

GREY = np.tile(np.arange(64, dtype=np.uint8), (48, 1))


def captured(source: Any) -> list[Captured]:
    try:
        return list(source.frames())
    finally:
        source.close()


def images(source: Any) -> list[CapturedImage]:
    found = captured(source)
    assert all(isinstance(c, CapturedImage) for c in found)
    return [c for c in found if isinstance(c, CapturedImage)]


# -- Folders and videos ----------------------------------------------------------------------------


def test_images_of_a_folder_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        cv2.imwrite(str(tmp_path / f"view_{number}.png"), np.full((48, 64), number, np.uint8))
    found = images(open_camera(str(tmp_path), {"fps": 4.0}))
    assert [int(c.pixels[0, 0, 0]) for c in found] == [1, 2, 10]
    assert [(c.time_ns, c.stamp) for c in found] == [
        (0, "position"), (250_000_000, "position"), (500_000_000, "position")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("stem", "time_ns"),
    [
        ("1732718400123456789", 1732718400123456789),
        ("1732718400123456", 1732718400123456000),
        ("1732718400123", 1732718400123000000),
        ("left-1732718400.25", 1732718400250000000),
        ("1732718400.123456", 1732718400123456000),
        ("frame_0042", None),
        ("20261127", None),
    ],
)
def test_times_in_names_are_read_by_their_digits(stem: str, time_ns: int | None) -> None:
    assert time_of_name(stem) == time_ns


def test_a_folder_without_times_needs_a_rate(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), GREY)
    with pytest.raises(ImageSourceError, match=r"a\.png state no times; give --fps"):
        open_camera(str(tmp_path))


def test_a_folder_with_times_has_them_as_exposure(tmp_path: Path) -> None:
    for time_ns in (1732718400033000000, 1732718400000000000):
        cv2.imwrite(str(tmp_path / f"{time_ns}.png"), GREY)
    found = images(open_camera(str(tmp_path)))
    assert [c.time_ns for c in found] == [1732718400000000000, 1732718400033000000]
    assert {(c.stamp, c.arrival_ns) for c in found} == {("exposure", None)}


def test_a_damaged_image_is_named_and_the_next_one_follows(tmp_path: Path) -> None:
    (tmp_path / "1.png").write_bytes(b"no image")
    cv2.imwrite(str(tmp_path / "2.png"), GREY)
    bad, good = captured(open_camera(str(tmp_path), {"fps": 10.0}))
    assert bad == UnreadableImage(0, "1.png: is not an image, or damaged")
    assert isinstance(good, CapturedImage)
    assert good.sequence == 1


def test_a_video_states_the_times_of_its_images(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(4):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(GREY, format="gray")))
        container.mux(stream.encode())
    found = images(open_camera(str(path)))
    assert [c.time_ns for c in found] == [0, 50_000_000, 100_000_000, 150_000_000]
    assert np.abs(found[0].pixels[..., 0].astype(int) - GREY).max() <= 24


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("/dev/video97", "/dev/video97: no such device"),
        ("97", "/dev/video97: no such device"),
        ("/dev/null", "/dev/null: is not a camera"),
        ("v4l2src ! appsink", "is built without GStreamer"),
        ("nothing.mp4", "no such file or folder; a source is"),
        ("nothing.mcap", "no such recording"),
    ],
)
def test_what_cannot_be_opened_is_said_in_one_line(address: str, text: str) -> None:
    with pytest.raises(ImageSourceError, match=text) as raised:
        open_camera(address)
    assert "\n" not in str(raised.value)


def test_files_that_hold_no_images_are_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(ImageSourceError, match="contains no images"):
        open_camera(str(tmp_path), {"fps": 1.0})
    with pytest.raises(ImageSourceError, match="is not a video"):
        open_camera(str(tmp_path / "notes.txt"))


def test_unknown_options_are_listed_with_the_known_ones() -> None:
    with pytest.raises(DeviceError, match="unknown option 'speed'; must be one of: width_px, hei"):
        open_camera("0", {"speed": 1})
    with pytest.raises(DeviceError, match=r"expected `float \| null`, got `str` in option fps"):
        open_camera("0", {"fps": "30"})


# -- Devices ---------------------------------------------------------------------------------------


class FakeCapture:
    """OpenCV's capture of a device that delivers ``count`` images, then ends or hangs."""

    def __init__(self, count: int, stamp_ms: float = 0.0, hangs: bool = False) -> None:
        self.count, self.stamp_ms, self.hangs = count, stamp_ms, hangs
        self.settings: dict[int, float] = {}

    def set(self, key: int, value: float) -> None:
        self.settings[key] = value

    def get(self, key: int) -> float:
        assert key == cv2.CAP_PROP_POS_MSEC
        return self.stamp_ms

    def read(self) -> tuple[bool, Any]:
        while self.count == 0 and self.hangs:
            time.sleep(0.01)
        self.count -= 1
        return self.count >= 0, GREY

    def release(self) -> None:
        self.hangs = False


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Callable[[FakeCapture | None], None]:
    """A function that puts a capture in the place of every device."""

    def put(fake: FakeCapture | None) -> None:
        monkeypatch.setattr(capture, "_check_device", lambda path: None)
        monkeypatch.setattr(capture, "_opened", lambda address, backend, limits=None: fake)

    return put


def first_of(source: Any) -> CapturedImage:
    frames: Iterator[Captured] = source.frames()
    found = next(frames)
    source.close()
    assert isinstance(found, CapturedImage)
    return found


def test_the_stamp_of_a_device_is_the_time_and_arrival_is_kept(
    device: Callable[[FakeCapture | None], None],
) -> None:
    fake = FakeCapture(1, stamp_ms=1234.567, hangs=True)
    device(fake)
    before_ns = time.time_ns()
    found = first_of(open_camera("0", {"width_px": 640, "height_px": 480, "fps": 30.0}))
    assert (found.time_ns, found.stamp) == (1_234_567_000, "exposure")
    assert found.arrival_ns is not None
    assert found.arrival_ns >= before_ns
    assert fake.settings[cv2.CAP_PROP_FRAME_WIDTH] == 640
    assert fake.settings[cv2.CAP_PROP_FPS] == 30.0


def test_without_a_stamp_the_time_is_that_of_arrival(
    device: Callable[[FakeCapture | None], None],
) -> None:
    device(FakeCapture(1, hangs=True))
    found = first_of(open_camera("/dev/video0"))
    assert found.stamp == "arrival"
    assert found.time_ns == found.arrival_ns


def test_busy_mute_and_unplugged_devices_are_told_apart(
    device: Callable[[FakeCapture | None], None],
) -> None:
    device(None)
    with pytest.raises(ImageSourceError, match="/dev/video0: is busy"):
        open_camera("0")
    device(FakeCapture(0, hangs=True))
    with pytest.raises(ImageSourceError, match=r"/dev/video0: is mute: no image for 0\.1 s"):
        captured(open_camera("0", {"silent_s": 0.1}))
    device(FakeCapture(0))
    with pytest.raises(ImageSourceError, match="/dev/video0: has ended"):
        captured(open_camera("0"))


def test_a_slow_reader_gets_the_newest_image(device: Callable[[FakeCapture | None], None]) -> None:
    device(FakeCapture(50, hangs=True))
    source = open_camera("0", {"silent_s": 0.2})
    frames, last, number = source.frames(), -1, 0
    while last < 49:
        time.sleep(0.01)
        found = next(frames)
        number += 1
        assert isinstance(found, CapturedImage)
        last = found.sequence
    source.close()
    assert number < 25


class OwnCamera:
    """A camera with a driver of the gateway: two images at once, then it is gone."""

    def __init__(self, stamp_ns: int | None) -> None:
        self.frames = [[], [CameraFrame(GREY, stamp_ns, 5), CameraFrame(GREY, stamp_ns, 9)]]
        self.closed = False

    def poll(self) -> list[CameraFrame]:
        if not self.frames:
            raise DeviceError("mine:1: is gone")
        return self.frames.pop(0)

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("stamp_ns", "expected"), [(7, (7, "exposure", 9, 1)), (None, (9, "arrival", 9, 1))]
)
def test_a_camera_of_the_gateway_is_a_source(
    stamp_ns: int | None, expected: tuple[object, ...]
) -> None:
    camera = OwnCamera(stamp_ns)
    source = PolledCamera(camera, "mine:1", 1.0)
    frames = source.frames()
    image = next(frames)
    assert isinstance(image, CapturedImage)
    assert (image.time_ns, image.stamp, image.arrival_ns, image.sequence) == expected
    with pytest.raises(DeviceError, match="is gone"):
        next(frames)
    source.close()
    assert camera.closed


def test_a_source_is_a_camera_of_the_gateway(
    device: Callable[[FakeCapture | None], None],
) -> None:
    device(FakeCapture(2, stamp_ms=1234.0))
    camera = open_driver("0", {"fps": 30.0}, DeviceHost(lambda: 42))
    seen: list[CameraFrame] = []
    fault = ""
    while not fault:
        try:
            seen += camera.poll()
        except DeviceError as error:
            fault = str(error)
        time.sleep(0.001)
    camera.close()
    assert fault.startswith("/dev/video0: has ended")
    assert {(f.stamp_ns, f.arrived_ns) for f in seen} <= {(1_234_000_000, 42)}
    with pytest.raises(DeviceError, match="unknown option 'speed'; must be one of: width"):
        open_driver("0", {"speed": 1}, DeviceHost(lambda: 42))


# -- Recordings ------------------------------------------------------------------------------------


def ros(type_name: str, time_ns: int, *rest: Any) -> bytes:
    types = TYPES.types
    stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp, "camera")
    return bytes(TYPES.serialize_cdr(types[type_name](header, *rest), type_name))


def ros_image(time_ns: int) -> bytes:
    """A grey image with two bytes of padding in each row."""
    padded = np.pad(GREY, ((0, 0), (0, 2)))
    return ros("sensor_msgs/msg/Image", time_ns, 48, 64, "mono8", 0, 66, padded.ravel())


def ros_jpeg(time_ns: int) -> bytes:
    data = np.asarray(cv2.imencode(".png", GREY)[1]).ravel()
    return ros("sensor_msgs/msg/CompressedImage", time_ns, "png", data)


def foxglove_png(time_ns: int) -> bytes:
    stamp = fox.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
    data = cv2.imencode(".png", GREY)[1].tobytes()
    return fox.CompressedImage(timestamp=stamp, frame_id="c", data=data, format="png").encode()


def foxglove_raw(time_ns: int) -> bytes:
    stamp = fox.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
    return fox.RawImage(
        timestamp=stamp, frame_id="c", width=64, height=48, encoding="mono8", step=64,
        data=GREY.tobytes(),
    ).encode()  # fmt: skip


def mission_image(time_ns: int) -> bytes:
    return codec.encode(
        Image(
            tick=0, sim_time_ns=time_ns, chaser=0, width_px=64, height_px=48, encoding="mono8",
            data=GREY.tobytes(),
        )
    )  # fmt: skip


KINDS: dict[str, tuple[str, str, Callable[[int], bytes]]] = {
    "/ros/raw": ("sensor_msgs/msg/Image", "cdr", ros_image),
    "/ros/compressed": ("sensor_msgs/msg/CompressedImage", "cdr", ros_jpeg),
    "/fox/compressed": ("foxglove.CompressedImage", "protobuf", foxglove_png),
    "/fox/raw": ("foxglove.RawImage", "protobuf", foxglove_raw),
    "world/chaser/0/image": ("Image", "msgpack", mission_image),
    "/numbers": ("std_msgs/msg/String", "cdr", lambda time_ns: b""),
}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "r.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, (schema, encoding, make) in KINDS.items():
            number = writer.register_schema(schema, "", b"")
            about = {"zenoh_encoding": encoding_of(Image)} if schema == "Image" else {}
            channel = writer.register_channel(topic, encoding, number, about)
            for k in range(2):
                writer.add_message(channel, k, make(5_000_000_000 + k), k, k)
        writer.finish()
    assert schema_of(Image)
    return path


@pytest.mark.parametrize("topic", [topic for topic in KINDS if topic != "/numbers"])
def test_image_topics_of_mcap_files_are_read_with_their_exposure(
    recording: Path, topic: str
) -> None:
    found = images(open_camera(str(recording), {"topic": topic}))
    assert [c.time_ns for c in found] == [5_000_000_000, 5_000_000_001]
    assert {c.stamp for c in found} == {"exposure"}
    for image in found:
        grey = image.pixels if image.pixels.ndim == 2 else image.pixels[..., 0]
        np.testing.assert_array_equal(grey, GREY)


@pytest.mark.parametrize("wanted", [None, "/nothing", "/numbers"])
def test_unknown_topics_are_answered_with_those_that_have_images(
    recording: Path, wanted: str | None
) -> None:
    with pytest.raises(
        ImageSourceError, match=r"chaser/0/image, /fox|/fox.*chaser/0/image"
    ) as said:
        open_camera(str(recording), {"topic": wanted})
    assert ("/numbers" in str(said.value)) == (wanted == "/numbers")


def test_a_damaged_message_is_named_and_the_next_one_follows(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/Image", "", b"")
        channel = writer.register_channel("/image", "cdr", schema)
        writer.add_message(channel, 0, ros_image(5)[:40], 0, 0)
        writer.add_message(channel, 1, ros_image(6), 1, 1)
        writer.finish()
    bad, good = captured(open_camera(str(path)))
    assert isinstance(bad, UnreadableImage)
    assert bad.reason.startswith("image 0 of /image: not a sensor_msgs/msg/Image")
    assert isinstance(good, CapturedImage)
    assert good.time_ns == 6


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bags_of_ros_2_are_read_with_either_storage(tmp_path: Path, storage: StoragePlugin) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag, version=9, storage_plugin=storage) as writer:
        kind = "sensor_msgs/msg/Image"
        connection = writer.add_connection("/camera/image_raw", kind, typestore=TYPES)
        writer.write(connection, 100, ros_image(77))
    (found,) = images(open_camera(str(bag)))
    assert found.time_ns == 77
    np.testing.assert_array_equal(found.pixels, GREY)
    (other,) = list(bag.glob("*.db3")) + list(bag.glob("*.mcap"))
    assert [c.time_ns for c in images(open_camera(str(other)))] == [77]
    with pytest.raises(ImageSourceError, match="has no topic /x; images: /camera/image_raw"):
        open_camera(str(bag), {"topic": "/x"})


# -- Pixels ----------------------------------------------------------------------------------------


def test_colours_become_blue_green_red() -> None:
    rgb = np.zeros((2, 2, 3), np.uint8)
    rgb[..., 0] = 200
    assert raw_pixels(rgb.tobytes(), 2, 2, "rgb8", 6)[0, 0].tolist() == [0, 0, 200]
    assert raw_pixels(rgb.tobytes(), 2, 2, "bgr8", 6)[0, 0].tolist() == [200, 0, 0]


def test_the_higher_byte_of_sixteen_bits_is_kept() -> None:
    wide = np.array([[0x1234, 0xABCD]], dtype="<u2")
    assert raw_pixels(wide.tobytes(), 2, 1, "mono16", 4).tolist() == [[0x12, 0xAB]]
    big = wide.astype(">u2")
    assert raw_pixels(big.tobytes(), 2, 1, "mono16", 4, True).tolist() == [[0x12, 0xAB]]


@pytest.mark.parametrize(
    ("pattern", "place"),
    [("rggb8", (0, 0)), ("bggr8", (1, 1)), ("gbrg8", (1, 0)), ("grbg8", (0, 1))],
)
def test_the_red_pixels_of_a_bayer_pattern_are_red(pattern: str, place: tuple[int, int]) -> None:
    mosaic = np.zeros((16, 16), np.uint8)
    mosaic[place[0] :: 2, place[1] :: 2] = 200
    blue, green, red = raw_pixels(mosaic.tobytes(), 16, 16, f"bayer_{pattern}", 16)[8, 8].tolist()
    assert (blue, red) == (0, 200)
    assert green < 200


def test_bad_pixels_are_refused() -> None:
    with pytest.raises(BadImageMessage, match="encoding 'depth' is unknown; known: mono8"):
        raw_pixels(b"", 2, 2, "depth", 2)
    with pytest.raises(BadImageMessage, match="3 bytes, 2 a row"):
        raw_pixels(b"abc", 2, 2, "mono8", 2)
    with pytest.raises(BadImageMessage, match="0 bytes are not"):
        compressed_pixels(b"")
