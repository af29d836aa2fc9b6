# SPDX-License-Identifier: Apache-2.0
"""Represent what the flight software knows of a target's shape, and how uncertain that is."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_int64
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.geometry_errors import error_modes
from chaserdock_models.meshes import Material, TriangleMesh
from chaserdock_models.native import address
from chaserdock_models.satellites import BOX_TRIANGLES
from chaserdock_models.targets import Box, cuboid_corners
from numpy.typing import NDArray

from ..native import function

_CREASE_COSINE = 0.8
"""Cosine of the angle, 37 degrees, up to which edges are shaded smoothly: facets of a cylinder, not
the edges of a box.
"""

MAX_TRIANGLES = 200_000
"""Most triangles of a tracker mesh: ten times as many as a mesh file may have
(``surface.MAX_TRIANGLES``). Rejects what cannot be the mesh of a scenario; each rendering takes
time for each triangle.
"""

SCALE_SIGMA = 0.003
"""Relative standard deviation of the scale of a target's known shape."""

_PLAIN_TEXTURE, _FOIL_TEXTURE = 0.1, 0.3
"""Relative standard deviation of grey levels by texture that the mesh does not have: of plain
surfaces, and of wrinkled foil.
"""
_FOIL_SLOPE = 0.35
"""Standard deviation of the slopes of wrinkled foil, which widen its highlights."""
_CELLS_BORDER_M = 0.0002
"""Standard deviation (m) of where single points of the border of solar cells are seen. The error
that they have in common is the mode ``rim``: the known mesh does not have the grid of cells.
"""
NO_PATTERN, CELLS, WRINKLES = 0, 1, 2
"""Patterns of surfaces, which the known mesh does not have."""
_SUNS, _SUN_TEXELS = 400, 64
"""Number of directions of the sun for which points are rated, 10 degrees apart, and side of their
shadow maps in texels: 6.6 MB. Of twelve views half the directions err by 0.133, twice by 0.109,
half and twice the texels by 0.102 and 0.108 instead of 0.106 % of the range.
"""
_FEW_SUNS, _FEW_SUN_TEXELS = 60, 256
"""The same for whole views with a sun behind the target, 26 degrees apart: 16 MB. Half and twice
change none of twelve views with a sun in front.
"""


class MeshError(ValueError):
    """A mesh that cannot be tracked."""


@dataclass(frozen=True)
class ShadowMaps:
    """Depth maps of a mesh towards k directions of the sun.

    ``to_sun_trf`` (k, 3): unit vectors in TRF. ``settings`` (k, 12): as in native/mesh.c.
    ``depths`` (k, size, size).
    """

    to_sun_trf: Array
    settings: Array
    depths: NDArray[np.float32]


def spread_directions(n: int) -> Array:
    """Return ``n`` unit vectors (n, 3) spread evenly over the sphere: a Fibonacci spiral."""
    k = np.arange(n)
    z, turn = 1.0 - (2.0 * k + 1.0) / n, np.pi * (3.0 - np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.ascontiguousarray(np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1))


def _surface(material: Material) -> tuple[float, float, float, float]:
    """Return reflectance, gloss, exponent and texture of a material.

    Wrinkles of foil widen its highlights and weaken them.
    """
    if material.texture != "insulation":
        return material.diffuse, material.specular, material.shininess, _PLAIN_TEXTURE
    # A lobe of exponent m has a variance of about 1 / m.
    width = 1.0 / material.shininess
    wide = width + _FOIL_SLOPE**2
    return material.diffuse, material.specular * width / wide, 1.0 / wide, _FOIL_TEXTURE


