"""Pose of a target from the corners of its markers, in ideal (undistorted) pixels.

Candidates from SQPnP (G. Terzakis, M. Lourakis, ECCV 2020) and IPPE (T. Collins, A. Bartoli, IJCV 2014), a
consensus over markers against false ids, Gauss-Newton with Levenberg's damping on the reprojection error, and
sigma^2 (J'J)^-1 as covariance. OpenCV's EPnP is left alone: it fails on coplanar points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_protocol import rotations
from chaserdock_protocol.camera import Camera
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.targets import TargetModel, clear_margin_m
from numpy.typing import NDArray

from chaserdock_agents.perception.refine import Pose, refine, residual_of, rotation_matrix

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

    def part(self, of: Indices) -> _Seen:
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
    seen = _Seen(camera, table, which, table.corners[which], np.asarray(corners_ideal_px), relative_sigma)
    found = _consensus(seen)
    if found is None:
        return nothing
    pose, used = found
    if len(which) >= 2 * len(used):
        others = np.delete(np.arange(len(which)), used)
        rival = _consensus(seen.part(others))
        if rival is not None and len(rival[1]) >= len(used):
            return nothing

    seen = seen.part(used)
    poses = [pose]
    first = table.rotations[seen.which[0]][:, 2] if len(used) else np.zeros(3)
    if np.ptp(seen.points @ first) < 1e-6:  # all in one plane: there may be a second pose
        poses += _other_than(pose, _plane_poses(seen))
    floor = SIGMA_FLOOR_SINGLE_PX if len(used) == 1 else SIGMA_FLOOR_PX
    solutions = _solutions(seen, poses, floor)
    if not solutions or solutions[0].reprojection_rms_px > MAX_RMS_PX:
        return nothing
    if len(used) == 1:
        row = int(seen.which[0])
        solutions = [
            s
            for s in solutions
            if _view_cosines(table, s)[row] >= MIN_SINGLE_COSINE
            and _missing(camera, table, row, s) < _MAX_MISSING
        ]
    return (tuple(solutions), used) if solutions else nothing


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
    scale = 1.0 / np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scale = scale * scale[:, None]
    values, vectors = np.linalg.eigh(information * scale)
    if not values[0] > 1e-12 * values[-1]:
        return None
    inverse = (vectors / values) @ vectors.T * scale
    return variance * 0.5 * (inverse + inverse.T), rss


def reprojection_rms_px(
    camera: Camera, points_trf_m: Array, pixels: Array, position: Array, rotation: Array
) -> float:
    """Root mean squared distance, ideal pixels, of projected points (n, 3) from ``pixels`` (n, 2)."""
    error = camera.project_ideal(points_trf_m @ rotation.T + position) - pixels
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


def _consensus(seen: _Seen) -> tuple[Pose, Indices] | None:
    """The pose on which the most markers agree, refined, and which of ``seen`` these are."""
    best: tuple[int, float] | None = None
    pose, error = Pose(np.zeros(3), np.eye(3)), np.zeros(0)
    for candidate in _candidates(seen):
        candidate_error = _marker_errors(seen, candidate)
        near = candidate_error < _COARSE_GATE_PX
        # Not the number of detections: two of one id cannot both be right.
        support = len(set(seen.which[near].tolist()))
        if support == 0:
            continue
        score = (support, -float(np.minimum(candidate_error, _COARSE_GATE_PX).sum()))
        if best is None or score > best:
            best, pose, error = score, candidate, candidate_error
        if support == len(near) and bool(np.all(candidate_error < _FINE_GATE_PX)):
            break  # all agree: no other candidate is needed
    if best is None:
        return None
    used = _one_of_each(seen.which, error, _COARSE_GATE_PX)
    for _ in range(3):
        refined = _refined(seen.part(used), pose)
        if refined is None:
            return None
        pose, error = refined, _marker_errors(seen, refined)
        gate = 2.0 * _FINE_GATE_PX
        if len(used) > 2:
            gate = min(max(_FINE_GATE_PX, _FINE_GATE_SIGMAS * float(np.median(error[used]))), _COARSE_GATE_PX)
        kept = _one_of_each(seen.which, error, gate)
        if len(kept) == 0:
            return None
        if np.array_equal(kept, used):
            break
        used = kept
    return pose, used


def _candidates(seen: _Seen) -> Iterator[Pose]:
    """Coarse poses to choose from, the likeliest first."""
    if len(seen.which) > 1:
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
    for i in np.argsort(-size, kind="stable")[:_CANDIDATE_MARKERS]:
        yield from _plane_poses(seen.part(np.array([i])))


def _refined(seen: _Seen, pose: Pose) -> Pose | None:
    points, pixels = seen.points.reshape(-1, 3), seen.pixels.reshape(-1, 2)
    return refine(seen.camera.matrix(), points, pixels, np.repeat(1.0 / seen.sigma, 8), pose)


def _plane_poses(seen: _Seen) -> list[Pose]:
    """Both IPPE poses of the target from points in the plane of the first marker (or, where IPPE fails, SQPnP's one)."""
    to_trf, origin = seen.table.rotations[seen.which[0]], seen.table.origins[seen.which[0]]
    flat = (seen.points.reshape(-1, 3) - origin) @ to_trf
    flat[:, 2] = 0.0  # IPPE wants it exactly
    pixels, matrix = seen.pixels.reshape(-1, 2), seen.camera.matrix()
    try:
        _, rvecs, tvecs, rms_px = cv2.solvePnPGeneric(flat, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
        if not np.min(np.asarray(rms_px)) < _PLANE_RMS_PX:
            # Seen exactly from ahead, OpenCV's IPPE makes any rotation vector out of a turn by 180 degrees.
            _, rvecs, tvecs, _ = cv2.solvePnPGeneric(flat, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # degenerate corners
        return []
    poses = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        rotation = rotation_matrix(rvec) @ to_trf.T
        position = np.asarray(tvec, dtype=float).ravel() - rotation @ origin
        if np.all(np.isfinite(rotation)) and np.all(np.isfinite(position)):
            poses.append(Pose(position, rotation))
    return poses


def _other_than(pose: Pose, candidates: list[Pose]) -> list[Pose]:
    """``candidates`` without the one that would be refined to ``pose``, which is refined, where that is plain:
    of two, the one several times nearer to it than the other."""
    if len(candidates) != 2:
        return candidates
    near, far = sorted(candidates, key=lambda candidate: _angle(candidate.rotation, pose.rotation))
    if _angle(near.rotation, pose.rotation) < _SAME_POSE_SHARE * _angle(far.rotation, pose.rotation):
        return [far]
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


def _one_of_each(which: Indices, error: Array, gate_px: float) -> Indices:
    """Indices, in order, of the detections within the gate: of several of one marker, that of least error."""
    kept: dict[int, int] = {}
    for k in np.argsort(error, kind="stable").tolist():
        if error[k] < gate_px:
            kept.setdefault(int(which[k]), k)
    return np.array(sorted(kept.values()), dtype=np.intp)


def _marker_errors(seen: _Seen, pose: Pose) -> Array:
    """Distance (n,) in pixels of each marker's worst corner; infinite if behind or seen from behind."""
    at = seen.points @ pose.rotation.T + pose.position
    error = np.sqrt(((seen.camera.project_ideal(at) - seen.pixels) ** 2).sum(axis=-1)).max(axis=-1)
    outwards = seen.table.rotations[seen.which][:, :, 2] @ pose.rotation.T
    facing = (outwards * at[:, 0]).sum(axis=-1) < 0.0
    return np.where(np.isfinite(error) & facing, error, np.inf)


def _view_cosines(table: MarkerTable, solution: PoseSolution) -> Array:
    """Cosine (m,) of the angle at which each marker is seen: 1 from straight ahead, negative from behind."""
    rotation = rotations.to_matrix(solution.q_irf_trf_wxyz)
    centres = table.origins @ rotation.T + solution.position_irf_m
    normals = table.rotations[:, :, 2] @ rotation.T
    return -(normals * centres).sum(axis=1) / np.linalg.norm(centres, axis=1)


def _missing(camera: Camera, table: MarkerTable, row: int, solution: PoseSolution) -> int:
    """How many markers other than ``row`` should be as plain to see as that one, if the pose were right."""
    at = table.corners @ rotations.to_matrix(solution.q_irf_trf_wxyz).T + solution.position_irf_m
    px = camera.project_ideal(at)
    size = np.abs(px[:, (1, 2, 3, 0)] - px).max(axis=-1).min(axis=-1)
    frame = np.array([camera.width_px, camera.height_px]) - 1.0 - _FRAME_MARGIN_PX
    inside = ((px > _FRAME_MARGIN_PX) & (px < frame)).all(axis=(1, 2))
    cosines = _view_cosines(table, solution)
    plain = inside & (size >= 0.6 * size[row]) & (cosines >= max(0.3, 0.7 * float(cosines[row])))
    plain[row] = False
    return int(plain.sum())
