# SPDX-License-Identifier: Apache-2.0
"""Mosaic of all camera images at one time of a recorded flight, with the detections drawn."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from chaserdock_agents.chaser.sighting import BadImage, decode_image
from chaserdock_protocol import pose_image
from chaserdock_protocol.messages import Image, Sighting
from chaserdock_protocol.recording.log import LogError, logged_scenario
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import NDArray

from chaserdock.pose_drawing import TEXT_BGR, draw_axes, draw_markers

from .images import Pair, pairs

_AXIS_M = 0.08
"""Length (m) of the drawn axes: about that of a marker."""

_LABEL_PX, _LABEL_DIM = 26, 0.3
"""Height (px) of the strip behind the label, and by what factor it is darkened: the label is white,
and so are markers.
"""

_NO_PICTURE = 6
"""Grey level (0 to 255) of an image without a picture. Larger: it passes for a lit scene."""


def snapshot(log: Path, at_s: float, width_px: int = 640) -> NDArray[np.uint8]:
    """Return a BGR mosaic of each chaser's last image exposed up to ``at_s``, each ``width_px``
    wide.

    Raise LogError for an unreadable log or one without an image up to then.
    """
    scenario, _ = logged_scenario(log)
    latest: dict[int, Pair] = {}
    end_s = 0.0
    for image, sighting in pairs(log, len(scenario.chasers)):
        end_s = max(end_s, image.sim_time_ns / 1e9)
        if image.sim_time_ns <= at_s * 1e9:
            latest[image.chaser] = image, sighting
    if not latest:
        raise LogError(f"{log}: holds no image up to {at_s:g} s")
    if at_s > end_s + 1.0 / scenario.time.image_hz:
        raise LogError(f"--at {at_s:g}: the last image of {log} is of {end_s:.2f} s")
    views = [annotated_image(scenario, *latest[i], width_px) for i in sorted(latest)]
    columns = math.ceil(math.sqrt(len(views)))
    blank = np.zeros_like(views[0])
    views += [blank] * (-len(views) % columns)
    rows = [np.hstack(views[k : k + columns]) for k in range(0, len(views), columns)]
    return np.vstack(rows)


def annotated_image(
    scenario: FlightScenario, image: Image, sighting: Sighting | None, width_px: int
) -> NDArray[np.uint8]:
    """Return the image as BGR, ``width_px`` wide, with the sighting's markers and pose: dark if it
    holds a pose in place of a picture. Raise LogError for a bad image.
    """
    try:
        grey = decode_image(image)
    except BadImage as error:
        raise LogError(
            f"image of chaser {image.chaser} at {image.sim_time_ns / 1e9:.2f} s: {error}"
        ) from None
    camera = scenario.camera_model()
    is_pose = scenario.perception.name == pose_image.NAME
    if is_pose:
        grey = np.full((camera.height_px, camera.width_px), _NO_PICTURE, np.uint8)
    # A gamma correction for display makes the shaded side visible.
    gamma = np.array([255 * (v / 255) ** 0.6 for v in range(256)]).astype(np.uint8)
    canvas: Any = cv2.cvtColor(cv2.LUT(grey, gamma), cv2.COLOR_GRAY2BGR)
    scale = width_px / grey.shape[1]
    canvas = cv2.resize(
        canvas, (width_px, round(grey.shape[0] * scale)), interpolation=cv2.INTER_AREA
    )
    if sighting is not None and sighting.sim_time_ns == image.sim_time_ns:
        if not is_pose:
            corners = (np.reshape(sighting.corners_px, (-1, 4, 2)) + 0.5) * scale - 0.5
            draw_markers(canvas, corners)
        if sighting.solutions:
            best = sighting.solutions[0]
            draw_axes(canvas, camera, best.position_m, best.q_wxyz, _AXIS_M, scale)
    text = f"chaser {image.chaser}  {image.sim_time_ns / 1e9:.2f} s  "
    text += "pose, no picture" if is_pose else seen_text(sighting)
    (length_px, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    size = 0.5 * min(1.0, (width_px - 16) / length_px)  # fit the text into a small image
    canvas[:_LABEL_PX] = (_LABEL_DIM * canvas[:_LABEL_PX]).astype(np.uint8)
    cv2.putText(canvas, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, size, TEXT_BGR, 1, cv2.LINE_AA)
    return np.asarray(canvas, dtype=np.uint8)


def seen_text(sighting: Sighting | None) -> str:
    """Return how a sighting found the target, by a number of markers or without any, or that it did
    not.
    """
    count = len(sighting.marker_ids) if sighting else 0
    if count:
        return f"{count} marker{'s' if count > 1 else ''}"
    return "seen without markers" if sighting is not None and sighting.solutions else "not seen"
