# SPDX-License-Identifier: Apache-2.0
"""Which boxes and points the plume of a thruster hits. The plume is a cone without end. Pure functions; SI units, radians."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from . import rotations
from .arrays import Array
from .targets import Box, cuboid_corners

_CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
_EDGES = np.array(
    [
        (i, j)
        for (i, a), (j, b) in itertools.combinations(enumerate(_CORNERS), 2)
        if sum(u != v for u, v in zip(a, b, strict=True)) == 1
    ]
)
"""Pairs of corners of a cuboid, in the order of ``cuboid_corners``, that an edge joins."""


def angle_to_box(nozzle_m: Array, axis: Array, box: Box) -> float:
    """Return the smallest angle between ``axis`` (3,), of unit length, and the direction from the nozzle (3,) to a point of a box.

    0 if the nozzle is in the box or the axis meets it. Otherwise the smallest angle is at an edge: within a plane that the axis
    does not meet, the angle has no minimum.
    """
    local = rotations.rotate_inverse(box.q_wxyz, nozzle_m - np.asarray(box.position_m))
    direction = rotations.rotate_inverse(box.q_wxyz, axis)
    half = np.asarray(box.size_m) / 2.0
    if _meets(local, direction, half):
        return 0.0
    corners = cuboid_corners(box.size_m) - local
    begin, end = corners[_EDGES[:, 0]], corners[_EDGES[:, 1]]
    length = np.linalg.norm(end - begin, axis=1)
    along = (end - begin) / length[:, None]
    # The cosine of the angle has one stationary point on a line: the root of a linear equation.
    begin_along, begin_axis = (begin * along).sum(axis=1), begin @ direction
    axis_along = along @ direction
    slope = axis_along * begin_along - begin_axis
    root = np.divide(
        begin_axis * begin_along - axis_along * (begin * begin).sum(axis=1),
        slope,
        out=np.zeros(len(slope)),
        where=np.abs(slope) > 1e-12,
    )
    points = np.concatenate([corners, begin + np.clip(root, 0.0, length)[:, None] * along])
    cosines = points @ direction / np.linalg.norm(points, axis=1)
    return math.acos(min(1.0, float(cosines.max())))


def _meets(origin: Array, direction: Array, half: Array) -> bool:
    """Return whether a ray meets the cuboid of half edges ``half`` about the origin of its own axes."""
    parallel = np.abs(direction) < 1e-12
    if np.any(parallel & (np.abs(origin) > half)):
        return False
    safe = np.where(parallel, 1.0, direction)
    first, second = (-half - origin) / safe, (half - origin) / safe
    enters = np.where(parallel, -math.inf, np.minimum(first, second)).max()
    leaves = np.where(parallel, math.inf, np.maximum(first, second)).min()
    return bool(leaves >= max(enters, 0.0))


def angle_to_point(nozzle_m: Array, axis: Array, point_m: Array) -> float:
    """Return the angle between ``axis`` (3,), of unit length, and the direction from the nozzle (3,) to a point (3,)."""
    off = np.asarray(point_m) - nozzle_m
    distance = float(np.linalg.norm(off))
    return 0.0 if distance == 0.0 else math.acos(max(-1.0, min(1.0, float(off @ axis) / distance)))


def plume_hits(
    nozzle_m: Array, force: Array, half_angle_rad: float, boxes: Sequence[Box], points_m: Sequence[Array] = ()
) -> bool:
    """Return whether the plume of a thruster at ``nozzle_m`` (3,) hits a box or a point; ``force`` (3,): its unit direction."""
    axis = -np.asarray(force, dtype=float)
    return any(angle_to_box(nozzle_m, axis, box) < half_angle_rad for box in boxes) or any(
        angle_to_point(nozzle_m, axis, point) < half_angle_rad for point in points_m
    )
