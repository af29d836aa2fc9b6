# SPDX-License-Identifier: Apache-2.0
"""Make a closed surface of a mapped target from its landmarks and from where they were seen.

Tetrahedra between the landmarks (Delaunay) are empty where lines of sight cross them; the boundary
of the others is the surface. Source: Q. Pan, G. Reitmayr and T. Drummond, "ProFORMA: Probabilistic
Feature-based On-line Rapid Model Acquisition", BMVC 2009. What no camera has seen is not empty: its
faces are marked, and stand for what may be behind them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from numpy.typing import NDArray
from scipy.spatial import Delaunay

_LEAST_LANDMARKS = 20
"""Landmarks below which nothing is said of a surface: a dozen faces describe no satellite."""
_LEAST_CROSSINGS = 3
"""Landmarks whose lines of sight must cross a tetrahedron to make it empty: one of a hundred is at
the wrong place. With a least length of the crossing as well, fins stay in gaps."""
_DEPTH_SIGMAS = 3.0
"""A line of sight ends this many standard deviations before its landmark."""
_DEPTH_M = 0.005
"""It ends this far before it at least, m: landmarks lie 4 mm from the surface in the median."""
_GRAZING = 0.17
"""Cosine of the angle between a face's normal and a line of sight up to which its vertices count as
seen from outside: 80 degrees."""
MOST_SIGHTS = 6
"""Lines of sight of each landmark, spread over the flight: three landmarks must have one through a
place to make it empty."""


@dataclass(frozen=True, eq=False)
class SightLines:
    """Lines of sight to landmarks: numbers (k,) of the landmarks, and the places (k, 3) of the
    cameras, TRF.
    """

    landmarks: IntArray
    cameras_m: Array

    def thinned(self, most: int = MOST_SIGHTS) -> SightLines:
        """Return at most so many lines of sight of each landmark, spread over their order."""
        order = np.argsort(self.landmarks, kind="stable")
        counts = np.bincount(self.landmarks)
        counts = counts[counts > 0]
        chosen = [
            start + np.unique(np.linspace(0, count - 1, most).astype(int))
            for start, count in zip(np.cumsum(counts) - counts, counts, strict=True)
        ]
        kept = order[np.concatenate([np.zeros(0, dtype=np.int64), *chosen])]
        return SightLines(self.landmarks[kept], self.cameras_m[kept])


@dataclass(frozen=True, eq=False)
class MappedSurface:
    """A closed surface in TRF: vertices (n, 3), triangles (m, 3) with outward normals, whether each
    was seen from outside (m,), and the standard deviation (n,) of each vertex, m.
    """

    vertices_m: Array
    triangles: IntArray
    seen: NDArray[np.bool_]
    sigma_m: Array

    def normals(self) -> Array:
        """Return the outward unit normal of each triangle (m, 3)."""
        a, b, c = (self.vertices_m[self.triangles[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    @cached_property
    def dense_m(self) -> Array:
        """Vertices, middles of edges and of triangles, and points between (k, 3): long triangles
        have no vertex near a place that they cross.
        """
        corners = self.vertices_m[self.triangles]
        shares = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)]) / 4.0
        return np.einsum("sk,tkd->tsd", shares, corners).reshape(-1, 3)

    def volume_m3(self) -> float:
        """Return the enclosed volume."""
        a, b, c = (self.vertices_m[self.triangles[:, k]] for k in range(3))
        return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6.0


def surface_of(
    landmarks_m: Array, covariances_m2: Array, sights: SightLines
) -> MappedSurface | None:
    """Return the surface of landmarks (n, 3), TRF, with covariances (n, 3, 3); None of too few.

    Every landmark stays a vertex only if it is on the boundary. A few lines of sight per landmark
    suffice.
    """
    if len(landmarks_m) < _LEAST_LANDMARKS:
        return None
    mesh = Delaunay(landmarks_m)
    tetrahedra = mesh.simplices.astype(np.int64)
    faces, owners = _sides(tetrahedra)
    ends, starts = _shortened(landmarks_m, covariances_m2, sights)
    crossed = _crossed(mesh, ends, starts - ends)
    by_landmark = np.unique(
        np.column_stack([sights.landmarks[crossed[:, 0]], crossed[:, 1]]), axis=0
    )
    crossings = np.bincount(by_landmark[:, 1], minlength=len(tetrahedra))
    solid = crossings < _LEAST_CROSSINGS
    triangles = _boundary(landmarks_m, tetrahedra, faces, owners, solid)
    if not len(triangles):
        return None
    used, renamed = np.unique(triangles, return_inverse=True)
    sigma = np.sqrt(np.linalg.eigvalsh(covariances_m2[used])[:, -1])
    unseen = np.zeros(len(triangles), dtype=np.bool_)
    surface = MappedSurface(
        landmarks_m[used], renamed.reshape(-1, 3).astype(np.int64), unseen, sigma
    )
    return replace(surface, seen=_seen(surface.normals(), triangles, landmarks_m, sights))


def _sides(tetrahedra: IntArray) -> tuple[IntArray, IntArray]:
    """Return each face once, (f, 3), and the tetrahedra beside it, (f, 2), -1 for none."""
    sides = np.sort(
        tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1
    )
    faces, which = np.unique(sides, axis=0, return_inverse=True)
    owners = np.full((len(faces), 2), -1, dtype=np.int64)
    order = np.argsort(which.ravel(), kind="stable")
    sorted_faces = which.ravel()[order]
    first = np.r_[True, sorted_faces[1:] != sorted_faces[:-1]]
    owners[sorted_faces[first], 0] = order[first] // 4
    owners[sorted_faces[~first], 1] = order[~first] // 4
    return faces, owners


def _crossed(mesh: Delaunay, origins_m: Array, along_m: Array) -> IntArray:
    """Return pairs (k, 2) of a line (n,) and a tetrahedron that it crosses. Lines lead from
    ``origins_m`` (n, 3) by ``along_m`` (n, 3); those that begin outside cross none.

    All lines walk at once, from each tetrahedron through the face by which they leave it.
    """
    corners = mesh.points[mesh.simplices]
    # Of the face opposite to each corner: its own corners, and its outward normal.
    a, b, c = (corners[:, [(k + step) % 4 for k in range(4)]] for step in (1, 2, 3))
    normals = np.cross(b - a, c - a)
    normals[np.einsum("tkj,tkj->tk", normals, corners - a) > 0.0] *= -1.0
    offsets = np.einsum("tkj,tkj->tk", normals, a)
    line = np.arange(len(origins_m))
    at = mesh.find_simplex(origins_m).astype(np.int64)
    pairs = []
    for _ in range(len(corners)):
        inside = at >= 0
        line, at = line[inside], at[inside]
        if not len(line):
            break
        pairs.append(np.column_stack([line, at]))
        speed = np.einsum("nkj,nj->nk", normals[at], along_m[line])
        room = offsets[at] - np.einsum("nkj,nj->nk", normals[at], origins_m[line])
        share = np.where(speed > 0.0, room / np.where(speed > 0.0, speed, 1.0), np.inf)
        face = np.argmin(share, axis=1)
        rows = np.arange(len(line))
        at = np.where(share[rows, face] < 1.0, mesh.neighbors[at, face], -1).astype(np.int64)
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])


def _shortened(
    landmarks_m: Array, covariances_m2: Array, sights: SightLines
) -> tuple[Array, Array]:
    """Return where lines of sight end, before their landmarks, and where they begin, (k, 3)."""
    at = landmarks_m[sights.landmarks]
    away = sights.cameras_m - at
    far_m = np.linalg.norm(away, axis=1, keepdims=True)
    towards = away / far_m
    covariances = covariances_m2[sights.landmarks]
    sigma_m = np.sqrt(np.einsum("ki,kij,kj->k", towards, covariances, towards))
    short_m = np.minimum(_DEPTH_M + _DEPTH_SIGMAS * sigma_m, far_m[:, 0])
    return at + short_m[:, None] * towards, sights.cameras_m


def met_triangles(origin_m: Array, direction: Array, corners: Array) -> tuple[IntArray, Array]:
    """Return which triangles (f, 3, 3) a ray meets, (k,), and at which multiples of ``direction``
    (3,), not negative, (k,).

    Source: T. Moeller and B. Trumbore, "Fast, minimum storage ray-triangle intersection", 1997.
    """
    a = corners[:, 0]
    along_b, along_c = corners[:, 1] - a, corners[:, 2] - a
    across = np.cross(direction, along_c)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.einsum("ij,ij->i", along_b, across)
        off = origin_m - a
        u = np.einsum("ij,ij->i", off, across) * inverse
        turned = np.cross(off, along_b)
        v = turned @ direction * inverse
        t = np.einsum("ij,ij->i", along_c, turned) * inverse
        met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t >= 0.0)
    return np.flatnonzero(met), t[met]


def _boundary(
    landmarks_m: Array,
    tetrahedra: IntArray,
    faces: IntArray,
    owners: IntArray,
    solid: NDArray[np.bool_],
) -> IntArray:
    """Return the faces between solid tetrahedra and others, (m, 3), with outward normals."""
    inside = np.where(owners >= 0, solid[owners], False)
    at = np.flatnonzero(inside[:, 0] != inside[:, 1])
    triangles = faces[at].copy()
    owner = np.where(inside[at, 0], owners[at, 0], owners[at, 1])
    centre = landmarks_m[tetrahedra[owner]].mean(axis=1)
    a, b, c = (landmarks_m[triangles[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - centre)
    triangles[outward < 0.0] = triangles[outward < 0.0][:, [0, 2, 1]]
    return triangles


def _seen(
    normals: Array, triangles: IntArray, landmarks_m: Array, sights: SightLines
) -> NDArray[np.bool_]:
    """Return whether each vertex of a triangle was seen from the side of its normal, (m,)."""
    away = sights.cameras_m - landmarks_m[sights.landmarks]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    seen = np.ones(len(triangles), dtype=np.bool_)
    order = np.argsort(sights.landmarks, kind="stable")
    by_landmark = np.split(
        away[order], np.searchsorted(sights.landmarks[order], np.arange(1, len(landmarks_m)))
    )
    for k, triangle in enumerate(triangles):
        seen[k] = all(
            len(by_landmark[i]) > 0 and float((by_landmark[i] @ normals[k]).max()) > _GRAZING
            for i in triangle
        )
    return seen
