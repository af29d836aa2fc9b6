# SPDX-License-Identifier: Apache-2.0
"""Signed distance from the cuboids of a body, with its gradient. Pure functions.

The distance from a cuboid is that from its nearest point; inside it is negative, to the nearest face (C. Ericson, Real-Time
Collision Detection, 2005, section 5.1.4). The NMPC's kernel computes the same (nmpc/native/planes.c).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array
from .targets import Box


def box_table(boxes: Sequence[Box]) -> Array:
    """Return centres (3), rotations box to body (9, row-major) and half edges (3) of cuboids, (C, 15)."""
    rows = [
        np.concatenate([b.position_m, rotations.to_matrix(b.q_wxyz).ravel(), np.array(b.size_m) / 2.0])
        for b in boxes
    ]
    return np.array(rows).reshape(-1, 15)


def moved(table: Array, positions_m: ArrayLike, q_wxyz: ArrayLike) -> Array:
    """Return a table (C, 15) for poses of the body (K, 3), (K, 4): (K, C, 15), in the frame of the poses."""
    turns = rotations.to_matrix(np.asarray(q_wxyz, dtype=float))
    out = np.empty((len(turns), len(table), 15))
    out[:, :, :3] = np.asarray(positions_m)[:, None] + np.einsum("kij,cj->kci", turns, table[:, :3])
    axes = np.einsum("kij,cjl->kcil", turns, table[:, 3:12].reshape(-1, 3, 3))
    out[:, :, 3:12] = axes.reshape(*axes.shape[:2], 9)
    out[:, :, 12:] = table[:, 12:]
    return out


def signed_distance(table: Array, point_m: ArrayLike) -> tuple[float, Array]:
    """Return the least signed distance (m) of a point (3,) from the cuboids of a table (C, 15), and its gradient (3,).

    Infinity without cuboids.
    """
    best, gradient = np.inf, np.zeros(3)
    for row in table:
        axes, half = row[3:12].reshape(3, 3), row[12:]
        local = axes.T @ (np.asarray(point_m, dtype=float) - row[:3])
        off = local - np.clip(local, -half, half)
        distance = float(np.linalg.norm(off))
        if distance > 0.0:
            normal = off / distance
        else:
            face = int(np.argmin(half - np.abs(local)))
            distance = float(np.abs(local[face]) - half[face])
            normal = np.zeros(3)
            normal[face] = 1.0 if local[face] >= 0.0 else -1.0
        if distance < best:
            best, gradient = distance, axes @ normal
    return best, gradient
