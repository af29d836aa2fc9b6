# SPDX-License-Identifier: Apache-2.0
"""Errors of an estimated pose against the true one, and their normalized square. Arrays of any
leading shape (...).
"""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plane import UP, across
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.planar import up_in_target
from numpy.typing import ArrayLike

from .motion import Track

POSE = (0, 1, 2, 6, 7, 8)
"""Position and attitude in the state (12) of ``TargetEstimate``."""


def pose_covariance(covariance: ArrayLike) -> Array:
    """Return the covariance (6, 6) of position and attitude in the row-major one (144,) or (12, 12)
    of ``TargetEstimate``.
    """
    return np.reshape(covariance, (12, 12))[np.ix_(POSE, POSE)]


def relative_pose(
    own_position_m: Array, own_q: Array, position_m: Array, q_wxyz: Array
) -> tuple[Array, Array]:
    """Return the pose of a body, (..., 3) m and (..., 4), in the frame of another one; all poses in
    the same frame.
    """
    place = rotations.rotate_inverse(q_wxyz, np.subtract(own_position_m, position_m))
    return place, rotations.multiply(rotations.conjugate(q_wxyz), own_q)


def pose_error(true_position_m: Array, true_q: Array, position_m: Array, q_wxyz: Array) -> Array:
    """Return true minus estimated pose (..., 6): m, and rotation vector in the axes of the body,
    rad.
    """
    turn = rotations.log(rotations.multiply(rotations.conjugate(q_wxyz), true_q))
    return np.concatenate([np.subtract(true_position_m, position_m), turn], axis=-1)


def normalized_square(error: Array, covariance: Array) -> Array:
    """Return the squares (...) of errors (..., n) normalized by their covariances (..., n, n): n on
    average if consistent.
    """
    return np.einsum("...i,...i->...", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def chi_square_band(freedoms: ArrayLike) -> tuple[Array, Array]:
    """Return the limits (...) between which 95 % of chi-square variables with ``freedoms`` (...)
    degrees of freedom are, 2.5 % beyond each.
    """
    from scipy.special import gammaincinv  # scipy.stats takes a second to import

    half = np.asarray(freedoms) / 2.0
    return 2.0 * gammaincinv(half, 0.025), 2.0 * gammaincinv(half, 0.975)


def measured_covariance(track: Track) -> Array:
    """Return the covariances (K, 6, 6) of measured poses: position, and attitude in the axes of the
    body.
    """
    variances = np.repeat(np.square([track.sigma_m, track.sigma_rad]), 3, axis=0).T
    return variances[:, :, None] * np.eye(6)


def relative_measured_covariance(own: Track, other: Track) -> Array:
    """Return the covariances (K, 6, 6) of the pose of one body relative to another, both measured:
    position in the axes of the other one, attitude in the own ones.

    To first order, with errors dx of positions in WRF and dtheta of attitudes in body axes: r = R^T
    (x_own - x) gives dr = R^T (dx_own - dx) + r x dtheta, and the attitude dtheta_own - Q^T dtheta,
    where R and Q are the rotations from the axes of the other body to WRF and from the own axes to
    its.
    """
    r, q = relative_pose(own.position_m, own.q_wxyz, other.position_m, other.q_wxyz)
    both = np.zeros((len(r), 6, 3))
    both[:, :3] = rotations.skew(r)
    both[:, 3:] = -np.swapaxes(rotations.to_matrix(q), 1, 2)
    turned = np.square(other.sigma_rad)[:, None, None] * both @ np.swapaxes(both, 1, 2)
    moved = np.repeat(np.stack([own.sigma_m**2 + other.sigma_m**2, own.sigma_rad**2]), 3, axis=0).T
    return turned + moved[:, :, None] * np.eye(6)


Verticals = tuple[Array, Array]
"""Vertical (3,) in the axes of a pose error's position, and in those of its rotation."""


def verticals_of(scenario: Scenario) -> tuple[Verticals, Verticals] | None:
    """Return the verticals of errors of the target's pose in WRF, and of a chaser's pose relative
    to it; None unless the bodies are on a floor.
    """
    up = up_in_target(scenario)
    return None if up is None else ((UP, up), (up, UP))


def pose_nees(error: Array, covariance: Array, verticals: Verticals | None = None) -> Array:
    """Return the NEES (...) of pose errors (..., 6) with covariances (..., 6, 6): 6 on average if
    consistent.

    With ``verticals``, of a body on a floor: twice that of place and rotation in the plane, as the
    other three components are known.
    """
    if verticals is None:
        return normalized_square(error, covariance)
    up, axis = verticals
    in_plane = np.zeros((3, 6))
    in_plane[:2, :3], in_plane[2, 3:] = across(up), axis
    return 2.0 * normalized_square(error @ in_plane.T, in_plane @ covariance @ in_plane.T)
