# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes of bodies: parts, materials, joints, geometry errors, and mass properties.

A mesh consists of parts, each a closed surface of one material, with triangles counter-clockwise as
seen from outside. Flight software and world both use this module, but not the same mesh: the
world's differs from the known one by `with_geometry_errors`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from . import rotations
from .arrays import Array, IntArray, Vector3

Texture = Literal["", "insulation", "cells"]


@dataclass(frozen=True)
class Material:
    """A surface: ``diffuse`` and ``specular`` reflectance (0 to 1) with Blinn's exponent
    ``shininess``.

    ``texture``: "insulation" (wrinkled foil), "cells" (grid of solar cells), or "" for a uniform
    surface. ``relative_density``: density over that of the other parts, for mass properties.
    """

    name: str
    diffuse: float = 0.5
    specular: float = 0.0
    shininess: float = 20.0
    texture: Texture = ""
    relative_density: float = 1.0


@dataclass(frozen=True, eq=False)
class MeshPart:
    """A closed surface: ``vertices_m`` (n, 3) in body axes and ``triangles`` (m, 3), indices of
    vertices.

    ``joint``: name of the joint that the part moves with; "" if it is fixed to the body.
    """

    name: str
    material: Material
    vertices_m: Array
    triangles: IntArray
    joint: str = ""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A body: its parts, and the position (body axes, m) of each joint that some of them move
    with.
    """

    name: str
    parts: tuple[MeshPart, ...]
    joints: Mapping[str, Vector3]

    @property
    def triangle_count(self) -> int:
        return sum(len(part.triangles) for part in self.parts)

    @property
    def part_names(self) -> tuple[str, ...]:
        return tuple(part.name for part in self.parts)

    def bounds_m(self) -> tuple[Array, Array]:
        """Return the least and the largest coordinates (3,) of the vertices, body axes."""
        low = np.min([part.vertices_m.min(axis=0) for part in self.parts], axis=0)
        return low, np.max([part.vertices_m.max(axis=0) for part in self.parts], axis=0)


@dataclass(frozen=True, eq=False)
class TriangleSoup:
    """All m triangles of a mesh.

    ``corners_m``, ``normals`` (m, 3, 3): by triangle and corner. ``part`` (m,): index of the part
    that a triangle belongs to.
    """

    corners_m: Array
    normals: Array
    part: IntArray


CREASE_RAD = np.radians(35.0)
"""Triangles that meet at a larger angle have a crease between them; across smaller ones, shading is
smooth.
"""


def triangle_soup(mesh: TriangleMesh) -> TriangleSoup:
    """Return the triangles of a mesh with smooth normals inside creases of less than
    ``CREASE_RAD``.
    """
    corners = np.concatenate([part.vertices_m[part.triangles] for part in mesh.parts])
    normals = np.concatenate([_corner_normals(part) for part in mesh.parts])
    number = np.repeat(np.arange(len(mesh.parts)), [len(part.triangles) for part in mesh.parts])
    return TriangleSoup(corners, normals, number)


def _corner_normals(part: MeshPart) -> Array:
    """Return unit normals (m, 3, 3) at the corners of m triangles.

    Each is the sum, weighted by angle, over neighbours on the same side of creases.
    """
    corners = part.vertices_m[part.triangles]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(ahead, axis=2) * np.linalg.norm(behind, axis=2)
    cosine = np.einsum("ijk,ijk->ij", ahead, behind) / np.maximum(lengths, 1e-30)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    around: list[list[tuple[int, int]]] = [[] for _ in part.vertices_m]
    for i, triangle in enumerate(part.triangles.tolist()):
        for k, vertex in enumerate(triangle):
            around[vertex].append((i, k))
    out = np.empty_like(corners)
    for uses in around:
        if not uses:
            continue
        faces = [i for i, _ in uses]
        weights = np.array([angle[i, k] for i, k in uses])
        smooth = (flat[faces] @ flat[faces].T > np.cos(CREASE_RAD)) @ (
            weights[:, None] * flat[faces]
        )
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
        for (i, k), normal in zip(uses, smooth, strict=True):
            out[i, k] = normal
    return out


def without_parts(mesh: TriangleMesh, names: Iterable[str]) -> TriangleMesh:
    """Return a mesh without some parts. Raises ValueError for an unknown name, or if nothing is
    left.
    """
    names = tuple(names)
    unknown = [name for name in names if name not in mesh.part_names]
    if unknown:
        raise ValueError(
            f"{mesh.name} has no part {unknown[0]!r}; its parts: {', '.join(mesh.part_names)}"
        )
    parts = tuple(part for part in mesh.parts if part.name not in names)
    if not parts:
        raise ValueError(f"{mesh.name}: no part would be left")
    return replace(mesh, parts=parts)


def with_geometry_errors(
    mesh: TriangleMesh, scale_share: float, turns_rad: Mapping[str, Array]
) -> TriangleMesh:
    """Return a mesh whose body is larger by ``scale_share``, and whose joints are turned.

    ``turns_rad``: rotation vector (3,) in body axes by name of the joint. Parts on a joint keep
    their size and move with it.
    """
    factor = 1.0 + scale_share
    joints = {name: tuple((factor * np.array(at)).tolist()) for name, at in mesh.joints.items()}
    parts = []
    for part in mesh.parts:
        if not part.joint:
            vertices = factor * part.vertices_m
        else:
            turn = rotations.exp(np.asarray(turns_rad.get(part.joint, np.zeros(3))))
            arm = part.vertices_m - np.array(mesh.joints[part.joint])
            vertices = rotations.rotate(turn, arm) + np.array(joints[part.joint])
        parts.append(replace(part, vertices_m=vertices))
    return TriangleMesh(mesh.name, tuple(parts), joints)


def moved(mesh: TriangleMesh, offset_m: Array, factor: Array | float = 1.0) -> TriangleMesh:
    """Return a mesh scaled by ``factor`` (scalar or (3,), positive), then displaced by ``offset_m``
    (3,).
    """
    parts = tuple(replace(p, vertices_m=p.vertices_m * factor + offset_m) for p in mesh.parts)
    joints = {
        name: tuple((np.array(at) * factor + offset_m).tolist()) for name, at in mesh.joints.items()
    }
    return TriangleMesh(mesh.name, parts, joints)


def volume_m3(part: MeshPart) -> float:
    """Return the volume of a closed part; negative if its triangles are clockwise."""
    a, b, c = np.moveaxis(part.vertices_m[part.triangles], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def open_edges(part: MeshPart) -> int:
    """Return the number of edges that are not shared by two triangles of opposite direction: 0 for
    a closed surface.
    """
    return int(np.abs(_edge_balance(part)[1]).sum())


def unshared_edges(part: MeshPart) -> int:
    """Return the number of edges of one triangle only: the rims of holes and sheets."""
    ends = np.concatenate([part.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    keys = ends.min(axis=1) * len(part.vertices_m) + ends.max(axis=1)
    return int((np.unique(keys, return_counts=True)[1] == 1).sum())


def hole_m(part: MeshPart) -> Array | None:
    """Return a point (3,), body axes, of the first hole, or None: the middle of an open edge.

    An edge is open unless two triangles of opposite direction share it.
    """
    edges, balance = _edge_balance(part)
    open_ones = edges[balance != 0]
    return part.vertices_m[open_ones[0]].mean(axis=0) if len(open_ones) else None


def _edge_balance(part: MeshPart) -> tuple[IntArray, IntArray]:
    """Return the edges (n, 2), lower vertex index first, and the balance (n,) of their directions.

    Balance: number of triangles that run along an edge upwards, less those that run downwards. It
    is 0 where two triangles of opposite direction share the edge.
    """
    ends = np.concatenate(
        [part.triangles[:, [0, 1]], part.triangles[:, [1, 2]], part.triangles[:, [2, 0]]]
    ).astype(np.int64)
    upwards = ends[:, 0] < ends[:, 1]
    keys = ends.min(axis=1) * len(part.vertices_m) + ends.max(axis=1)
    unique, where = np.unique(keys, return_inverse=True)
    balance = np.bincount(
        where, weights=np.where(upwards, 1.0, -1.0), minlength=len(unique)
    ).astype(np.int64)
    return np.stack(np.divmod(unique, len(part.vertices_m)), axis=1), balance


def mass_properties(mesh: TriangleMesh, mass_kg: float) -> tuple[Array, Array]:
    """Return centre of mass (3,), m, and inertia tensor (3, 3) about it, kg m^2, body axes, of
    closed homogeneous parts.

    Exact integrals over the tetrahedra between origin and triangles (F. Tonon, 2004). Parts that
    overlap count twice. Raises ValueError if the volume is not positive.
    """
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for part in mesh.parts:
        corners = part.vertices_m[part.triangles]
        six = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        six = six * part.material.relative_density
        sums = corners.sum(axis=1)
        volume += float(six.sum()) / 6.0
        first += six @ sums / 24.0
        # Integral of x x^T over a tetrahedron with one corner at the origin.
        second += (
            np.einsum("i,ij,ik->jk", six, sums, sums)
            + np.einsum("i,icj,ick->jk", six, corners, corners)
        ) / 120.0
    if not volume > 0.0:
        raise ValueError(
            f"{mesh.name}: its volume is {volume:.3g} m³; the triangles must be counter-clockwise"
        )
    density, centre = mass_kg / volume, first / volume
    about_centre = density * second - mass_kg * np.outer(centre, centre)
    return centre, np.trace(about_centre) * np.eye(3) - about_centre
