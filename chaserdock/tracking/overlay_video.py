# SPDX-License-Identifier: Apache-2.0
"""Writes overlays as a video (H.264), each image at its own time."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import replaced
from numpy.typing import NDArray

from .subjects import TrackError

_PER_SECOND = 1000
"""Steps of time in a second of video, finer than images follow each other."""
_LONGEST_STEPS = 1000
"""Longest time that an image is shown, one second: gaps of a recording are cut."""


class OverlayVideo:
    """A video that grows image by image."""

    def __init__(self, container: Any) -> None:
        self._container, self._stream = container, None
        self._time_ns, self._step = 0, 0

    def write(self, image: NDArray[np.uint8], time_ns: int) -> None:
        """Add a BGR image of a time; times that do not increase follow by a step."""
        if self._stream is None:
            self._stream = self._opened(image)
        else:
            steps = round((time_ns - self._time_ns) * _PER_SECOND / 1e9)
            self._step += min(max(steps, 1), _LONGEST_STEPS)
        self._time_ns = time_ns
        odd = image.shape[0] % 2, image.shape[1] % 2
        if any(odd):  # H.264 needs even sides
            image = np.asarray(
                cv2.copyMakeBorder(image, 0, odd[0], 0, odd[1], cv2.BORDER_REPLICATE), np.uint8
            )
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = self._step, Fraction(1, _PER_SECOND)
        self._container.mux(self._stream.encode(frame))

    def finish(self) -> None:
        """Write the images that the encoder holds."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())

    def _opened(self, image: NDArray[np.uint8]) -> Any:
        stream: Any = self._container.add_stream("libx264", rate=_PER_SECOND)
        height, width = image.shape[:2]
        stream.width, stream.height = width + width % 2, height + height % 2
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, _PER_SECOND)
        stream.options = {"crf": "23", "preset": "veryfast"}
        return stream


@contextmanager
def overlay_video(path: Path) -> Generator[OverlayVideo]:
    """Open a new video, which takes its place when the block ends. Raises TrackError."""
    if path.suffix.lower() != ".mp4":
        raise TrackError(f"--video {path}: must end in .mp4")
    with (
        errors_of_writing(path, TrackError),
        replaced(path) as new,
        av.open(str(new), "w") as container,
    ):
        video = OverlayVideo(container)
        yield video
        video.finish()
