# SPDX-License-Identifier: Apache-2.0
"""Adjust motion, cameras and landmarks to what cameras saw: bundle adjustment.

Unknowns are the nine of the motion, nine of each chaser's camera, three of each view (noise of its
attitude), three of each landmark and two of each track: how fast its point slides. Landmarks and
slides are eliminated (Schur complement); the others are few and solved densely.
Levenberg-Marquardt with Cauchy weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from .types import CameraUncertainty, CameraViews, ConstantRates, MapEstimate, Observations

MOTION, CAMERA, TURN = 9, 9, 3
"""Numbers of unknowns of the motion, of a chaser's camera and of a view."""


@dataclass(frozen=True)
class AdjustmentTuning:
    """Numbers of the adjustment, with units and reasons."""

    steps: int = 12
    """Most steps; from the last estimate three or four are needed."""
    least_gain: float = 1e-4
    """Relative gain of the cost below which it ends: the estimate then changes by a hundredth of
    its standard deviation."""
    robust_px: float = 0.6
    """Residual with half weight: twice that of a good track."""
    damping: float = 1e-4
    """First damping, share of the diagonal."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What an adjustment starts from. ``focal_px``: of all cameras. ``prior``: of the motion; along
    its axis of rotation it says where the origin of TRF is. ``noise_px``: of a coordinate, for
    independent observations. ``slide_px_s``: standard deviation of how fast a point slides.
    """

    views: CameraViews
    observations: Observations
    cameras: Sequence[CameraUncertainty]
    focal_px: float
    prior: ConstantRates
    noise_px: float
    slide_px_s: float

    @cached_property
    def tracks(self) -> _Tracks:
        """The tracks of the observations."""
        seen = self.observations
        keys, first, of = np.unique(seen.track, return_index=True, return_inverse=True)
        return _Tracks(of, seen.landmark[first], seen.weight * seen.age_s, _summing(of, len(keys)))


