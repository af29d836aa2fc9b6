# SPDX-License-Identifier: Apache-2.0
"""Draws what a tracker sees into the image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel, cuboid_corners
from numpy.typing import NDArray

from chaserdock.pose_drawing import MARKER_BGR, TEXT_BGR, draw_axes, draw_markers

from .tracker import TrackedImage, TrackedTarget

_AXIS_SHARE = 0.4
"""Length of the drawn axes over the target's largest extent; that of a marker's, over its side."""
_EDGES = tuple((a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit)
"""Pairs of corners of a cuboid, in the order of `cuboid_corners`, that an edge joins."""
_SHADED = 0.3
"""Share of the light that stays behind text, so that it is legible on any image."""
_ALERT_BGR = (80, 160, 255)
"""Colour (0 to 255) of what is ambiguous or lost: orange."""
_SINCE_1970_NS = 10**18
"""Times from here on, the year 2001, are counted from 1970; cameras and flights count from 0."""
_TEXT_SHARE = 1.0 / 900.0
"""Size of text for each pixel of the image's height: twelve pixels of 480."""


def overlay(
    image: NDArray[np.uint8],
    camera: Camera,
    models: Sequence[TargetModel],
    tracked: TrackedImage,
    per_second: float,
) -> NDArray[np.uint8]:
    """Return a BGR copy of an image with axes, outlines, ids and figures of each target.

    ``per_second``: images processed a second.
    """
    grey = image.ndim == 2 or image.shape[2] == 1
    canvas: Any = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if grey else image.copy()
    size = max(0.45, canvas.shape[0] * _TEXT_SHARE)
    for model, target in zip(models, tracked.targets, strict=True):
        _draw_target(canvas, camera, model, target, size)
    for row, text in enumerate(lines_of(tracked, per_second)):
        good = row == 0 or tracked.targets[row - 1].status == "tracked"
        colour = TEXT_BGR if good else _ALERT_BGR
        _put(canvas, text, 8, round((row + 1) * 34 * size), size, colour)
    return np.asarray(canvas, dtype=np.uint8)


def lines_of(tracked: TrackedImage, per_second: float) -> list[str]:
    """Return the figures of an image: time and speed, then a line for each target."""
    lines = [f"{_clock(tracked.time_ns)}   {per_second:.0f} images/s"]
    for target in tracked.targets:
        pose = target.pose
        if pose is None:
            lines.append(f"{target.name}: {target.status}")
            continue
        count = len(target.marker_ids)
        by = f"{count} marker{'s' if count > 1 else ''}" if count else "shape"
        x, y, z = (1e3 * pose.position_m).tolist()
        lines.append(
            f"{target.name}: {target.status}, {by}, ({x:.1f}, {y:.1f}, {z:.1f}) mm "
            f"+- {1e3 * pose.sigma_m:.2f} mm, {math.degrees(pose.sigma_rad):.3f} deg; "
            f"{pose.residual_px:.2f} px"
        )
    return lines


def _clock(time_ns: int) -> str:
    """Return a time: since 1970 as UTC, others in seconds."""
    if time_ns < _SINCE_1970_NS:
        return f"{time_ns / 1e9:.2f} s"
    when = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{when:%H:%M:%S}.{time_ns // 10**7 % 100:02d} UTC"


def _draw_target(
    canvas: Any, camera: Camera, model: TargetModel, target: TrackedTarget, size: float
) -> None:
    draw_markers(canvas, target.corners_px)
    for number, corners in zip(target.marker_ids.tolist(), target.corners_px, strict=True):
        x, y = corners[0].tolist()
        _put(canvas, str(number), round(x) + 4, round(y) + round(24 * size), size, MARKER_BGR)
    if target.pose is None:
        return
    if not len(target.marker_ids):
        _draw_boxes(canvas, camera, model, target)
    sides = [m.side_m for m in model.markers] if len(model.markers) == 1 else model.size_m
    for pose in reversed(target.poses):
        draw_axes(canvas, camera, pose.position_m, pose.q_wxyz, _AXIS_SHARE * max(sides))


def _draw_boxes(canvas: Any, camera: Camera, model: TargetModel, target: TrackedTarget) -> None:
    """Draw the cuboids around the parts of a shape."""
    assert target.pose is not None
    for box in model.boxes:
        corners = rotations.rotate(box.q_wxyz, cuboid_corners(box.size_m)) + box.position_m
        seen = rotations.rotate(target.pose.q_wxyz, corners) + target.pose.position_m
        px = camera.project(seen)
        if not np.isfinite(px).all():
            continue
        ends = np.round(px * 16).astype(int).tolist()
        for a, b in _EDGES:
            cv2.line(canvas, ends[a], ends[b], MARKER_BGR, 1, cv2.LINE_AA, 4)


def _put(canvas: Any, text: str, x: int, y: int, size: float, colour: tuple[int, int, int]) -> None:
    """Write a line with its baseline at ``y`` on a shaded ground."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    rows = slice(max(y - height - 3, 0), max(y + below, 0))
    columns = slice(max(x - 3, 0), max(x + width + 3, 0))
    canvas[rows, columns] = (_SHADED * canvas[rows, columns]).astype(np.uint8)
    cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
