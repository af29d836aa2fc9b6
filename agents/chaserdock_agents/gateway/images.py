# SPDX-License-Identifier: Apache-2.0
"""Images of a camera: their pixels, their size, and as messages of a mission. No I/O."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Image

from .devices import ImageArray


class BadImageMessage(ValueError):
    """An image message that cannot be decoded."""


class Encoding(NamedTuple):
    """How pixels stand in raw bytes: channels, bytes of one, and OpenCV's conversions to BGR and to
    grey; None: as it is.
    """

    channels: int
    size: int
    to_bgr: int | None
    to_grey: int | None


_UYVY = Encoding(2, 1, cv2.COLOR_YUV2BGR_UYVY, cv2.COLOR_YUV2GRAY_UYVY)
_YUYV = Encoding(2, 1, cv2.COLOR_YUV2BGR_YUY2, cv2.COLOR_YUV2GRAY_YUY2)
ENCODINGS: dict[str, Encoding] = {
    "mono8": Encoding(1, 1, None, None),
    "8uc1": Encoding(1, 1, None, None),
    "mono16": Encoding(1, 2, None, None),
    "16uc1": Encoding(1, 2, None, None),
    "bgr8": Encoding(3, 1, None, cv2.COLOR_BGR2GRAY),
    "8uc3": Encoding(3, 1, None, cv2.COLOR_BGR2GRAY),
    "rgb8": Encoding(3, 1, cv2.COLOR_RGB2BGR, cv2.COLOR_RGB2GRAY),
    "bgra8": Encoding(4, 1, cv2.COLOR_BGRA2BGR, cv2.COLOR_BGRA2GRAY),
    "rgba8": Encoding(4, 1, cv2.COLOR_RGBA2BGR, cv2.COLOR_RGBA2GRAY),
    # OpenCV names a pattern by its second row and column, ROS by its first.
    "bayer_rggb8": Encoding(1, 1, cv2.COLOR_BayerBG2BGR, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": Encoding(1, 1, cv2.COLOR_BayerRG2BGR, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": Encoding(1, 1, cv2.COLOR_BayerGR2BGR, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": Encoding(1, 1, cv2.COLOR_BayerGB2BGR, cv2.COLOR_BayerGB2GRAY),
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
}
"""Encodings of pixels by ROS' names, in lower case."""


def why_other_size(image: ImageArray, camera: Camera) -> str:
    """Return how the size of an image differs from its camera's calibration; empty if it does
    not.
    """
    height, width = image.shape[:2]
    if (width, height) == (camera.width_px, camera.height_px):
        return ""
    return (
        f"images of {width} x {height}; the calibration is for "
        f"{camera.width_px} x {camera.height_px}"
    )


def image_message(
    rate_hz: int, quality: int, chaser: int, image: ImageArray, exposed_ns: int
) -> Image:
    """Return an image (h, w) or (h, w, 3) that was exposed at ``exposed_ns`` of mission time.

    It belongs to the tick that can use it first: at or after the exposure. ``quality``: of JPEG, 0
    for uncompressed.
    """
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    data = gray
    if quality:
        _, data = cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return Image(
        tick=-(-exposed_ns * rate_hz // 1_000_000_000),
        sim_time_ns=exposed_ns,
        chaser=chaser,
        width_px=gray.shape[1],
        height_px=gray.shape[0],
        encoding="jpeg" if quality else "mono8",
        data=data.tobytes(),
    )


def raw_pixels(
    data: Any,
    width: int,
    height: int,
    encoding: str,
    step: int,
    big_endian: bool = False,
    *,
    grey: bool = False,
) -> ImageArray:
    """Return the image of raw bytes with ``step`` bytes a row: grey (h, w) or BGR (h, w, 3), with
    ``grey`` always the former. Of 16 bits the higher byte counts. Raises BadImageMessage.
    """
    known = ENCODINGS.get(encoding.lower())
    if known is None:
        raise BadImageMessage(f"encoding {encoding!r} is unknown; known: {', '.join(ENCODINGS)}")
    content, row = np.frombuffer(data, np.uint8), width * known.channels * known.size
    if width < 1 or height < 1 or step < row or content.size < step * (height - 1) + row:
        raise BadImageMessage(
            f"{content.size} bytes, {step} a row; {width} x {height} pixels of {encoding} have "
            f"{row} a row"
        )
    missing = max(0, step * height - content.size)  # the last row may end with its pixels
    rows = np.pad(content, (0, missing))[: step * height] if missing else content[: step * height]
    pixels = rows.reshape(height, step)[:, :row]
    if known.size == 2:
        pixels = pixels[:, (0 if big_endian else 1) :: 2]
    if known.channels > 1:
        pixels = pixels.reshape(height, width, known.channels)
    pixels = np.ascontiguousarray(pixels)
    code = known.to_grey if grey else known.to_bgr
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code), np.uint8)


def compressed_pixels(data: Any, *, grey: bool = False) -> ImageArray:
    """Return the image of a JPEG, PNG or another file that OpenCV reads, as BGR or ``grey``. Raises
    BadImageMessage.
    """
    content = np.frombuffer(data, np.uint8)
    colours = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    pixels: Any = None
    if content.size:
        pixels = cv2.imdecode(content, colours | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise BadImageMessage(f"{content.size} bytes are not a JPEG or PNG, or damaged")
    return np.asarray(pixels, np.uint8)
