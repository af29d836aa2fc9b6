# SPDX-License-Identifier: Apache-2.0
"""Sources of images: devices, video files and addresses, folders, recordings.

A kind of source is one file with a function that opens it, and one line in ``_BUILT_IN``. Cameras
with a driver of the gateway (``devices``) are sources, too, by their address ``SCHEME:REST``; and
`open_driver` makes a source a camera of the gateway.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any

from ..devices import GROUPS
from ..options import read_options
from .capture import open_address, open_device, open_pipeline
from .files import open_path
from .polled import open_driver, open_polled
from .recording import open_recording
from .source import (
    Captured,
    CapturedImage,
    ImageSource,
    ImageSourceError,
    OpeningOptions,
    Stamp,
    UnreadableImage,
)

Opener = Callable[[str, OpeningOptions], ImageSource]
_BUILT_IN: tuple[tuple[str, Opener], ...] = (
    # The first pattern that the address matches decides.
    (r"\d+|/dev/.+", open_device),
    (r".+ ! .+", open_pipeline),
    (r"(rtsps?|https?|udp|tcp|rtmp)://.+", open_address),
    (r".+\.(mcap|db3)", open_recording),
    (r"(?s).*", open_path),
)


def open_camera(
    address: str, options: OpeningOptions | Mapping[str, Any] | None = None
) -> ImageSource:
    """Open the source of images at ``address``.

    A device (``0``, ``/dev/video0``), an address (``rtsp://…``), a GStreamer pipeline (``… ! …``),
    a video file, a folder of images, a recording (``.mcap``, folder of a ROS 2 bag), or
    ``SCHEME:REST`` of a driver of the gateway. ``options``: those of `OpeningOptions`, also as a
    table. Raises ImageSourceError, and DeviceError for other options and of a driver.
    """
    if not isinstance(options, OpeningOptions):
        options = read_options(OpeningOptions, options or {})
    scheme, colon, _ = address.partition(":")
    if colon and scheme in {e.name for e in entry_points(group=GROUPS["camera"])}:
        return open_polled(address, options)
    opener = next(o for pattern, o in _BUILT_IN if re.fullmatch(pattern, address))
    return opener(address, options)


__all__ = [
    "Captured",
    "CapturedImage",
    "ImageSource",
    "ImageSourceError",
    "OpeningOptions",
    "Stamp",
    "UnreadableImage",
    "open_camera",
    "open_driver",
]
