# SPDX-License-Identifier: Apache-2.0
"""Images of a camera: their pixels, their size, and as messages of a mission. No I/O."""

from __future__ import annotations

import cv2
import numpy as np
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Image

from .devices import ImageArray


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


def converted_rows(
    rows: ImageArray, width: int, channels: int, size: int, conversion: int | None, big_endian: bool
) -> ImageArray:
    """Return the image of rows (h, step), which may be longer than their pixels: of 16 bits the
    higher byte, then converted by a code of OpenCV.
    """
    pixels = rows[:, : width * channels * size]
    if size == 2:
        pixels = pixels[:, (0 if big_endian else 1) :: 2]
    if channels > 1:
        pixels = pixels.reshape(len(rows), width, channels)
    pixels = np.ascontiguousarray(pixels)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)
