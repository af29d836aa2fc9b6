"""Pose of a target from the corners of its markers, in ideal (undistorted) pixels.

Candidates from SQPnP (G. Terzakis, M. Lourakis, ECCV 2020) and IPPE (T. Collins, A. Bartoli, IJCV 2014), a
consensus over markers against false ids, Gauss-Newton with Levenberg's damping on the reprojection error, and
sigma^2 (J'J)^-1 as covariance. OpenCV's EPnP is left alone: it fails on coplanar points.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel, clear_margin_m
from numpy.typing import NDArray

from .refine import Pose, refine, residual_of, rotation_matrix
from .views import marker_errors, plain_markers, squared_errors

Indices = NDArray[np.intp]

# Corner noise is never taken to be below this, pixels; a single marker leaves but two degrees of freedom.
SIGMA_FLOOR_PX, SIGMA_FLOOR_SINGLE_PX = 0.1, 0.2
# A single marker seen at a more grazing angle than this says too little of its tilt, and overrates it.
MIN_SINGLE_COSINE = 0.25
# Worst corner of a marker that agrees with a coarse candidate, and with a refined pose.
_COARSE_GATE_PX, _FINE_GATE_PX = 6.0, 1.5
_FINE_GATE_SIGMAS = 5.0
MAX_RMS_PX = 2.0
# The second solution of a plane is kept when its -2 log likelihood is no more than this above the first's.
_AMBIGUITY_LIMIT = 25.0
_CANDIDATE_MARKERS = 6
# A plane's coarse pose that fits worse than this is none.
_PLANE_RMS_PX = 1.0
# Of a plane's two coarse poses, one this much nearer to the refined pose than the other is that very pose.
_SAME_POSE_SHARE = 0.25
# A lone marker is a false id when this many others ought to be as plain to see and none is.
_MAX_MISSING = 2
_FRAME_MARGIN_PX = 8.0


@dataclass(frozen=True)
class PoseSolution:
    """Pose of the target in the camera.

    ``position_irf_m`` (3,); ``q_irf_trf_wxyz`` (4,) rotates TRF -> IRF; ``covariance`` (6, 6): position in
    IRF axes (m), then dtheta (rad) in TRF axes with q_true = q (x) exp(dtheta); ``reprojection_rms_px``: root
    of the mean squared distance between a corner found and the same corner projected.
    """

    position_irf_m: Array
    q_irf_trf_wxyz: Array
    covariance: Array
    reprojection_rms_px: float


@dataclass(frozen=True)
class MarkerTable:
    """The m markers of a target as arrays: ``ids`` (m,), ``corners`` (m, 4, 3), ``origins`` (m, 3) and
    ``rotations`` (m, 3, 3), marker -> TRF, in metres in TRF; ``margin_share`` (m,): white border over side."""

    ids: NDArray[np.int64]
    corners: Array
    origins: Array
    rotations: Array
    margin_share: Array

    @cached_property
    def normals(self) -> Array:
        """Unit vectors (m, 3) in TRF, out of the marked faces."""
        return np.ascontiguousarray(self.rotations[:, :, 2])

    @cached_property
    def surface(self) -> Array:
        """Corners (4 m, 3), then origins (m, 3), then normals (m, 3): what a rotation turns at once."""
        return np.concatenate([self.corners.reshape(-1, 3), self.origins, self.normals])

    @classmethod
    def of(cls, model: TargetModel) -> MarkerTable:
        """The table of a model's markers, in their order."""
        markers = model.markers
        return cls(
            np.array([m.id for m in markers], dtype=np.int64),
            np.array([m.corners_trf_m() for m in markers]).reshape(-1, 4, 3),
            np.array([m.position_trf_m for m in markers]).reshape(-1, 3),
            np.array([rotations.to_matrix(m.q_trf_marker_wxyz) for m in markers]).reshape(-1, 3, 3),
            np.array([clear_margin_m(model, m) / m.side_m for m in markers]),
        )


