# SPDX-License-Identifier: Apache-2.0
"""What a path may be: a folder of images, a bag of ROS 2, a folder with a log, a video file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from .capture import VideoFile
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

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_UNITS_NS = ((19, 1), (16, 1_000), (13, 1_000_000))
"""Digits of a time since 1970, and its unit, ns: nanoseconds, microseconds, milliseconds."""


def open_path(address: str, options: OpeningOptions) -> ImageSource:
    """Open the folder or file at a path."""
    path = Path(address)
    if not path.exists():
        raise ImageSourceError(
            f"{address}: no such file or folder; a source is a camera (0, /dev/video0), a video, "
            "an address (rtsp://…), a folder of images, or a recording (….mcap, a ROS 2 bag)"
        )
    if path.is_file():
        return VideoFile(path, options.fps)
    if (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")):
        return open_recording(address, options)
    return ImageFolder(path, options.fps)


class ImageFolder:
    """Delivers the images of a folder, sorted by the numbers in their names.

    Names that are times since 1970 (1732718400123456789.png: ns, µs or ms by their digits; or
    seconds, 1732718400.123456.png) give the times of exposure; other images follow each other at
    ``fps``.
    """

    live = False

    def __init__(self, folder: Path, fps: float | None) -> None:
        self.name, self._fps = str(folder), fps
        paths = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES]
        if not paths:
            raise ImageSourceError(f"{folder}: contains no images ({', '.join(SUFFIXES)})")
        self._paths = sorted(paths, key=lambda p: (*_natural(p.stem), p.suffix))
        times = [time_of_name(p.stem) for p in self._paths]
        self._times_ns = None if fps is not None or None in times else times
        if self._times_ns is None and fps is None:
            raise ImageSourceError(
                f"{folder}: names such as {self._paths[0].name} state no times; give --fps"
            )

    def frames(self) -> Iterator[Captured]:
        """Yield the images in order."""
        for sequence, path in enumerate(self._paths):
            pixels = None
            try:
                data = np.fromfile(path, dtype=np.uint8)
            except OSError as error:
                yield UnreadableImage(sequence, f"{path.name}: {error.strerror or error}")
                continue
            if data.size:
                pixels = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            if pixels is None:
                yield UnreadableImage(sequence, f"{path.name}: is not an image, or damaged")
                continue
            time_ns, stamp = self._time(sequence)
            yield CapturedImage(np.asarray(pixels, np.uint8), time_ns, stamp, None, sequence)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _time(self, sequence: int) -> tuple[int, Stamp]:
        if self._times_ns is not None and (time_ns := self._times_ns[sequence]) is not None:
            return time_ns, "exposure"
        assert self._fps is not None
        return round(1e9 * sequence / self._fps), "position"


def time_of_name(stem: str) -> int | None:
    """Return the time, ns, that the name of an image states; None for another number or name."""
    if found := re.fullmatch(r"(?:.*[^\d.])?(\d{9,10})[.](\d{1,9})", stem):
        return int(found[1]) * 1_000_000_000 + int(found[2].ljust(9, "0"))
    if found := re.fullmatch(r"(?:.*\D)?(\d{12,19})", stem):
        digits = len(found[1])
        return int(found[1]) * next(unit for least, unit in _UNITS_NS if digits >= least - 1)
    return None


def _natural(stem: str) -> tuple[list[tuple[int, str]], str]:
    """Return a key that sorts 2 before 10."""
    parts = re.findall(r"\d+|\D+", stem)
    return [(int(p), "") if p.isdigit() else (-1, p) for p in parts], stem
