# SPDX-License-Identifier: Apache-2.0
"""Detect markers by OpenCV's ArUco detector, with settings tuned by measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel, cuboid_corners
from numpy.typing import ArrayLike, NDArray

# Margin around a predicted target: share of its size in the image, and px. Wider: a less accurate
# prediction suffices; narrower: less time.
_REGION_SHARE, _REGION_MARGIN_PX = 0.25, 24.0
# Shorter side, px, below which images and regions are not halved. Smaller: less time; larger: fewer
# small markers are lost at half size.
_HALVED_PX = 300
# Share of the image above which a region is not used: it would hardly save time.
_REGION_LIMIT = 0.7
# White border, in cells of a marker, that detection needs anywhere, and where a cell has so many
# pixels or more in the image (docs/evidence/cameras.md#printed-sheets).
LEAST_MARGIN_CELLS, NEAR_MARGIN_CELLS, NEAR_CELL_PX = 0.5, 0.4, 4

Region = tuple[int, int, int, int]


@dataclass(frozen=True)
class Detections:
    """Markers found in an image; an id can occur more than once.

    ``ids`` (n,). ``corners_px`` (n, 4, 2): top left, top right, bottom right, bottom left of the
    upright marker.
    """

    ids: NDArray[np.int64]
    corners_px: Array


class _Windows(NamedTuple):
    """Sizes of the threshold windows: least, largest and step, px.

    ``distance_rate``: distance below which two candidates are one, over a marker's perimeter.
    ``perimeter_px``: least perimeter of a marker. Smaller: markers farther away, and more false
    candidates. ``border_share``: largest share of wrong cells in a marker's black border.
    """

    least_px: int
    most_px: int
    step_px: int
    distance_rate: float
    perimeter_px: float
    border_share: float


# OpenCV's own distance is 0.125.
_WINDOWS = (_Windows(7, 7, 16, 0.125, 40.0, 0.15), _Windows(7, 23, 16, 0.125, 40.0, 0.15))
# Settings of a second look, where nothing was found, at twice the cost (11 instead of 4 ms at 1280
# x 720): those that find most far markers (benchmarks/perception.py, ``markers-small``). Narrow
# windows in small steps find small markers; the small distance keeps candidates inside each other
# apart, such as the outer edge of a white border. The share of the border is OpenCV's own. Where
# that finds nothing, OpenCV's own windows find one marker in 1,000 such views.
_THOROUGH = (_Windows(3, 23, 4, 0.02, 8.0, 0.35), _Windows(3, 23, 10, 0.05, 8.0, 0.35))

NOTHING = Detections(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)))


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's predefined dictionary of this name; raises ValueError for an unknown name."""
    code = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or code is None:
        raise ValueError(f"unknown ArUco dictionary {name!r}")
    return cv2.aruco.getPredefinedDictionary(code)


def detect(
    image: NDArray[np.uint8],
    dictionary: cv2.aruco.Dictionary,
    region: Region | None,
    thorough: bool = False,
    enough: int | None = None,
) -> Detections:
    """Detect markers of ``dictionary`` in a grey image or its ``region``.

    ``region``: left, top, right, bottom, px; right and bottom excluded. Corners are those of
    OpenCV's contours, accurate to about a pixel.

    A threshold window of 7 px detects nearly as many markers as 7 and 23 px together, in half the
    time; the second is used if the first detects fewer than two. ``thorough`` uses 3 to 23 px and
    separates adjacent candidates: slower, for far markers and narrow white borders. With ``enough``
    a large image is searched at half size first, in a third of the time; the result is used if it
    has that many markers.
    """
    left, top, right, bottom = region or (0, 0, image.shape[1], image.shape[0])
    part = image[top:bottom, left:right]
    found = NOTHING
    if enough is not None and not thorough and min(part.shape) >= _HALVED_PX:
        half = np.asarray(
            cv2.resize(part, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
        found = _detect(half, dictionary, _WINDOWS[0])
        if len(found.ids) >= enough:
            return Detections(found.ids, 2.0 * found.corners_px + 0.5 + np.array([left, top]))
    for windows in _THOROUGH if thorough else _WINDOWS:
        found = _detect(part, dictionary, windows)
        if len(found.ids) >= (1 if thorough else 2):
            break
    return Detections(found.ids, found.corners_px + np.array([left, top]))


@lru_cache(maxsize=4096)
def _detector(
    dictionary: cv2.aruco.Dictionary, windows: _Windows, longer_px: int
) -> cv2.aruco.ArucoDetector:
    """Return OpenCV's detector for images with this longer side; cached, as a flight uses few
    sizes.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = windows.least_px
    parameters.adaptiveThreshWinSizeMax = windows.most_px
    parameters.adaptiveThreshWinSizeStep = windows.step_px
    parameters.minMarkerDistanceRate = windows.distance_rate
    # Relative to the size of the image passed in, which may be a region.
    parameters.minMarkerPerimeterRate = windows.perimeter_px / longer_px
    # Relative to the longer side; a marker that fills the image must be accepted.
    parameters.maxMarkerPerimeterRate = 8.0
    parameters.maxErroneousBitsInBorderRate = windows.border_share
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def _detect(
    part: NDArray[np.uint8], dictionary: cv2.aruco.Dictionary, windows: _Windows
) -> Detections:
    corners, ids, _ = _detector(dictionary, windows, max(part.shape)).detectMarkers(part)
    if ids is None or len(ids) == 0:
        return NOTHING
    px = np.array(corners, dtype=float).reshape(-1, 4, 2)
    return Detections(np.asarray(ids, dtype=np.int64).ravel(), px)


def region_of(
    camera: Camera, model: TargetModel, position_irf_m: ArrayLike, q_irf_trf_wxyz: ArrayLike
) -> Region | None:
    """Return the image region of a target with this predicted pose; None to search the whole
    image.
    """
    turn = rotations.to_matrix(q_irf_trf_wxyz)
    points = cuboid_corners(model.size_m) @ turn.T + np.asarray(position_irf_m)
    # The sum is finite only if every coordinate is.
    if not math.isfinite(float(points.sum())) or min(points[:, 2].tolist()) < 0.02:
        return None
    px = camera.project(points)
    if not math.isfinite(float(px.sum())):  # some of it is beyond the lens
        return None
    x_px, y_px = px.T.tolist()
    across, down = _grown(x_px, camera.width_px), _grown(y_px, camera.height_px)
    if across is None or down is None:
        return None
    (left, right), (top, bottom) = across, down
    if right - left < 16 or bottom - top < 16:
        return None
    if (right - left) * (bottom - top) > _REGION_LIMIT * camera.width_px * camera.height_px:
        return None
    return left, top, right, bottom


def _grown(px: list[float], end: int) -> tuple[int, int] | None:
    """Return the interval of these pixels with margins, on an axis of ``end`` pixels; None if not
    finite.
    """
    low, high = min(px), max(px)
    grow = _REGION_SHARE * (high - low) + _REGION_MARGIN_PX
    if not math.isfinite(grow):
        return None
    return math.floor(max(low - grow, 0.0)), min(math.ceil(min(high + grow, end)) + 1, end)
