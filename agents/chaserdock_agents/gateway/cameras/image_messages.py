# SPDX-License-Identifier: Apache-2.0
"""Image messages of recordings and topics: ROS 2, Foxglove, and those of a mission."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import cv2
from chaserdock_protocol.failure_watch import text_of

from ..devices import ImageArray
from ..images import BadImageMessage, compressed_pixels, raw_pixels


class TimedPixels(NamedTuple):
    """An image, grey (h, w) or BGR (h, w, 3), and its stamp: the time of its exposure, ns."""

    pixels: ImageArray
    time_ns: int


# -- ROS 2 -----------------------------------------------------------------------------------------


def ros_image(message: Any) -> TimedPixels:
    """Return the image of a ``sensor_msgs/msg/Image``, as rosbags has it."""
    m = message
    pixels = raw_pixels(m.data, m.width, m.height, m.encoding, m.step, bool(m.is_bigendian))
    return TimedPixels(pixels, _ros_time(m))


def ros_compressed_image(message: Any) -> TimedPixels:
    """Return the image of a ``sensor_msgs/msg/CompressedImage``, as rosbags has it."""
    return TimedPixels(compressed_pixels(message.data), _ros_time(message))


def _ros_time(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def _of_ros(type_name: str, convert: Callable[[Any], TimedPixels]) -> Decoder:
    def decode(data: bytes, message_encoding: str, about: dict[str, str]) -> TimedPixels:
        from chaserdock_agents.ros2.types import TYPES

        try:
            return convert(TYPES.deserialize_cdr(data, type_name))
        except BadImageMessage:
            raise
        except Exception as error:  # rosbags raises many kinds on damaged bytes
            raise BadImageMessage(f"not a {type_name}: {error}") from None

    return decode


# -- Foxglove --------------------------------------------------------------------------------------


def _foxglove_compressed(data: bytes, encoding: str, about: dict[str, str]) -> TimedPixels:
    if encoding == "json":
        value = json.loads(data)
        content = base64.b64decode(value["data"])
        return TimedPixels(compressed_pixels(content), _json_time(value))
    fields = dict(protobuf_fields(data))
    return TimedPixels(compressed_pixels(fields.get(2, b"")), _protobuf_time(fields))


def _foxglove_raw(data: bytes, encoding: str, about: dict[str, str]) -> TimedPixels:
    if encoding == "json":
        v = json.loads(data)
        content = base64.b64decode(v["data"])
        size = int(v["width"]), int(v["height"])
        return TimedPixels(raw_pixels(content, *size, v["encoding"], int(v["step"])), _json_time(v))
    f = dict(protobuf_fields(data))
    name = f.get(4, b"").decode(errors="replace")
    pixels = raw_pixels(f.get(6, b""), f.get(2, 0), f.get(3, 0), name, f.get(5, 0))
    return TimedPixels(pixels, _protobuf_time(f))


def _json_time(value: dict[str, Any]) -> int:
    stamp = value["timestamp"]
    return int(stamp["sec"]) * 1_000_000_000 + int(stamp["nsec"])


def _protobuf_time(fields: dict[int, Any]) -> int:
    stamp = dict(protobuf_fields(fields.get(1, b"")))
    return stamp.get(1, 0) * 1_000_000_000 + stamp.get(2, 0)


def protobuf_fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield number and value of the fields of a protobuf message: integers, and bytes of what has a
    length (Protocol Buffers, "Encoding"). Raises BadImageMessage.
    """
    place = 0

    def varint() -> int:
        nonlocal place
        value = shift = 0
        while True:
            if place >= len(data) or shift > 63:
                raise BadImageMessage("damaged protobuf")
            byte = data[place]
            place += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7

    while place < len(data):
        key = varint()
        kind, length = key & 7, {1: 8, 5: 4}.get(key & 7)
        if kind == 0:
            yield key >> 3, varint()
            continue
        if kind == 2:
            length = varint()
        if length is None or place + length > len(data):
            raise BadImageMessage("damaged protobuf")
        content = data[place : place + length]
        place += length
        yield key >> 3, content if kind == 2 else int.from_bytes(content, "little")


# -- Missions --------------------------------------------------------------------------------------


def _mission(data: bytes, encoding: str, about: dict[str, str]) -> TimedPixels:
    from chaserdock_protocol.codec import Rejected
    from chaserdock_protocol.messages import Image
    from chaserdock_protocol.recording.schema_migrations import decode_logged

    from chaserdock_agents.chaser.sighting import BadImage, decode_image

    try:
        message = decode_logged(Image, data, about.get("zenoh_encoding", ""))
        return TimedPixels(decode_image(message), message.sim_time_ns)
    except (Rejected, BadImage) as error:
        raise BadImageMessage(str(error)) from None


Decoder = Callable[[bytes, str, dict[str, str]], TimedPixels]
"""Decodes a message: its bytes, their encoding (``cdr``, ``protobuf``, ``json``, ``msgpack``) and
what the channel says about it. Raises BadImageMessage."""

ROS_TYPES: dict[str, Callable[[Any], TimedPixels]] = {
    "sensor_msgs/msg/Image": ros_image,
    "sensor_msgs/msg/CompressedImage": ros_compressed_image,
}
"""Image messages of ROS 2 by type."""
DECODERS: dict[str, Decoder] = {
    **{name: _of_ros(name, convert) for name, convert in ROS_TYPES.items()},
    "foxglove.CompressedImage": _foxglove_compressed,
    "foxglove.RawImage": _foxglove_raw,
    "Image": _mission,
}
"""Image messages by the name of their schema."""


def decode_image_message(
    schema: str, data: bytes, encoding: str, about: dict[str, str]
) -> TimedPixels:
    """Return the image of a message with a schema of ``DECODERS``. Raises BadImageMessage."""
    try:
        return DECODERS[schema](data, encoding, about)
    except BadImageMessage:
        raise
    except (KeyError, ValueError, TypeError, AttributeError, struct.error, cv2.error) as error:
        raise BadImageMessage(f"damaged {schema}: {text_of(error)}") from None