class _Tracks(NamedTuple):
    """The q tracks of k observations: ``of`` (k,) each is, ``landmark`` (q,) of each. ``lever_s``
    (k,): derivative of a weighted residual by the slide of its track. ``gather`` (q, k): sums.
    """

    of: IntArray
    landmark: IntArray
    lever_s: Array
    gather: sparse.csr_matrix

    def sums(self, values: Array) -> Array:
        """Return the sums (q, ...) of values (k, ...) by track."""
        return np.asarray(self.gather @ values)


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Result of an adjustment.

    ``residual_px`` (k,): of each observation. ``covariance`` (a, a): of motion and cameras,
    ``landmark_covariances_m2`` (n, 3, 3), TRF. ``centre_m`` (3,), WRF at the motion's time: mean of
    the landmarks; ``centre_covariance_m2`` (3, 3): it does not depend on where the origin is.
    ``cost``: mean of the robust costs of all observations. ``converged``: whether the last step
    gained next to nothing.
    """

    estimate: MapEstimate
    residual_px: Array
    covariance: Array
    landmark_covariances_m2: Array
    centre_m: Array
    centre_covariance_m2: Array
    cost: float
    converged: bool


@dataclass(frozen=True, eq=False)
class _Linearized:
    """Residuals (k, 2), px, and their derivatives by the 21 unknowns of motion, camera and view
    (k, 2, 21) and by the landmark (k, 2, 3).
    """

    residual: Array
    by_view: Array
    by_landmark: Array


def right_jacobian(phi: Array) -> Array:
    """Return the right Jacobian (n, 3, 3) of rotation vectors (n, 3) (Sola eq. 143)."""
    angle = np.linalg.norm(phi, axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    s = rotations.skew(phi)
    return np.eye(3) - a * s + b * (s @ s)


class _Geometry(NamedTuple):
    """Landmarks as views see them: rotations (m, 3, 3) TRF to WRF, IRF by odometry to the true IRF,
    and WRF to the true IRF; landmarks of observations (k, 3) in IRF.
    """

    turned: Array
    to_camera: Array
    from_w: Array
    points: Array


def _geometry(problem: Problem, estimate: MapEstimate) -> _Geometry:
    seen, views = problem.observations, problem.views
    position, turned = estimate.motion.at(views.time_s)
    error = estimate.cameras[views.chaser]
    to_camera = rotations.to_matrix(rotations.exp(-(error[:, :3] + estimate.turns)))
    # y = Q (p + R X - c) - T s, with Q from WRF and T from IRF by odometry to the true IRF.
    from_w = to_camera @ views.rotation.transpose(0, 2, 1)
    offset = np.einsum("mij,mj->mi", from_w, position - views.position_w_m)
    offset -= np.einsum("mij,mj->mi", to_camera, error[:, 3:6])
    matrix = from_w @ turned
    points = estimate.landmarks_m[seen.landmark]
    points = (matrix[seen.view] @ points[:, :, None])[:, :, 0] + offset[seen.view]
    return _Geometry(turned, to_camera, from_w, points)


class MapFit(NamedTuple):
    """How observations fit an estimate whose slides are those of least cost: the estimate, weighted
    residuals (k, 2), px, which are large for landmarks behind a camera, and depths (k,), m.
    """

    estimate: MapEstimate
    residual: Array
    depth_m: Array


def fit(problem: Problem, estimate: MapEstimate, robust_px: float) -> MapFit:
    """Return how observations fit motion, cameras, turns and landmarks of an estimate."""
    y, tracks = _geometry(problem, estimate).points, problem.tracks
    slides = np.zeros((len(tracks.landmark), 2))
    still = _residuals(problem, replace(estimate, slides_px_s=slides), y)
    residual = still
    for _ in range(_SLIDE_ROUNDS):
        weight = _weights(residual, robust_px) / problem.noise_px**2
        stiff = tracks.sums(weight * tracks.lever_s**2) + _slide_information(problem, slides)
        slides = -tracks.sums((weight * tracks.lever_s)[:, None] * still) / stiff[:, None]
        residual = still + tracks.lever_s[:, None] * slides[tracks.of]
    return MapFit(replace(estimate, slides_px_s=slides), residual, y[:, 2])


_SLIDE_ROUNDS = 3
"""Repetitions until the slides of tracks and the weights of their observations agree."""


def _residuals(problem: Problem, estimate: MapEstimate, y: Array) -> Array:
    depth = np.maximum(y[:, 2:], _LEAST_DEPTH_M)
    seen, tracks = problem.observations, problem.tracks
    error = estimate.cameras[problem.views.chaser[seen.view]]
    off = problem.focal_px * ((1.0 + error[:, 6:7]) * y[:, :2] / depth - seen.rays)
    slide = error[:, 7:9] + estimate.slides_px_s[tracks.of]
    return seen.weight[:, None] * off + tracks.lever_s[:, None] * slide


_LEAST_DEPTH_M = 0.02
"""Depth below which a landmark counts as behind a camera."""


def _linearize(problem: Problem, estimate: MapEstimate) -> _Linearized:
    views, seen, motion = problem.views, problem.observations, estimate.motion
    turned, to_camera, from_w, y = _geometry(problem, estimate)
    after = views.time_s - motion.time_s
    depth = np.maximum(y[:, 2], _LEAST_DEPTH_M)
    focal = problem.focal_px * (1.0 + estimate.cameras[views.chaser[seen.view], 6])
    by_y = np.zeros((len(y), 2, 3))
    by_y[:, 0, 0] = by_y[:, 1, 1] = focal / depth
    by_y[:, :, 2] = -(focal / depth**2)[:, None] * y[:, :2]
    by_y *= seen.weight[:, None, None]
    by_w = by_y @ from_w[seen.view]
    by_landmark = by_w @ turned[seen.view]
    jr = right_jacobian(motion.omega_rad_s * after[:, None]) * after[:, None, None]
    points = estimate.landmarks_m[seen.landmark]
    by_rate = -by_landmark @ rotations.skew(points) @ jr[seen.view]
    by_turn = by_y @ rotations.skew(y)
    out = np.empty((len(y), 2, MOTION + CAMERA + TURN))
    out[:, :, 0:3] = by_w
    out[:, :, 3:6] = by_w * after[seen.view, None, None]
    out[:, :, 6:9] = by_rate
    out[:, :, 9:12] = out[:, :, 18:21] = by_turn
    out[:, :, 12:15] = -by_y @ to_camera[seen.view]
    out[:, :, 15] = problem.focal_px * y[:, :2] * (seen.weight / depth)[:, None]
    out[:, :, 16:18] = np.eye(2) * problem.tracks.lever_s[:, None, None]
    return _Linearized(_residuals(problem, estimate, y), out, by_landmark)


class _Normal:
    """Normal equations: of motion, cameras and views, with landmarks and slides eliminated.

    ``u`` (a, a) and ``g`` (a,): of what is not eliminated. ``v`` (n, 3, 3), ``h`` (n, 3) and ``w``
    (n, 3, a): of landmarks. Those of slides, divided by the root of their information: ``c``
    (q, 2, a), ``e`` (q, 2, 3) with the track's landmark, ``s`` (q, 2); ``root`` (q,).
    """

    def __init__(self, problem: Problem, estimate: MapEstimate, weights: Array) -> None:
        lin, seen, views = _linearize(problem, estimate), problem.observations, problem.views
        tracks = problem.tracks
        count, landmarks = len(views.time_s), len(estimate.landmarks_m)
        chasers = len(problem.cameras)
        first_turn = MOTION + CAMERA * chasers
        size = first_turn + TURN * count
        root = np.sqrt(weights)[:, None] / problem.noise_px
        a, b = lin.by_view * root[:, :, None], lin.by_landmark * root[:, :, None]
        r = lin.residual * root
        u, g = np.zeros((size, size)), np.zeros(size)
        starts = np.searchsorted(seen.view, np.arange(count + 1))
        for view in range(count):
            rows = slice(starts[view], starts[view + 1])
            block = a[rows].reshape(-1, MOTION + CAMERA + TURN)
            at = self._places(views.chaser[view], view, first_turn)
            u[np.ix_(at, at)] += block.T @ block
            g[at] += block.T @ r[rows].ravel()
        self._chaser, self._turns = views.chaser[seen.view], first_turn + TURN * seen.view
        self._shape = (chasers, size)
        gather = _by_landmark(seen, landmarks)
        self.v = _gathered(gather, b.transpose(0, 2, 1) @ b)
        self.h = _gathered(gather, b.transpose(0, 2, 1) @ r[:, :, None])[:, :, 0]
        self.w = self._crossed(gather, b.transpose(0, 2, 1) @ a, seen.landmark)
        lever = tracks.lever_s * root[:, 0]
        information = tracks.sums(lever**2) + _slide_information(problem, estimate.slides_px_s)
        self.root = np.sqrt(information)
        share = lever / self.root[tracks.of]
        self.c = self._crossed(tracks.gather, share[:, None, None] * a, tracks.of)
        self.e = _gathered(tracks.gather, share[:, None, None] * b)
        prior = _slide_information(problem, estimate.slides_px_s)[:, None] * estimate.slides_px_s
        self.s = tracks.sums(share[:, None] * r) + prior / self.root[:, None]
        self.landmark = tracks.landmark
        joined = _summing(tracks.landmark, landmarks)
        back = self.e.transpose(0, 2, 1)
        self.v -= _gathered(joined, back @ self.e)
        self.h -= _gathered(joined, back @ self.s[:, :, None])[:, :, 0]
        self.w -= _gathered(joined, back @ self.c)
        flat = self.c.reshape(-1, size)
        g -= self.s.ravel() @ flat
        sigma = _prior_sigmas(problem)
        off = _off_prior(problem, estimate)
        u[np.diag_indices(size)] += 1.0 / sigma**2
        g += off / sigma**2
        axis = _gauge(problem)
        u[:3, :3] += np.outer(axis, axis)
        g[:3] += axis * (axis @ off[:3])
        self.u, self.g = u - flat.T @ flat, g

    def _crossed(self, gather: sparse.csr_matrix, cross: Array, group: IntArray) -> Array:
        """Return products (n, j, a) with all unknowns, by group, of products (k, j, 21) of
        observations with theirs.
        """
        chasers, size = self._shape
        by_motion = _gathered(gather, cross[:, :, :MOTION])
        out = np.zeros((*by_motion.shape[:2], size))
        out[:, :, :MOTION] = by_motion
        for chaser in range(chasers):
            own = (self._chaser == chaser)[:, None, None]
            at = MOTION + CAMERA * chaser
            part = cross[:, :, MOTION : MOTION + CAMERA] * own
            out[:, :, at : at + CAMERA] = _gathered(gather, part)
        rows = self._turns[:, None] + np.arange(TURN)
        out[group[:, None], :, rows] = cross[:, :, MOTION + CAMERA :].transpose(0, 2, 1)
        return out

    @staticmethod
    def _places(chaser: int, view: int, first_turn: int) -> IntArray:
        camera = MOTION + CAMERA * int(chaser)
        turn = first_turn + TURN * view
        return np.concatenate(
            [np.arange(MOTION), np.arange(camera, camera + CAMERA), np.arange(turn, turn + TURN)]
        )

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Return the reduced matrix (a, a) and vector (a,), and the inverse (n, 3, 3) of the
        landmarks' blocks.
        """
        v = self.v + np.eye(3) * _FLOOR
        v = v + np.eye(3) * (damping * np.einsum("nii->ni", v)[:, None, :])
        lower = np.linalg.inv(np.linalg.cholesky(v))
        whitened = (lower @ self.w).reshape(-1, len(self.u))
        inverse = lower.transpose(0, 2, 1) @ lower
        s = self.u + np.diag(damping * np.diag(self.u)) - whitened.T @ whitened
        rhs = self.g - np.einsum("nij,nj->ni", lower, self.h).ravel() @ whitened
        return s, rhs, inverse

    def step(self, damping: float) -> tuple[Array, Array, Array]:
        """Return the steps of motion, cameras and views (a,), of the landmarks (n, 3), and of the
        slides (q, 2).
        """
        s, rhs, inverse = self.reduced(damping)
        first = -cho_solve(cho_factor(s, lower=True), rhs)
        points = -np.einsum("nij,nj->ni", inverse, self.h + self.w @ first)
        of_points = np.einsum("qij,qj->qi", self.e, points[self.landmark])
        return first, points, -(self.s + self.c @ first + of_points) / self.root[:, None]


