# SPDX-License-Identifier: Apache-2.0
"""Plumes of thrusters: which boxes and points they hit, and what they exert. Pure functions; SI
units, radians.

For the question of a hit the plume is a cone without end. Its momentum flux is that of Simons: A
cos^m(pi theta / 2 theta_limit) / r^2 at the angle theta from the axis and the distance r, and none
beyond theta_limit (G. A. Simons, Effect of Nozzle Boundary Layers on Rocket Exhaust Plumes, AIAA
Journal 10, 1972; there m = 2 / (gamma - 1), which is 5 for a cold gas with gamma = 1.4).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from . import rotations
from .arrays import Array
from .targets import Box, cuboid_corners

REACH_M = 10.0
"""Distance up to which a plume acts, m. There 1 N of thrust gives some 20 mN/m^2 at most."""
_CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
_EDGES = np.array(
    [
        (i, j)
        for (i, a), (j, b) in itertools.combinations(enumerate(_CORNERS), 2)
        if sum(u != v for u, v in zip(a, b, strict=True)) == 1
    ]
)
"""Pairs of corners of a cuboid, in the order of ``cuboid_corners``, that an edge joins."""


def angle_to_box(nozzle_m: Array, axis: Array, box: Box) -> float:
    """Return the smallest angle (rad) between ``axis`` and the directions from a nozzle to a box.

    ``axis`` (3,): unit vector. 0 if the nozzle is in the box or the axis meets it. Otherwise the
    smallest angle is at an edge: within a plane that the axis does not meet, the angle has no
    minimum.
    """
    local = rotations.rotate_inverse(box.q_wxyz, nozzle_m - np.asarray(box.position_m))
    direction = rotations.rotate_inverse(box.q_wxyz, axis)
    half = np.asarray(box.size_m) / 2.0
    if _meets(local, direction, half):
        return 0.0
    corners = cuboid_corners(box.size_m) - local
    begin, end = corners[_EDGES[:, 0]], corners[_EDGES[:, 1]]
    length = np.linalg.norm(end - begin, axis=1)
    along = (end - begin) / length[:, None]
    # The cosine of the angle has one stationary point on a line: the root of a linear equation.
    begin_along, begin_axis = (begin * along).sum(axis=1), begin @ direction
    axis_along = along @ direction
    slope = axis_along * begin_along - begin_axis
    root = np.divide(
        begin_axis * begin_along - axis_along * (begin * begin).sum(axis=1),
        slope,
        out=np.zeros(len(slope)),
        where=np.abs(slope) > 1e-12,
    )
    points = np.concatenate([corners, begin + np.clip(root, 0.0, length)[:, None] * along])
    cosines = points @ direction / np.linalg.norm(points, axis=1)
    return math.acos(min(1.0, float(cosines.max())))


def _meets(origin: Array, direction: Array, half: Array) -> bool:
    """Return whether a ray meets the cuboid of half edges ``half`` about the origin of its own
    axes.
    """
    parallel = np.abs(direction) < 1e-12
    if np.any(parallel & (np.abs(origin) > half)):
        return False
    safe = np.where(parallel, 1.0, direction)
    first, second = (-half - origin) / safe, (half - origin) / safe
    enters = np.where(parallel, -math.inf, np.minimum(first, second)).max()
    leaves = np.where(parallel, math.inf, np.maximum(first, second)).min()
    return bool(leaves >= max(enters, 0.0))


def angle_to_point(nozzle_m: Array, axis: Array, point_m: Array) -> float:
    """Return the angle (rad) between ``axis`` (3,), a unit vector, and the direction from a nozzle
    to a point.
    """
    off = np.asarray(point_m) - nozzle_m
    distance = float(np.linalg.norm(off))
    return 0.0 if distance == 0.0 else math.acos(max(-1.0, min(1.0, float(off @ axis) / distance)))


def plume_hits(
    nozzle_m: Array,
    force: Array,
    half_angle_rad: float,
    boxes: Sequence[Box],
    points_m: Sequence[Array] = (),
) -> bool:
    """Return whether the plume of a thruster hits a box or a point.

    ``nozzle_m`` (3,). ``force`` (3,): unit direction of the thruster's force; the plume goes the
    opposite way.
    """
    axis = -np.asarray(force, dtype=float)
    return any(angle_to_box(nozzle_m, axis, box) < half_angle_rad for box in boxes) or any(
        angle_to_point(nozzle_m, axis, point) < half_angle_rad for point in points_m
    )


@dataclass(frozen=True, eq=False)
class Panels:
    """Flat parts of a body's surface in its axes: centres (P, 3), outward normals (P, 3), areas
    (P,).
    """

    centres_m: Array
    normals: Array
    areas_m2: Array


def panels_of(boxes: Sequence[Box], parts: int = 6) -> Panels:
    """Return the faces of boxes, each divided into ``parts`` x ``parts`` panels."""
    middles = (np.arange(parts) + 0.5) / parts - 0.5
    u, v = (grid.ravel() for grid in np.meshgrid(middles, middles))
    centres, normals, areas = [], [], []
    for box in boxes:
        size = np.asarray(box.size_m)
        for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            local = np.zeros((len(u), 3))
            local[:, axis], local[:, one], local[:, two] = (
                sign * size[axis] / 2.0,
                u * size[one],
                v * size[two],
            )
            normal = np.zeros(3)
            normal[axis] = sign
            centres.append(np.asarray(box.position_m) + rotations.rotate(box.q_wxyz, local))
            normals.append(np.tile(rotations.rotate(box.q_wxyz, normal), (len(u), 1)))
            areas.append(np.full(len(u), size[one] * size[two] / parts**2))
    return Panels(np.concatenate(centres), np.concatenate(normals), np.concatenate(areas))


@dataclass(frozen=True)
class PlumeFlux:
    """Momentum flux of a plume per newton of thrust.

    ``limit_rad`` (below pi / 2) and ``exponent``: theta_limit and m of the module's docstring.
    """

    limit_rad: float
    exponent: float

    @cached_property
    def axial(self) -> float:
        """Factor A: the flux through any surface that closes the cone carries the thrust along the
        axis.
        """
        nodes, weights = np.polynomial.legendre.leggauss(64)
        theta = 0.5 * self.limit_rad * (nodes + 1.0)
        shape = np.cos(0.5 * math.pi * theta / self.limit_rad) ** self.exponent
        carried = (
            float((weights * shape * np.cos(theta) * np.sin(theta)).sum()) * 0.5 * self.limit_rad
        )
        return 1.0 / (2.0 * math.pi * carried)

    def at(self, cosines: Array) -> Array:
        """Return the flux times the square of the distance, 1/sr, at angles with these cosines
        (...).
        """
        theta = np.arccos(np.clip(cosines, -1.0, 1.0))
        shape = np.cos(0.5 * math.pi * np.minimum(theta / self.limit_rad, 1.0)) ** self.exponent
        return np.where(theta < self.limit_rad, self.axial * shape, 0.0)


def plume_wrench(
    flux: PlumeFlux,
    panels: Panels,
    nozzles_m: Array,
    forces: Array,
    thrusts_N: Array,
) -> Array:
    """Return force and torque (6,) that the plumes of thrusters exert on panels.

    Torque is about the origin; axes are those of the panels. ``nozzles_m``, ``forces`` (n, 3):
    nozzles and unit directions of the thrusters' forces; the plumes go the opposite way. Each panel
    that faces a nozzle within `REACH_M` takes up the whole momentum of the flux through it;
    panels do not shade others.
    """
    firing = thrusts_N > 0.0
    if not firing.any():
        return np.zeros(6)
    away = panels.centres_m - nozzles_m[firing, None]
    distance = np.maximum(np.linalg.norm(away, axis=2), 1e-3)
    along = away / distance[..., None]
    facing = -np.einsum("npi,pi->np", along, panels.normals)
    cosines = -np.einsum("npi,ni->np", along, forces[firing])
    share = np.where(
        (facing > 0.0) & (distance <= REACH_M), flux.at(cosines) * facing / distance**2, 0.0
    )
    force = (thrusts_N[firing, None] * share * panels.areas_m2)[..., None] * along
    torque = np.cross(panels.centres_m, force)
    return np.concatenate([force.sum(axis=(0, 1)), torque.sum(axis=(0, 1))])
