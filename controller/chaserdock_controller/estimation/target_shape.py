# SPDX-License-Identifier: Apache-2.0
"""Errors of the target's known geometry, fused over views from all around by an information filter.

A view has information on the geometry for any pose (the Schur complement of the tracker's least squares). Views from one direction
err alike, by texture and shading that the known mesh does not have, and count once. The parameters are in their standard deviations;
prior: 0 with covariance 1.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.geometry_errors import GeometryParameter, geometry_parameters
from chaserdock_protocol.messages import Sighting
from chaserdock_protocol.scenario import FlightScenario
from msgspec import Struct

from chaserdock_controller.interfaces import EstimatedShape, Observation

VIEW_CELLS = 80
"""Number of directions of view that are distinguished, about 25 degrees from each other."""
FLOOR_SIGMAS = 0.15
"""Standard deviation, as a share of the prior one, of what the views of a target have in common."""
_GATE_SIGMAS = 4.0


def _spiral() -> Array:
    k = np.arange(VIEW_CELLS)
    z, turn = 1.0 - (2.0 * k + 1.0) / VIEW_CELLS, math.pi * (3.0 - math.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


_CELLS = _spiral()
"""Directions (VIEW_CELLS, 3) on a Fibonacci spiral."""


def view_cell(direction_trf: Array) -> int:
    """Return the number of the cell of a direction (3,), a unit vector from the target in TRF."""
    return int(np.argmax(_CELLS @ direction_trf))


class ShapeFilter(Struct, frozen=True, eq=False):
    """Information (k, k) and information vector (k,) of the parameters, and the cells of the views that were used."""

    information: Array
    vector: Array
    cells: frozenset[int] = frozenset()

    @classmethod
    def prior(cls, count: int) -> ShapeFilter:
        """Return the filter before the first view of ``count`` parameters."""
        return cls(np.eye(count), np.zeros(count))

    @property
    def coverage(self) -> float:
        """Share of all directions of view that were used."""
        return len(self.cells) / VIEW_CELLS

    def mean(self) -> Array:
        """Return the estimated parameters (k,)."""
        return np.asarray(np.linalg.solve(self.information, self.vector), dtype=float)

    def covariance(self) -> Array:
        """Return the covariance (k, k), with what all views have in common, but nowhere larger than the prior."""
        covariance = np.asarray(np.linalg.inv(self.information), dtype=float)
        if not self.cells:
            return covariance
        # Both have the prior information in them: the sum is that of the views and their common errors.
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        return (vectors * np.minimum(values + FLOOR_SIGMAS**2, 1.0)) @ vectors.T

    def with_view(self, direction_trf: Array, matrix: Array, vector: Array) -> ShapeFilter:
        """Return the filter after a view from a direction (3,); itself for a known direction, or a view that contradicts it."""
        cell = view_cell(direction_trf)
        if cell in self.cells or self._contradicts(matrix, vector):
            return self
        return ShapeFilter(self.information + matrix, self.vector + vector, self.cells | {cell})

    def _contradicts(self, matrix: Array, vector: Array) -> bool:
        """Return whether a view's estimate is farther from this one than their covariances explain."""
        values, vectors = np.linalg.eigh(matrix)
        informed = values > 0.05 * max(float(values[-1]), 1e-12)
        basis = vectors[:, informed]
        estimate = (basis.T @ vector) / values[informed]
        spread = basis.T @ self.covariance() @ basis + np.diag(1.0 / values[informed])
        off = estimate - basis.T @ self.mean()
        return float(off @ np.linalg.solve(spread, off)) > _GATE_SIGMAS**2 * len(off)


def shape_parameters(scenario: FlightScenario) -> tuple[GeometryParameter, ...]:
    """Return the errors of the target's known geometry; none without a mesh, or for a perception that does not use it."""
    mesh, knowledge = scenario.target.known_mesh(), scenario.target.knowledge
    if mesh is None or scenario.perception.name != "model":
        return ()
    return geometry_parameters(mesh, math.radians(knowledge.panel_deg), knowledge.scale_share)


class ShapeEstimation:
    """Fuses the images of chasers that inspect the target."""

    def __init__(self, parameters: tuple[GeometryParameter, ...]) -> None:
        self.parameters = parameters
        self.filter = ShapeFilter.prior(len(parameters))

    def update(self, observation: Observation, inspecting: Collection[int]) -> EstimatedShape | None:
        """Return the estimate after a tick; None before the first view."""
        before = self.filter
        for sighting in observation.sightings:
            if sighting.chaser in inspecting:
                self.filter = self._with(sighting)
        if not self.filter.cells:
            return None
        return EstimatedShape(
            self.parameters,
            self.filter.mean(),
            self.filter.covariance(),
            len(self.filter.cells),
            self.filter.coverage,
            self.filter is not before,
        )

    def _with(self, sighting: Sighting) -> ShapeFilter:
        """Return the filter with a sighting; without it where it has no information on these parameters."""
        measured, k = sighting.geometry, len(self.parameters)
        if (
            measured is None
            or not sighting.solutions
            or (len(measured.vector), len(measured.information)) != (k, k * k)
        ):
            return self.filter
        pose = sighting.solutions[0]
        direction = -rotations.rotate_inverse(np.array(pose.q_wxyz), np.array(pose.position_m))
        matrix, vector = np.array(measured.information).reshape(k, k), np.array(measured.vector)
        if not (np.isfinite(matrix).all() and np.isfinite(vector).all() and np.isfinite(direction).all()):
            return self.filter
        return self.filter.with_view(direction / np.linalg.norm(direction), matrix, vector)