_FLOOR = 1e-3
"""Information, 1/m^2, that keeps a landmark seen along one line solvable: 30 m."""


def _by_landmark(seen: Observations, count: int) -> sparse.csr_matrix:
    """Return the matrix (n, k) that sums what observations have by landmark."""
    return _summing(seen.landmark, count)


def _summing(group: IntArray, count: int) -> sparse.csr_matrix:
    """Return the matrix (n, k) that sums values (k, ...) by their groups (k,)."""
    every = np.arange(len(group))
    return sparse.csr_matrix((np.ones(len(every)), (group, every)), (count, len(every)))


def _gathered(gather: sparse.csr_matrix, values: Array) -> Array:
    """Return the sums (n, ...) of values (k, ...) by landmark."""
    flat = gather @ values.reshape(len(values), -1)
    return np.asarray(flat).reshape(-1, *values.shape[1:])


def _off_prior(problem: Problem, estimate: MapEstimate) -> Array:
    """Return motion, cameras and turns (a,) less what is expected of them."""
    motion = estimate.motion.vector() - problem.prior.vector()
    return np.concatenate([motion, estimate.cameras.ravel(), estimate.turns.ravel()])


def _prior_sigmas(problem: Problem) -> Array:
    motion = np.repeat([_POSITION_PRIOR_M, _VELOCITY_PRIOR_M_S, _RATE_PRIOR_RAD_S], 3)
    mean_px_s = _MEAN_SLIDE * problem.slide_px_s
    cameras = [
        np.array([*[c.turn_rad] * 3, *[c.shift_m] * 3, c.focal_share, *[mean_px_s] * 2])
        for c in problem.cameras
    ]
    noise = np.array([view_turn_sigma_rad(c) for c in problem.cameras])
    turns = np.repeat(noise[problem.views.chaser], 3)
    return np.maximum(np.concatenate([motion, *cameras, turns]), _LEAST_SIGMA)


