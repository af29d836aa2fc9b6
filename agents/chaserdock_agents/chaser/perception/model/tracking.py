# SPDX-License-Identifier: Apache-2.0
"""Track a pose from a prior: alignment from coarse to fine, validity gate, several starts.

Pure functions.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
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
"""Gate: least share of inliers of a pose."""
MIN_SCORE = 0.56
"""Gate: least product of inlier share and mean correlation."""
MAX_POSITION_SIGMA_SHARE, MAX_ATTITUDE_SIGMA_RAD = 0.02, math.radians(2.0)
"""Gate: largest standard deviation of a pose in any direction; of position, as a share of the
range.
"""


@dataclass(frozen=True)
class TrackingParameters:
    """Parameters of the way from a prior to a pose, tuned by benchmarks/perception.py (``shape``).

    Comments state the median error of poses at half and at twice a value; 0.106 % of the range with
    these.
    """

    # Most pixels of the target at the finest level: 36 ms of CPU (``steps.level_ms``). Half: 0.111
    # %; twice: the same.
    finest_area_px: int = 600_000
    # Most pixels at the coarsest level, about 110 squared: the reach of a search is a tenth of the
    # target there. Half: 0.106; twice: 0.097 %, in twice the time.
    coarsest_area_px: int = 12_000
    # Pixels of the target below which it is aligned at twice the image's resolution, so that its
    # profiles do not overlap. Half and twice: the same, at 0.9 to 4 m.
    upsampled_area_px: int = 24_000
    # Largest diameter of the target at the finest level, px of that level: of the image's own, and
    # of a coarser one. Nearer targets are aligned at a coarser level, as they show texture that the
    # mesh does not have at the size of profiles, and a whole image of them takes the most time.
    largest_px: tuple[float, float] = (NEAR_PX, 740.0)
    # Reach of the search at the first level, px.
    first_reach_px: int = 10
    # Reach at the next levels, px, whose prior is half as wrong.
    next_reach_px: int = 5
    # Displacement of starts around a prior, as a share of the range.
    start_share: float = 0.02
    # Rotation of starts around a prior.
    start_rad: float = math.radians(3.0)
    # Share of inliers of a pose from a rough prior, below which light and view are repeated once.
    settled_share: float = 0.85
    # Rotation of a pose from the view that it comes from, above which they are repeated.
    settled_rad: float = math.radians(0.5)
    # Most repetitions. A pose that still turns is rejected.
    most_repeated: int = 3


_TRACK = TrackingParameters()

_EVEN_LIGHT = Lighting(None, 0.0, 1.0, shadows=False)
"""Light from everywhere."""


def is_valid(alignment: Alignment | None) -> TypeGuard[Alignment]:
    """Return whether an alignment passes the gate: enough correlated inliers, and an observable
    pose.
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
    """Return the levels at which a target at ``pose`` is aligned, coarse to fine; empty if out of
    view.

    The finest one shows the target on at most 600,000 pixels, so that a rendering takes bounded
    time, and at most ``largest_px`` wide, of which it may show a part. Small targets are upsampled
    twice.
    """
    found = window_of(pyramid, 0, mesh, pose)
    if found is None:
        return ()
    area = found[0].height * found[0].width
    finest = -1 if area < _TRACK.upsampled_area_px else 0
    diameter = diameter_px(pyramid.camera, mesh, pose)
    while (
        area / 4**finest > _TRACK.finest_area_px
        or diameter / 2**finest > _TRACK.largest_px[finest > 0]
    ):
        finest += 1
    coarsest = finest
    while area / 4**coarsest > _TRACK.coarsest_area_px and coarsest < finest + 4:
        coarsest += 1
    return tuple(range(coarsest, finest - 1, -1))


def pose_steps(
    pyramid: Pyramid,
    mesh: TrackerMesh,
    prior: PoseInCamera,
    light: Lighting,
    levels: tuple[int, ...],
    first_reach_px: int = _TRACK.first_reach_px,
    modes: Array | None = None,
) -> Steps[Alignment | None]:
    """Align the mesh with an image from ``prior``, one level in each step.

    None without an alignment at the last level.
    """
    pose, alignment = prior, None
    for number, k in enumerate(levels):
        yield view_ms(pyramid, mesh, pose, k)
        points = control_points(pyramid, k, mesh, pose, light)
        alignment = (
            None
            if points is None
            else align(
                pyramid,
                points,
                pose,
                first_reach_px if number == 0 else _TRACK.next_reach_px,
                modes,
            )
        )
        if alignment is not None:
            pose, modes = alignment.pose, alignment.modes
    return alignment


def refine_from_prior(
    pyramid: Pyramid, mesh: TrackerMesh, prior: PoseInCamera, modes: Array | None = None
) -> tuple[Alignment, Lighting] | None:
    """Return the pose near ``prior``, and the light; neither needs to be known well.

    None without an alignment.
    """
    return result_of(prior_steps(pyramid, mesh, prior, modes))


