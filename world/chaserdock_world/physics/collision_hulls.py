# SPDX-License-Identifier: Apache-2.0
"""Divide a mesh into convex pieces for collisions, as the engines need convex shapes.

Each connected surface of a part is cut in two across its longest direction until the convex hull of
a piece is at most ``tolerance_m`` in front of it, or until there are ``MOST_PIECES`` of it. A
cuboid, a cylinder and the like stay one piece; a ring becomes arcs and a dish facets, so that what
is inside a ring or in front of a dish does not touch anything.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.decimation import decimated
from chaserdock_models.meshes import MeshPart, TriangleMesh

if TYPE_CHECKING:  # as slow to import as the whole world, and needed for targets with hulls only
    from scipy.spatial import ConvexHull

MOST_PIECES = 16
"""Most convex pieces of a surface. More: closer to the surface; fewer: fewer contacts to check in a
step.
"""
_WITHIN = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3], [6], [6], [6]])
"""Barycentric coordinates of the points of a triangle at which a gap is measured."""
_MOST_VERTICES = 128
"""Most vertices of a piece. More: closer to the surface; fewer: faster, as Bullet searches all of
them in a contact.
"""
_MOST_TRIANGLES = 1500
"""Triangles of a surface above which it is simplified before it is cut. More: closer to the
surface; fewer: faster, as the time to cut it grows with them.
"""
_UNCUT = 10.0
"""Length of a piece, in tolerances, below which it is not cut."""

Cut = tuple[int, float]
"""A plane across one axis of a piece: number of the axis, and coordinate on it, m."""


def collision_hulls(mesh: TriangleMesh, tolerance_m: float = 0.004) -> list[Array]:
    """Return the vertices (n, 3), body axes, of convex pieces of all parts of a mesh."""
    return [
        hull
        for part in mesh.parts
        for surface in connected_surfaces(part)
        for hull in _pieces(_coarse(surface), tolerance_m)
    ]


def _coarse(part: MeshPart) -> MeshPart:
    return decimated(part, _MOST_TRIANGLES) if len(part.triangles) > _MOST_TRIANGLES else part


def connected_surfaces(part: MeshPart) -> list[MeshPart]:
    """Return the connected surfaces of a part."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(part.vertices_m)
    rows, columns = part.triangles[:, [0, 1, 2]].ravel(), part.triangles[:, [1, 2, 0]].ravel()
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    if count == 1:
        return [part]
    of_triangle = label[part.triangles[:, 0]]
    surfaces = []
    for k in np.unique(of_triangle):
        used, triangles = np.unique(part.triangles[of_triangle == k], return_inverse=True)
        surfaces.append(
            replace(part, vertices_m=part.vertices_m[used], triangles=triangles.reshape(-1, 3))
        )
    return surfaces


def _pieces(part: MeshPart, tolerance_m: float) -> list[Array]:
    _, axes = np.linalg.eigh(np.cov(part.vertices_m.T))
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # a mirror would turn the surface inside out
    local = part.vertices_m @ axes
    done: list[Array] = []
    waiting: list[tuple[Array, list[Cut]]] = [(local[part.triangles], [])]
    while waiting:
        corners, cuts = waiting.pop()
        points = corners.reshape(-1, 3)
        hull = _hull(points)
        low, high = points.min(axis=0), points.max(axis=0)
        small = float((high - low).max()) < _UNCUT * tolerance_m
        full = len(done) + len(waiting) + 2 > MOST_PIECES
        if hull is None or small or full or _gap_m(corners, hull, cuts) <= tolerance_m:
            done.append(_few(points if hull is None else points[hull.vertices]))
            continue
        axis = int(np.argmax(high - low))
        middle = float(low[axis] + high[axis]) / 2.0
        for side in (-1.0, 1.0):
            waiting.insert(0, (_clipped(corners, axis, middle, side), [*cuts, (axis, middle)]))
    return [hull @ axes.T for hull in done]


def _hull(points: Array) -> ConvexHull | None:
    """Return the convex hull, or None for points in a plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points)
    except QhullError:
        return None


def _few(vertices: Array) -> Array:
    """Return at most ``_MOST_VERTICES`` of a hull's vertices, spread over directions."""
    if len(vertices) <= _MOST_VERTICES:
        return vertices
    k = np.arange(_MOST_VERTICES) + 0.5
    height, turn = 1.0 - 2.0 * k / _MOST_VERTICES, np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - height**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
    return vertices[np.unique(np.argmax(vertices @ directions.T, axis=0))]


def _gap_m(corners: Array, hull: ConvexHull, cuts: list[Cut]) -> float:
    """Return the largest distance, m, from a surface (m, 3, 3) along its normal to the hull.

    Facets of the hull in cuts count as open.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    solid = length > 1e-12
    points = np.einsum("sk,mkj->smj", _WITHIN, corners[solid]).reshape(-1, 3)
    normal = np.tile(normal[solid] / length[solid, None], (len(_WITHIN), 1))

    planes = np.unique(np.round(hull.equations, 9), axis=0)
    for axis, at in cuts:
        planes = planes[
            (np.abs(planes[:, axis]) < 1.0 - 1e-6) | (np.abs(np.abs(planes[:, 3]) - abs(at)) > 1e-7)
        ]

    every = max(1, len(points) // _MOST_TRIANGLES)
    points, normal = points[::every], normal[::every]
    towards = normal @ planes[:, :3].T
    inside = np.maximum(-(points @ planes[:, :3].T + planes[:, 3]), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(towards > 1e-6, inside / towards, np.inf)
    return float(reach.min(axis=1, initial=np.inf).max(initial=0.0))


def _clipped(corners: Array, axis: int, at: float, side: float) -> Array:
    """Return the triangles (., 3, 3) of the part of ``corners`` with ``side * (x - at) >= 0``.

    x is the coordinate along ``axis``.
    """
    height = side * (corners[:, :, axis] - at)
    kept = [corners[(height >= 0.0).all(axis=1)]]
    crossing = ~((height >= 0.0).all(axis=1) | (height <= 0.0).all(axis=1))
    for triangle, h in zip(corners[crossing], height[crossing], strict=True):
        polygon = []
        for k in range(3):
            p, q, hp, hq = triangle[k], triangle[(k + 1) % 3], h[k], h[(k + 1) % 3]
            if hp >= 0.0:
                polygon.append(p)
            if (hp >= 0.0) != (hq >= 0.0):
                point = p + (q - p) * (hp / (hp - hq))
                point[axis] = at
                polygon.append(point)
        kept.append(
            np.array([[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)])
        )
    return np.concatenate(kept)


def triangles_of(vertices: Array) -> IntArray:
    """Return the triangles (m, 3) of the hull of ``vertices`` (n, 3); none for points in a
    plane.
    """
    hull = _hull(vertices)
    return (
        np.zeros((0, 3), dtype=np.int64)
        if hull is None
        else np.asarray(hull.simplices, dtype=np.int64)
    )
