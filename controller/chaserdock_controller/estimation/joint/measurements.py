# SPDX-License-Identifier: Apache-2.0
"""Measurement models of the joint filter: odometry, and a sighting in the camera frame
(native/measurements.c).

To first order a residual is r = H e + n, with the error vector e of ``state`` and white noise n.

Sighting. Chaser at p_i with attitude C_i, lens at l (CRF), nominal camera axes R (IRF to CRF), E =
C_i R. A target at p with attitude R_t appears at S^-1 exp(-delta) (E' (p - p_i - C_i l) - b), with
the attitude exp(-delta) E' R_t.

Errors of the camera, constant in IRF: rotation vector delta of its true axes, shift b of its lens,
relative error s of its focal length. S = diag(1, 1, 1 + s), as a longer focal length reduces the
measured distance. To first order an error of the principal point acts as a rotation.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry, PoseSolution

from . import kernels
from .parameters import JointParameters
from .state import TARGET, JointState, packed

_ODOMETRY_ROWS = np.arange(12)


class CameraMounting(NamedTuple):
    """Nominal lens position (3,) in CRF, and the axes of the camera, IRF to CRF, as matrix (3, 3)
    and quaternion (4,).
    """

    position_m: Array
    axes: Array
    q_wxyz: Array


class LinearizedMeasurement(NamedTuple):
    """Linearized measurement of k values.

    Residual (k,); its Jacobians by the errors of the target (k, 12) and of the chaser (k, CHASER);
    noise covariance (k, k).
    """

    residual: Array
    by_target: Array
    by_chaser: Array
    noise: Array


def mounting_of(camera: Camera) -> CameraMounting:
    """Return the nominal mounting of a camera."""
    q = np.array(camera.q_crf_irf_wxyz)
    return CameraMounting(np.array(camera.position_crf_m), so3.to_matrix(q), q)


def measurement(
    chasers: int,
    i: int,
    odometry: Odometry | None,
    solution: PoseSolution | None,
    markers: int,
    mounting: CameraMounting,
    p: JointParameters,
    view: Array | None = None,
) -> kernels.NativeMeasurement:
    """Pack what chaser ``i`` of ``chasers`` measures in a tick for the kernels: odometry, a
    solution from ``markers`` markers, or both.

    ``view`` (6, 6): covariance that defines the unit of the view error; the stated one by default.
    """
    measured = sighted = None
    if odometry is not None:
        o = odometry
        state = np.array([*o.position_m, *o.velocity_m_s, *o.q_wxyz, *o.omega_rad_s])
        measured = state, odometry_noise(odometry, p)
    if solution is not None:
        noise = p.sighting_noise(markers)
        pose = np.array([*solution.position_m, *solution.q_wxyz])
        stated = sighting_covariance(solution, p)
        sighted = (
            pose,
            stated,
            stated if view is None else view,
            noise.white_ratio,
            noise.view_ratio,
        )
    return kernels.NativeMeasurement(chasers, i, mounting, measured, sighted)


def linearize(state: JointState, z: kernels.NativeMeasurement) -> LinearizedMeasurement:
    """Return the linearized measurement. Sighting first: position in IRF, m; rotation in TRF, rad.
    Then odometry: position, velocity, attitude, rate.
    """
    residual, jacobian, noise = kernels.linearize(z, packed(state))
    return LinearizedMeasurement(residual, jacobian[:, :TARGET], jacobian[:, TARGET:], noise)


def odometry_noise(odometry: Odometry, p: JointParameters) -> Array:
    """Return the covariance (12, 12) of the white noise of odometry: the stated one plus the
    floor.
    """
    floors = (p.floor_position_m, p.floor_velocity_m_s, p.floor_attitude_rad, p.floor_omega_rad_s)
    stated = (
        odometry.position_covariance_m2,
        odometry.velocity_covariance_m2_s2,
        odometry.attitude_covariance_rad2,
        odometry.omega_covariance_rad2_s2,
    )
    return _white_noise(stated, floors)


@lru_cache(maxsize=64)  # sensors mostly state the same covariance in every message
def _white_noise(stated: tuple[tuple[float, ...], ...], floors: tuple[float, ...]) -> Array:
    noise = np.zeros((12, 12))
    for k, covariance in enumerate(stated):
        part = slice(3 * k, 3 * k + 3)
        noise[part, part] = np.reshape(covariance, (3, 3))
    noise[_ODOMETRY_ROWS, _ODOMETRY_ROWS] += np.repeat([floor**2 for floor in floors], 3)
    return noise


class PredictedSighting(NamedTuple):
    """Predicted pose of the target in IRF: position (3,) and attitude (4,). Jacobians as in
    ``LinearizedMeasurement``, without the columns of ``VIEW``.
    """

    position_m: Array
    q_wxyz: Array
    by_target: Array
    by_chaser: Array


def predict_sighting(state: JointState, i: int, mounting: CameraMounting) -> PredictedSighting:
    """Predict the sighting of the target by chaser ``i``."""
    pose, jacobian = kernels.predict_sighting(packed(state), i, mounting)
    return PredictedSighting(pose[:3], pose[3:], jacobian[:, :TARGET], jacobian[:, TARGET:])


def sighting_covariance(solution: PoseSolution, p: JointParameters) -> Array:
    """Return the covariance (6, 6) of a sighting: the stated one plus the floor."""
    covariance = np.array(solution.covariance)
    covariance[0:21:7] += p.floor_sighting_m**2
    covariance[21::7] += p.floor_sighting_rad**2
    return covariance.reshape(6, 6)
