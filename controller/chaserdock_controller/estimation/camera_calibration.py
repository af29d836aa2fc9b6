# SPDX-License-Identifier: Apache-2.0
"""Measurement model of a camera with extrinsic and focal-length calibration errors. Pure functions.

Each camera has seven errors, constant in its own axes (IRF): the rotation vector delta of its true
axes, the shift b of its optical centre, and the relative error s of its focal length. With the
nominal centre e (WRF) and axes E (IRF to WRF), a target at p, q is measured at e + E m and E
exp(-delta) E^-1 q, where m = S^-1 exp(-delta) (E' (p - e) - b) and S = diag(1, 1, 1 + s): a longer
focal length reduces the measured distance. To first order, an error of the principal point equals a
rotation.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from chaserdock_models import scalar_rotations as so3

from .parameters import MekfParameters
from .types import Array, CameraPose

ERRORS = 7
"""Components of a camera's calibration error: rotation (3), shift (3), focal length (1)."""
NO_ERROR = np.zeros(ERRORS)
NO_ERROR.flags.writeable = False


class PredictedMeasurement(NamedTuple):
    """Predicted position (3,) and attitude (4,) in WRF; Jacobian (3, 3) of the position by the
    target's position, and (6, 7) of both (attitude in TRF axes) by the camera's errors."""

    position_m: Array
    q_wxyz: Array
    by_position: Array
    by_errors: Array


def predict_measurement(
    camera: CameraPose, position_m: Array, q_wxyz: Array, errors: Array
) -> PredictedMeasurement:
    """Predict what a camera with ``errors`` (7,) measures of a target at ``position_m`` (3,),
    ``q_wxyz`` (4,), WRF.
    """
    axes = so3.to_matrix(camera.q_wxyz)
    delta, focal_ratio = errors[:3], 1.0 + float(errors[6])
    r_delta = so3.to_matrix(so3.exp(-delta))
    scaled_axes = axes * [1.0, 1.0, 1.0 / focal_ratio]  # E S^-1
    line = axes.T @ (position_m - camera.position_m) - errors[3:6]
    measured = r_delta @ line
    jr = so3.right_jacobian(-delta)
    jacobian = np.zeros((6, ERRORS))
    jacobian[:3, :3] = scaled_axes @ r_delta @ so3.skew(line) @ jr
    jacobian[:3, 3:6] = -scaled_axes @ r_delta
    jacobian[:3, 6] = axes[:, 2] * (-float(measured[2]) / focal_ratio**2)
    jacobian[3:, :3] = -so3.to_matrix(q_wxyz).T @ axes @ jr
    q = so3.multiply(
        so3.multiply(camera.q_wxyz, so3.exp(-delta)), so3.inverse_multiply(camera.q_wxyz, q_wxyz)
    )
    return PredictedMeasurement(
        camera.position_m + scaled_axes @ measured, q, scaled_axes @ r_delta @ axes.T, jacobian
    )


def prior(p: MekfParameters) -> Array:
    """Return the prior covariance (7, 7) of a camera's errors."""
    return _diagonal(p.bias_attitude_rad, p.bias_position_m, p.bias_focal_share)


@lru_cache(maxsize=64)
def _diagonal(turn_rad: float, shift_m: float, share: float) -> Array:
    matrix = np.diag([turn_rad**2] * 3 + [shift_m**2] * 3 + [share**2])
    matrix.flags.writeable = False
    return matrix


def pose_prior_covariance(
    camera: CameraPose, position_m: Array, q_wxyz: Array, p: MekfParameters
) -> Array:
    """Return the covariance (6, 6) of a measured pose due to the camera's prior errors."""
    g = predict_measurement(camera, position_m, q_wxyz, NO_ERROR).by_errors
    return g @ prior(p) @ g.T
