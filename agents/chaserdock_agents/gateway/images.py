# SPDX-License-Identifier: Apache-2.0
"""Images of a camera as messages of a mission. No I/O."""

from __future__ import annotations

import cv2
from chaserdock_protocol.messages import Image

from .devices import ImageArray


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
