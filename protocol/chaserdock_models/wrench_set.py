# SPDX-License-Identifier: Apache-2.0
"""The set of wrenches that a thruster layout can produce. Pure functions; SI units, body axes
(CRF).

The set {B f, 0 <= f <= f_max} is a zonotope. Each of its facets is parallel to five of the
thrusters' wrenches, so the normals of all facets follow from all combinations of five (P. McMullen,
"On zonotopes", Trans. AMS 159, 1971).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .arrays import Array


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

    ``matrix`` (6, n): from ``wrench_matrix``. ``normals`` (K, 6): of all facets, independent of the
    thrust limits.
    """

    matrix: Array
    normals: Array

    def box_scale(self, thrust_max_N: Array, box: Array) -> float:
        """Return the largest s for which every wrench within +-s * ``box`` (6,) is feasible with
        thrusts up to (n,).

        0 if some direction of force and torque is infeasible.
        """
        if not len(self.normals):
            return 0.0
        along = (self.normals @ self.matrix) * thrust_max_N
        reach = np.abs(self.normals) @ box
        support = np.minimum(
            np.maximum(along, 0.0).sum(axis=1), np.maximum(-along, 0.0).sum(axis=1)
        )
        return float(np.min(support / reach))


def wrench_set(matrix: Array) -> WrenchSet:
    """Return the wrench set of a layout (6, n). A layout that does not span all six dimensions has
    no normals.
    """
    n = matrix.shape[1]
    scale = np.abs(matrix).max(axis=1) if n else np.zeros(6)
    if (
        n < 6
        or np.any(scale == 0.0)
        or np.linalg.matrix_rank(matrix / scale[:, None], tol=1e-9) < 6
    ):
        return WrenchSet(matrix, np.zeros((0, 6)))
    fives = (matrix / scale[:, None]).T[np.array(list(itertools.combinations(range(n), 5)))]
    # The generalized cross product of five vectors: the signed minors.
    normals = np.stack(
        [(-1) ** i * np.linalg.det(np.delete(fives, i, axis=2)) for i in range(6)], axis=1
    )
    lengths = np.linalg.norm(normals, axis=1)
    kept = lengths > 1e-9 * lengths.max()
    return WrenchSet(matrix, normals[kept] / lengths[kept, None] / scale)
