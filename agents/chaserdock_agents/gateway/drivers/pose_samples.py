# SPDX-License-Identifier: Apache-2.0
"""What drivers of pose sources share: vectors and covariances of messages."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array

from ..devices import PoseSample

KEPT = 1000
"""Messages kept between two polls: 10 s of motion capture at 100 Hz; older ones are dropped."""


def turned(q_wxyz: Array, vector: Array) -> Array | None:
    """Return a body-axes vector (3,) in world axes; None if either is not finite."""
    return rotations.rotate(rotations.normalize(q_wxyz), vector) if is_finite(vector) else None


def is_finite(values: Array) -> bool:
    """Test whether all values are finite."""
    return bool(np.isfinite(values).all())


def is_pose(sample: PoseSample) -> bool:
    """Test whether a sample states a position and an attitude."""
    q = sample.q_wxyz
    return is_finite(sample.position_m) and is_finite(q) and bool(np.any(q))


def stated(covariance: Array) -> bool:
    """Test whether a covariance is one: ROS leaves zeros, or -1 first, where none is known."""
    return is_finite(covariance) and bool(np.any(covariance)) and bool(covariance.flat[0] >= 0.0)


def to_body_rotation(covariance: Array, q_wxyz: Array) -> Array:
    """Return a pose's covariance (6, 6) with the rotation about body axes, from one with the
    rotation about world axes, as ROS states it: a rotation theta_w is R theta_b.
    """
    to_body = np.eye(6)
    to_body[3:, 3:] = rotations.to_matrix(rotations.normalize(q_wxyz)).T
    return to_body @ covariance @ to_body.T