@dataclass(frozen=True)
class _Seen:
    """n detections: ``which`` marker of the table each is, ``points`` (n, 4, 3) in TRF, ``pixels`` (n, 4, 2) and
    ``sigma`` (n,), relative."""

    camera: Camera
    table: MarkerTable
    which: Indices
    points: Array
    pixels: Array
    sigma: Array

    @cached_property
    def normals(self) -> Array:
        """Unit vectors (n, 3) in TRF, out of the marked faces."""
        return self.table.normals[self.which]

    @cached_property
    def weight(self) -> Array:
        """Of each number (8 n,) among the pixels."""
        return np.repeat(1.0 / self.sigma, 8)

    @cached_property
    def plane_poses(self) -> list[Pose]:
        """As `_plane_poses`, which of a lone marker are both its candidates and its two poses."""
        return _plane_poses(self)

    def part(self, of: list[int]) -> _Seen:
        if len(of) == len(self.which):  # indices are ascending and distinct: all of them
            return self
        return _Seen(
            self.camera, self.table, self.which[of], self.points[of], self.pixels[of], self.sigma[of]
        )


def solve(
    camera: Camera, table: MarkerTable, which: Indices, corners_ideal_px: Array, relative_sigma: Array
) -> tuple[tuple[PoseSolution, ...], Indices]:
    """Poses, best first, that explain the detected markers, and the indices of the detections they rest on.

    ``which`` (n,): row of ``table`` of each detection, a row may occur more than once; ``corners_ideal_px``
    (n, 4, 2); ``relative_sigma`` (n,): uncertainty of a detection's corners, over that of the best.
    None (and no indices) when nothing is explained well, when a single marker is seen at a grazing angle or
    without the many others that its pose would show, or when the detections fall into two camps of equal
    strength that contradict each other. Two when the markers lie in one plane and its tilt cannot be told from
    its mirror image.
    """
    nothing: tuple[tuple[PoseSolution, ...], Indices] = ((), np.zeros(0, dtype=np.intp))
    if not len(which):
        return nothing
    seen = _Seen(
        camera,
        table,
        which,
        table.corners[which],
        np.array(corners_ideal_px, dtype=float, order="C"),
        relative_sigma,
    )
    found = _consensus(seen)
    if found is None:
        return nothing
    pose, used = found
    if len(which) >= 2 * len(used):
        others = set(range(len(which))).difference(used)
        rival = _consensus(seen.part(sorted(others)))
        if rival is not None and len(rival[1]) >= len(used):
            return nothing

    seen = seen.part(used)
    poses = [pose]
    # All in one plane, as those of one marker are: there may be a second pose.
    if len(used) == 1 or np.ptp(seen.points @ seen.normals[0]) < 1e-6:
        poses += _other_than(pose, seen.plane_poses)
    floor = SIGMA_FLOOR_SINGLE_PX if len(used) == 1 else SIGMA_FLOOR_PX
    solutions = _solutions(seen, poses, floor)
    if not solutions or solutions[0].reprojection_rms_px > MAX_RMS_PX:
        return nothing
    if len(used) == 1:
        row = int(seen.which[0])
        solutions = [s for s in solutions if _may_stand_alone(camera, table, row, s)]
    return (tuple(solutions), np.array(used, dtype=np.intp)) if solutions else nothing


