# SPDX-License-Identifier: Apache-2.0
"""Sources of images as cameras of the gateway, and cameras of the gateway as sources of images."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..devices import CameraFrame, CameraSource, DeviceError, DeviceHost, open_device
from ..options import read_options
from .capture import LiveCapture, open_address, open_pipeline
from .capture import open_device as open_video_device
from .source import (
    Captured,
    CapturedImage,
    ImageSource,
    ImageSourceError,
    OpeningOptions,
    UnreadableImage,
)

_PAUSE_S = 0.002
"""Time between two questions for a new image: a twentieth of what a tracker takes at 30 Hz."""
_WAITING = 16
"""Images that wait for the gateway, half a second at 30 Hz; beyond, the oldest are dropped."""


def open_polled(address: str, options: OpeningOptions) -> PolledCamera:
    """Open a camera by its driver of the gateway. Raises DeviceError."""
    camera = open_device("camera", address, {}, DeviceHost(time.time_ns))
    return PolledCamera(camera, address, options.silent_s)


class PolledCamera:
    """Delivers the newest image of a camera of the gateway."""

    live = True

    def __init__(self, camera: CameraSource, name: str, silent_s: float) -> None:
        self.name, self._camera, self._silent_s = name, camera, silent_s

    def frames(self) -> Iterator[Captured]:
        """Yield the newest image as soon as there is one. Raises ImageSourceError when there is
        none for too long, DeviceError when the device is gone.
        """
        sequence, heard_s = 0, time.monotonic()
        while True:
            found = self._camera.poll()
            if not found:
                if time.monotonic() - heard_s > self._silent_s:
                    raise ImageSourceError(
                        f"{self.name}: is mute: no image for {self._silent_s:g} s"
                    )
                time.sleep(_PAUSE_S)
                continue
            heard_s = time.monotonic()
            sequence += len(found)
            newest = found[-1]
            stamped = newest.stamp_ns is not None
            yield CapturedImage(
                newest.image,
                newest.stamp_ns if newest.stamp_ns is not None else newest.arrived_ns,
                "exposure" if stamped else "arrival",
                newest.arrived_ns,
                sequence - 1,
            )

    def close(self) -> None:
        """Release the device."""
        self._camera.close()


def open_driver(address: str, options: Mapping[str, Any], host: DeviceHost) -> SourceCamera:
    """Open a device (``0``), a network address or a pipeline as a camera of the gateway.

    ``options``: those of `OpeningOptions`. Raises DeviceError for others, ImageSourceError.
    """
    given = read_options(OpeningOptions, options)
    source: LiveCapture
    if " ! " in address:
        source = open_pipeline(address, given, host.now_ns)
    elif "://" in address:
        source = open_address(address, given, host.now_ns)
    else:
        source = open_video_device(address, given, host.now_ns)
    return SourceCamera(source)


class SourceCamera:
    """A camera of the gateway that a source of images feeds, in a thread of its own."""

    def __init__(self, source: ImageSource) -> None:
        self._source, self._fault = source, ""
        self._waiting: queue.Queue[CameraFrame] = queue.Queue(maxsize=_WAITING)
        threading.Thread(target=self._feed, name=f"camera {source.name}", daemon=True).start()

    def poll(self) -> Sequence[CameraFrame]:
        """Return what has arrived since the last call. Raises DeviceError when the source has
        ended.
        """
        found: list[CameraFrame] = []
        while not self._waiting.empty():
            found.append(self._waiting.get_nowait())
        if self._fault and not found:
            raise DeviceError(self._fault)
        return found

    def close(self) -> None:
        """Release the source."""
        self._source.close()

    def _feed(self) -> None:
        try:
            for captured in self._source.frames():
                if isinstance(captured, UnreadableImage):
                    continue
                stamp_ns = captured.time_ns if captured.stamp == "exposure" else None
                arrived_ns = captured.arrival_ns
                assert arrived_ns is not None  # of a live source
                if self._waiting.full():
                    self._waiting.get_nowait()
                self._waiting.put_nowait(CameraFrame(captured.pixels, stamp_ns, arrived_ns))
            self._fault = f"{self._source.name}: has ended"
        except ImageSourceError as error:
            self._fault = str(error)
