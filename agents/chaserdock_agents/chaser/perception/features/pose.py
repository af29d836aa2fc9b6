# SPDX-License-Identifier: Apache-2.0
"""Measure the pose of a mapped target by its predicted motion and the landmarks in an image.

The landmarks must confirm the prediction, else there is no pose. The pose is the mean of both by
their covariances: points slide alike with shading and edges, so that a good map predicts better
than one image shows, and an old one does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera

from ..pnp import TargetPose
from ..refine import PoseInCamera


@dataclass(frozen=True)
class MapPoseTuning:
    """Numbers of the pose by a map, with units and reasons."""

    noise_px: float = 0.5
    """Standard deviation of a followed point: median residual 0.15 to 0.4 px
    (docs/evidence/unknown.md)."""
    slide_px_s: float = 0.05
    """Slide of a point while it is followed, as in the mapper."""
    alike: float = 8.0
    """Points that err together, as neighbours slide alike: the covariance counts so many as
    one."""
    gate_sigmas: float = 3.0
    """Points farther from the adjusted pose are not used; the gate of poses is as wide beyond
    ``gate_rad`` and ``gate_share``."""
    least_points: int = 20
    """Used points of a pose: less than a tenth of those usually in view."""
    least_share: float = 0.5
    """Share of the known points that must fit; of a wrong pose, few do."""
    gate_rad: float = 0.035
    """Largest difference from the predicted attitude, 2 degrees, beyond its standard deviations."""
    gate_share: float = 0.02
    """The same for the position, as a share of the range."""
    same_images: float = 12.0
    """Images whose poses err alike, because one map predicts them: the covariance is larger by this
    factor, so that as many are worth one. 60 are of one map; with so many, a new map took the
    filter half a minute (NEES: docs/unknown-target.md)."""
    steps: int = 8
    """Gauss-Newton steps, of which four are needed from 3 degrees off."""


@dataclass(frozen=True, eq=False)
class SeenLandmarks:
    """Landmarks of an image: ideal pixels (n, 2), ages (n,), s, places (n, 3), TRF, and covariances
    (n, 3, 3) of these without what all have in common, which is no error of a pose.
    """

    px: Array
    ages_s: Array
    landmarks_m: Array
    covariances_m2: Array


class NoMapPose(Exception):
    """An image shows no trustworthy pose. The text says why."""


def pose_by_map(
    camera: Camera,
    seen: SeenLandmarks,
    predicted: PoseInCamera,
    covariance: Array,
    tuning: MapPoseTuning | None = None,
) -> TargetPose:
    """Return the pose of the target. ``covariance`` (6, 6): of the predicted pose, position in IRF
    axes and dtheta in TRF axes, positive definite.

    Raises NoMapPose if too few points fit, or the pose is too far from the predicted one.
    """
    tuning = tuning or MapPoseTuning()
    pose, count = predicted, len(seen.px)
    if count < tuning.least_points:
        raise NoMapPose(f"{count} points of the map in view")
    for _ in range(tuning.steps):
        residual, by_pose, sigma = _linearized(camera, seen, pose, tuning)
        off = np.linalg.norm(residual, axis=1) / sigma
        # Cauchy weights: points that slide do not pull.
        weights = 1.0 / (sigma**2 * (1.0 + off**2))
        step = _solved(by_pose, residual, weights)
        pose = _moved(pose, step)
        if float(np.abs(step).max()) < _SMALL_STEP:
            break
    residual, by_pose, sigma = _linearized(camera, seen, pose, tuning)
    fits = np.linalg.norm(residual, axis=1) < tuning.gate_sigmas * sigma
    used = int(fits.sum())
    if used < max(tuning.least_points, tuning.least_share * count):
        raise NoMapPose(f"{used} of {count} points fit the map")
    information = np.einsum("nki,nkj,n->ij", by_pose[fits], by_pose[fits], 1.0 / sigma[fits] ** 2)
    rms_px = float(np.sqrt((residual[fits] ** 2).sum(axis=1).mean()))
    shown = tuning.alike * np.linalg.inv(information)
    shown += _slid_alike(camera, seen.landmarks_m[fits], pose, rms_px)
    apart = _apart(pose, predicted)
    _check_gate(apart, float(np.linalg.norm(predicted.position)), shown + covariance, tuning)
    gain = covariance @ np.linalg.inv(shown + covariance)
    fused = _moved(predicted, gain @ apart)
    left = covariance - gain @ covariance
    q = rotations.normalize(rotations.from_matrix(fused.rotation))
    return TargetPose(fused.position, q, tuning.same_images * 0.5 * (left + left.T), rms_px)


_SMALL_STEP = 1e-6
"""Step, m and rad, at which the iteration ends: a thousandth of the noise."""
_NEAREST_M = 0.1
"""Depth of a landmark below which it counts as behind the camera."""


def _linearized(
    camera: Camera, seen: SeenLandmarks, pose: PoseInCamera, tuning: MapPoseTuning
) -> tuple[Array, Array, Array]:
    """Return residuals (n, 2), px, their derivatives (n, 2, 6) by position (IRF) and dtheta (TRF),
    and standard deviations (n,) of a coordinate, px.
    """
    at = seen.landmarks_m @ pose.rotation.T + pose.position
    z = np.maximum(at[:, 2], _NEAREST_M)
    by_place = np.zeros((len(at), 2, 3))
    by_place[:, 0, 0], by_place[:, 1, 1] = camera.fx_px / z, camera.fy_px / z
    by_place[:, 0, 2] = -camera.fx_px * at[:, 0] / z**2
    by_place[:, 1, 2] = -camera.fy_px * at[:, 1] / z**2
    by_landmark = by_place @ pose.rotation
    turned = -by_landmark @ rotations.skew(seen.landmarks_m)
    residual = seen.px - camera.project_ideal(at)
    residual[at[:, 2] < _NEAREST_M] = _BEHIND_PX
    spread = np.einsum("nki,nij,nkj->n", by_landmark, seen.covariances_m2, by_landmark) / 2.0
    own = tuning.noise_px**2 + (tuning.slide_px_s * seen.ages_s) ** 2
    return residual, np.concatenate([by_place, turned], axis=2), np.sqrt(own + spread)


_BEHIND_PX = 1e3
"""Residual of a landmark behind the camera: it never fits."""


def _solved(by_pose: Array, residual: Array, weights: Array) -> Array:
    """Return the step (6,) of weighted least squares. Raises NoMapPose if it is not determined."""
    matrix = np.einsum("nki,nkj,n->ij", by_pose, by_pose, weights)
    try:
        return np.linalg.solve(matrix, np.einsum("nki,nk,n->i", by_pose, residual, weights))
    except np.linalg.LinAlgError:
        raise NoMapPose("the points in view do not determine a pose") from None


def _moved(pose: PoseInCamera, step: Array) -> PoseInCamera:
    turn = rotations.to_matrix(rotations.exp(step[3:]))
    return PoseInCamera(pose.position + step[:3], pose.rotation @ turn)


def _slid_alike(camera: Camera, landmarks_m: Array, pose: PoseInCamera, slide_px: float) -> Array:
    """Return the covariance (6, 6) of a pose if all points have slid alike by ``slide_px``: as a
    shift, and as a turn that moves the landmarks by as much.
    """
    shift_m = slide_px * float(pose.position[2]) / camera.fx_px
    radius_m = float(np.sqrt(landmarks_m.var(axis=0).sum()))
    return np.diag([shift_m**2] * 3 + [(shift_m / radius_m) ** 2] * 3)


def _apart(pose: PoseInCamera, predicted: PoseInCamera) -> Array:
    """Return position and dtheta (6,) of a pose from the predicted one."""
    turn = rotations.log(rotations.from_matrix(predicted.rotation.T @ pose.rotation))
    return np.concatenate([pose.position - predicted.position, turn])


def _check_gate(apart: Array, range_m: float, covariance: Array, tuning: MapPoseTuning) -> None:
    """Raise NoMapPose for a pose too far from the predicted one, by ``apart`` (6,)."""
    apart_m, apart_rad = float(np.linalg.norm(apart[:3])), float(np.linalg.norm(apart[3:]))
    sigma_m, sigma_rad = (
        float(np.sqrt(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1])) for k in (0, 3)
    )
    if apart_m > tuning.gate_share * range_m + tuning.gate_sigmas * sigma_m:
        raise NoMapPose(f"{1e3 * apart_m:.0f} mm from the predicted position")
    if apart_rad > tuning.gate_rad + tuning.gate_sigmas * sigma_rad:
        raise NoMapPose(f"{np.degrees(apart_rad):.1f} degrees from the predicted attitude")
