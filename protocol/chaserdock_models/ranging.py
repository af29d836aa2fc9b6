# SPDX-License-Identifier: Apache-2.0
"""Pose of a far target from its bearing, a range sensor, and the attitude that it sends: the model of ``[ranging]``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from . import rotations
from .arrays import Array
from .camera import Camera


@dataclass(frozen=True)
class RangingErrors:
    """Standard deviations of the white errors: range (m) and, in addition, as a share of it; bearing and attitude per axis (rad).
    ``reach_m``: greatest range."""

    range_m: float
    range_share: float
    bearing_rad: float
    attitude_rad: float
    reach_m: float


@dataclass(frozen=True, eq=False)
class RangedPose:
    """A measured pose: position (3,) m in IRF, rotation (4,) TRF to IRF, covariance (6, 6) over position (IRF axes) and rotation (TRF
    axes), and the bearing's standard deviation in pixels."""

    position_m: Array
    q_wxyz: Array
    covariance: Array
    bearing_px: float


def ranged_pose(
    errors: RangingErrors, camera: Camera, position_m: Array, q_wxyz: Array, white: Array
) -> RangedPose | None:
    """Return the measurement of a true pose (position (3,) in IRF, rotation (4,) TRF to IRF); None out of the image or of reach.

    ``white`` (6,): standard normal numbers, from which the errors follow.
    """
    distance = float(np.linalg.norm(position_m))
    if distance > errors.reach_m:
        return None
    u, v = camera.project_ideal(position_m[None])[0]
    if not (0.0 <= u <= camera.width_px - 1.0 and 0.0 <= v <= camera.height_px - 1.0):
        return None
    along = position_m / distance
    range_m = math.hypot(errors.range_m, errors.range_share * distance)
    across_m = errors.bearing_rad * distance
    covariance = np.zeros((6, 6))
    line = np.outer(along, along)
    covariance[:3, :3] = range_m**2 * line + across_m**2 * (np.eye(3) - line)
    covariance[3:, 3:] = errors.attitude_rad**2 * np.eye(3)
    error = np.linalg.cholesky(covariance) @ white
    turned = rotations.multiply(q_wxyz, rotations.exp(error[3:]))
    return RangedPose(position_m + error[:3], turned, covariance, errors.bearing_rad * camera.fx_px)
