# SPDX-License-Identifier: Apache-2.0
"""Camera devices, network addresses, GStreamer pipelines and video files, through OpenCV."""

from __future__ import annotations

import errno
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2

from .source import Captured, CapturedImage, ImageSourceError, OpeningOptions, Stamp

_QUERY_CAPABILITIES = 0x80685600
"""VIDIOC_QUERYCAP of Video4Linux (linux/videodev2.h), which every camera answers."""
_LEAST_STAMP_MS = 1.0
"""Stamps below are none: drivers without them, and first images, state 0."""
_ENDS_WITHIN_S = 1.0
"""Time for which closing waits for a capture that hangs in its driver."""
NowNs = Callable[[], int]


def open_device(address: str, options: OpeningOptions, clock: NowNs = time.time_ns) -> LiveCapture:
    """Open a camera of Video4Linux, ``0`` or ``/dev/video0``."""
    path = Path(f"/dev/video{address}" if address.isdigit() else address)
    _check_device(path)
    capture = _opened(str(path), cv2.CAP_V4L2)
    if capture is None:
        raise ImageSourceError(f"{path}: is busy: another program uses this camera; end that")
    settings = {
        cv2.CAP_PROP_FRAME_WIDTH: options.width_px,
        cv2.CAP_PROP_FRAME_HEIGHT: options.height_px,
        cv2.CAP_PROP_FPS: options.fps,
        cv2.CAP_PROP_BUFFERSIZE: 1,
    }
    for key, value in settings.items():
        if value is not None:
            capture.set(key, value)
    return LiveCapture(capture, str(path), options.silent_s, clock, stamped=True)


def open_address(address: str, options: OpeningOptions, clock: NowNs = time.time_ns) -> LiveCapture:
    """Open a stream by its address, ``rtsp://HOST/PATH``."""
    patience_ms = round(1e3 * options.silent_s)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, patience_ms]
    limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, patience_ms]
    capture = _opened(address, cv2.CAP_FFMPEG, limits)
    if capture is None:
        raise ImageSourceError(
            f"{address}: no stream within {options.silent_s:g} s; check host, port, path and "
            "password"
        )
    return LiveCapture(capture, address, options.silent_s, clock, stamped=False)


def open_pipeline(
    address: str, options: OpeningOptions, clock: NowNs = time.time_ns
) -> LiveCapture:
    """Open a GStreamer pipeline, which ends in ``appsink``."""
    if not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
        raise ImageSourceError(
            f"{address}: this OpenCV {cv2.__version__} is built without GStreamer, as those of "
            "PyPI are; give the camera's device or RTSP address, or install another OpenCV"
        )
    capture = _opened(address, cv2.CAP_GSTREAMER)
    if capture is None:
        raise ImageSourceError(f"{address}: the pipeline does not start; try it in gst-launch-1.0")
    return LiveCapture(capture, address, options.silent_s, clock, stamped=False)


def _check_device(path: Path) -> None:
    """Raise ImageSourceError unless a path is a camera that this user may open."""
    import fcntl

    if not path.exists():
        others = ", ".join(map(str, sorted(Path("/dev").glob("video*"))))
        raise ImageSourceError(f"{path}: no such device; there {_are(others)}")
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise ImageSourceError(f"{path}: is busy: another program uses it; end that") from None
        who = "; join the group video" if error.errno == errno.EACCES else ""
        raise ImageSourceError(f"{path}: cannot be opened: {error.strerror}{who}") from None
    try:
        fcntl.ioctl(descriptor, _QUERY_CAPABILITIES, bytes(104))
    except OSError:
        raise ImageSourceError(f"{path}: is not a camera (Video4Linux)") from None
    finally:
        os.close(descriptor)


def _are(names: str) -> str:
    return f"are {names}" if names else "is no camera on this machine"


def _opened(address: str, backend: int, limits: list[int] | None = None) -> Any:
    """Return OpenCV's capture, or None. OpenCV's own messages are not shown."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture: Any = cv2.VideoCapture(address, backend, limits or [])
    finally:
        cv2.utils.logging.setLogLevel(level)
    if capture.isOpened():
        return capture
    capture.release()
    return None


class LiveCapture:
    """Delivers the newest image of a capture, which a thread of its own reads, so that images do
    not wait in a buffer.

    ``stamped``: the driver states the time of exposure, by this machine's monotonic clock.
    """

    live = True

    def __init__(
        self, capture: Any, name: str, silent_s: float, clock: NowNs, stamped: bool
    ) -> None:
        self.name = name
        self._capture, self._silent_s = capture, silent_s
        self._clock, self._stamped = clock, stamped
        self._newest: queue.Queue[CapturedImage | None] = queue.Queue(maxsize=1)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"camera {name}", daemon=True)

    def frames(self) -> Iterator[Captured]:
        """Yield the newest image as soon as there is one. Raises ImageSourceError when there is
        none for too long, or when the stream ends.
        """
        self._thread.start()
        while True:
            try:
                image = self._newest.get(timeout=self._silent_s)
            except queue.Empty:
                raise ImageSourceError(
                    f"{self.name}: is mute: no image for {self._silent_s:g} s; check its cable, "
                    "shutter and stream"
                ) from None
            if image is None:
                raise ImageSourceError(f"{self.name}: has ended; was it unplugged or switched off?")
            yield image

    def close(self) -> None:
        """Release the capture; safe to call twice."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(_ENDS_WITHIN_S)
        if not self._thread.is_alive():
            self._capture.release()

    def _read(self) -> None:
        sequence = 0
        while not self._closed.is_set():
            good, pixels = self._capture.read()
            arrival_ns = self._clock()
            if not good:
                self._put(None)
                return
            time_ns, stamp = self._time(arrival_ns)
            self._put(CapturedImage(pixels, time_ns, stamp, arrival_ns, sequence))
            sequence += 1

    def _put(self, image: CapturedImage | None) -> None:
        try:
            self._newest.put_nowait(image)
        except queue.Full:
            with suppress(queue.Empty):  # taken meanwhile
                self._newest.get_nowait()
            self._newest.put_nowait(image)  # no other thread puts

    def _time(self, arrival_ns: int) -> tuple[int, Stamp]:
        stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC) if self._stamped else 0.0
        if stamp_ms < _LEAST_STAMP_MS:
            return arrival_ns, "arrival"
        return round(1e6 * stamp_ms), "exposure"


class VideoFile:
    """Delivers all images of a video file, with their times in it."""

    live = False

    def __init__(self, path: Path, fps: float | None) -> None:
        self.name = str(path)
        self._fps = fps
        self._capture = _opened(str(path), cv2.CAP_FFMPEG)
        if self._capture is None:
            raise ImageSourceError(f"{path}: is not a video that FFmpeg reads")

    def frames(self) -> Iterator[Captured]:
        """Yield the images in order."""
        sequence = 0
        while True:
            good, pixels = self._capture.read()
            if not good:
                return
            position_ns = round(1e6 * self._capture.get(cv2.CAP_PROP_POS_MSEC))
            time_ns = position_ns if self._fps is None else round(1e9 * sequence / self._fps)
            yield CapturedImage(pixels, time_ns, "position", None, sequence)
            sequence += 1

    def close(self) -> None:
        """Release the file."""
        self._capture.release()
