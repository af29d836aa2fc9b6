# SPDX-License-Identifier: Apache-2.0
"""Draws measured poses and markers into images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import ArrayLike

MARKER_BGR = (90, 220, 90)
"""Colour (0 to 255) of detected markers: green, which grey images do not have."""
TEXT_BGR = (235, 235, 235)
"""Colour (0 to 255) of text: light on dark images."""
AXES_BGR = ((80, 80, 255), (90, 220, 90), (255, 160, 60))
"""Colours (0 to 255) of the axes x, y, z: red, green, blue."""


def draw_markers(canvas: Any, corners_px: Array) -> None:
    """Draw the outlines of markers with corners (n, 4, 2) into a BGR image."""
    for square in corners_px:
        points = np.round(square * 16).astype(np.int32)
        cv2.polylines(canvas, [points], True, MARKER_BGR, 1, cv2.LINE_AA, 4)


def draw_axes(
    canvas: Any,
    camera: Camera,
    position_m: ArrayLike,
    q_wxyz: ArrayLike,
    length_m: float,
    scale: float = 1.0,
) -> None:
    """Draw the axes of a frame: x red, y green, z blue, ``length_m`` each.

    ``position_m`` (3,) of its origin and ``q_wxyz`` (4,), rotation of its axes, in the camera.
    ``scale``: pixels of the canvas per pixel of the camera. Draws nothing of a frame beside the
    lens.
    """
    points = np.vstack([np.zeros(3), length_m * np.eye(3)])
    px = (camera.project(rotations.rotate(q_wxyz, points) + np.asarray(position_m)) + 0.5) * scale
    if not np.all(np.isfinite(px)):
        return
    ends = np.round((px - 0.5) * 16).astype(int)
    for k, colour in enumerate(AXES_BGR):
        a, b = ends[0].tolist(), ends[k + 1].tolist()
        cv2.line(canvas, a, b, colour, 2, cv2.LINE_AA, 4)
