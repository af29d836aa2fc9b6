"""What a camera that is not quite as calibrated measures: prediction and Jacobians. Pure functions.

Seven numbers a camera, constant in its own axes (IRF), so that they turn with the chaser: the rotation vector delta by
which it is really turned, the shift b of its lens, and the share s by which its focal length is longer. With the told
lens e (WRF) and axes E (IRF to WRF), a target at p, q is taken to be at e + E m and E exp(-delta) E^-1 q, where
m = S^-1 exp(-delta) (E' (p - e) - b) and S = diag(1, 1, 1 + s): a longer focal length makes things nearer, not smaller
across. An error of the principal point looks, to first order, as a turn does.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from chaserdock_models import scalar_rotations as so3

from .parameters import MekfParameters
from .types import Array, CameraPose

ERRORS = 7
"""Numbers of a camera's calibration error: turn (3), shift (3), focal length (1)."""
NO_ERROR = np.zeros(ERRORS)
NO_ERROR.flags.writeable = False


class Seen(NamedTuple):
    """What is to be measured: position (3,) and attitude (4,) in WRF; Jacobian (3, 3) of the position by the target's,
    and (6, 7) of both (attitude in TRF axes) by the camera's errors."""

    position_m: Array
    q_wxyz: Array
    by_position: Array
    by_errors: Array


def seen_by(eye: CameraPose, position_m: Array, q_wxyz: Array, errors: Array) -> Seen:
    """What a camera with ``errors`` (7,) measures of a target at ``position_m`` (3,), ``q_wxyz`` (4,), WRF."""
    axes = so3.to_matrix(eye.q_wxyz)
    turn, longer = errors[:3], 1.0 + float(errors[6])
    back = so3.to_matrix(so3.exp(-turn))
    told = axes * [1.0, 1.0, 1.0 / longer]  # E S^-1
    line = axes.T @ (position_m - eye.position_m) - errors[3:6]
    turned = back @ line
    jr = so3.right_jacobian(-turn)
    jacobian = np.zeros((6, ERRORS))
    jacobian[:3, :3] = told @ back @ so3.skew(line) @ jr
    jacobian[:3, 3:6] = -told @ back
    jacobian[:3, 6] = axes[:, 2] * (-float(turned[2]) / longer**2)
    jacobian[3:, :3] = -so3.to_matrix(q_wxyz).T @ axes @ jr
    q = so3.multiply(so3.multiply(eye.q_wxyz, so3.exp(-turn)), so3.inverse_multiply(eye.q_wxyz, q_wxyz))
    return Seen(eye.position_m + told @ turned, q, told @ back @ axes.T, jacobian)


def prior(p: MekfParameters) -> Array:
    """Covariance (7, 7) of a camera's errors before anything is known of them."""
    return _diagonal(p.bias_attitude_rad, p.bias_position_m, p.bias_focal_share)


@lru_cache(maxsize=64)
def _diagonal(turn_rad: float, shift_m: float, share: float) -> Array:
    matrix = np.diag([turn_rad**2] * 3 + [shift_m**2] * 3 + [share**2])
    matrix.flags.writeable = False
    return matrix


def pose_prior(eye: CameraPose, position_m: Array, q_wxyz: Array, p: MekfParameters) -> Array:
    """Covariance (6, 6) of a measured pose that comes of the camera's unknown errors alone."""
    g = seen_by(eye, position_m, q_wxyz, NO_ERROR).by_errors
    return g @ prior(p) @ g.T
