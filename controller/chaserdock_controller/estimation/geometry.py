# SPDX-License-Identifier: Apache-2.0
"""Transform a camera measurement to a pose of the target in WRF, with covariance."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations as rot
from chaserdock_models import scalar_rotations as so3
from numpy.typing import ArrayLike

from .types import Array, PoseHypothesis


def _array(value: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    array = np.asarray(value, dtype=float)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    return array


def to_world(
    position_m: ArrayLike,
    q_wxyz: ArrayLike,
    camera_position_crf_m: ArrayLike,
    q_crf_irf_wxyz: ArrayLike,
    position_irf_m: ArrayLike,
    q_irf_trf_wxyz: ArrayLike,
    covariance_irf: ArrayLike,
    odometry_covariance: ArrayLike | None = None,
) -> PoseHypothesis:
    """Return the pose of the target in WRF from one chaser's odometry and its camera's measurement.

    position_m (3,), q_wxyz (4,): the chaser's pose, CRF to WRF, at the time of the exposure.
    camera_position_crf_m (3,), q_crf_irf_wxyz (4,): the camera's mounting, IRF to CRF.
    position_irf_m (3,), q_irf_trf_wxyz (4,): the measured pose of the target, TRF to IRF.
    covariance_irf (6, 6): of the measured pose, order (position in IRF axes, dtheta in TRF axes), m and rad.
    odometry_covariance (6, 6): of the chaser's pose, order (position in WRF axes, dtheta in CRF
        axes), or None for a perfectly known pose. Its attitude error moves the target sideways by the
        lever arm from the chaser's origin to the target.

    Quaternions are normalized. Raises ValueError for wrong shapes and for a zero quaternion.

    First-order propagation. With C the chaser's rotation matrix, l the target's position in CRF and
    D = R(CRF <- TRF): dp = dp_chaser - C [l]x dtheta_chaser + C R(CRF <- IRF) dp_irf and
    dtheta = D' dtheta_chaser + dtheta_irf.
    """
    p_c = _array(position_m, (3,), "position_m")
    q_c = rot.normalize(_array(q_wxyz, (4,), "q_wxyz"))
    mount_p = _array(camera_position_crf_m, (3,), "camera_position_crf_m")
    mount_q = rot.normalize(_array(q_crf_irf_wxyz, (4,), "q_crf_irf_wxyz"))
    p_i = _array(position_irf_m, (3,), "position_irf_m")
    q_i = rot.normalize(_array(q_irf_trf_wxyz, (4,), "q_irf_trf_wxyz"))
    covariance = _array(covariance_irf, (6, 6), "covariance_irf")

    c = so3.to_matrix(q_c)
    camera = so3.to_matrix(mount_q)
    lever = mount_p + camera @ p_i
    q_ct = rot.multiply(mount_q, q_i)

    j = np.eye(6)
    j[:3, :3] = c @ camera
    total = j @ covariance @ j.T
    if odometry_covariance is not None:
        odometry = _array(odometry_covariance, (6, 6), "odometry_covariance")
        j = np.eye(6)
        j[:3, 3:] = -c @ so3.skew(lever)
        j[3:, 3:] = so3.to_matrix(q_ct).T
        total = total + j @ odometry @ j.T
    return PoseHypothesis(
        p_c + c @ lever, rot.normalize(rot.multiply(q_c, q_ct)), 0.5 * (total + total.T)
    )