def prior_steps(
    pyramid: Pyramid, mesh: TrackerMesh, prior: PoseInCamera, modes: Array | None = None
) -> Steps[tuple[Alignment, Lighting] | None]:
    """Do what `refine_from_prior` does, in steps; None also for a pose that does not settle.

    Starts from even light, for a prior that may be far off. If that explains the image badly, as
    where sunlight only grazes the target, it also starts from the light at the prior and returns
    the better result.
    """
    found = yield from rough_prior_steps(pyramid, mesh, prior, modes)
    levels = levels_of(pyramid, mesh, prior)
    if (found is not None and found[0].inlier_share >= _TRACK.settled_share) or not levels:
        return found
    light = yield from light_steps(pyramid, mesh, prior, levels[0], by_view=True)
    if light is None:
        return found
    other = yield from _settling_steps(pyramid, mesh, prior, light, levels, modes)
    return max((f for f in (found, other) if f is not None), key=lambda f: f[0].score, default=None)


def rough_prior_steps(
    pyramid: Pyramid, mesh: TrackerMesh, prior: PoseInCamera, modes: Array | None = None
) -> Steps[tuple[Alignment, Lighting] | None]:
    """Return pose and light, starting from even light; None also for a pose that does not settle.

    The outline and the borders of materials give a coarse pose. From it follows the light, which
    improves the pose, which improves the light.
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
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, light: Lighting,
    levels: tuple[int, ...], modes: Array | None
) -> Steps[tuple[Alignment, Lighting] | None]:  # fmt: skip
    """Align the two finest levels, and repeat light and pose until the pose settles; else None."""
    fine = yield from pose_steps(
        pyramid, mesh, pose, light, levels[-2:], _TRACK.next_reach_px, modes
    )
    for number in range(_TRACK.most_repeated):
        if fine is None or _is_settled(fine, 0.0 if number else _TRACK.settled_share):
            break
        # The light of a coarse pose that is wrong by degrees is wrong as well, and draws the fine
        # pose away from the truth.
        light = (yield from light_steps(pyramid, mesh, fine.pose, levels[0], by_view=True)) or light
        fine = yield from pose_steps(
            pyramid, mesh, fine.pose, light, levels[-2:], _TRACK.next_reach_px, fine.modes
        )
        if fine is not None and not _is_settled(fine):
            # With few points, the coarser level may turn a pose away by more than the limit, and
            # the finest level turns it back.
            fine = yield from pose_steps(
                pyramid, mesh, fine.pose, light, levels[-1:], _TRACK.next_reach_px, fine.modes
            )
    return (fine, light) if fine is not None and _is_settled(fine) else None


def _is_settled(alignment: Alignment, least_share: float = 0.0) -> bool:
    """Return whether a pose hardly turned from its view's, with at least ``least_share`` of
    inliers.
    """
    turned_rad = turn_between(alignment.pose, alignment.points.pose)
    return alignment.inlier_share >= least_share and turned_rad <= _TRACK.settled_rad


def track_points(
    pyramid: Pyramid, points: ControlPoints, prior: PoseInCamera, modes: Array | None = None
) -> Alignment | None:
    """Align the control points of an earlier rendering from ``prior``."""
    return align(pyramid, points, prior, _TRACK.first_reach_px, modes)


def starts_around(prior: PoseInCamera) -> list[PoseInCamera]:
    """Return twelve poses around ``prior``: rotated and displaced along each axis, either way."""
    starts, step_m = [], _TRACK.start_share * float(np.linalg.norm(prior.position))
    for axis, sign in itertools.product(range(3), (1.0, -1.0)):
        unit = sign * np.eye(3)[axis]
        turn = rotations.to_matrix(rotations.exp(_TRACK.start_rad * unit))
        starts.append(PoseInCamera(prior.position, turn @ prior.rotation))
        starts.append(PoseInCamera(prior.position + step_m * unit, prior.rotation))
    return starts


def start_steps(
    pyramid: Pyramid, mesh: TrackerMesh, starts: list[PoseInCamera], light: Lighting
) -> Steps[Alignment | None]:
    """Return the best alignment from several starts, in steps.

    All are aligned at the coarsest level, the best three at all levels.
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
    """Return the expected CPU time, ms, to align the view of one level."""
    return level_ms(area_px(pyramid, level, mesh, pose))


def turn_between(a: PoseInCamera, b: PoseInCamera) -> float:
    """Return the angle between the attitudes of two poses, rad."""
    cosine = 0.5 * (float(np.sum(a.rotation * b.rotation)) - 1.0)
    return math.acos(min(1.0, max(-1.0, cosine)))


def pose_error(estimate: PoseInCamera, truth: PoseInCamera) -> Array:
    """Return the error (6,) of a pose as in its covariance: position in IRF, rotation in
    TRF axes.
    """
    turn = rotations.log(rotations.from_matrix(estimate.rotation.T @ truth.rotation))
    return np.concatenate([truth.position - estimate.position, turn])
