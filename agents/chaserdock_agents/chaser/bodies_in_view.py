# SPDX-License-Identifier: Apache-2.0
"""Where a chaser's own probe and other chasers are in its images, so that perception leaves them
out.

The controller's estimate of the target states the poses of all chasers relative to it: no chaser
hears another one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import Box
from chaserdock_protocol.messages import TargetEstimate

Disc = tuple[float, float, float]
"""Centre x and y, and radius, px."""
_PROBE_STEP_M, _BODY_STEP_M = 0.01, 0.05
"""Distance of the discs along the own probe, and in another chaser, m: 20 px at 2 m."""
_MARGIN_PX = 12.0
"""What discs reach beyond a body: half a window of tracking. The poses of chasers are known to 5
mm: 2 px at 2 m."""
_NEAREST_M = 0.02
"""Depth beyond which a body is drawn at all."""


def probe_discs(camera: Camera, probe: Box) -> tuple[Disc, ...]:
    """Return the discs that cover a chaser's own probe in its images.

    ``probe``: cuboid along X of CRF.
    """
    length_m, *across_m = probe.size_m
    along = np.arange(0.0, length_m + _PROBE_STEP_M, _PROBE_STEP_M) - length_m / 2.0
    places = np.array(probe.position_m) + along[:, None] * np.array([1.0, 0.0, 0.0])
    return _discs(camera, places, (max(across_m) + _PROBE_STEP_M) / np.sqrt(2.0))


def chaser_discs(
    camera: Camera, boxes: Sequence[Box], own: int, estimate: TargetEstimate
) -> tuple[Disc, ...]:
    """Return the discs that cover the other chasers in the images of chaser ``own``, by their poses
    in an estimate; none if it does not state its own. ``boxes``: cuboids of every chaser, CRF.
    """
    poses = {r.chaser: (np.array(r.position_m), np.array(r.q_wxyz)) for r in estimate.relative}
    if own not in poses:
        return ()
    place, q = poses[own]
    out: list[Disc] = []
    for chaser, (at, turn) in poses.items():
        if chaser == own:
            continue
        for box in boxes:
            inside, radius_m = _filled(box)
            places = at + rotations.rotate(turn, inside)
            out += _discs(camera, rotations.rotate_inverse(q, places - place), radius_m)
    return tuple(out)


def _filled(box: Box) -> tuple[Array, float]:
    """Return points (n, 3) in a cuboid, CRF, and the radius of the balls about them that fill
    it.
    """
    size = np.array(box.size_m)
    counts = np.ceil(size / _BODY_STEP_M).astype(int)
    axes = [(np.arange(n) + 0.5) / n - 0.5 for n in counts.tolist()]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.array(box.position_m) + rotations.rotate(box.q_wxyz, grid * size)
    return points, float(np.linalg.norm(size / counts)) / 2.0


def _discs(camera: Camera, places_m: Array, radius_m: float) -> tuple[Disc, ...]:
    """Return the discs of balls about places (n, 3), CRF, that are before the camera."""
    at = rotations.rotate_inverse(camera.q_crf_irf_wxyz, places_m - np.array(camera.position_crf_m))
    seen = at[at[:, 2] > _NEAREST_M]
    radii = camera.fx_px * radius_m / seen[:, 2]
    discs = np.column_stack([camera.project(seen), radii + _MARGIN_PX])
    return tuple(
        (float(x), float(y), float(r)) for x, y, r in discs[np.isfinite(discs).all(axis=1)]
    )
