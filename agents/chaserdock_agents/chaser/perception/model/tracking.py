# SPDX-License-Identifier: Apache-2.0
"""Track a pose from a prior: coarse to fine alignment, validity gate, several starts. Pure
functions.
"""

from __future__ import annotations

import itertools
import math
from typing import TypeGuard

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array

from ..refine import PoseInCamera
from .alignment import (
    NEAR_PX,
    Alignment,
    ControlPoints,
    Pyramid,
    align,
    area_px,
    control_points,
    diameter_px,
    window_of,
)
from .lighting import light_steps
from .mesh import TrackerMesh
from .rendering import Lighting
from .steps import Steps, level_ms, result_of

MIN_INLIER_SHARE = 0.66
"""Gate: a smaller share of inliers rejects a pose."""
MIN_SCORE = 0.56
"""Gate: a smaller product of inlier share and mean correlation rejects a pose."""
MAX_POSITION_SIGMA_SHARE, MAX_ATTITUDE_SIGMA_RAD = 0.02, math.radians(2.0)
"""Gate: a larger standard deviation in any direction, of position as a share of the range, rejects
a pose.
"""
_FINEST_AREA_PX, _COARSEST_AREA_PX, _UPSAMPLED_AREA_PX = 600_000, 12_000, 24_000
_LARGEST_PX = (NEAR_PX, 740.0)
"""Largest diameter of the target at the finest level, in pixels of it: if that is the image's own,
or a coarser one. Nearer targets are aligned at a coarser level: they show texture that the mesh
does not have at the size of profiles, and a whole image of them takes the most time."""
_FIRST_REACH_PX, _NEXT_REACH_PX = 10, 5
_START_SHARE, _START_RAD = 0.02, math.radians(3.0)
_SETTLED_SHARE, _SETTLED_RAD, _MOST_REPEATED = 0.85, math.radians(0.5), 3
"""A pose from a rough prior is settled within this turn from the view that it comes from; light and
view are repeated until it is, at most three times, and once for a smaller share of inliers. One
that still turns is rejected."""
_EVEN_LIGHT = Lighting(None, 0.0, 1.0, shadows=False)
"""Light from everywhere."""


def is_valid(alignment: Alignment | None) -> TypeGuard[Alignment]:
    """Return whether an alignment passes the gate: enough inliers, well correlated, and a pose that
    is observable.
    """
    if (
        alignment is None
        or alignment.inlier_share < MIN_INLIER_SHARE
        or alignment.score < MIN_SCORE
    ):
        return False
    position_m = math.sqrt(float(np.linalg.eigvalsh(alignment.covariance[:3, :3])[-1]))
    attitude_rad = math.sqrt(float(np.linalg.eigvalsh(alignment.covariance[3:, 3:])[-1]))
    range_m = float(np.linalg.norm(alignment.pose.position))
    return (
        position_m <= MAX_POSITION_SIGMA_SHARE * range_m and attitude_rad <= MAX_ATTITUDE_SIGMA_RAD
    )


def levels_of(pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera) -> tuple[int, ...]:
    """Return the levels at which a target at ``pose`` is aligned, coarse to fine; empty if it is
    out of view.

    The finest one shows the target on at most 600,000 pixels, so that a rendering takes bounded
    time, and at most ``_LARGEST_PX`` wide, of which it may show a part; small targets are upsampled
    twice.
    """
    found = window_of(pyramid, 0, mesh, pose)
    if found is None:
        return ()
    area = found[0].height * found[0].width
    finest = -1 if area < _UPSAMPLED_AREA_PX else 0
    diameter = diameter_px(pyramid.camera, mesh, pose)
    while area / 4**finest > _FINEST_AREA_PX or diameter / 2**finest > _LARGEST_PX[finest > 0]:
        finest += 1
    coarsest = finest
    while area / 4**coarsest > _COARSEST_AREA_PX and coarsest < finest + 4:
        coarsest += 1
    return tuple(range(coarsest, finest - 1, -1))


def pose_steps(
    pyramid: Pyramid,
    mesh: TrackerMesh,
    prior: PoseInCamera,
    light: Lighting,
    levels: tuple[int, ...],
    first_reach_px: int = _FIRST_REACH_PX,
    modes: Array | None = None,
) -> Steps[Alignment | None]:
    """Align the mesh with an image from ``prior``, one level in each step; None without an
    alignment at the last level.
    """
    pose, alignment = prior, None
    for number, k in enumerate(levels):
        yield view_ms(pyramid, mesh, pose, k)
        points = control_points(pyramid, k, mesh, pose, light)
        alignment = (
            None
            if points is None
            else align(
                pyramid, points, pose, first_reach_px if number == 0 else _NEXT_REACH_PX, modes
            )
        )
        if alignment is not None:
            pose, modes = alignment.pose, alignment.modes
    return alignment


def refine_from_prior(
    pyramid: Pyramid, mesh: TrackerMesh, prior: PoseInCamera, modes: Array | None = None
) -> tuple[Alignment, Lighting] | None:
    """Return the pose near ``prior`` and the light, neither of which needs to be known well; None
    without an alignment.
    """
    return result_of(prior_steps(pyramid, mesh, prior, modes))


def prior_steps(
    pyramid: Pyramid, mesh: TrackerMesh, prior: PoseInCamera, modes: Array | None = None
) -> Steps[tuple[Alignment, Lighting] | None]:
    """Do what `refine_from_prior` does, in steps; None also for a pose that does not settle.

    Starts from light from everywhere, for a prior that may be far off. If that explains the image
    badly, as where sunlight only grazes the target, starts from the light at the prior as well, and
    returns the better one.
    """
    found = yield from rough_prior_steps(pyramid, mesh, prior, modes)
    levels = levels_of(pyramid, mesh, prior)
    if (found is not None and found[0].inlier_share >= _SETTLED_SHARE) or not levels:
        return found
    light = yield from light_steps(pyramid, mesh, prior, levels[0], by_view=True)
    if light is None:
        return found
    other = yield from _settling_steps(pyramid, mesh, prior, light, levels, modes)
    return max((f for f in (found, other) if f is not None), key=lambda f: f[0].score, default=None)


