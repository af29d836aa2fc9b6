# SPDX-License-Identifier: Apache-2.0
"""Simulate sensor errors: cameras against their calibration; noise, drift and bias of odometry.

Camera errors and biases are drawn once per chaser, noise and drift once per tick, from the
scenario's seed, the chaser's number and the tick only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Square3
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.navigation import NavigationErrors

from chaserdock_world.random_draws import GaussMarkov, Stream, generator

_NO_DRIFT = np.zeros(6)


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Errors of one camera against its calibration.

    Rotation vector (3,) and shift (3,) in CRF; relative error of the focal length; principal point
    (2,) in pixels.
    """

    turn_rad: Array
    shift_m: Array
    focal_share: float
    centre_px: Array


def camera_errors(scenario: Scenario, chaser: int) -> CameraErrors:
    """Return the errors of a chaser's camera: those of ``[navigation]`` and of
    ``[truth.camera]``.
    """
    stated, unknown = scenario.navigation.errors(), scenario.truth.camera
    known = generator(scenario.seed, Stream.CALIBRATION, chaser).standard_normal(9)
    beyond = generator(scenario.seed, Stream.UNKNOWN_CALIBRATION, chaser).standard_normal(9)
    return CameraErrors(
        stated.camera_turn_rad * known[3:6] + math.radians(unknown.turn_deg) * beyond[3:6],
        stated.camera_shift_m * known[6:9] + unknown.shift_m * beyond[6:9],
        float(stated.camera_focal_share * known[0] + unknown.focal_share * beyond[0]),
        stated.camera_centre_px * known[1:3] + unknown.centre_px * beyond[1:3],
    )


def true_camera(scenario: Scenario, chaser: int) -> Camera:
    """Return the true camera of a chaser: the calibrated one with its errors."""
    calibrated, error = scenario.camera_model(), camera_errors(scenario, chaser)
    if not (
        error.turn_rad.any() or error.shift_m.any() or error.focal_share or error.centre_px.any()
    ):
        return calibrated
    scale = 1.0 + error.focal_share
    turned = rotations.multiply(rotations.exp(error.turn_rad), calibrated.q_crf_irf_wxyz)
    qw, qx, qy, qz = turned.tolist()
    x, y, z = (np.array(calibrated.position_crf_m) + error.shift_m).tolist()
    cx, cy = error.centre_px.tolist()
    return replace(
        calibrated,
        fx_px=calibrated.fx_px * scale,
        fy_px=calibrated.fy_px * scale,
        cx_px=calibrated.cx_px + cx,
        cy_px=calibrated.cy_px + cy,
        position_crf_m=(x, y, z),
        q_crf_irf_wxyz=(qw, qx, qy, qz),
    )


def white_covariances(errors: NavigationErrors) -> dict[str, Square3]:
    """Return the covariance fields of ``Odometry``: white noise only, without drift and bias."""
    cross, roll = errors.attitude_noise_rad, errors.attitude_roll_noise_rad
    sigmas = {
        "position_covariance_m2": np.full(3, errors.position_noise_m),
        "velocity_covariance_m2_s2": np.full(3, errors.velocity_noise_m_s),
        "attitude_covariance_rad2": np.array([roll, cross, cross]),
        "omega_covariance_rad2_s2": np.full(3, errors.omega_noise_rad_s),
    }
    return {name: vector(np.diag(sigma**2)) for name, sigma in sigmas.items()}


class OdometrySensor:
    """Measure the chasers' states with the errors of ``[navigation]``."""

    def __init__(self, scenario: Scenario):
        seed, chasers = scenario.seed, range(len(scenario.chasers))
        self._seed, self._errors = seed, scenario.navigation.errors()
        self._exact = self._errors.exact_odometry
        self._noise_factor = scenario.truth.sensors.noise_factor
        self._bias = [generator(seed, Stream.BIAS, i).standard_normal(9) for i in chasers]
        # Drift in units of its standard deviations: position (3), attitude (3).
        times_s = np.repeat(
            [self._errors.position_drift_time_s, self._errors.attitude_drift_time_s], 3
        )
        period_s = 1.0 / scenario.time.rate_hz
        self._drift = [
            GaussMarkov(seed, Stream.DRIFT, i, times_s.tolist(), period_s) for i in chasers
        ]
        self._drifts = bool(self._errors.position_drift_m or self._errors.attitude_drift_rad)
        self.covariances = white_covariances(self._errors)
        cross, roll = self._errors.attitude_noise_rad, self._errors.attitude_roll_noise_rad
        position, velocity, omega = (
            self._errors.position_noise_m,
            self._errors.velocity_noise_m_s,
            self._errors.omega_noise_rad_s,
        )
        self._sigmas = np.array(
            [*[position] * 3, roll, cross, cross, *[velocity] * 3, *[omega] * 3]
        )
        self._biases = [self.biases(i) for i in chasers]

    def biases(self, chaser: int) -> tuple[Array, Array, Array]:
        """Return the constant errors of a chaser: position (3,), m, attitude (3,), rad, and rate
        (3,), rad/s.
        """
        errors, bias = self._errors, self._bias[chaser]
        return (
            errors.position_bias_m * bias[:3],
            errors.attitude_bias_rad * bias[3:6],
            errors.gyro_bias_rad_s * bias[6:],
        )

    def measure(self, chaser: int, tick: int, state: BodyState) -> BodyState:
        """Return the measured ``state`` of a chaser; ``state`` itself if odometry is exact."""
        errors = self._errors
        if self._exact:
            return state
        noise = (
            generator(self._seed, Stream.NOISE, chaser, tick).standard_normal(12)
            * self._noise_factor
        )
        white, (position_bias, attitude_bias, gyro_bias) = (
            self._sigmas * noise,
            self._biases[chaser],
        )
        drift = self._drift[chaser].at(tick) if self._drifts else _NO_DRIFT
        turn = attitude_bias + white[3:6] + errors.attitude_drift_rad * drift[3:]
        offset = position_bias + errors.position_drift_m * drift[:3]
        return BodyState(
            state.position_m + offset + white[:3],
            state.velocity_m_s + white[6:9],
            rotations.multiply(state.q_wxyz, rotations.exp(turn)),
            state.omega_rad_s + gyro_bias + white[9:],
        )
