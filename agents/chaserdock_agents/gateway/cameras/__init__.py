# SPDX-License-Identifier: Apache-2.0
"""Sources of images: devices, video files and addresses, folders, recordings.

A kind of source is one file with a function that opens it, and one line in ``_BUILT_IN``. Installed
packages add others by entry points of the group ``chaserdock.cameras``; their address is
``NAME:REST``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from chaserdock_protocol import plugins

from .capture import open_address, open_device, open_pipeline
from .files import open_path
from .recording import open_recording
from .source import (
    ImageSource,
    Captured,
    CapturedImage,
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
    ``NAME:REST`` of an installed source. ``options``: those of `OpeningOptions`, also as a
    table. Raises ImageSourceError, and PluginError for an installed source that does not start.
    """
    given = options if isinstance(options, OpeningOptions) else _options(options or {})
    name, _, rest = address.partition(":")
    if re.fullmatch(r"[A-Za-z][\w-]+", name) and name in plugins.installed("camera"):
        return plugins.make("camera", name, (), rest, given)
    opener = next(o for pattern, o in _BUILT_IN if re.fullmatch(pattern, address))
    return opener(address, given)


def _options(values: Mapping[str, Any]) -> OpeningOptions:
    try:
        return OpeningOptions(**values)
    except TypeError:
        known = OpeningOptions.__dataclass_fields__
        wrong = sorted(set(values) - set(known))
        raise ImageSourceError(
            f"option {', '.join(wrong)} of a camera is unknown; known: {', '.join(known)}"
        ) from None


__all__ = [
    "ImageSource",
    "Captured",
    "CapturedImage",
    "ImageSourceError",
    "OpeningOptions",
    "Stamp",
    "UnreadableImage",
    "open_camera",
]
