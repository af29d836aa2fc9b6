# SPDX-License-Identifier: Apache-2.0
"""Reduce the triangles of a mesh by quadric edge collapse, and measure the deviation that this
causes.

M. Garland, P. Heckbert: Surface Simplification Using Quadric Error Metrics, 1997, as in the package
fast-simplification.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .arrays import Array, IntArray
from .meshes import MeshPart, TriangleMesh, open_edges

_SAMPLES = 8_000
"""Approximate number of points on a surface by which a query finds nearby triangles. More: a more
certain bound; fewer: less time.
"""
_QUERIES = 6_000
"""Approximate number of points of a surface whose distance from the other one is computed. About as
many as samples, so that both directions cost the same.
"""
_NEAR = 6
"""Nearest samples of a query whose triangles are measured: as many as surround a point in a
triangular grid.
"""
_LEAST = 12
"""Fewest triangles of a part: those of a cuboid."""
_BISECTIONS = 5
"""Steps of the search for a number of triangles. Each halves the range of its logarithm; five leave
a factor of about 1.3 between 12 and 20,000 triangles.
"""


def deviation_m(part: MeshPart, other: MeshPart) -> float:
    """Return the largest distance (m) of vertices and triangle centres of either surface from the
    other.

    Of large meshes every n-th point is used. The result is an upper bound at these points: the
    distance is exact for the triangles near each of them.
    """
    return max(_one_sided(part, other), _one_sided(other, part))


def _one_sided(part: MeshPart, other: MeshPart) -> float:
    from scipy.spatial import KDTree  # slow to import, and needed for meshes of files only

    points = np.concatenate([part.vertices_m, part.vertices_m[part.triangles].mean(axis=1)])
    points = points[:: max(1, len(points) // _QUERIES)]
    corners = other.vertices_m[other.triangles]
    samples, owner = _surface_samples(corners)
    near = owner[
        KDTree(samples).query(points, k=min(_NEAR, len(samples)))[1].reshape(len(points), -1)
    ]
    distance = _point_triangle(np.repeat(points[:, None], near.shape[1], axis=1), corners[near])
    return float(distance.min(axis=1).max())


def _surface_samples(corners: Array) -> tuple[Array, IntArray]:
    """Return points (n, 3) spread over triangles (m, 3, 3), and the triangle (n,) of each."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = (
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        / 2
    )
    spacing = max(float(np.sqrt(area.sum() / _SAMPLES)), 1e-12)
    steps = np.clip(np.ceil(edges / spacing), 1, 40).astype(int)
    points, owner = [], []
    for n in np.unique(steps):
        rows = np.flatnonzero(steps == n)
        i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
        inside = i + j < n
        u, v = (i[inside] + 1 / 3) / n, (j[inside] + 1 / 3) / n
        weights = np.stack([1 - u - v, u, v], axis=1)
        points.append(np.einsum("sk,mkj->msj", weights, corners[rows]).reshape(-1, 3))
        owner.append(np.repeat(rows, len(u)))
    return np.concatenate(points), np.concatenate(owner)


def _point_triangle(points: Array, corners: Array) -> Array:
    """Return the distances (...) of points (..., 3) from triangles (..., 3, 3)."""
    a, b, c = (corners[..., k, :] for k in range(3))
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal**2).sum(axis=-1), 1e-60)
    inside = np.ones(points.shape[:-1], dtype=bool)
    edge = np.full(points.shape[:-1], np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        along, to = q - p, points - p
        inside &= (np.cross(along, to) * normal).sum(axis=-1) >= 0.0
        share = (along * to).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-60)
        nearest = p + np.clip(share, 0.0, 1.0)[..., None] * along
        edge = np.minimum(edge, np.linalg.norm(points - nearest, axis=-1))
    height = np.abs(((points - a) * normal).sum(axis=-1)) / np.sqrt(square)
    return np.where(inside, height, edge)


def decimated(part: MeshPart, count: int) -> MeshPart:
    """Return a closed part with about ``count`` triangles.

    Returns the part itself where fewer triangles would leave holes.
    """
    import fast_simplification  # slow to import, and needed for meshes of files only

    vertices, triangles, *_ = fast_simplification.simplify(
        part.vertices_m, part.triangles.astype(np.int32), target_count=max(count, _LEAST)
    )
    out = replace(
        part,
        vertices_m=np.asarray(vertices, dtype=float),
        triangles=np.asarray(triangles, dtype=np.int64),
    )
    return out if len(triangles) >= 4 and not open_edges(out) else part


def limited(mesh: TriangleMesh, triangles: int) -> tuple[TriangleMesh, float]:
    """Return a mesh with at most about ``triangles`` triangles, and its deviation (m).

    Each part keeps its share of the triangles, and at least ``_LEAST``.
    """
    if mesh.triangle_count <= triangles:
        return mesh, 0.0
    share = triangles / mesh.triangle_count
    parts = tuple(decimated(p, int(share * len(p.triangles))) for p in mesh.parts)
    moved = [deviation_m(p, q) for p, q in zip(mesh.parts, parts, strict=True) if p is not q]
    return replace(mesh, parts=parts), max(moved, default=0.0)


def simplified(mesh: TriangleMesh, tolerance_m: float) -> TriangleMesh:
    """Return a mesh with fewer triangles whose surface deviates from the given one by at most
    ``tolerance_m``.
    """
    return replace(mesh, parts=tuple(_simplified_part(p, tolerance_m) for p in mesh.parts))


def _simplified_part(part: MeshPart, tolerance_m: float) -> MeshPart:
    best, low, high = part, _LEAST, len(part.triangles)
    for _ in range(_BISECTIONS):
        count = int(np.sqrt(low * high))
        if count >= len(best.triangles):
            break
        trial = decimated(part, count)
        if trial is not part and deviation_m(part, trial) <= tolerance_m:
            best, high = trial, count
        else:
            low = count + 1
    return best
