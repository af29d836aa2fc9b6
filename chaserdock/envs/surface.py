# SPDX-License-Identifier: Apache-2.0
"""Points on the target's surface that chasers have to see: the task ``inspect``.

As in AFRL's safe-autonomy-sims (D. van Wijk et al., "Deep reinforcement learning for autonomous
spacecraft inspection using illumination", 2023), a point counts once it is in the field of view, on
the visible side and lit; here on the target's cuboids instead of a sphere. native/surface.h is the
environments' own; `Coverage` has the same definition for flight code.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario.learning import LearningInspection
from numpy.typing import NDArray

_COVERED_M = 1e-6
"""A point counts as covered by another cuboid from this distance on, m: far above rounding."""


@dataclass(frozen=True, eq=False)
class TargetSurface:
    """Faces of the target's cuboids that are not covered by others, and points on them, TRF.

    ``planes`` (F, 4): outward normal, and distance from the origin. ``points_m`` (P, 3). ``face``
    (P,) and ``box`` (F,): face of each point, and cuboid of each face.
    """

    planes: Array
    points_m: Array
    face: IntArray
    box: IntArray


def surface_of(boxes: Sequence[Box], spacing_m: float) -> TargetSurface:
    """Return the surface of cuboids, with points in the middles of cells of at most ``spacing_m``
    by ``spacing_m``.
    """
    planes, points, boxes_of = list[Array](), list[Array](), list[int]()
    for number, box in enumerate(boxes):
        half, turn = np.array(box.size_m) / 2.0, rotations.to_matrix(np.array(box.q_wxyz))
        for axis in range(3):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            cells = [_middles(float(half[k]), spacing_m) for k in (i, j)]
            for sign in (1.0, -1.0):
                local = np.zeros((cells[0].size * cells[1].size, 3))
                local[:, axis] = sign * half[axis]
                local[:, i], local[:, j] = (g.ravel() for g in np.meshgrid(*cells, indexing="ij"))
                places = np.array(box.position_m) + local @ turn.T
                places = places[~_covered(places, boxes, number)]
                if len(places):
                    normal = sign * turn[:, axis]
                    planes.append(np.append(normal, normal @ places[0]))
                    points.append(places)
                    boxes_of.append(number)
    face = np.repeat(np.arange(len(points)), [len(p) for p in points])
    return TargetSurface(np.array(planes), np.concatenate(points), face, np.array(boxes_of))


def _middles(half_m: float, spacing_m: float) -> Array:
    count = max(1, math.ceil(2.0 * half_m / spacing_m - 1e-9))
    return half_m * ((2.0 * np.arange(count) + 1.0) / count - 1.0)


def _covered(points_m: Array, boxes: Sequence[Box], own: int) -> NDArray[np.bool_]:
    """Return which points (n, 3) lie in or on another cuboid."""
    found = np.zeros(len(points_m), dtype=bool)
    for number, box in enumerate(boxes):
        if number != own:
            local = rotations.rotate_inverse(np.array(box.q_wxyz), points_m - box.position_m)
            found |= (np.abs(local) <= np.array(box.size_m) / 2.0 + _COVERED_M).all(axis=1)
    return found


class Coverage:
    """Which points of the target's surface have been seen.

    ``to_sun_wrf`` (3,): direction to the sun, which flight code has from its ephemeris.
    """

    def __init__(
        self,
        boxes: Sequence[Box],
        camera: Camera,
        settings: LearningInspection,
        to_sun_wrf: Array,
    ) -> None:
        self.surface = surface_of(boxes, settings.spacing_m)
        self.seen = np.zeros(len(self.surface.points_m), dtype=bool)
        self._boxes, self._camera, self._settings = tuple(boxes), camera, settings
        self._to_sun = to_sun_wrf / np.linalg.norm(to_sun_wrf)
        self._least_cosine = math.cos(math.radians(settings.incidence_deg))
        self._extent_m = extent_m(boxes)

    def look(self, chaser: BodyState, target: BodyState) -> IntArray:
        """Mark what a chaser sees in an image, and return the numbers of the points that nobody had
        seen before.
        """
        surface, sun = self.surface, self._sun(target)
        position, attitude = _relative(chaser, target)
        eye, q = self._camera.irf_pose_in_world(position, attitude)
        normals = surface.planes[surface.face, :3]
        sight = eye - surface.points_m
        distance = np.linalg.norm(sight, axis=1)
        height = np.sum(normals * sight, axis=1)
        ahead = rotations.rotate_inverse(q, -sight)
        left, top, right, bottom = (math.tan(a) for a in self._camera.angles_to_borders())
        x, y, z = ahead.T
        good = ~self.seen & (height > 0.0) & (distance <= self._settings.range_m)
        good &= height >= self._least_cosine * distance
        good &= (z > 0.0) & (x > -left * z) & (y > -top * z) & (x < right * z) & (y < bottom * z)
        if self._settings.sunlit:
            good &= normals @ sun > 0.0
        found = [
            p
            for p in np.flatnonzero(good).tolist()
            if not self._hidden(p, eye)
            and not (
                self._settings.sunlit
                and self._hidden(p, surface.points_m[p] + self._extent_m * sun)
            )
        ]
        self.seen[found] = True
        return np.array(found, dtype=np.int64)

    def elements(self, chaser: BodyState, target: BodyState) -> Array:
        """Return what the task adds to an observation, (10,): see docs/learning.md."""
        surface, sun = self.surface, self._sun(target)
        position, _ = _relative(chaser, target)
        faces, out = np.unique(surface.face[~self.seen]), np.zeros(10)
        out[6], out[7:] = self.seen.mean(), sun
        if len(faces):
            middles = [surface.points_m[(surface.face == k) & ~self.seen].mean(0) for k in faces]
            apart = np.array(middles) - position
            lit = (surface.planes[faces, :3] @ sun > 0.0) | (not self._settings.sunlit)
            best = np.lexsort((np.linalg.norm(apart, axis=1), ~lit))[0]
            out[:6] = *apart[best], *surface.planes[faces[best], :3]
        return out

    def _sun(self, target: BodyState) -> Array:
        return rotations.rotate_inverse(target.q_wxyz, self._to_sun)

    def _hidden(self, point: int, to_m: Array) -> bool:
        """Return whether another cuboid meets the segment from a point."""
        own = int(self.surface.box[self.surface.face[point]])
        return any(
            _meets(box, self.surface.points_m[point], to_m)
            for number, box in enumerate(self._boxes)
            if number != own
        )


def extent_m(boxes: Sequence[Box]) -> float:
    """Return the diameter of a sphere about TRF's origin that contains all cuboids, m."""
    radii = [math.hypot(*box.position_m) + math.hypot(*box.size_m) / 2.0 for box in boxes]
    return 2.0 * max(radii)


def _relative(chaser: BodyState, target: BodyState) -> tuple[Array, Array]:
    """Return position and attitude of a chaser in TRF."""
    apart = chaser.position_m - target.position_m
    q = rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz)
    return rotations.rotate_inverse(target.q_wxyz, apart), q


def _meets(box: Box, from_m: Array, to_m: Array) -> bool:
    """Return whether a segment meets a cuboid, by its part within each pair of faces."""
    q, half = np.array(box.q_wxyz), np.array(box.size_m) / 2.0
    start = rotations.rotate_inverse(q, from_m - box.position_m)
    way = rotations.rotate_inverse(q, to_m - from_m)
    enters, leaves = 0.0, 1.0
    for x, d, h in zip(start.tolist(), way.tolist(), half.tolist(), strict=True):
        if d == 0.0:
            if abs(x) > h:
                return False
            continue
        near, far = sorted(((-h - x) / d, (h - x) / d))
        enters, leaves = max(enters, near), min(leaves, far)
    return enters <= leaves
