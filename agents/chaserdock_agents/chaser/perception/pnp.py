# SPDX-License-Identifier: Apache-2.0
"""Compute the pose of a target from the corners of its markers, in ideal (undistorted) pixels.

Candidates from SQPnP (G. Terzakis, M. Lourakis, ECCV 2020) and IPPE (T. Collins, A. Bartoli, IJCV
2014), a consensus over markers against false ids, Levenberg-Marquardt on the whitened reprojection
error, and (J'J)^-1 as covariance. OpenCV's EPnP is not used, as it fails on coplanar points.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel, clear_margin_m
from numpy.typing import NDArray

from .corners import CornerErrors
from .refine import PoseInCamera, refine, residual_of, rotation_matrix
from .views import count_visible_markers, marker_errors, squared_errors

Indices = NDArray[np.intp]

# Weight of the stated errors of corners, in residuals, where these tell how large errors are.
# Larger: images with more or other errors than stated are believed too much; smaller: the
# covariance of few corners scatters.
_PRIOR_RESIDUALS = 4.0
# Least factor of the stated variance by residuals: these do not show what all markers of an image
# have in common. Larger: too large covariances; smaller: too small ones of many small markers.
_LEAST_FACTOR = 0.6
# Least cosine of the viewing angle of a single marker: at a more grazing angle its tilt is poorly
# determined, with an optimistic covariance.
MIN_SINGLE_COSINE = 0.25
# Largest corner error, px, of an inlier of a coarse candidate, and of a refined pose.
_COARSE_GATE_PX, _FINE_GATE_PX = 6.0, 1.5
# The fine gate grows to this many medians of the markers' errors, up to the coarse gate: in a
# blurred or noisy image all corners err alike.
_FINE_GATE_SIGMAS = 5.0
# Largest reprojection error of a pose, px: 50 times the error of a corner in a sharp image, so that
# only wrong poses are rejected.
MAX_RMS_PX = 2.0
# Excess of -2 log likelihood over the best, up to which the second pose of a plane is kept.
_AMBIGUITY_LIMIT = 25.0
# Poses are tried from all markers together and from this many of the largest. Each costs a solution
# by IPPE; with six there is one right marker unless most are false.
_CANDIDATE_MARKERS = 6
# Largest error of a coarse pose of a plane, px.
_PLANE_RMS_PX = 1.0
# Of a plane's two coarse poses, one counts as the refined pose if its angle to that is this share
# of the other's.
_SAME_POSE_SHARE = 0.25
# Squared error of a side, of which two are expected, above which it may be wrong: one of 3,000
# right ones is. So much must an image explain better without it, in units of the noise; its errors
# count by this weight then. So many sides are tried, and so many found in one image.
_WRONG_SIDE_SQUARE, _WRONG_SIDE_WEIGHT, _SUSPECTS, _MOST_WRONG_SIDES = 16.0, 0.02, 8, 4
# A single marker counts as a false id if this many others should be as visible and none is
# detected.
_MAX_MISSING = 2
# Half cells around the place where a pose puts a marker, within which it is looked for: the
# neighbours of a single one (a corner that is wrong by a pixel moves them by two), and those that
# are left when a pose is known. Larger: more time, and more false ones.
_ALONE_HALF_CELLS, _LEFT_HALF_CELLS = 4, 1
# Distance from the image's border, px, within which a marker need not be visible: its white border,
# which the detector needs, may be cut. Larger: fewer false ids are recognized; smaller: right ones
# are rejected.
_FRAME_MARGIN_PX = 8.0


@dataclass(frozen=True)
class TargetPose:
    """Pose of the target in the camera.

    ``position_irf_m`` (3,); ``q_irf_trf_wxyz`` (4,) rotates TRF -> IRF; ``covariance`` (6, 6):
    position in IRF axes (m), then dtheta (rad) in TRF axes with q_true = q (x) exp(dtheta);
    ``reprojection_rms_px``: root of the mean squared distance between detected and projected
    corners.
    """

    position_irf_m: Array
    q_irf_trf_wxyz: Array
    covariance: Array
    reprojection_rms_px: float


@dataclass(frozen=True)
class MarkerTable:
    """The m markers of a target as arrays, in metres and TRF.

    ``ids`` (m,); ``corners`` (m, 4, 3); ``origins`` (m, 3); ``rotations`` (m, 3, 3): marker to TRF.
    ``margin_share`` (m,): width of the white border over the side. ``outlined`` (m,): whether the
    border ends at that width on all sides.
    """

    ids: NDArray[np.int64]
    corners: Array
    origins: Array
    rotations: Array
    margin_share: Array
    outlined: NDArray[np.bool_]

    @cached_property
    def normals(self) -> Array:
        """Unit vectors (m, 3) in TRF, out of the marked faces."""
        return np.ascontiguousarray(self.rotations[:, :, 2])

    @cached_property
    def surface(self) -> Array:
        """Corners (4 m, 3), origins (m, 3) and normals (m, 3), to be rotated together."""
        return np.concatenate([self.corners.reshape(-1, 3), self.origins, self.normals])

    @staticmethod
    @lru_cache(maxsize=8)
    def of(model: TargetModel) -> MarkerTable:
        """Return the table of a model's markers, in their order; not to be written to, as it is
        shared.
        """
        markers = model.markers
        margins_m = np.array([clear_margin_m(model, m) for m in markers])
        return MarkerTable(
            np.array([m.id for m in markers], dtype=np.int64),
            np.array([m.corners_trf_m() for m in markers]).reshape(-1, 4, 3),
            np.array([m.position_trf_m for m in markers]).reshape(-1, 3),
            np.array([rotations.to_matrix(m.q_trf_marker_wxyz) for m in markers]).reshape(-1, 3, 3),
            margins_m / np.array([m.side_m for m in markers]),
            # Nothing is nearer than the end of the white paint.
            np.abs(margins_m - model.white_margin_m) < 1e-9,
        )


@dataclass(frozen=True)
class _DetectedMarkers:
    """n detections with what is known of their markers.

    ``which``: row of each in the marker table. ``points`` (n, 4, 3): corners in TRF. ``pixels`` (n,
    4, 2): ideal. ``errors``: of each marker's corners.
    """

    camera: Camera
    table: MarkerTable
    which: Indices
    points: Array
    pixels: Array
    errors: CornerErrors

    @cached_property
    def normals(self) -> Array:
        """Unit vectors (n, 3) in TRF, out of the marked faces."""
        return self.table.normals[self.which]

    @cached_property
    def plane_poses(self) -> list[PoseInCamera]:
        """Poses of `_plane_poses`, cached: a single marker needs them both as candidates and as
        solutions.
        """
        return _plane_poses(self)

    def followed_by(self, others: FurtherMarkers) -> _DetectedMarkers:
        which = np.concatenate([self.which, others.which])
        pixels = np.concatenate([self.pixels, others.corners_px])
        errors = self.errors.followed_by(others.errors)
        return _DetectedMarkers(
            self.camera, self.table, which, self.table.corners[which], pixels, errors
        )

    def part(self, of: list[int]) -> _DetectedMarkers:
        if len(of) == len(self.which):  # indices are ascending and distinct: all of them
            return self
        return _DetectedMarkers(
            self.camera,
            self.table,
            self.which[of],
            self.points[of],
            self.pixels[of],
            self.errors.part(of),
        )


@dataclass(frozen=True)
class FurtherMarkers:
    """k markers that fewer or worse corners than those of a pose show, to be added to it.

    ``which`` (k,), ``corners_px`` (k, 4, 2), ideal, and ``errors`` as for `solve`. ``read``:
    indices of those at the places where their cells were read.
    """

    which: Indices
    corners_px: Array
    errors: CornerErrors
    read: range


Further = Callable[[PoseInCamera, Indices, int], tuple[int, FurtherMarkers]]
"""Returns the markers beside given rows that an image shows at a pose, each up to so many half
cells away, and the number of those returned before."""


def solve(
    camera: Camera,
    table: MarkerTable,
    which: Indices,
    corners_ideal_px: Array,
    errors: CornerErrors,
    further: Further | None = None,
) -> tuple[tuple[TargetPose, ...], Indices]:
    """Return the poses, best first, that explain the detections, and the indices of those used.

    ``which`` (n,): row of ``table`` of each detection; a row may occur more than once.
    ``corners_ideal_px`` (n, 4, 2). ``errors``: of their corners. ``further``: markers to be added
    to a pose; their indices follow those of the detections.

    Returns no pose and no indices if nothing is explained well, if a single marker is seen at a
    grazing angle or without others that its pose would show, or if two equally large groups of
    detections contradict each other. Returns two poses if the markers are coplanar and their tilt
    is ambiguous.
    """
    nothing: tuple[tuple[TargetPose, ...], Indices] = ((), np.zeros(0, dtype=np.intp))
    if not len(which):
        return nothing
    seen = _DetectedMarkers(
        camera,
        table,
        which,
        table.corners[which],
        np.array(corners_ideal_px, dtype=float, order="C"),
        errors,
    )
    found = _consensus(seen)
    if found is None:
        return nothing
    pose, used = found
    if len(which) >= 2 * len(used):
        others = sorted(set(range(len(which))).difference(used, _seen_twice(seen, used)))
        rival = _consensus(seen.part(others)) if others else None
        if rival is not None and len(rival[1]) >= len(used):
            return nothing

    seen = first = seen.part(used)
    if further is not None:
        seen, pose, added = _with_further(first, pose, further, 0)
        if len(used) == 1 and not added:
            seen, pose, added = _with_neighbours(first, pose, further)
            first = seen
        else:
            seen, pose, left = _with_further(seen, pose, further, _LEFT_HALF_CELLS)
            added += left
        used = used + [len(which) + k for k in added]
    seen, pose = _without_wrong_sides(seen, pose)
    poses = [pose]
    # Coplanar corners, as those of a single marker, may have a second pose.
    if len(used) == 1 or np.ptp(seen.points @ seen.normals[0]) < 1e-6:
        poses += _other_than(pose, first.plane_poses)
    solutions = _solutions(seen, poses)
    if not solutions or solutions[0].reprojection_rms_px > MAX_RMS_PX:
        return nothing
    if len(used) == 1:
        row = int(seen.which[0])
        solutions = [s for s in solutions if _is_single_marker_valid(camera, table, row, s)]
    return (tuple(solutions), np.array(used, dtype=np.intp)) if solutions else nothing


def pose_covariance(
    camera: Camera, points_trf_m: Array, pixels: Array, errors: CornerErrors, pose: PoseInCamera
) -> tuple[Array, Array, float] | None:
    """Return the covariance (6, 6) of a pose, as in `TargetPose`, for the stated errors: by those
    that corners have by themselves, and by the common one; and its whitened sum of squares, without
    what the common error explains.

    The pose fits the corners (n, 4, 3) of n markers to ideal pixels (n, 4, 2) with ``errors``. None
    if the pose is not observable or has points behind the camera.
    """
    found = residual_of(camera.matrix(), points_trf_m, pixels, errors.whitening, pose)
    if found is None:
        return None
    residual, jacobian = found
    rss = float(residual @ residual)
    # By position and dtheta: a rotation phi in camera axes is R dtheta.
    jacobian = np.concatenate([jacobian[:, 3:], jacobian[:, :3] @ pose.rotation], axis=1)
    information = jacobian.T @ jacobian
    if not (math.isfinite(rss) and math.isfinite(float(information.sum()))):
        return None
    # Metres and radians are scaled to comparable size before the condition number is checked.
    each = [1.0 / math.sqrt(max(d, 1e-300)) for d in information.diagonal().tolist()]
    scale = np.array([[a * b for b in each] for a in each])
    values, vectors = np.linalg.eigh(information * scale)
    least, *_, largest = values.tolist()
    if not least > 1e-12 * largest:
        return None
    inverse = (vectors / values) @ vectors.T * scale
    common = errors.common.ravel()
    moved = inverse @ (jacobian.T @ common)
    left = common - jacobian @ moved
    rss -= float(left @ residual) ** 2 / (1.0 + float(left @ left))
    return 0.5 * (inverse + inverse.T), np.outer(moved, moved), rss


def reprojection_rms_px(
    camera: Camera, points_trf_m: Array, pixels: Array, position: Array, rotation: Array
) -> float:
    """Return the root mean squared distance (ideal px) of projected points (n, 3) from ``pixels``
    (n, 2).
    """
    squares = squared_errors(camera, points_trf_m, pixels, PoseInCamera(position, rotation))
    return math.sqrt(float(squares.sum()) / len(squares))


def _consensus(seen: _DetectedMarkers) -> tuple[PoseInCamera, list[int]] | None:
    """Return the refined pose with the most inliers, and their indices in ``seen``, ascending."""
    which: list[int] = seen.which.tolist()
    best: tuple[tuple[int, float], PoseInCamera, list[float]] | None = None
    for candidate in _candidates(seen):
        candidate_error = _marker_errors(seen, candidate)
        # Distinct ids: of two detections of one id at most one is right.
        near = [row for row, e in zip(which, candidate_error, strict=True) if e < _COARSE_GATE_PX]
        support = len(set(near))
        if support == 0:
            continue
        score = support, -float(np.minimum(candidate_error, _COARSE_GATE_PX).sum())
        if best is None or score > best[0]:
            best = score, candidate, candidate_error
        if support == len(which) and max(candidate_error) < _FINE_GATE_PX:
            break  # all are inliers: no other candidate is needed

    if best is None:
        return None
    _, pose, error = best

    used = _one_of_each(which, error, _COARSE_GATE_PX)
    for _ in range(3):
        refined = _refined(seen.part(used), pose)
        if refined is None:
            return None
        pose, error = refined, _marker_errors(seen, refined)
        gate = 2.0 * _FINE_GATE_PX
        if len(used) > 2:
            sigmas = _FINE_GATE_SIGMAS * statistics.median(error[k] for k in used)
            gate = min(max(_FINE_GATE_PX, sigmas), _COARSE_GATE_PX)
        kept = _one_of_each(which, error, gate)
        if not kept:
            return None
        if kept == used:
            break
        used = kept
    return pose, used


def _candidates(seen: _DetectedMarkers) -> Iterator[PoseInCamera]:
    """Yield coarse poses, the most likely first."""
    if len(seen.which) == 1:
        yield from seen.plane_poses
        return
    points, pixels = seen.points.reshape(-1, 3), seen.pixels.reshape(-1, 2)
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            points, pixels, seen.camera.matrix(), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # degenerate corners
        rvecs, tvecs = (), ()
    for rvec, tvec in zip(rvecs[:1], tvecs[:1], strict=True):
        yield PoseInCamera(np.asarray(tvec, dtype=float).ravel(), rotation_matrix(rvec))
    size = np.abs(seen.pixels[:, (1, 2, 3, 0)] - seen.pixels).sum(axis=-1).min(axis=-1)
    for i in np.argsort(-size, kind="stable")[:_CANDIDATE_MARKERS].tolist():
        yield from seen.part([i]).plane_poses


def _refined(seen: _DetectedMarkers, pose: PoseInCamera) -> PoseInCamera | None:
    return refine(seen.camera.matrix(), seen.points, seen.pixels, seen.errors.whitening, pose)


def _plane_poses(seen: _DetectedMarkers) -> list[PoseInCamera]:
    """Return both IPPE poses from points in the plane of the first marker, or SQPnP's pose where
    IPPE fails.
    """
    to_trf, origin = seen.table.rotations[seen.which[0]], seen.table.origins[seen.which[0]]
    flat = (seen.points.reshape(-1, 3) - origin) @ to_trf
    flat[:, 2] = 0.0  # IPPE requires exactly zero
    pixels, matrix = seen.pixels.reshape(-1, 2), seen.camera.matrix()
    try:
        _, rvecs, tvecs, rms_px = cv2.solvePnPGeneric(
            flat, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE
        )
        if not np.asarray(rms_px).min() < _PLANE_RMS_PX:
            # Face-on, OpenCV's IPPE returns an arbitrary rotation vector for a rotation by 180
            # degrees.
            _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
                flat, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP
            )
    except cv2.error:  # degenerate corners
        return []
    poses = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        rotation = rotation_matrix(rvec) @ to_trf.T
        position = np.asarray(tvec, dtype=float).ravel() - rotation @ origin
        if _all_finite(rotation) and _all_finite(position):
            poses.append(PoseInCamera(position, rotation))
    return poses


def _all_finite(values: Array) -> bool:
    return all(map(math.isfinite, values.ravel().tolist()))


def _other_than(pose: PoseInCamera, candidates: list[PoseInCamera]) -> list[PoseInCamera]:
    """Return ``candidates`` without the one that converges to the refined ``pose``.

    Only if of two candidates one is several times nearer to it.
    """
    if len(candidates) != 2:
        return candidates
    a, b = (_angle(candidate.rotation, pose.rotation) for candidate in candidates)
    if min(a, b) < _SAME_POSE_SHARE * max(a, b):
        return candidates[1:] if a < b else candidates[:1]
    return candidates


def _angle(a: Array, b: Array) -> float:
    """Return the angle, 0 to pi, between two rotation matrices (their Frobenius distance is sqrt(8)
    sin(angle / 2)).
    """
    difference = (a - b).ravel()
    return 2.0 * math.asin(min(math.sqrt(float(difference @ difference) / 8.0), 1.0))


def _seen_twice(seen: _DetectedMarkers, used: list[int]) -> set[int]:
    """Return the detections that are second ones of a used marker, such as the outer edge of its
    white border: of the same id, with the centre inside it.
    """
    centres = seen.pixels.mean(axis=1)
    reach = np.linalg.norm(seen.pixels - centres[:, None], axis=-1).min(axis=1)
    return {
        k
        for k in range(len(seen.which))
        for u in used
        if seen.which[k] == seen.which[u] and math.dist(centres[k], centres[u]) < 0.5 * reach[u]
    }


def _with_further(
    seen: _DetectedMarkers, pose: PoseInCamera, further: Further, half_cells: int
) -> tuple[_DetectedMarkers, PoseInCamera, list[int]]:
    """Return the markers of a pose with those ``further`` ones that agree with it, the pose of all,
    and the indices of these among all further ones.
    """
    before, more = further(pose, seen.which, half_cells)
    joined, pose, kept = _with_agreeing(seen, pose, more)
    return joined, pose, [before + k for k in kept]


def _with_agreeing(
    seen: _DetectedMarkers, pose: PoseInCamera, further: FurtherMarkers
) -> tuple[_DetectedMarkers, PoseInCamera, list[int]]:
    """Return the same with indices in ``further``."""
    which, n = further.which, len(seen.which)
    if not len(which):
        return seen, pose, []
    points, normals = seen.table.corners[which], seen.table.normals[which]
    error = marker_errors(seen.camera, points, normals, further.corners_px, pose)
    sigma_px = np.sqrt(8.0 / np.square(further.errors.whitening).sum(axis=(1, 2)))
    gate = np.clip(_FINE_GATE_SIGMAS * sigma_px, _FINE_GATE_PX, _COARSE_GATE_PX)
    near = [
        # A fitted marker comes before the same one at the place where it was read.
        e + (_COARSE_GATE_PX if k in further.read else 0.0) if e < g else math.inf
        for k, (e, g) in enumerate(zip(error, gate.tolist(), strict=True))
    ]
    kept = _one_of_each(which.tolist(), near, 2.0 * _COARSE_GATE_PX)
    if not kept:
        return seen, pose, []
    joined = seen.followed_by(further).part([*range(n), *(n + k for k in kept)])
    refined = _refined(joined, pose)
    return (seen, pose, []) if refined is None else (joined, refined, kept)


def _with_neighbours(
    alone: _DetectedMarkers, pose: PoseInCamera, further: Further
) -> tuple[_DetectedMarkers, PoseInCamera, list[int]]:
    """Return a single marker with its neighbours, the pose of all, and the indices of the
    neighbours among ``further`` ones.

    A pose of one small marker puts others some of their cells away from where they are. At least
    half of the markers that should be as visible must be found there: others are a false id's.
    """
    best, row = (alone, pose, list[int]()), int(alone.which[0])
    for candidate in (pose, *_other_than(pose, alone.plane_poses)[:1]):
        before, more = further(candidate, alone.which, _ALONE_HALF_CELLS)
        found = _consensus(alone.followed_by(more)) if len(more.which) else None
        if found is None or found[1][0] != 0:
            continue
        seen, refined, kept = _with_agreeing(alone, found[0], more)
        seen, refined, left = _with_further(seen, refined, further, _LEFT_HALF_CELLS)
        kept = [before + k for k in kept] + left
        expected, _ = count_visible_markers(
            alone.camera, alone.table.surface, row, refined, _FRAME_MARGIN_PX
        )
        if len(kept) > len(best[2]) and 2 * len(kept) >= expected:
            best = seen, refined, kept
    return best


def _without_wrong_sides(
    seen: _DetectedMarkers, pose: PoseInCamera
) -> tuple[_DetectedMarkers, PoseInCamera]:
    """Return the markers with larger errors of sides that contradict the others, and their pose.

    Such sides are fitted to something else, as the edge of a brighter face beside a narrow border.
    """
    for _ in range(_MOST_WRONG_SIDES):
        square = _side_squares(seen, pose)
        if not float(square.max()) > _WRONG_SIDE_SQUARE or square.size <= 4:
            break
        trials = []
        for k in np.argsort(-square, kind="stable")[:_SUSPECTS].tolist():
            weights = np.ones(square.size)
            weights[k] = _WRONG_SIDE_WEIGHT
            less = seen.errors.weighted(np.repeat(weights, 2).reshape(-1, 8))
            trial = replace(seen, errors=less)
            refined = _refined(trial, pose)
            if refined is not None:
                trials.append((float(_side_squares(trial, refined).sum()), trial, refined))
        if not trials:
            break
        rss, better, refined = min(trials, key=lambda t: t[0])
        noise = max(1.0, rss / (2.0 * square.size - 6.0))
        if rss + _WRONG_SIDE_SQUARE * noise > float(square.sum()):
            break
        seen, pose = better, refined
    return seen, pose


def _side_squares(seen: _DetectedMarkers, pose: PoseInCamera) -> Array:
    """Return the whitened squared error (4 n,) of each side; zero behind the camera."""
    found = residual_of(seen.camera.matrix(), seen.points, seen.pixels, seen.errors.whitening, pose)
    return (
        np.zeros(4 * len(seen.which))
        if found is None
        else np.square(found[0]).reshape(-1, 2).sum(axis=1)
    )


def _solutions(seen: _DetectedMarkers, poses: list[PoseInCamera]) -> list[TargetPose]:
    """Return refined, distinct poses, best first; later ones are about as likely as the first.

    Errors are as large as stated, and as the residuals of the best pose tell: of the stated
    variance's factor, which has an inverse gamma distribution of ``_PRIOR_RESIDUALS`` degrees of
    freedom, the mean by them is taken.
    """
    found: list[tuple[float, Array, Array, PoseInCamera]] = []
    for number, pose in enumerate(poses):
        refined = pose if number == 0 else _refined(seen, pose)  # the first one is refined already
        if refined is None:
            continue
        if any(_angle(refined.rotation, other.rotation) < 1e-3 for *_, other in found):
            continue
        result = pose_covariance(seen.camera, seen.points, seen.pixels, seen.errors, refined)
        if result is not None:
            found.append((result[2], result[0], result[1], refined))
    if not found:
        return []
    found.sort(key=lambda item: item[0])
    least, free = found[0][0], int(seen.errors.whitening.any(axis=2).sum()) - 6
    factor = max((_PRIOR_RESIDUALS + least) / (_PRIOR_RESIDUALS + free), _LEAST_FACTOR)
    points, pixels = seen.points.reshape(-1, 3), seen.pixels.reshape(-1, 2)
    return [
        TargetPose(
            pose.position,
            rotations.from_matrix(pose.rotation),
            factor * own + common,
            reprojection_rms_px(seen.camera, points, pixels, pose.position, pose.rotation),
        )
        for rss, own, common, pose in found
        if rss - least <= _AMBIGUITY_LIMIT * factor
    ]


def _one_of_each(which: list[int], error: list[float], gate_px: float) -> list[int]:
    """Return the indices, ascending, of the best detection of each marker within the gate."""
    kept: dict[int, int] = {}
    for k in sorted(range(len(error)), key=error.__getitem__):
        if error[k] < gate_px:
            kept.setdefault(which[k], k)
    return sorted(kept.values())


def _marker_errors(seen: _DetectedMarkers, pose: PoseInCamera) -> list[float]:
    return marker_errors(seen.camera, seen.points, seen.normals, seen.pixels, pose)


def _is_single_marker_valid(
    camera: Camera, table: MarkerTable, row: int, solution: TargetPose
) -> bool:
    """Return whether the pose of a single marker is observable, and explains that no other is
    detected.
    """
    pose = PoseInCamera(solution.position_irf_m, rotations.to_matrix(solution.q_irf_trf_wxyz))
    missing, cosine = count_visible_markers(camera, table.surface, row, pose, _FRAME_MARGIN_PX)
    return cosine >= MIN_SINGLE_COSINE and missing < _MAX_MISSING
