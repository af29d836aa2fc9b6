# SPDX-License-Identifier: Apache-2.0
"""Rings that are found on a mapped satellite, against its mesh.

A ring is true if the vertices of the mesh run along nearly all of it: plates have none but at their
corners. Its errors are those against the circle through these vertices; edges that are nearer to
each other than that, as those of a tube, count as one.
"""

from __future__ import annotations

import time

import numpy as np
from chaserdock_agents.chaser.perception.features import find_ellipses, region_around
from chaserdock_agents.mapper.rings import Ring, circle_sights, find_rings
from chaserdock_agents.mapper.types import ConstantRates
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.satellites import satellite

from .unknown_scene import Exposure

SEARCHED_IMAGES = 13
"""In every 13th image ellipses are sought: once in 2.6 s."""
NEAR_M = 0.012
"""Distance within which a vertex is on a ring: half of what lies between the edges of a tube of
3 cm, and more than half of that between vertices."""
LEAST_SHARE = 0.9
"""Share of a ring along which there must be vertices."""


class RingSearch:
    """Finds rings as chasers and mapper do: ellipses in some images, circles by the last map."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._images: list[tuple[float, Array, Array, Array]] = []
        self._took_s: list[float] = []

    def look(
        self, exposure: Exposure, lens: Array, q: Array, px: Array, known: ConstantRates | None
    ) -> None:
        """Seek ellipses around ideal pixels (n, 2) in an image, if it is the turn of one and there
        is a map.
        """
        if known is None or round(exposure.time_s * 5) % SEARCHED_IMAGES:
            return
        begin_s = time.process_time()
        region = region_around(self.camera, px)
        rows = find_ellipses(exposure.image, self.camera, region).rows()
        self._took_s.append(time.process_time() - begin_s)
        self._images.append((exposure.time_s, lens, rotations.to_matrix(q), rows))

    def figures(
        self, mesh: str, motion: ConstantRates, turn: Array, origin_m: Array
    ) -> dict[str, float]:
        """Return the figures of the rings by a map: number of true and of false ones; of the true
        ones the RMS errors of centre, normal and radius, and the mean squared error of the normal
        by its variance (of 2). ``turn`` (3, 3): true TRF to that of the map; ``origin_m`` (3,):
        the true origin.
        """
        begin_s = time.process_time()
        images = []
        for at_s, lens, rotation, ellipses in self._images:
            p, r = motion.at([at_s])
            images.append((r[0].T @ (lens - p[0]), r[0].T @ rotation, ellipses))
        rings = find_rings(circle_sights(self.camera, images))
        took_s = time.process_time() - begin_s
        vertices = np.concatenate([part.vertices_m for part in satellite(mesh).parts])
        found = [
            errors_of(ring, turn.T @ (ring.centre_m - origin_m), turn.T @ ring.normal, vertices)
            for ring in rings
        ]
        errors = np.array([e for e in found if e is not None]).reshape(-1, 4)
        offset, angle, radius = np.sqrt(np.mean(errors[:, :3] ** 2, axis=0)) if len(errors) else _NO
        return {
            "ellipses_mean_s": float(np.mean(self._took_s)),
            "rings_s": took_s,
            "rings": float(len(errors)),
            "rings_false": float(len(rings) - len(errors)),
            "ring_offset_m": float(offset),
            "ring_angle_rad": float(angle),
            "ring_radius_m": float(radius),
            "ring_nees": float(np.mean(errors[:, 3])) if len(errors) else float("nan"),
        }


_NO = np.full(3, np.nan)
"""Errors where there is no ring."""


def errors_of(
    ring: Ring, centre: Array, normal: Array, vertices: Array
) -> tuple[float, float, float, float] | None:
    """Return errors of centre, normal and radius, and the squared error of the normal by its
    variance; None of a false ring. ``centre``, ``normal`` (3,): in the frame of the vertices.
    """
    one, other = np.linalg.svd(normal[None])[2][1:]
    angles = np.linspace(0.0, 2.0 * np.pi, _PLACES, endpoint=False)
    edge = centre + ring.radius_m * (
        np.outer(np.cos(angles), one) + np.outer(np.sin(angles), other)
    )
    distance = np.linalg.norm(edge[:, None] - vertices, axis=2)
    near = distance.min(axis=1) < NEAR_M
    if near.mean() < LEAST_SHARE:
        return None
    true = vertices[distance.argmin(axis=1)[near]]
    # Vertices are not evenly spread: the middle of their circle, not their mean.
    middle = true.mean(axis=0)
    axes = np.linalg.svd(true - middle)[2]
    flat = (true - middle) @ axes[:2].T
    rows = np.column_stack([2.0 * flat, np.ones(len(flat))])
    x, y, rest = np.linalg.lstsq(rows, (flat**2).sum(axis=1), rcond=None)[0]
    true_centre = middle + x * axes[0] + y * axes[1]
    angle = float(np.arcsin(min(1.0, float(np.linalg.norm(np.cross(axes[2], normal))))))
    return (
        float(np.linalg.norm(centre - true_centre)),
        angle,
        float(ring.radius_m - np.sqrt(rest + x * x + y * y)),
        (angle / ring.normal_sigma_rad) ** 2,
    )


_PLACES = 36
"""Places along a ring that are compared with the mesh."""
