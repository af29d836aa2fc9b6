# SPDX-License-Identifier: Apache-2.0
"""The set of wrenches that a thruster layout can produce. Pure functions; SI units, body axes
(CRF).

The set {B f, 0 <= f <= f_max} is a zonotope. Each of its facets is parallel to five of the
thrusters' wrenches, so the normals of all facets follow from all combinations of five (P. McMullen,
"On zonotopes", Trans. AMS 159, 1971). Of a body that moves along k axes only these components of
the wrenches count, and facets are parallel to k - 1 of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .arrays import Array, IntArray

ALL_AXES = range(6)
"""Components of a wrench: force along x, y and z, torque about x, y and z."""


class ThrusterMount(Protocol):
    """Position (m) and unit direction of force of a thruster, CRF."""

    @property
    def position_m(self) -> tuple[float, float, float]: ...

    @property
    def direction(self) -> tuple[float, float, float]: ...


def wrench_matrix(thrusters: Sequence[ThrusterMount]) -> Array:
    """Return the matrix (6, n) of force and torque about the centre of mass for 1 N of each
    thruster.
    """
    directions = np.array([thruster.direction for thruster in thrusters], dtype=float).reshape(
        -1, 3
    )
    positions = np.array([thruster.position_m for thruster in thrusters], dtype=float).reshape(
        -1, 3
    )
    return np.concatenate([directions.T, np.cross(positions, directions).T])


@dataclass(frozen=True, eq=False)
class WrenchSet:
    """The wrenches that a thruster layout can produce.

    ``matrix`` (k, n): from ``wrench_matrix``, the rows of ``axes`` (k,). ``normals`` (K, k): of all
    facets, independent of the thrust limits.
    """

    matrix: Array
    normals: Array
    axes: IntArray

    def box_scale(self, thrust_max_N: Array, box: Array) -> float:
        """Return the largest s for which every wrench within +-s * ``box`` (6,) is feasible with
        thrusts up to (n,); of the box, only the components of ``axes`` count.

        0 if some direction of force and torque is infeasible.
        """
        if not len(self.normals):
            return 0.0
        along = (self.normals @ self.matrix) * thrust_max_N
        reach = np.abs(self.normals) @ box[self.axes]
        support = np.minimum(
            np.maximum(along, 0.0).sum(axis=1), np.maximum(-along, 0.0).sum(axis=1)
        )
        return float(np.min(support / reach))


def wrench_set(matrix: Array, axes: Sequence[int] | IntArray = ALL_AXES) -> WrenchSet:
    """Return the set of the wrenches of a layout (6, n) along ``axes``, the rows that count.

    A layout that does not span all of these axes has no normals.
    """
    axes = np.asarray(axes, dtype=np.int64)
    k, n = len(axes), matrix.shape[1]
    matrix = matrix[axes]
    scale = np.abs(matrix).max(axis=1) if n else np.zeros(k)
    if (
        n < k
        or np.any(scale == 0.0)
        or np.linalg.matrix_rank(matrix / scale[:, None], tol=1e-9) < k
    ):
        return WrenchSet(matrix, np.zeros((0, k)), axes)
    sides = (matrix / scale[:, None]).T[np.array(list(itertools.combinations(range(n), k - 1)))]
    # The generalized cross product of k - 1 vectors: the signed minors.
    normals = np.stack(
        [(-1) ** i * np.linalg.det(np.delete(sides, i, axis=2)) for i in range(k)], axis=1
    )
    lengths = np.linalg.norm(normals, axis=1)
    kept = lengths > 1e-9 * lengths.max()
    return WrenchSet(matrix, normals[kept] / lengths[kept, None] / scale, axes)
