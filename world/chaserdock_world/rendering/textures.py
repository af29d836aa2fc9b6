# SPDX-License-Identifier: Apache-2.0
"""Draw textures of a target's faces: markers, exactly averaged over the area of each texel.

A texel's value is the mean over its area at every resolution, so that rendering from a coarser
texture blurs a marker but does not shift its edges.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.targets import Box, Marker, TargetModel, face_extent, face_rotation
from numpy.typing import NDArray

FINEST_TEXEL_M = 0.00025
"""Width of the finest texel, m: half a pixel of the default camera at 0.5 m. Nearer, texels are
interpolated.
"""
# Reflectance of the printed white and black.
WHITE, BLACK = 0.95, 0.05


def marker_cells(dictionary: str, marker_id: int) -> NDArray[np.uint8]:
    """Return the cells (n, n) of an ArUco marker with its black border, row 0 on top: 1 white, 0
    black.

    Raises ValueError for a dictionary that OpenCV does not have or an id that is not in it.
    """
    code = getattr(cv2.aruco, dictionary, None)
    if not dictionary.startswith("DICT_") or code is None:
        raise ValueError(f"unknown ArUco dictionary {dictionary!r}")
    table = cv2.aruco.getPredefinedDictionary(code)
    if not 0 <= marker_id < len(table.bytesList):
        raise ValueError(f"{dictionary} has no marker {marker_id}")
    cells = cv2.aruco.generateImageMarker(table, marker_id, table.markerSize + 2, borderBits=1)
    return (np.asarray(cells) > 0).astype(np.uint8)


def markers_on_face(model: TargetModel, box: Box, face: int) -> list[tuple[Marker, Array, int]]:
    """Return the markers on one face of a box, with their places and rotations.

    Place: centre (2,) in the face's axes (x right, y up; m). Rotation: number of counter-clockwise
    quarter turns of the marker's image. Raises ValueError for a marker in the face's plane whose
    rotation is not a multiple of a quarter turn.
    """
    found = []
    q_box_face = face_rotation(face)
    depth = face_extent(box.size_m, face)[2]
    q_trf_face = rotations.multiply(box.q_wxyz, q_box_face)
    for marker in model.markers:
        centre = rotations.rotate_inverse(
            q_trf_face, np.array(marker.position_trf_m) - box.position_m
        )
        turn = rotations.to_matrix(
            rotations.multiply(rotations.conjugate(q_trf_face), marker.q_trf_marker_wxyz)
        )
        if abs(centre[2] - depth) > 1e-6 or turn[2, 2] < 1.0 - 1e-9:
            continue
        quarter = np.arctan2(turn[1, 0], turn[0, 0]) / (np.pi / 2.0)
        if abs(quarter - round(quarter)) > 1e-6:
            raise ValueError(f"marker {marker.id} is not parallel to the edges of its face")
        found.append((marker, centre[:2], round(quarter) % 4))
    return found


@lru_cache(maxsize=64)
def finest_texture(model: TargetModel, box_index: int, face: int) -> NDArray[np.uint8] | None:
    """Return reflectance times 255 (rows, columns) of one face at FINEST_TEXEL_M; None for a face
    without markers.

    Column 0 is at the left and row 0 on top, as seen from outside with the face's up direction
    upwards. The array is read-only and shared between callers.
    """
    box = model.boxes[box_index]
    markers = markers_on_face(model, box, face)
    if not markers:
        return None
    width, height, _ = face_extent(box.size_m, face)
    shape = (max(2, round(height / FINEST_TEXEL_M)), max(2, round(width / FINEST_TEXEL_M)))
    texture = np.full(shape, box.shade, dtype=np.float32)
    white = np.full((1, 1), WHITE)
    for marker, centre, _ in markers:  # all white borders first: they may overlap other markers
        half = marker.side_m / 2.0 + model.white_margin_m
        _print(texture, white, centre, half, width, height)
    for marker, centre, quarters in markers:
        cells = np.rot90(marker_cells(model.dictionary, marker.id), quarters)
        _print(
            texture, np.where(cells > 0, WHITE, BLACK), centre, marker.side_m / 2.0, width, height
        )
    finished = np.rint(texture * np.float32(255.0)).astype(np.uint8)
    finished.setflags(write=False)
    return finished


def _print(
    texture: NDArray[np.float32],
    cells: Array,
    centre: Array,
    half_m: float,
    width_m: float,
    height_m: float,
) -> None:
    """Print a square of cells, in place, weighted by the share of each texel that a cell covers."""
    rows, columns = texture.shape
    n = len(cells)
    # Cell edges in texels from the left and from the top; the face's y axis points up.
    x = (np.linspace(-half_m, half_m, n + 1) + centre[0] + width_m / 2.0) * columns / width_m
    y = (np.linspace(-half_m, half_m, n + 1) - centre[1] + height_m / 2.0) * rows / height_m
    left, right = max(int(np.floor(x[0])), 0), min(int(np.ceil(x[-1])), columns)
    top, bottom = max(int(np.floor(y[0])), 0), min(int(np.ceil(y[-1])), rows)
    across = _coverage(x, left, right)
    down = _coverage(y, top, bottom)
    patch = texture[top:bottom, left:right]
    uncovered = 1.0 - np.outer(down.sum(axis=0), across.sum(axis=0)).astype(np.float32)
    patch *= uncovered
    patch += (down.T @ cells @ across).astype(np.float32)


def _coverage(edges: Array, first: int, last: int) -> Array:
    """Return the share (cells, texels) of texels first..last - 1 that lies between consecutive
    ``edges``.
    """
    texels = np.arange(first, last, dtype=float)
    low = np.maximum(edges[:-1, None], texels[None, :])
    high = np.minimum(edges[1:, None], texels[None, :] + 1.0)
    return np.maximum(high - low, 0.0)
