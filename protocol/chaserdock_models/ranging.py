# SPDX-License-Identifier: Apache-2.0
"""Model the measurements of ``[ranging]``: the range of a far target, the attitude that it sends,
and its bearing where there are no images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from . import rotations
from .arrays import Array
from .camera import Camera

_BEARING_RAD = math.radians(0.005)
"""Standard deviation of a bearing per axis without images, rad: about a tenth of a pixel."""


@dataclass(frozen=True)
class RangingErrors:
    """Standard deviations of the white errors of ``[ranging]``.

    Range: an absolute part (m) and a share of the range. Attitude: per axis, rad.
    ``reach_m``: greatest range that is measured.
    """

    range_m: float
    range_share: float
    attitude_rad: float
    reach_m: float

    def range_sigma_m(self, distance_m: float) -> float:
        """Return the standard deviation of the range at a distance."""
        return math.hypot(self.range_m, self.range_share * distance_m)


@dataclass(frozen=True, eq=False)
class RangedPose:
    """Measured pose of the target.

    Position (3,), m, in IRF; rotation (4,) TRF to IRF. Covariance (6, 6) over position (IRF axes)
    and rotation (TRF axes). Standard deviation of the bearing in pixels.
    """

    position_m: Array
    q_wxyz: Array
    covariance: Array
    bearing_px: float


@dataclass(frozen=True, eq=False)
class RangeReading:
    """Measured range of the target, and the attitude that it sends.

    Range: distance (m) of TRF's origin from the optical centre, with standard deviation. Attitude:
    TRF to IRF (4,).
    """

    range_m: float
    sigma_m: float
    q_wxyz: Array


def _in_view(errors: RangingErrors, camera: Camera, position_m: Array) -> bool:
    """Return whether a target is in reach and in the image."""
    if float(np.linalg.norm(position_m)) > errors.reach_m:
        return False
    u, v = camera.project(position_m[None])[0]
    return bool(0.0 <= u <= camera.width_px - 1.0 and 0.0 <= v <= camera.height_px - 1.0)


def range_reading(
    errors: RangingErrors, camera: Camera, position_m: Array, q_wxyz: Array, white: Array
) -> RangeReading | None:
    """Return measured range and attitude of a true pose; None out of the image or of reach.

    ``position_m`` (3,): in IRF. ``q_wxyz`` (4,): TRF to IRF. ``white`` (4,): standard normal
    numbers that the errors are scaled from.
    """
    if not _in_view(errors, camera, position_m):
        return None
    distance = float(np.linalg.norm(position_m))
    sigma = errors.range_sigma_m(distance)
    turned = rotations.multiply(q_wxyz, rotations.exp(errors.attitude_rad * white[1:]))
    return RangeReading(distance + sigma * float(white[0]), sigma, turned)


def ranged_pose(
    errors: RangingErrors, camera: Camera, position_m: Array, q_wxyz: Array, white: Array
) -> RangedPose | None:
    """Return the measurement of a true pose; None out of the image or of reach.

    ``position_m`` (3,): in IRF. ``q_wxyz`` (4,): TRF to IRF. ``white`` (6,): standard normal
    numbers that the errors are scaled from.
    """
    if not _in_view(errors, camera, position_m):
        return None
    distance = float(np.linalg.norm(position_m))
    along = position_m / distance
    range_m = errors.range_sigma_m(distance)
    across_m = _BEARING_RAD * distance
    covariance = np.zeros((6, 6))
    line = np.outer(along, along)
    covariance[:3, :3] = range_m**2 * line + across_m**2 * (np.eye(3) - line)
    covariance[3:, 3:] = errors.attitude_rad**2 * np.eye(3)
    error = np.linalg.cholesky(covariance) @ white
    turned = rotations.multiply(q_wxyz, rotations.exp(error[3:]))
    return RangedPose(position_m + error[:3], turned, covariance, _BEARING_RAD * camera.fx_px)