def _gauge(problem: Problem) -> Array:
    """Return the row (3,) that keeps the origin where the prior puts it along the first axis of
    rotation: images do not tell where along the axis it is.
    """
    axis = problem.prior.omega_rad_s
    return axis / max(float(np.linalg.norm(axis)), _LEAST_SIGMA) / _GAUGE_SIGMA_M


_GAUGE_SIGMA_M = 1e-4
"""Standard deviation of the origin along the axis: a convention, below all errors."""


def view_turn_sigma_rad(camera: CameraUncertainty) -> float:
    """Return the standard deviation of a view's turn: noise of attitude, and that of position,
    which looks the same at ``_USUAL_RANGE_M``.
    """
    return float(np.hypot(camera.attitude_noise_rad, camera.position_noise_m / _USUAL_RANGE_M))


_MEAN_SLIDE = 0.6
"""Standard deviation of the mean slide of a camera's points, share of that of one point: shading
follows the light."""
_POSITION_PRIOR_M = 0.5
"""Standard deviation of the first guess of the target's position: the cameras' lines of sight to
the middle of the moving points."""
_VELOCITY_PRIOR_M_S = 0.1
"""Standard deviation of the target's velocity against that of the chasers that hold beside it."""
_RATE_PRIOR_RAD_S = 1.0
"""Standard deviation of the rate: no knowledge."""
_LEAST_SIGMA = 1e-7
"""Least standard deviation of a prior: exact cameras stay solvable."""
_USUAL_RANGE_M = 1.8
"""Range of an inspection: 0.5 mm are 0.016 degrees there."""


