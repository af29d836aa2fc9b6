# SPDX-License-Identifier: Apache-2.0
"""Errors of the target's known geometry, fused over views from all sides by an information filter.

A view carries information on the geometry for any pose: the Schur complement of the tracker's least
squares. Views from one direction have similar errors, caused by texture and shading that the mesh
lacks, and count once. Parameters are in units of their standard deviations; prior: 0 with
covariance 1. The scale follows from the distance of two cameras, as their images show it and as
odometry measures it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.geometry_errors import GeometryParameter, geometry_parameters
from chaserdock_protocol.messages import GeometryMeasurement, PoseSolution, Sighting
from chaserdock_protocol.scenario import FlightScenario
from msgspec import Struct
from msgspec.structs import replace

from chaserdock_controller.interfaces import EstimatedShape, Observation

VIEW_CELLS = 80
"""Number of directions of view that are distinguished, about 25 degrees from each other."""
FLOOR_SIGMAS = 0.15
"""Standard deviation that all views have in common, as a share of the prior one."""
_GATE_SIGMAS = 4.0
"""Gate of a pair of views, in standard deviations: rejects 1 of 16,000 consistent ones."""
_LEAST_BASELINE = 0.3
"""Least distance of two cameras, as a share of the range, for their images to determine the
scale.
"""


def _spiral() -> Array:
    k = np.arange(VIEW_CELLS)
    z, turn = 1.0 - (2.0 * k + 1.0) / VIEW_CELLS, math.pi * (3.0 - math.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


_CELLS = _spiral()
"""Directions (VIEW_CELLS, 3) on a Fibonacci spiral."""


def view_cell(direction_trf: Array) -> int:
    """Return the number of the cell that contains a direction (3,): a unit vector from the target,
    TRF.
    """
    return int(np.argmax(_CELLS @ direction_trf))


class SeenPlace(Struct, frozen=True, eq=False):
    """Place from which an image shows the target.

    The place (3,) of the lens in TRF for exact geometry; its change (3, k) by the geometry's
    errors; its covariance (3, 3) for known errors; the cell of the direction of view.
    """

    place_m: Array
    by_errors: Array
    covariance: Array
    cell: int


class ShapeFilter(Struct, frozen=True, eq=False):
    """Information (k, k) and information vector (k,) of the geometry parameters, prior included,
    from single views; and the cells of the views that were used.

    ``baselines`` (k + 1, k + 1) and ``lengths`` (k + 1,): the same from pairs of views, whose
    distance odometry measures. The last parameter is the error that all these distances share, in
    units of its standard deviation. ``pairs``: cells of the pairs that were used.
    """

    information: Array
    vector: Array
    baselines: Array
    lengths: Array
    cells: frozenset[int] = frozenset()
    pairs: frozenset[tuple[int, int]] = frozenset()

    @classmethod
    def prior(cls, count: int) -> ShapeFilter:
        """Return the filter of ``count`` parameters before the first view."""
        both = count + 1
        return cls(np.eye(count), np.zeros(count), np.zeros((both, both)), np.zeros(both))

    @property
    def coverage(self) -> float:
        """Return the share of all directions of view that were used."""
        return len(self.cells) / VIEW_CELLS

    @property
    def used(self) -> bool:
        """Return whether any view was used."""
        return bool(self.cells or self.pairs)

    def mean(self) -> Array:
        """Return the estimated parameters (k,)."""
        matrix, vector = self._combined()
        return np.asarray(np.linalg.solve(matrix, vector), dtype=float)[:-1]

    def covariance(self) -> Array:
        """Return the covariance (k, k), including the error that all views share."""
        covariance = np.asarray(np.linalg.inv(self._combined()[0]), dtype=float)[:-1, :-1]
        return 0.5 * (covariance + covariance.T)

    def _combined(self) -> tuple[Array, Array]:
        """Return information (k + 1, k + 1) and vector (k + 1,) of all parameters from prior, views
        and baselines.
        """
        k = len(self.vector)
        values, vectors = np.linalg.eigh(self.information - np.eye(k))
        values = np.maximum(values, 0.0)
        known = 1.0 / (1.0 + FLOOR_SIGMAS**2 * values)
        matrix, vector = self.baselines + np.eye(k + 1), self.lengths.copy()
        matrix[:k, :k] += (vectors * (values * known)) @ vectors.T
        vector[:k] += vectors @ (known * (vectors.T @ self.vector))
        return matrix, vector

    def with_view(self, direction_trf: Array, matrix: Array, vector: Array) -> ShapeFilter:
        """Return the filter after a view from a direction (3,). It is unchanged if the direction
        was used before or the view contradicts the estimate.
        """
        cell = view_cell(direction_trf)
        if cell in self.cells or self._contradicts(matrix, vector):
            return self
        information, vector = self.information + matrix, self.vector + vector
        return replace(self, information=information, vector=vector, cells=self.cells | {cell})

    def with_baseline(
        self, a: SeenPlace, b: SeenPlace, length_m: float, sigma_m: float, common_m: float
    ) -> ShapeFilter:
        """Return the filter after two simultaneous views from places ``length_m`` apart. It is
        unchanged if the directions were used before or the distance contradicts the estimate.

        ``sigma_m``, ``common_m``: standard deviations of the distance by noise, and by the error
        that all distances share.
        """
        pair = (min(a.cell, b.cell), max(a.cell, b.cell))
        between = a.place_m - b.place_m
        seen_m = float(np.linalg.norm(between))
        if pair in self.pairs or not seen_m > _LEAST_BASELINE * float(np.linalg.norm(a.place_m)):
            return self
        along = between / seen_m
        row = np.append(along @ (a.by_errors - b.by_errors), common_m)
        variance = sigma_m**2 + float(along @ (a.covariance + b.covariance) @ along)
        off = length_m - seen_m
        matrix, vector = self._combined()
        expected = float(row @ np.linalg.solve(matrix, vector))
        spread = variance + float(row @ np.linalg.solve(matrix, row))
        if not (off - expected) ** 2 <= _GATE_SIGMAS**2 * spread:
            return self
        return replace(
            self,
            baselines=self.baselines + np.outer(row, row) / variance,
            lengths=self.lengths + row * (off / variance),
            pairs=self.pairs | {pair},
        )

    def _contradicts(self, matrix: Array, vector: Array) -> bool:
        """Return whether a view's estimate differs from this one by more than their covariances
        explain.
        """
        values, vectors = np.linalg.eigh(matrix)
        informed = values > 0.05 * max(float(values[-1]), 1e-12)
        basis = vectors[:, informed]
        estimate = (basis.T @ vector) / values[informed]
        spread = basis.T @ self.covariance() @ basis + np.diag(1.0 / values[informed])
        off = estimate - basis.T @ self.mean()
        return float(off @ np.linalg.solve(spread, off)) > _GATE_SIGMAS**2 * len(off)


def shape_parameters(scenario: FlightScenario) -> tuple[GeometryParameter, ...]:
    """Return the parameters of the target's geometry that are estimated. Empty without a mesh, or
    for a perception that does not use it.
    """
    mesh, knowledge = scenario.target.known_mesh(), scenario.target.knowledge
    if mesh is None or scenario.perception.name != "model":
        return ()
    return geometry_parameters(mesh, math.radians(knowledge.panel_deg), knowledge.scale_share)


def seen_place(pose: PoseSolution, measured: GeometryMeasurement, count: int) -> SeenPlace | None:
    """Return the place from which an image shows the target; None if the image has no information
    on ``count`` parameters.
    """
    if len(measured.position_by_errors) != 3 * count or len(measured.position_covariance_m2) != 9:
        return None
    axes = rotations.to_matrix(np.array(pose.q_wxyz)).T
    place = -axes @ np.array(measured.position_m)
    arm = np.cross(place, np.eye(3))
    attitude = np.array(pose.covariance).reshape(6, 6)[3:, 3:]
    covariance = (
        axes @ np.array(measured.position_covariance_m2).reshape(3, 3) @ axes.T
        + arm @ attitude @ arm.T
    )
    by_errors = -axes @ np.array(measured.position_by_errors).reshape(3, count)
    if not (
        np.isfinite(place).all() and np.isfinite(by_errors).all() and np.isfinite(covariance).all()
    ):
        return None
    if not np.linalg.norm(place) > 0.0:
        return None
    return SeenPlace(place, by_errors, covariance, view_cell(place / np.linalg.norm(place)))


class ShapeEstimation:
    """Fuses single images of chasers that inspect the target, and pairs of images of any chasers,
    whose distance odometry measures.

    A single image hardly determines the scale: a larger body farther away looks the same. The
    distance of two cameras determines it.
    """

    def __init__(self, scenario: FlightScenario, parameters: tuple[GeometryParameter, ...]) -> None:
        self.parameters = parameters
        self.filter = ShapeFilter.prior(len(parameters))
        self._camera, errors = scenario.camera_model(), scenario.navigation.errors()
        place_m = math.hypot(errors.position_drift_m, errors.position_bias_m, errors.camera_shift_m)
        self._place_sigma_m, self._focal_share = place_m, errors.camera_focal_share

    def update(
        self, observation: Observation, inspecting: Collection[int]
    ) -> EstimatedShape | None:
        """Fuse the images of a tick. Returns the estimate, or None before the first view."""
        before = self.filter
        for sighting in observation.sightings:
            if sighting.chaser in inspecting:
                self.filter = self._with(sighting)
        self._add_baselines(observation)
        if not self.filter.used:
            return None
        return EstimatedShape(
            self.parameters,
            self.filter.mean(),
            self.filter.covariance(),
            len(self.filter.cells),
            self.filter.coverage,
            self.filter is not before,
        )

    def _add_baselines(self, observation: Observation) -> None:
        """Fuse the distances between cameras that see the target in the same tick."""
        seen = []
        for sighting in observation.sightings:
            odometry = observation.chasers[sighting.chaser].measured
            measured = sighting.geometry
            if measured is None or odometry is None or odometry.sim_time_ns != sighting.sim_time_ns:
                continue
            ambiguous = len(sighting.solutions) != 1
            place = (
                None
                if ambiguous
                else seen_place(sighting.solutions[0], measured, len(self.parameters))
            )
            if place is not None:
                lens, _ = self._camera.irf_pose_in_world(odometry.position_m, odometry.q_wxyz)
                noise = np.array(odometry.position_covariance_m2).reshape(3, 3)
                seen.append((place, lens, noise))
        for (a, lens_a, noise_a), (b, lens_b, noise_b) in itertools.combinations(seen, 2):
            between = lens_a - lens_b
            length_m = float(np.linalg.norm(between))
            along = between / max(length_m, 1e-9)
            sigma_m = math.sqrt(max(float(along @ (noise_a + noise_b) @ along), 0.0))
            focal_m = self._focal_share * math.hypot(
                *(float(np.linalg.norm(x.place_m)) for x in (a, b))
            )
            common_m = math.hypot(math.sqrt(2.0) * self._place_sigma_m, focal_m)
            self.filter = self.filter.with_baseline(a, b, length_m, sigma_m, common_m)

    def _with(self, sighting: Sighting) -> ShapeFilter:
        """Return the filter after a sighting, unchanged if that has no information on these
        parameters.
        """
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
        if not (
            np.isfinite(matrix).all() and np.isfinite(vector).all() and np.isfinite(direction).all()
        ):
            return self.filter
        return self.filter.with_view(direction / np.linalg.norm(direction), matrix, vector)