def pose_covariance(
    camera: Camera,
    points_trf_m: Array,
    pixels: Array,
    position: Array,
    rotation: Array,
    floor_px: float,
    sigma: Array,
) -> tuple[Array, float] | None:
    """Covariance (6, 6), as in `PoseSolution`, and weighted sum of squared residuals of a pose.

    The pose fits n points (n, 3) to n ideal pixels (n, 2) with relative uncertainties ``sigma`` (n,). It is
    s^2 (J'J)^-1 with s^2 = rss / (2n - 6), s at least ``floor_px``. None when the geometry leaves the pose
    undetermined or has points behind the camera.
    """
    pose = Pose(position, rotation)
    found = residual_of(camera.matrix(), points_trf_m, pixels, np.repeat(1.0 / sigma, 2), pose)
    if found is None:
        return None
    residual, jacobian = found
    rss = float(residual @ residual)
    # By position and dtheta: a turn phi in the camera's axes is R dtheta.
    jacobian = np.concatenate([jacobian[:, 3:], jacobian[:, :3] @ rotation], axis=1)
    information = jacobian.T @ jacobian
    if not (math.isfinite(rss) and math.isfinite(float(information.sum()))):
        return None
    variance = max(floor_px**2, rss / (len(residual) - 6))
    # Metres and radians are scaled to comparable size before the condition is judged.
    each = [1.0 / math.sqrt(max(d, 1e-300)) for d in information.diagonal().tolist()]
    scale = np.array([[a * b for b in each] for a in each])
    values, vectors = np.linalg.eigh(information * scale)
    least, *_, largest = values.tolist()
    if not least > 1e-12 * largest:
        return None
    inverse = (vectors / values) @ vectors.T * scale
    return variance * 0.5 * (inverse + inverse.T), rss


def reprojection_rms_px(
    camera: Camera, points_trf_m: Array, pixels: Array, position: Array, rotation: Array
) -> float:
    """Root mean squared distance, ideal pixels, of projected points (n, 3) from ``pixels`` (n, 2)."""
    squares = squared_errors(camera, points_trf_m, pixels, Pose(position, rotation))
    return math.sqrt(float(squares.sum()) / len(squares))


def _consensus(seen: _Seen) -> tuple[Pose, list[int]] | None:
    """The pose on which the most markers agree, refined, and which of ``seen`` these are, in ascending order."""
    which: list[int] = seen.which.tolist()
    best: tuple[tuple[int, float], Pose, list[float]] | None = None
    for candidate in _candidates(seen):
        candidate_error = _marker_errors(seen, candidate)
        # Not the number of detections: two of one id cannot both be right.
        near = [row for row, e in zip(which, candidate_error, strict=True) if e < _COARSE_GATE_PX]
        support = len(set(near))
        if support == 0:
            continue
        score = support, -float(np.minimum(candidate_error, _COARSE_GATE_PX).sum())
        if best is None or score > best[0]:
            best = score, candidate, candidate_error
        if support == len(which) and max(candidate_error) < _FINE_GATE_PX:
            break  # all agree: no other candidate is needed
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


def _candidates(seen: _Seen) -> Iterator[Pose]:
    """Coarse poses to choose from, the likeliest first."""
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
        yield Pose(np.asarray(tvec, dtype=float).ravel(), rotation_matrix(rvec))
    size = np.abs(seen.pixels[:, (1, 2, 3, 0)] - seen.pixels).sum(axis=-1).min(axis=-1)
    for i in np.argsort(-size, kind="stable")[:_CANDIDATE_MARKERS].tolist():
        yield from seen.part([i]).plane_poses


def _refined(seen: _Seen, pose: Pose) -> Pose | None:
    points, pixels = seen.points.reshape(-1, 3), seen.pixels.reshape(-1, 2)
    return refine(seen.camera.matrix(), points, pixels, seen.weight, pose)


