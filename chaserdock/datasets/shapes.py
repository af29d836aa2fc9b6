# SPDX-License-Identifier: Apache-2.0
"""Shape of a target for metrics: points, diameter and symmetries."""

from __future__ import annotations

import itertools
from collections import defaultdict

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import Material, TriangleMesh
from scipy.spatial import ConvexHull, KDTree, QhullError

from .types import TargetShape

_SAME_SHARE = 0.002
"""Distance, as a share of the diameter, within which vertices count as coincident."""
_MOST_POINTS = 2000
"""Points of a shape for ADD, evenly spread over its vertices; bounds the time per image."""


def shape_of(mesh: TriangleMesh, symmetric: bool = True) -> TargetShape:
    """Return the shape of a target. Candidate symmetries are the rotations of a cube in TRF.

    ``symmetric``: False for a target with markers, which has no symmetry.
    """
    vertices = np.concatenate([part.vertices_m for part in mesh.parts])
    diameter_m = diameter_of(vertices)
    turns = _symmetries(mesh, _SAME_SHARE * diameter_m) if symmetric else np.zeros((0, 3, 3))
    return TargetShape(vertices, diameter_m, turns)


def diameter_of(points: Array) -> float:
    """Return the largest distance between two of the points (n, 3)."""
    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError:  # a flat body
        corners = points
    return max(float(np.linalg.norm(corners - corner, axis=1).max()) for corner in corners)


def sampled(points: Array) -> Array:
    """Return at most ``_MOST_POINTS`` of the points (n, 3), evenly spread over their order."""
    return points[np.unique(np.linspace(0, len(points) - 1, _MOST_POINTS).astype(np.int64))]


def _symmetries(mesh: TriangleMesh, tolerance_m: float) -> Array:
    """Return the rotations (k, 3, 3) of a cube, identity excluded, that map the vertices of each
    material onto each other.
    """
    by_material: dict[Material, list[Array]] = defaultdict(list)
    for part in mesh.parts:
        by_material[part.material].append(part.vertices_m)
    clouds = [np.concatenate(parts) for parts in by_material.values()]
    trees = [KDTree(cloud) for cloud in clouds]

    def leaves_unchanged(turn: Array) -> bool:
        return all(
            float(np.max(tree.query(cloud @ turn.T)[0])) <= tolerance_m
            for cloud, tree in zip(clouds, trees, strict=True)
        )

    found = [turn for turn in _cube_rotations() if leaves_unchanged(turn)]
    return np.array(found).reshape(-1, 3, 3)


def _cube_rotations() -> list[Array]:
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.diag(signs)[:, list(order)]
            if np.linalg.det(turn) > 0.0 and not np.array_equal(turn, np.eye(3)):
                turns.append(turn)
    return turns
