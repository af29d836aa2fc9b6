# SPDX-License-Identifier: Apache-2.0
"""Sensor errors: cameras against their calibration, and noise, drift and bias of the chasers' odometry.

Camera errors and biases are drawn once per chaser, noise and drift once per tick, from the scenario's seed, the chaser's
number and the tick only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Square3
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.navigation import NavigationErrors

from chaserdock_world.physics.simulation import BodyState

# Separate the random streams from each other and from that of the image noise.
_CALIBRATION, _BIAS, _NOISE, _DRIFT = 101, 102, 103, 104


def _generator(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def true_camera(scenario: Scenario, chaser: int) -> Camera:
    """Return the true camera of a chaser: the calibrated one with the errors of ``[navigation]``."""
    calibrated, error = scenario.camera_model(), scenario.navigation.errors()
    if error.exact_camera:
        return calibrated
    draw = _generator(scenario.seed, _CALIBRATION, chaser).standard_normal(9)
    scale = 1.0 + error.camera_focal_share * draw[0]
    turn = rotations.exp(error.camera_turn_rad * draw[3:6])
    qw, qx, qy, qz = rotations.multiply(turn, calibrated.q_crf_irf_wxyz).tolist()
    x, y, z = (np.array(calibrated.position_crf_m) + error.camera_shift_m * draw[6:9]).tolist()
    return replace(
        calibrated,
        fx_px=calibrated.fx_px * scale,
        fy_px=calibrated.fy_px * scale,
        cx_px=calibrated.cx_px + error.camera_centre_px * float(draw[1]),
        cy_px=calibrated.cy_px + error.camera_centre_px * float(draw[2]),
        position_crf_m=(x, y, z),
        q_crf_irf_wxyz=(qw, qx, qy, qz),
    )


def white_covariances(errors: NavigationErrors) -> dict[str, Square3]:
    """Return the covariance fields of ``Odometry``: what is new in every tick, without drift and bias."""
    cross, roll = errors.attitude_noise_rad, errors.attitude_roll_noise_rad
    sigmas = {
        "position_covariance_m2": np.full(3, errors.position_noise_m),
        "velocity_covariance_m2_s2": np.full(3, errors.velocity_noise_m_s),
        "attitude_covariance_rad2": np.array([roll, cross, cross]),
        "omega_covariance_rad2_s2": np.full(3, errors.omega_noise_rad_s),
    }
    return {name: vector(np.diag(sigma**2)) for name, sigma in sigmas.items()}


class OdometrySensor:
    """Measures the chasers' states with the errors of ``[navigation]``."""

    def __init__(self, scenario: Scenario):
        self._seed, self._errors = scenario.seed, scenario.navigation.errors()
        self._period_s = 1.0 / scenario.time.rate_hz
        chasers = range(len(scenario.chasers))
        self._bias = [_generator(scenario.seed, _BIAS, i).standard_normal(9) for i in chasers]
        # Tick and value (6,) of the drift of each chaser: position (3,), attitude (3,), in standard deviations.
        self._drifts: dict[int, tuple[int, Array]] = {}
        self.covariances = white_covariances(self._errors)

    def measure(self, chaser: int, tick: int, state: BodyState) -> BodyState:
        """Return the measured ``state`` of a chaser; ``state`` itself if odometry is exact."""
        errors = self._errors
        if errors.exact_odometry:
            return state
        noise = _generator(self._seed, _NOISE, chaser, tick).standard_normal(12)
        bias, drift = self._bias[chaser], self._drift(chaser, tick)
        attitude_noise = np.array(
            [errors.attitude_roll_noise_rad, errors.attitude_noise_rad, errors.attitude_noise_rad]
        )
        turn = errors.attitude_bias_rad * bias[3:6] + attitude_noise * noise[3:6]
        offset = errors.position_bias_m * bias[:3] + errors.position_drift_m * drift[:3]
        return BodyState(
            state.position_m + offset + errors.position_noise_m * noise[:3],
            state.velocity_m_s + errors.velocity_noise_m_s * noise[6:9],
            rotations.multiply(state.q_wxyz, rotations.exp(turn + errors.attitude_drift_rad * drift[3:])),
            state.omega_rad_s + errors.gyro_bias_rad_s * bias[6:] + errors.omega_noise_rad_s * noise[9:],
        )

    def _drift(self, chaser: int, tick: int) -> Array:
        """Return the drift (6,) of a chaser in standard deviations: the exact discretization of a stationary Gauss-Markov
        process, which depends on the tick only."""
        errors = self._errors
        if not (errors.position_drift_m or errors.attitude_drift_rad):
            return np.zeros(6)
        times_s = np.repeat([errors.position_drift_time_s, errors.attitude_drift_time_s], 3)
        kept = np.exp(-self._period_s / times_s)
        new = np.sqrt(-np.expm1(-2.0 * self._period_s / times_s))
        at, value = self._drifts.get(chaser, (-1, np.zeros(6)))
        if at < 0 or at > tick:
            at, value = 0, _generator(self._seed, _DRIFT, chaser, 0).standard_normal(6)
        while at < tick:
            at += 1
            value = kept * value + new * _generator(self._seed, _DRIFT, chaser, at).standard_normal(6)
        self._drifts[chaser] = at, value
        return value
