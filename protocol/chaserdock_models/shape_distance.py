# SPDX-License-Identifier: Apache-2.0
"""Compute signed distances from the cuboids of a body, and distances between bodies of cuboids.

Pure functions. The distance from a cuboid is that from its nearest point; inside it is negative, to
the nearest face (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.4). Between two
bodies it is the gap between planes that separate them along one direction, which never exceeds the
true distance. The NMPC's kernel computes the same (nmpc/native/planes.c).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array
from .targets import Box


def chaser_boxes(
    size_m: tuple[float, float, float] = (0.25, 0.25, 0.05), probe_reach_m: float = 0.35
) -> tuple[Box, ...]:
    """Return the boxes of a chaser in CRF: its body and a thin docking probe along +X up to
    ``probe_reach_m``.

    Raises ValueError if the probe does not reach beyond the body.
    """
    front = size_m[0] / 2.0
    if probe_reach_m <= front:
        raise ValueError(
            f"the probe ({probe_reach_m} m) must reach beyond the body's front ({front} m)"
        )
    length = probe_reach_m - front
    probe = Box((length, 0.012, 0.012), (front + length / 2.0, 0.0, 0.0), shade=0.45)
    return (Box(size_m, shade=0.3), probe)


def box_table(boxes: Sequence[Box]) -> Array:
    """Return a table (C, 15) of cuboids: centre (3), rotation box to body (9, row-major), half
    edges (3).
    """
    rows = [
        np.concatenate(
            [b.position_m, rotations.to_matrix(b.q_wxyz).ravel(), np.array(b.size_m) / 2.0]
        )
        for b in boxes
    ]
    return np.array(rows).reshape(-1, 15)


def moved(table: Array, positions_m: ArrayLike, q_wxyz: ArrayLike) -> Array:
    """Return the table (K, C, 15) of a body's cuboids (C, 15) at K poses, in the frame of the
    poses.

    Poses: positions (K, 3) and attitudes (K, 4).
    """
    turns = rotations.to_matrix(np.asarray(q_wxyz, dtype=float))
    out = np.empty((len(turns), len(table), 15))
    out[:, :, :3] = np.asarray(positions_m)[:, None] + np.einsum("kij,cj->kci", turns, table[:, :3])
    axes = np.einsum("kij,cjl->kcil", turns, table[:, 3:12].reshape(-1, 3, 3))
    out[:, :, 3:12] = axes.reshape(*axes.shape[:2], 9)
    out[:, :, 12:] = table[:, 12:]
    return out


def signed_distance(table: Array, point_m: ArrayLike) -> tuple[float, Array]:
    """Return the least signed distance (m) of a point (3,) from cuboids, and its gradient (3,).

    ``table`` (C, 15); without cuboids the distance is infinite.
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


def reach_along(table: Array, direction: ArrayLike, q_wxyz: ArrayLike) -> float:
    """Return how far a body (C, 15) in the attitude (4,) reaches from its origin along a unit
    vector (3,), m.
    """
    local = rotations.rotate_inverse(
        np.asarray(q_wxyz, dtype=float), np.asarray(direction, dtype=float)
    )
    along = table[:, 3:12].reshape(-1, 3, 3).transpose(0, 2, 1) @ local
    return float((table[:, :3] @ local + (np.abs(along) * table[:, 12:]).sum(axis=1)).max())


def distance_from_cuboids(
    table: Array, body: Array, position_m: ArrayLike, q_wxyz: ArrayLike
) -> float:
    """Return the least gap (m) between cuboids (C, 15) and a ``body`` (S, 15) at a pose (3,), (4,).

    The gap is measured along the gradient of each cuboid's signed distance at the body's origin.
    """
    gaps = []
    for row in table:
        distance_m, normal = signed_distance(row[None], position_m)
        gaps.append(distance_m - reach_along(body, -normal, q_wxyz))
    return min(gaps, default=np.inf)


def distance_between(
    body: Array, pose: tuple[ArrayLike, ArrayLike], other: tuple[ArrayLike, ArrayLike]
) -> float:
    """Return the gap (m) between two bodies of equal shape (S, 15), along the line of their
    origins.

    Each pose: position (3,) and attitude (4,).
    """
    line = np.asarray(pose[0], dtype=float) - np.asarray(other[0], dtype=float)
    apart_m = float(np.linalg.norm(line))
    if apart_m == 0.0:
        return -np.inf
    line = line / apart_m
    return apart_m - reach_along(body, -line, pose[1]) - reach_along(body, line, other[1])


def swept_distance(a: Array, b: Array, sweep_a_m: ArrayLike, sweep_b_m: ArrayLike) -> float:
    """Return the least gap (m) between two bodies of cuboids while each moves along a line.

    ``a``, ``b`` (C, 15): the bodies where they begin, in one frame. ``sweep_a_m``, ``sweep_b_m``
    (3,): their displacements, which may be made at any time, so that each place of one may meet
    each place of the other. The gap is negative exactly if two places overlap; where edges or
    corners are nearest it may fall short of the true distance.

    Both swept cuboids are zonotopes, and so is their Minkowski difference: its faces are spanned by
    pairs of edges (P. McMullen, "On zonotopes", 1971).
    """
    sweeps = np.asarray(sweep_a_m, dtype=float) / 2.0, np.asarray(sweep_b_m, dtype=float) / 2.0
    gaps = []
    for one, other in product(a, b):
        apart = one[:3] + sweeps[0] - other[:3] - sweeps[1]
        boxes = (row[3:12].reshape(3, 3).T * row[12:, None] for row in (one, other))
        edges = np.vstack([*boxes, sweeps])
        gaps.append(_zonotope_distance(apart, edges))
    return min(gaps)


def _zonotope_distance(centre_m: Array, edges_m: Array) -> float:
    """Return the gap (m) between the origin and a zonotope of half edges (E, 3) about a centre
    (3,), along its best separating direction.
    """
    first, second = np.triu_indices(len(edges_m), 1)
    faces = np.cross(edges_m[first], edges_m[second])
    directions = np.vstack([faces, centre_m])
    lengths = np.linalg.norm(directions, axis=1)
    directions = directions[lengths > 0.0] / lengths[lengths > 0.0, None]
    return float((np.abs(directions @ centre_m) - np.abs(directions @ edges_m.T).sum(axis=1)).max())