@dataclass(frozen=True)
class TrackerMesh:
    """A closed triangle mesh with one material per triangle.

    ``vertices_m`` (n, 3) in TRF; ``triangles`` (m, 3) int64, counter-clockwise seen from outside;
    ``reflectance`` (m,), 0 to 1. ``modes_m`` (k, n, 3): displacement of the vertices by one
    standard deviation of each of k independent errors of the geometry, such as the angle of a
    panel. ``gloss`` (m, 2): specular reflectance and Blinn's exponent, empty for dull surfaces;
    ``texture`` (m,): relative standard deviation of the grey levels by texture, empty for that of
    plain surfaces; ``border_m`` (m,): standard deviation of where the borders of a surface are
    seen, empty for none. Raises MeshError for arrays that are not such a mesh.
    """

    vertices_m: Array
    triangles: NDArray[np.int64]
    reflectance: Array
    modes_m: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    gloss: Array = field(default_factory=lambda: np.zeros((0, 2)))
    texture: Array = field(default_factory=lambda: np.zeros(0))
    border_m: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        vertices, triangles, reflectance = self.vertices_m, self.triangles, self.reflectance
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or not np.all(np.isfinite(vertices)):
            raise MeshError(
                f"vertices must be finite numbers of shape (n, 3), not {vertices.shape}"
            )
        if (
            triangles.ndim != 2
            or triangles.shape[1:] != (3,)
            or not 4 <= len(triangles) <= MAX_TRIANGLES
        ):
            raise MeshError(
                f"a tracker mesh has 4 to {MAX_TRIANGLES} triangles of shape (m, 3), not "
                f"{triangles.shape}; simplify the mesh"
            )
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise MeshError(f"triangles must index the {len(vertices)} vertices")

        if reflectance.shape != (len(triangles),) or not np.all(
            (reflectance >= 0.0) & (reflectance <= 1.0)
        ):
            raise MeshError(f"reflectance must be {len(triangles)} numbers from 0 to 1")

        for name, values, shape in (
            ("gloss", self.gloss, (len(triangles), 2)),
            ("texture", self.texture, (len(triangles),)),
            ("border_m", self.border_m, (len(triangles),)),
        ):
            if len(values) and not (
                values.shape == shape and np.all((values >= 0.0) & (values < 1000.0))
            ):
                raise MeshError(f"{name} must be numbers from 0 to 1000 of shape {shape}")
        if len(self.modes_m) and self.modes_m.shape[1:] != vertices.shape:
            raise MeshError(
                f"modes must have shape (k, {len(vertices)}, 3), not {self.modes_m.shape}"
            )

    @classmethod
    def of_boxes(cls, boxes: Sequence[Box], scale_sigma: float = SCALE_SIGMA) -> TrackerMesh:
        """Return the mesh of cuboids in TRF, eight vertices each.

        Its only mode is an error of the scale; none if ``scale_sigma`` is 0.
        """
        vertices = np.concatenate(
            [
                rotations.rotate(np.array(b.q_wxyz), cuboid_corners(b.size_m)) + b.position_m
                for b in boxes
            ]
        )
        triangles = np.concatenate([BOX_TRIANGLES + 8 * i for i in range(len(boxes))])
        shade = np.repeat([b.shade for b in boxes], len(BOX_TRIANGLES))
        modes = np.array([scale_sigma * vertices] if scale_sigma > 0.0 else []).reshape(
            -1, len(vertices), 3
        )
        return cls(vertices, triangles, shade, modes)

    @classmethod
    def of_mesh(cls, mesh: TriangleMesh, joint_sigma_rad: float, scale_sigma: float) -> TrackerMesh:
        """Return the tracker mesh of a body's mesh, with the modes of `error_modes`."""
        counts = np.cumsum([0, *(len(part.vertices_m) for part in mesh.parts)])
        triangles = np.concatenate(
            [p.triangles + first for p, first in zip(mesh.parts, counts[:-1], strict=True)]
        )
        surfaces = np.repeat(
            [_surface(p.material) for p in mesh.parts],
            [len(p.triangles) for p in mesh.parts],
            axis=0,
        )

        known = np.concatenate([part.vertices_m for part in mesh.parts])
        modes = error_modes(mesh, joint_sigma_rad, scale_sigma)
        border = np.repeat(
            [_CELLS_BORDER_M * (p.material.texture == "cells") for p in mesh.parts],
            [len(p.triangles) for p in mesh.parts],
        )
        return cls(
            known,
            triangles.astype(np.int64),
            surfaces[:, 0],
            modes,
            surfaces[:, 1:3],
            surfaces[:, 3],
            border,
        )

    def corrected(self, mean: Array, covariance: Array) -> TrackerMesh:
        """Return the mesh corrected by the estimate of its modes.

        ``mean`` (k,), ``covariance`` (k, k): in the present standard deviations. The new modes are
        the columns of the lower Cholesky factor of the covariance. The coarse shadow maps are kept.
        """
        factor = np.linalg.cholesky(covariance)
        new = replace(
            self,
            vertices_m=self.vertices_m + np.einsum("k,kni->ni", mean, self.modes_m),
            modes_m=np.einsum("kj,kni->jni", factor, self.modes_m),
        )
        new.__dict__.update({k: v for k, v in self.__dict__.items() if k in ("suns", "few_suns")})
        return new

    @cached_property
    def contiguous(self) -> tuple[Array, NDArray[np.int64], Array, Array]:
        """Mesh as kernels take it: vertices, triangles, corner normals (m, 3, 3) and surfaces (m,
        3).

        Surfaces: reflectance, gloss, exponent.
        """
        gloss = self.gloss if len(self.gloss) else np.zeros((len(self.triangles), 2))
        return (
            np.array(self.vertices_m, dtype=float, order="C"),
            np.array(self.triangles, dtype=np.int64, order="C"),
            self._corner_normals(),
            np.ascontiguousarray(np.column_stack([self.reflectance, gloss]), dtype=float),
        )

    @cached_property
    def texture_share(self) -> Array:
        """Relative standard deviation (m,) of the grey levels of each triangle by texture."""
        return self.texture if len(self.texture) else np.full(len(self.triangles), _PLAIN_TEXTURE)

    def border_of(self, owners: NDArray[np.int64]) -> Array:
        """Return the standard deviation (n,), m, of where the borders of triangles ``owners`` (n,)
        are seen.
        """
        return self.border_m[owners] if len(self.border_m) else np.zeros(len(owners))

    @cached_property
    def patterns(self) -> NDArray[np.int64]:
        """Pattern (m,) of the surface of each triangle: none, solar cells, or wrinkles."""
        cells = (
            self.border_m > 0.0 if len(self.border_m) else np.zeros(len(self.triangles), dtype=bool)
        )
        wrinkled = self.texture_share >= _FOIL_TEXTURE
        return np.where(cells, CELLS, np.where(wrinkled, WRINKLES, NO_PATTERN))

    @cached_property
    def mean_normals(self) -> Array:
        """Unit normal (m, 3) of each triangle, the mean of its corners'."""
        mean = self.contiguous[2].mean(axis=1)
        return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-30)

    @cached_property
    def suns(self) -> ShadowMaps:
        """Shadow maps of directions all around, made when first used."""
        return self.shadow_maps(spread_directions(_SUNS), _SUN_TEXELS)

    @cached_property
    def few_suns(self) -> ShadowMaps:
        """Shadow maps of fewer directions all around, made when first used."""
        return self.shadow_maps(spread_directions(_FEW_SUNS), _FEW_SUN_TEXELS)

    def shadow_maps(self, to_sun_trf: Array, texels: int) -> ShadowMaps:
        """Return a shadow map of ``texels`` squared for each of k unit vectors (k, 3) to the sun in
        TRF.
        """
        k = len(to_sun_trf)
        axis = np.eye(3)[np.argmin(np.abs(to_sun_trf), axis=1)]
        right = np.cross(axis, to_sun_trf)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        per_m = 0.49 * texels / self.radius_m
        settings = np.empty((k, 12))
        settings[:, :9] = np.stack(
            [right, np.cross(to_sun_trf, right), to_sun_trf], axis=1
        ).reshape(k, 9)
        settings[:, 9:] = per_m, texels, 1.5 / per_m
        depths = np.empty((k, texels, texels), np.float32)
        vertices, triangles, _, _ = self.contiguous
        for row, depth in zip(settings, depths, strict=True):
            function("shadow_map")(
                (c_double * 12)(*row), address(vertices), address(triangles),
                c_int64(len(triangles)), address(depth)
            )  # fmt: skip
        return ShadowMaps(np.array(to_sun_trf, dtype=float, order="C"), settings, depths)

    @cached_property
    def radius_m(self) -> float:
        """Radius of the sphere about TRF's origin that contains the mesh, metres."""
        return float(np.linalg.norm(self.vertices_m, axis=1).max())

    def mode_displacements(self, owners: NDArray[np.int64], points_m: Array) -> Array:
        """Return the displacements (k, n, 3), m, of points (n, 3) on triangles ``owners`` (n,) by
        each mode.
        """
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
        normals = np.where(
            length > 1e-30, total / np.maximum(length, 1e-30), np.repeat(unit, 3, axis=0)
        )
        return np.ascontiguousarray(normals.reshape(-1, 3, 3))
