# SPDX-License-Identifier: Apache-2.0
"""The tracker mesh: what flight software knows of a target's shape, and how uncertain it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import TriangleMesh, with_geometry_errors
from chaserdock_models.satellites import BOX_TRIANGLES
from chaserdock_models.targets import Box, cuboid_corners
from numpy.typing import NDArray

_CREASE_COSINE = 0.8
"""Normals are smoothed over edges of a smaller angle, 37 degrees: facets of a cylinder, not the edges of a box."""

MAX_TRIANGLES = 200_000

SCALE_SIGMA = 0.003
"""Standard deviation of the scale of a target's known shape."""


class MeshError(ValueError):
    """A mesh that cannot be tracked."""


@dataclass(frozen=True)
class TrackerMesh:
    """A closed triangle mesh with one reflectance per triangle.

    ``vertices_m`` (n, 3) in TRF; ``triangles`` (m, 3) int64, counter-clockwise seen from outside; ``reflectance`` (m,), 0 to 1.
    ``modes_m`` (k, n, 3): displacement of the vertices by one standard deviation of each of k independent errors of the
    geometry, such as the angle of a panel. Raises MeshError for arrays that are not such a mesh.
    """

    vertices_m: Array
    triangles: NDArray[np.int64]
    reflectance: Array
    modes_m: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))

    def __post_init__(self) -> None:
        vertices, triangles, reflectance = self.vertices_m, self.triangles, self.reflectance
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or not np.all(np.isfinite(vertices)):
            raise MeshError(f"vertices must be finite numbers of shape (n, 3), not {vertices.shape}")
        if triangles.ndim != 2 or triangles.shape[1:] != (3,) or not 4 <= len(triangles) <= MAX_TRIANGLES:
            raise MeshError(
                f"a tracker mesh has 4 to {MAX_TRIANGLES} triangles of shape (m, 3), not {triangles.shape}; simplify the mesh"
            )
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise MeshError(f"triangles must index the {len(vertices)} vertices")
        if reflectance.shape != (len(triangles),) or not np.all((reflectance >= 0.0) & (reflectance <= 1.0)):
            raise MeshError(f"reflectance must be {len(triangles)} numbers from 0 to 1")
        if len(self.modes_m) and self.modes_m.shape[1:] != vertices.shape:
            raise MeshError(f"modes must have shape (k, {len(vertices)}, 3), not {self.modes_m.shape}")

    @classmethod
    def of_boxes(cls, boxes: Sequence[Box], scale_sigma: float = SCALE_SIGMA) -> TrackerMesh:
        """Return the mesh of cuboids in TRF, eight vertices each; its mode is an error of the scale, if not 0."""
        vertices = np.concatenate(
            [rotations.rotate(np.array(b.q_wxyz), cuboid_corners(b.size_m)) + b.position_m for b in boxes]
        )
        triangles = np.concatenate([BOX_TRIANGLES + 8 * i for i in range(len(boxes))])
        shade = np.repeat([b.shade for b in boxes], len(BOX_TRIANGLES))
        modes = np.array([scale_sigma * vertices] if scale_sigma > 0.0 else []).reshape(-1, len(vertices), 3)
        return cls(vertices, triangles, shade, modes)

    @classmethod
    def of_mesh(cls, mesh: TriangleMesh, joint_sigma_rad: float, scale_sigma: float) -> TrackerMesh:
        """Return the tracker mesh of a body's mesh; modes: the scale of the body, and a turn of each joint about each axis."""
        counts = np.cumsum([0, *(len(part.vertices_m) for part in mesh.parts)])
        triangles = np.concatenate(
            [p.triangles + first for p, first in zip(mesh.parts, counts[:-1], strict=True)]
        )
        shade = np.repeat([p.material.diffuse for p in mesh.parts], [len(p.triangles) for p in mesh.parts])

        def vertices(of: TriangleMesh) -> Array:
            return np.concatenate([part.vertices_m for part in of.parts])

        known = vertices(mesh)
        turns = (
            [{joint: joint_sigma_rad * axis} for joint in mesh.joints for axis in np.eye(3)]
            if joint_sigma_rad
            else []
        )
        modes = [vertices(with_geometry_errors(mesh, 0.0, turn)) - known for turn in turns]
        if scale_sigma > 0.0:
            modes.append(vertices(with_geometry_errors(mesh, scale_sigma, {})) - known)
        stacked = np.array(modes).reshape(len(modes), len(known), 3)
        return cls(known, triangles.astype(np.int64), shade, stacked)

    @cached_property
    def contiguous(self) -> tuple[Array, NDArray[np.int64], Array, Array]:
        """Vertices, triangles, corner normals (m, 3, 3) and reflectance as the kernels take them."""
        return (
            np.array(self.vertices_m, dtype=float, order="C"),
            np.array(self.triangles, dtype=np.int64, order="C"),
            self._corner_normals(),
            np.array(self.reflectance, dtype=float, order="C"),
        )

    @cached_property
    def radius_m(self) -> float:
        """Radius of the sphere about TRF's origin that contains the mesh, metres."""
        return float(np.linalg.norm(self.vertices_m, axis=1).max())

    def mode_displacements(self, owners: NDArray[np.int64], points_m: Array) -> Array:
        """Return the displacements (k, n, 3) by each mode of points (n, 3) on the triangles ``owners`` (n,)."""
        if not len(self.modes_m):
            return np.zeros((0, len(points_m), 3))
        corners = self.triangles[owners]
        a, b, c = (self.vertices_m[corners[:, i]] for i in range(3))
        # Barycentric coordinates, limited to the triangle: silhouette points may lie beside it.
        ab, ac, ap = b - a, c - a, points_m - a
        d00, d01, d11 = (np.einsum("ij,ij->i", x, y) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
        d20, d21 = np.einsum("ij,ij->i", ap, ab), np.einsum("ij,ij->i", ap, ac)
        area = np.maximum(d00 * d11 - d01 * d01, 1e-18)
        v = np.clip((d11 * d20 - d01 * d21) / area, 0.0, 1.0)
        w = np.clip((d00 * d21 - d01 * d20) / area, 0.0, 1.0 - v)
        share = np.stack([1.0 - v - w, v, w], axis=1)
        return np.einsum("nc,knci->kni", share, self.modes_m[:, corners])

    def _corner_normals(self) -> Array:
        at = self.vertices_m[self.triangles]
        facing = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
        unit = facing / np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-30)
        # Vertices at one place count as one, so that meshes with split vertices are smooth as well.
        _, place = np.unique(np.round(self.vertices_m, 6), axis=0, return_inverse=True)
        corner_place = place.reshape(-1)[self.triangles].ravel()
        order = np.argsort(corner_place, kind="stable")
        starts = np.searchsorted(corner_place[order], corner_place)
        counts = np.bincount(corner_place)[corner_place]
        corner = np.repeat(np.arange(len(corner_place)), counts)
        within = np.arange(len(corner)) - np.repeat(np.cumsum(counts) - counts, counts)
        other = order[starts[corner] + within] // 3
        smooth = np.einsum("ij,ij->i", unit[corner // 3], unit[other]) > _CREASE_COSINE
        total = np.zeros((len(corner_place), 3))
        np.add.at(total, corner[smooth], facing[other[smooth]])
        length = np.linalg.norm(total, axis=1, keepdims=True)
        normals = np.where(length > 1e-30, total / np.maximum(length, 1e-30), np.repeat(unit, 3, axis=0))
        return np.ascontiguousarray(normals.reshape(-1, 3, 3))
