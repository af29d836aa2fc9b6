# SPDX-License-Identifier: Apache-2.0
"""Correct the tracker mesh by its estimated errors, and express what an image tells about them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from chaserdock_models.arrays import Array

from ..pipeline import GeometryInformation
from .mesh import TrackerMesh


@dataclass(frozen=True, eq=False)
class GeometryCorrection:
    """Estimated errors (k,) of a mesh, in standard deviations of these, and their covariance (k,
    k).
    """

    mean: Array
    covariance: Array

    @cached_property
    def factor(self) -> Array:
        """Lower Cholesky factor (k, k) of the covariance; its columns are the modes of the
        corrected mesh.
        """
        return np.asarray(np.linalg.cholesky(self.covariance), dtype=float)

    def is_of(self, mean: Array) -> bool:
        """Return whether this is the correction by ``mean`` (k,)."""
        return np.array_equal(self.mean, mean)

    def applied(self, mesh: TrackerMesh) -> TrackerMesh:
        """Return ``mesh``, which has these errors, after the correction."""
        return mesh.corrected(self.mean, self.covariance)

    def of_uncorrected(self, found: GeometryInformation) -> GeometryInformation:
        """Convert information about the corrected mesh's errors to information about the
        original's.

        With e = mean + C x for errors x of the corrected mesh, information L about x is C^-T L C^-1
        about e.
        """
        back = np.linalg.inv(self.factor)
        by_errors = found.position_by_errors @ back
        position = found.position_m - by_errors @ self.mean
        if not len(found.vector):
            return replace(found, position_m=position, position_by_errors=by_errors)
        matrix = back.T @ found.matrix @ back
        vector = back.T @ found.vector + matrix @ self.mean
        return GeometryInformation(matrix, vector, position, by_errors, found.position_covariance)