def _plane_poses(seen: _Seen) -> list[Pose]:
    """Both IPPE poses of the target from points in the plane of the first marker (or, where IPPE fails, SQPnP's one)."""
    to_trf, origin = seen.table.rotations[seen.which[0]], seen.table.origins[seen.which[0]]
    flat = (seen.points.reshape(-1, 3) - origin) @ to_trf
    flat[:, 2] = 0.0  # IPPE wants it exactly
    pixels, matrix = seen.pixels.reshape(-1, 2), seen.camera.matrix()
    try:
        _, rvecs, tvecs, rms_px = cv2.solvePnPGeneric(flat, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
        if not np.asarray(rms_px).min() < _PLANE_RMS_PX:
            # Seen exactly from ahead, OpenCV's IPPE makes any rotation vector out of a turn by 180 degrees.
            _, rvecs, tvecs, _ = cv2.solvePnPGeneric(flat, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # degenerate corners
        return []
    poses = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        rotation = rotation_matrix(rvec) @ to_trf.T
        position = np.asarray(tvec, dtype=float).ravel() - rotation @ origin
        if _all_finite(rotation) and _all_finite(position):
            poses.append(Pose(position, rotation))
    return poses


def _all_finite(values: Array) -> bool:
    return all(map(math.isfinite, values.ravel().tolist()))


def _other_than(pose: Pose, candidates: list[Pose]) -> list[Pose]:
    """``candidates`` without the one that would be refined to ``pose``, which is refined, where that is plain:
    of two, the one several times nearer to it than the other."""
    if len(candidates) != 2:
        return candidates
    a, b = (_angle(candidate.rotation, pose.rotation) for candidate in candidates)
    if min(a, b) < _SAME_POSE_SHARE * max(a, b):
        return candidates[1:] if a < b else candidates[:1]
    return candidates


def _angle(a: Array, b: Array) -> float:
    """Angle, 0 to pi, between two rotation matrices (their distance by Frobenius is sqrt(8) sin(angle / 2))."""
    difference = (a - b).ravel()
    return 2.0 * math.asin(min(math.sqrt(float(difference @ difference) / 8.0), 1.0))


def _solutions(seen: _Seen, poses: list[Pose], floor_px: float) -> list[PoseSolution]:
    """Refined, distinct poses, best first, of which the later ones are about as likely as the first."""
    points, pixels = seen.points.reshape(-1, 3), seen.pixels.reshape(-1, 2)
    sigma = np.repeat(seen.sigma, 4)
    found: list[tuple[float, PoseSolution]] = []
    kept: list[Array] = []
    for number, pose in enumerate(poses):
        refined = pose if number == 0 else _refined(seen, pose)  # the first one comes refined
        if refined is None or any(_angle(refined.rotation, other) < 1e-3 for other in kept):
            continue
        position, rotation = refined.position, refined.rotation
        result = pose_covariance(seen.camera, points, pixels, position, rotation, floor_px, sigma)
        if result is None:
            continue
        kept.append(rotation)
        rms = reprojection_rms_px(seen.camera, points, pixels, position, rotation)
        q = rotations.from_matrix(rotation)
        found.append((result[1], PoseSolution(position, q, result[0], rms)))
    if not found:
        return []
    found.sort(key=lambda item: item[0])
    least = found[0][0]
    variance = max(floor_px**2, least / (2 * len(points) - 6))
    return [solution for rss, solution in found if (rss - least) / variance <= _AMBIGUITY_LIMIT]


def _one_of_each(which: list[int], error: list[float], gate_px: float) -> list[int]:
    """Indices, in order, of the detections within the gate: of several of one marker, that of least error."""
    kept: dict[int, int] = {}
    for k in sorted(range(len(error)), key=error.__getitem__):
        if error[k] < gate_px:
            kept.setdefault(which[k], k)
    return sorted(kept.values())


def _marker_errors(seen: _Seen, pose: Pose) -> list[float]:
    return marker_errors(seen.camera, seen.points, seen.normals, seen.pixels, pose)


def _may_stand_alone(camera: Camera, table: MarkerTable, row: int, solution: PoseSolution) -> bool:
    """Whether the pose of a single marker says enough, and shows that one alone."""
    pose = Pose(solution.position_irf_m, rotations.to_matrix(solution.q_irf_trf_wxyz))
    missing, cosine = plain_markers(camera, table.surface, row, pose, _FRAME_MARGIN_PX)
    return cosine >= MIN_SINGLE_COSINE and missing < _MAX_MISSING