def _moved(
    estimate: MapEstimate, problem: Problem, first: Array, landmarks: Array, slides: Array
) -> MapEstimate:
    chasers = len(problem.cameras)
    end = MOTION + CAMERA * chasers
    return MapEstimate(
        estimate.motion.moved(first[:MOTION]),
        estimate.cameras + first[MOTION:end].reshape(chasers, CAMERA),
        estimate.turns + first[end:].reshape(-1, TURN),
        estimate.landmarks_m + landmarks,
        estimate.slides_px_s + slides,
    )


def _weights(residual: Array, robust_px: float) -> Array:
    """Return the weights (k,) of residuals (k, 2) that follow from `robust_cost`."""
    return 1.0 / (1.0 + (residual**2).sum(axis=1) / robust_px**2)


def _slide_information(problem: Problem, slides_px_s: Array) -> Array:
    """Return the weights (q,), s^2/px^2, of the priors of slides (q, 2): Student's distribution."""
    sigma, freedom = problem.slide_px_s, _SLIDE_FREEDOM
    share = (slides_px_s**2).sum(axis=1) / sigma**2
    return (freedom + 2.0) / (freedom + share) / sigma**2


_SLIDE_FREEDOM = 3.0
"""Degrees of freedom of the distribution of slides: most points hardly slide, some much."""


def robust_cost(residual: Array, robust_px: float) -> Array:
    """Return Cauchy's cost (k,), px^2, of residuals (k, 2)."""
    return robust_px**2 * np.log1p((residual**2).sum(axis=1) / robust_px**2)


def _total(problem: Problem, estimate: MapEstimate, robust_px: float) -> float:
    residual = _residuals(problem, estimate, _geometry(problem, estimate).points)
    seen = robust_cost(residual, robust_px).sum() / problem.noise_px**2
    freedom, sigma = _SLIDE_FREEDOM, problem.slide_px_s
    share = (estimate.slides_px_s**2).sum(axis=1) / (freedom * sigma**2)
    seen += (freedom + 2.0) * np.log1p(share).sum()
    off = _off_prior(problem, estimate)
    prior = ((off / _prior_sigmas(problem)) ** 2).sum() + (_gauge(problem) @ off[:3]) ** 2
    return float(seen + prior)


def adjust(
    problem: Problem, start: MapEstimate, tuning: AdjustmentTuning | None = None
) -> Adjusted | None:
    """Return the estimate of least robust cost near ``start``; None if it is not determined."""
    tuning = tuning or AdjustmentTuning()
    estimate, damping, converged = (
        fit(problem, start, tuning.robust_px).estimate,
        tuning.damping,
        False,
    )
    cost = _total(problem, estimate, tuning.robust_px)
    try:
        for _ in range(tuning.steps):
            residual = _residuals(problem, estimate, _geometry(problem, estimate).points)
            normal = _Normal(problem, estimate, _weights(residual, tuning.robust_px))
            for _ in range(_TRIES):
                candidate = _moved(estimate, problem, *normal.step(damping))
                reached = _total(problem, candidate, tuning.robust_px)
                if reached < cost:
                    break
                damping *= 10.0
            else:
                converged = True
                break
            gain, cost, estimate = (cost - reached) / max(cost, 1e-12), reached, candidate
            damping = max(damping / 10.0, 1e-9)
            if gain < tuning.least_gain:
                converged = True
                break
        return _described(problem, estimate, tuning, converged)
    except np.linalg.LinAlgError:
        return None


