# SPDX-License-Identifier: Apache-2.0
"""Read a camera from ROS 2: ``sensor_msgs/msg/Image`` or ``CompressedImage``, and ``CameraInfo``.

Images are turned to grey levels of 8 bits. The calibration in use is the scenario's; one on the
network that differs is an error.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from chaserdock_models.camera import Camera

from ..devices import CameraFrame, DeviceError, DeviceHost, ImageArray
from ..images import BadImageMessage, compressed_pixels, raw_pixels, why_other_size
from ..options import read_options
from .ros2_network import RosEndpoints, RosOptions, absolute_name
from .ros2_poses import stamp_of

KEPT = 4
"""Images kept between two polls: the newest count, and one takes up to some megabytes."""
MATRIX_PX = 0.1
"""Difference, px, of camera matrices that are the same: rounding in files, far below the 1 px to
which calibrations repeat.
"""
COEFFICIENT = 1e-4
"""Difference of lens coefficients that are the same: below 0.1 px in an image 1000 px wide."""
UNREADABLE = 10
"""Unreadable images in a row that are a fault of the camera: single ones are damaged on the way."""
_INFO = "sensor_msgs/msg/CameraInfo"


class RosCameraOptions(RosOptions, frozen=True, kw_only=True):
    """Options of a camera on ROS 2. ``camera_info``: topic of its calibration; ``""`` for none;
    default: ``camera_info`` beside the images.
    """

    type: Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"] = (
        "sensor_msgs/msg/Image"
    )
    camera_info: str | None = None


def grey_of_image(message: Any) -> ImageArray:
    """Return ``sensor_msgs/msg/Image`` as grey levels (h, w). Raises BadImageMessage."""
    m = message
    return raw_pixels(
        m.data, m.width, m.height, m.encoding, m.step, bool(m.is_bigendian), grey=True
    )


def grey_of_compressed(message: Any) -> ImageArray:
    """Return ``sensor_msgs/msg/CompressedImage`` as grey levels (h, w). Raises BadImageMessage."""
    return compressed_pixels(message.data, grey=True)


def difference_of_calibration(info: Any, camera: Camera) -> str | None:
    """Return how ``sensor_msgs/msg/CameraInfo`` differs from a camera; None if it does not, or
    states no calibration (a focal length of 0).
    """
    if (info.width, info.height) != (camera.width_px, camera.height_px):
        return (
            f"CameraInfo states {info.width} x {info.height} px, the scenario's calibration is of "
            f"{camera.width_px} x {camera.height_px} px"
        )
    matrix = np.reshape(np.asarray(info.k, float), (3, 3))
    if matrix[0, 0] == 0.0:
        return None
    if not np.abs(matrix - camera.matrix()).max() <= MATRIX_PX:
        stated, own = (m[[0, 1, 0, 1], [0, 1, 2, 2]].round(3) for m in (matrix, camera.matrix()))
        return f"CameraInfo states fx, fy, cx, cy {stated} px, the scenario {own} px"
    model, coefficients = camera.ros_distortion()
    stated = np.asarray(info.d, float)
    size = max(len(stated), len(coefficients))
    both = [np.pad(c, (0, size - len(c))) for c in (stated, np.asarray(coefficients, float))]
    # Models that agree in all coefficients agree: the polynomial of 5 is one of 8 with zeros.
    fisheye = [name == "equidistant" for name in (info.distortion_model, model)]
    if not size or (fisheye[0] == fisheye[1] and np.abs(both[0] - both[1]).max() <= COEFFICIENT):
        return None
    return (
        f"CameraInfo states {info.distortion_model} {stated.tolist()}, the scenario {model} "
        f"{list(coefficients)}"
    )


class RosCamera:
    """Images of one topic."""

    def __init__(self, topic: str, options: RosCameraOptions, host: DeviceHost) -> None:
        self._camera, self._unreadable = host.camera, 0
        compressed = options.type.endswith("CompressedImage")
        self._grey = grey_of_compressed if compressed else grey_of_image
        self._arrived: deque[tuple[Any, int]] = deque(maxlen=KEPT)
        self._info: Any = None
        info = options.camera_info
        if info is None:
            info = f"{topic.rpartition('/')[0]}/camera_info"
        self._endpoints = RosEndpoints(options)
        try:
            if info and self._camera is not None:
                self._endpoints.subscribe(absolute_name(info), _INFO, self._take_info)
            self._endpoints.subscribe(
                topic, options.type, lambda m: self._arrived.append((m, host.now_ns()))
            )
        except BaseException:
            self._endpoints.close()
            raise

    def _take_info(self, info: Any) -> None:
        self._info = info

    def poll(self) -> Sequence[CameraFrame]:
        """See `CameraSource`. Raises DeviceError, too, for images or a calibration that differ from
        the scenario's, and for several unreadable images in a row.
        """
        if self._info is not None and self._camera is not None:
            difference = difference_of_calibration(self._info, self._camera)
            if difference:
                raise DeviceError(difference)
            self._info = None
        frames: list[CameraFrame] = []
        while self._arrived:
            message, arrived_ns = self._arrived.popleft()
            try:
                grey = self._grey(message)
            except BadImageMessage as error:
                self._unreadable += 1
                if self._unreadable >= UNREADABLE:
                    raise DeviceError(f"{self._unreadable} images in a row: {error}") from None
                continue
            self._unreadable = 0
            if self._camera is not None and (other := why_other_size(grey, self._camera)):
                raise DeviceError(other)
            frames.append(CameraFrame(grey, stamp_of(message.header), arrived_ns))
        if not frames:
            self._endpoints.check()
        return frames

    def close(self) -> None:
        """Release the camera."""
        self._endpoints.close()


def open_camera(address: str, options: Mapping[str, Any], host: DeviceHost) -> RosCamera:
    """Open a camera: ``ros2:/robot0/camera/image_raw``."""
    return RosCamera(absolute_name(address), read_options(RosCameraOptions, options), host)
