# SPDX-License-Identifier: Apache-2.0
"""Find markers that the detector has missed, by their cells, where a pose puts them.

The detector needs a closed contour and cells of several pixels. Where a pose is known from other
markers, the grey levels of a marker's cells tell whether it is there. The arithmetic is in C
(native/cells.c).
"""

from __future__ import annotations

from ctypes import Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from numpy.typing import NDArray

from .lens import native_lens
from .native import LIBRARY, function
from .pnp import MarkerTable
from .refine import PoseInCamera

PLACE_CELLS = 0.3
"""Standard deviation, cells, of the place where a marker's cells correlate best among every half
cell: twice what poses of rendered far markers show. Smaller: such places outweigh fitted sides."""
LEAST_CORRELATION = 0.7
"""Correlation of a marker's cells with those of its id, above which it is there: uniform noise in
36 cells exceeds it once in 100,000, and once in 1,200 if 81 places are tried."""
FAINT_CORRELATION = 0.35
"""The same of a marker that may be there, beside others that are: blur takes so much of cells of a
pixel. The fit of all its cells tells (`pattern`). Smaller: more fits; larger: fewer far markers."""


@LIBRARY.structure("ReadLimits")
class _ReadLimits(Structure):
    """Mirror `ReadLimits` of native/cells.c."""

    _fields_ = [
        (name, c_double)
        for name in ("cosine", "cell_px", "frame_px", "sampled", "contrast")
    ]  # fmt: skip


# OpenCV reads no marker at a smaller cosine or with narrower cells; the sides need a
# pixel beyond them; four places within the middle of a cell are sampled; contrast as for sides.
LIMITS = _ReadLimits(0.08, 0.7, 1.0, 0.2, 8.0)


@dataclass(frozen=True)
class ReadMarkers:
    """What a pose shows of a target's m markers.

    ``corners_px`` (m, 4, 2): projected, ideal; of a marker that was looked for: where its cells
    correlate best. ``finest_px`` (m,): width of the finer of cell and
    border, NaN for a marker that does not face the camera. ``rows`` (k,): of those whose cells were
    read. ``faint`` (j,): of further ones that may be there.
    """

    corners_px: Array
    finest_px: Array
    rows: NDArray[np.intp]
    faint: NDArray[np.intp]


class CellReader:
    """Reads the markers of a table in an image. Stateless."""

    def __init__(self, table: MarkerTable, dictionary: cv2.aruco.Dictionary) -> None:
        self._table, self.cells = table, dictionary.markerSize + 2
        self._margin = np.array(table.margin_share, dtype=float, order="C")
        self.white = np.zeros((len(table.ids), self.cells, self.cells), dtype=np.uint8)
        # Ids beyond the dictionary are never seen: they stay black, without contrast.
        for row in np.flatnonzero(table.ids < len(dictionary.bytesList)).tolist():
            code = dictionary.bytesList[table.ids[row] : table.ids[row] + 1]
            bits = cv2.aruco.Dictionary.getBitsFromByteList(code, dictionary.markerSize)
            self.white[row, 1:-1, 1:-1] = bits

    def read(
        self,
        image: NDArray[np.uint8],
        camera: Camera,
        pose: PoseInCamera,
        known: NDArray[np.intp],
        reach: int = 0,
    ) -> ReadMarkers:
        """Read the markers that a pose shows in the distorted grey image, except ``known`` rows.

        Each is looked for up to ``reach`` half cells away from where the pose puts it.
        """
        m = len(self._table.ids)
        surface = np.ascontiguousarray(self._table.surface @ pose.rotation.T)
        position = np.array(pose.position, dtype=float)
        image, skip = np.ascontiguousarray(image), np.zeros(m, dtype=np.uint8)
        skip[known] = 1
        px, finest, found = np.empty((m, 4, 2)), np.empty(m), np.empty(m)
        lens = byref(native_lens(camera)) if camera.distorts else None
        function("read_markers")(
            c_void_p(image.ctypes.data), c_int64(image.shape[0]), c_int64(image.shape[1]),
            (c_double * 4)(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
            lens, byref(LIMITS), address(surface), address(position),
            address(self._margin), c_int64(m), address(self.white), c_int64(self.cells),
            address(skip), c_int64(reach), address(px), address(finest), address(found),
        )  # fmt: skip
        rows = np.flatnonzero(found > LEAST_CORRELATION)
        faint = (found > FAINT_CORRELATION) & (found <= LEAST_CORRELATION)
        return ReadMarkers(px, finest, rows, np.flatnonzero(faint & (len(rows) > 0)))