_TRIES = 6
"""Dampings tried for a step, each ten times the one before."""


def _described(
    problem: Problem, estimate: MapEstimate, tuning: AdjustmentTuning, converged: bool
) -> Adjusted:
    residual = _residuals(problem, estimate, _geometry(problem, estimate).points)
    normal = _Normal(problem, estimate, _weights(residual, tuning.robust_px))
    s, _, inverse = normal.reduced(0.0)
    count = len(s)
    factor = cho_factor(s, lower=True)
    covariance = cho_solve(factor, np.eye(count))
    few = MOTION + CAMERA * len(problem.cameras)
    n = len(estimate.landmarks_m)
    # A landmark follows the other unknowns by -by_first'.
    by_first = inverse @ normal.w
    # Turns of the views are left out of the landmarks' covariances: they average out.
    by_few = by_first[:, :, :few]
    landmark = inverse + by_few @ covariance[:few, :few] @ by_few.transpose(0, 2, 1)
    # The centre of the landmarks, p + mean X, at the motion's time.
    by_centre = -by_first.mean(axis=0).T
    by_centre[:3] += np.eye(3)
    centre = by_centre.T @ covariance @ by_centre + inverse.sum(axis=0) / n**2
    return Adjusted(
        estimate,
        np.linalg.norm(residual, axis=1),
        covariance[:few, :few],
        landmark,
        estimate.motion.position_w_m + estimate.landmarks_m.mean(axis=0),
        centre,
        float(robust_cost(residual, tuning.robust_px).mean()),
        converged,
    )


def triangulate(problem: Problem, estimate: MapEstimate, count: int) -> tuple[Array, Array]:
    """Return ``count`` landmarks (n, 3), TRF, where the lines of sight meet, and the standard
    deviation (n,), m, of each along its worst direction; infinite where it cannot be told.

    Of ``estimate`` motion and cameras count.
    """
    views, seen, motion = problem.views, problem.observations, estimate.motion
    position, turned = motion.at(views.time_s)
    error = estimate.cameras[views.chaser]
    true = views.rotation @ rotations.to_matrix(rotations.exp(error[:, :3] + estimate.turns))
    lens = views.position_w_m + np.einsum("mij,mj->mi", views.rotation, error[:, 3:6])
    back = turned.transpose(0, 2, 1)
    centre = np.einsum("mij,mj->mi", back, lens - position)
    rays = seen.rays / (1.0 + error[seen.view, 6:7])
    rays = np.column_stack([rays, np.ones(len(rays))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    direction = np.einsum("kij,kj->ki", (back @ true)[seen.view], rays)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    gather = _by_landmark(seen, count)
    from_centre = np.einsum("kij,kj->ki", across, centre[seen.view])
    points: Array = np.zeros((count, 3))
    weight = seen.weight**2
    for _ in range(_TRIANGULATIONS):
        matrix = _gathered(gather, across * weight[:, None, None])
        vector = _gathered(gather, (from_centre * weight[:, None])[:, :, None])[:, :, 0]
        matrix = matrix + np.eye(3) * 1e-9
        points = np.asarray(np.linalg.solve(matrix, vector[:, :, None])[:, :, 0], dtype=float)
        away = points[seen.landmark] - centre[seen.view]
        depth = np.maximum(np.einsum("ki,ki->k", away, direction), _LEAST_DEPTH_M)
        off_px = (
            problem.focal_px
            * seen.weight
            * np.linalg.norm(np.einsum("kij,kj->ki", across, away), axis=1)
            / depth
        )
        weight = (problem.focal_px * seen.weight / depth) ** 2 / (
            1.0 + (off_px / _TRIANGULATION_PX) ** 2
        )
    information = _gathered(gather, across * weight[:, None, None]) / problem.noise_px**2
    least = np.linalg.eigvalsh(information)[:, 0]
    sigma = np.where(least > 0.0, 1.0 / np.sqrt(np.maximum(least, 1e-12)), np.inf)
    return points, sigma


_TRIANGULATIONS, _TRIANGULATION_PX = 4, 2.0
"""Repetitions of a triangulation, and the residual with half weight in it: the motion is not
accurate yet."""


def with_landmarks(estimate: MapEstimate, landmarks_m: Array) -> MapEstimate:
    """Return the estimate with other landmarks."""
    return replace(estimate, landmarks_m=landmarks_m)
