# SPDX-License-Identifier: Apache-2.0
"""Measurement models of the joint filter: odometry, and a sighting in the frame of the camera. Pure functions.

Residuals are to first order r = H e + n, with e the error vector of ``state`` and n white noise. With the chaser at p_i, C_i, the
lens at l (CRF), the nominal camera axes R (IRF to CRF), E = C_i R and the camera errors delta, b, s of ``camera_calibration``, a
target at p, R_t is seen at S^-1 exp(-delta) (E' (p - p_i - C_i l) - b) with the attitude exp(-delta) E' R_t.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry, PoseSolution

from .parameters import JointParameters
from .state import (
    ATTITUDE,
    ATTITUDE_DRIFT,
    CHASER,
    FOCAL,
    GYRO_BIAS,
    POSITION,
    POSITION_DRIFT,
    RATE,
    SHIFT,
    TARGET,
    TURN,
    VELOCITY,
    VIEW,
    JointState,
)

_EYE3 = np.eye(3)
_ODOMETRY_ROWS = np.arange(12)
_CONSTANT_JACOBIAN = np.zeros((12, CHASER))
"""Elements of the Jacobian of odometry that are the same for every state."""
_CONSTANT_JACOBIAN[0:3, POSITION] = _CONSTANT_JACOBIAN[0:3, POSITION_DRIFT] = _EYE3
_CONSTANT_JACOBIAN[3:6, VELOCITY] = _EYE3
_CONSTANT_JACOBIAN[9:12, RATE] = _CONSTANT_JACOBIAN[9:12, GYRO_BIAS] = _EYE3


class CameraMounting(NamedTuple):
    """Nominal lens position (3,) in CRF, and the axes of the camera, IRF to CRF, as matrix (3, 3) and quaternion (4,)."""

    position_m: Array
    axes: Array
    q_wxyz: Array


class LinearizedMeasurement(NamedTuple):
    """Residual (k,), its Jacobians by the errors of the target (k, 12) and of the chaser (k, CHASER), and noise (k, k)."""

    residual: Array
    by_target: Array
    by_chaser: Array
    noise: Array


def mounting_of(camera: Camera) -> CameraMounting:
    """Return the nominal mounting of a camera."""
    q = np.array(camera.q_crf_irf_wxyz)
    return CameraMounting(np.array(camera.position_crf_m), so3.to_matrix(q), q)


def linearize_odometry(
    state: JointState, i: int, odometry: Odometry, p: JointParameters
) -> LinearizedMeasurement:
    """Return the residual (12,) of a chaser's odometry: position, velocity, attitude, rate."""
    drift = state.of(i, ATTITUDE_DRIFT)
    q = so3.multiply(state.attitudes_wxyz[i], so3.exp(drift))
    r = np.empty(12)
    r[0:3] = odometry.position_m - state.positions_m[i] - state.of(i, POSITION_DRIFT)
    r[3:6] = odometry.velocity_m_s - state.velocities_m_s[i]
    r[6:9] = so3.log(so3.normalize(so3.inverse_multiply(q, np.array(odometry.q_wxyz))))
    r[9:12] = odometry.omega_rad_s - state.omegas_rad_s[i] - state.of(i, GYRO_BIAS)
    h = _CONSTANT_JACOBIAN.copy()
    h[6:9, ATTITUDE] = so3.to_matrix(so3.exp(-drift))
    h[6:9, ATTITUDE_DRIFT] = so3.right_jacobian(drift)
    return LinearizedMeasurement(r, np.zeros((12, TARGET)), h, odometry_noise(odometry, p))


def odometry_noise(odometry: Odometry, p: JointParameters) -> Array:
    """Return the covariance (12, 12) of the white noise of odometry: as stated, and the floor."""
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
    noise.flags.writeable = False
    return noise


class PredictedSighting(NamedTuple):
    """Predicted pose of the target in IRF: position (3,) and attitude (4,), with Jacobians as in ``LinearizedMeasurement``,
    without the columns of ``VIEW``."""

    position_m: Array
    q_wxyz: Array
    by_target: Array
    by_chaser: Array


def predict_sighting(state: JointState, i: int, mounting: CameraMounting) -> PredictedSighting:
    """Predict the sighting of the target by chaser ``i``."""
    c, rt = so3.to_matrix(state.attitudes_wxyz[i]), so3.to_matrix(state.q_wxyz)
    delta, shift = state.of(i, TURN), state.of(i, SHIFT)
    scale = np.array([1.0, 1.0, 1.0 / (1.0 + float(state.of(i, FOCAL)[0]))])
    axes = c @ mounting.axes
    r_delta = so3.to_matrix(so3.exp(-delta))
    to_target = c.T @ (state.position_m - state.positions_m[i])  # CRF
    x = mounting.axes.T @ (to_target - mounting.position_m) - shift
    measured = scale * (r_delta @ x)
    jr = so3.right_jacobian(-delta)
    by_line = scale[:, None] * r_delta
    by_target, by_chaser = np.zeros((6, TARGET)), np.zeros((6, CHASER))
    by_target[0:3, POSITION] = by_line @ axes.T
    by_target[3:6, ATTITUDE] = _EYE3
    by_chaser[0:3, POSITION] = -by_target[0:3, POSITION]
    by_chaser[0:3, ATTITUDE] = by_line @ mounting.axes.T @ so3.skew(to_target)
    by_chaser[0:3, TURN] = by_line @ so3.skew(x) @ jr
    by_chaser[0:3, SHIFT] = -by_line
    by_chaser[2, FOCAL.start] = -float(measured[2]) * float(scale[2])
    by_chaser[3:6, ATTITUDE] = -rt.T @ c
    by_chaser[3:6, TURN] = -rt.T @ axes @ jr
    q_camera = so3.multiply(so3.multiply(state.attitudes_wxyz[i], mounting.q_wxyz), so3.exp(delta))
    return PredictedSighting(measured, so3.inverse_multiply(q_camera, state.q_wxyz), by_target, by_chaser)


def linearize_sighting(
    state: JointState,
    i: int,
    solution: PoseSolution,
    markers: int,
    mounting: CameraMounting,
    p: JointParameters,
) -> LinearizedMeasurement:
    """Return the residual (6,) of a solution from so many ``markers``: position in IRF, m, and rotation in TRF, rad."""
    predicted = predict_sighting(state, i, mounting)
    stated = sighting_covariance(solution, p)
    noise = p.sighting_noise(markers)
    factor = noise.view_ratio * np.linalg.cholesky(stated)
    view = factor @ state.of(i, VIEW)
    r = np.empty(6)
    r[0:3] = solution.position_m - predicted.position_m - view[0:3]
    turn = so3.log(so3.normalize(so3.inverse_multiply(predicted.q_wxyz, np.array(solution.q_wxyz))))
    r[3:6] = turn - view[3:6]
    by_chaser = predicted.by_chaser
    by_chaser[:, VIEW] = factor
    return LinearizedMeasurement(r, predicted.by_target, by_chaser, noise.white_ratio**2 * stated)


def sighting_covariance(solution: PoseSolution, p: JointParameters) -> Array:
    """Return the stated covariance (6, 6) of a sighting with the floor."""
    covariance = np.array(solution.covariance)
    covariance[0:21:7] += p.floor_sighting_m**2
    covariance[21::7] += p.floor_sighting_rad**2
    return covariance.reshape(6, 6)