def rough_prior_steps(
    pyramid: Pyramid, mesh: TrackerMesh, prior: PoseInCamera, modes: Array | None = None
) -> Steps[tuple[Alignment, Lighting] | None]:
    """Return pose and light, starting from light from everywhere; None also for a pose that does
    not settle.

    The outline and the borders of materials give a coarse pose; from it follows the light, which
    improves the coarse pose, which improves the light.
    """
    levels = levels_of(pyramid, mesh, prior)
    if not levels:
        return None
    pose, light = prior, _EVEN_LIGHT
    for by_view in (False, True):
        coarse = yield from pose_steps(pyramid, mesh, pose, light, levels[:1], modes=modes)
        pose = coarse.pose if coarse else pose
        found = yield from light_steps(pyramid, mesh, pose, levels[0], by_view=by_view)
        if found is None:
            return None
        light = found
    return (yield from _settling_steps(pyramid, mesh, pose, light, levels, modes))


def _settling_steps(
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, light: Lighting, levels: tuple[int, ...], modes: Array | None
) -> Steps[tuple[Alignment, Lighting] | None]:  # fmt: skip
    """Align the two finest levels, and improve light and pose again until the pose settles; None if
    it does not.
    """
    fine = yield from pose_steps(pyramid, mesh, pose, light, levels[-2:], _NEXT_REACH_PX, modes)
    for number in range(_MOST_REPEATED):
        if fine is None or _is_settled(fine, 0.0 if number else _SETTLED_SHARE):
            break
        # The light of a coarse pose that is wrong by degrees is wrong as well, and leaves the fine
        # one between the two.
        light = (yield from light_steps(pyramid, mesh, fine.pose, levels[0], by_view=True)) or light
        fine = yield from pose_steps(
            pyramid, mesh, fine.pose, light, levels[-2:], _NEXT_REACH_PX, fine.modes
        )
        if fine is not None and not _is_settled(fine):
            # Of few points the coarser level turns a pose away by more than that, and the finest
            # one back.
            fine = yield from pose_steps(
                pyramid, mesh, fine.pose, light, levels[-1:], _NEXT_REACH_PX, fine.modes
            )
    return (fine, light) if fine is not None and _is_settled(fine) else None


def _is_settled(alignment: Alignment, least_share: float = 0.0) -> bool:
    """Return whether a pose hardly turned from that of its view, and at least ``least_share`` of
    the points agree with it.
    """
    turned_rad = turn_between(alignment.pose, alignment.points.pose)
    return alignment.inlier_share >= least_share and turned_rad <= _SETTLED_RAD


def track_points(
    pyramid: Pyramid, points: ControlPoints, prior: PoseInCamera, modes: Array | None = None
) -> Alignment | None:
    """Align the control points of an earlier rendering from ``prior``."""
    return align(pyramid, points, prior, _FIRST_REACH_PX, modes)


def starts_around(prior: PoseInCamera) -> list[PoseInCamera]:
    """Return twelve poses around ``prior``: turned by 3 degrees about each axis, moved by 2 % of
    the range along each.
    """
    starts, step_m = [], _START_SHARE * float(np.linalg.norm(prior.position))
    for axis, sign in itertools.product(range(3), (1.0, -1.0)):
        unit = sign * np.eye(3)[axis]
        turn = rotations.to_matrix(rotations.exp(_START_RAD * unit))
        starts.append(PoseInCamera(prior.position, turn @ prior.rotation))
        starts.append(PoseInCamera(prior.position + step_m * unit, prior.rotation))
    return starts


def start_steps(
    pyramid: Pyramid, mesh: TrackerMesh, starts: list[PoseInCamera], light: Lighting
) -> Steps[Alignment | None]:
    """Return the best alignment from several starts, in steps: all at the coarsest level, the best
    three at all levels.
    """
    coarse: list[Alignment] = []
    for start in starts:
        levels = levels_of(pyramid, mesh, start)
        found = yield from pose_steps(pyramid, mesh, start, light, levels[:1])
        if found is not None:
            coarse.append(found)
    coarse.sort(key=lambda a: -a.score)
    best: Alignment | None = None
    for candidate in coarse[:3]:
        levels = levels_of(pyramid, mesh, candidate.pose)
        found = yield from pose_steps(pyramid, mesh, candidate.pose, light, levels)
        if found is not None and (best is None or found.score > best.score):
            best = found
    return best


def view_ms(pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int) -> float:
    """Return the expected CPU time to align a view of one level."""
    return level_ms(area_px(pyramid, level, mesh, pose))


def turn_between(a: PoseInCamera, b: PoseInCamera) -> float:
    """Return the angle between the attitudes of two poses, rad."""
    cosine = 0.5 * (float(np.sum(a.rotation * b.rotation)) - 1.0)
    return math.acos(min(1.0, max(-1.0, cosine)))


def pose_error(estimate: PoseInCamera, truth: PoseInCamera) -> Array:
    """Return the error (6,) of a pose in the coordinates of its covariance: position in IRF,
    rotation in TRF axes.
    """
    turn = rotations.log(rotations.from_matrix(estimate.rotation.T @ truth.rotation))
    return np.concatenate([truth.position - estimate.position, turn])
