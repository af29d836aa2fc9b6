# SPDX-License-Identifier: Apache-2.0
"""Sensor errors: camera calibration errors, and bias and noise of the chasers' odometry.

Calibration errors and biases are drawn once per chaser, noise once per tick, from the scenario's seed, the chaser's number
and the tick only.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_protocol.scenario import Scenario

from chaserdock_world.physics.simulation import BodyState

# Separate the random streams from each other and from that of the image noise.
_CALIBRATION, _BIAS, _NOISE = 101, 102, 103


def _generator(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def true_camera(scenario: Scenario, chaser: int) -> Camera:
    """Return the true camera of a chaser: the calibrated one with the scenario's calibration error."""
    calibrated, error = scenario.camera_model(), scenario.camera.calibration_error
    if not error.any:
        return calibrated
    draw = _generator(scenario.seed, _CALIBRATION, chaser).standard_normal(9)
    scale = 1.0 + error.focal_length_share * draw[0]
    turn = rotations.exp(math.radians(error.mounting_deg) * draw[3:6])
    qw, qx, qy, qz = rotations.multiply(turn, calibrated.q_crf_irf_wxyz).tolist()
    x, y, z = (np.array(calibrated.position_crf_m) + error.mounting_m * draw[6:9]).tolist()
    return replace(
        calibrated,
        fx_px=calibrated.fx_px * scale,
        fy_px=calibrated.fy_px * scale,
        cx_px=calibrated.cx_px + error.centre_px * float(draw[1]),
        cy_px=calibrated.cy_px + error.centre_px * float(draw[2]),
        position_crf_m=(x, y, z),
        q_crf_irf_wxyz=(qw, qx, qy, qz),
    )


class OdometrySensor:
    """Measures the chasers' states with the bias and noise of the scenario."""

    def __init__(self, scenario: Scenario):
        self._seed, self._errors = scenario.seed, scenario.odometry
        self._bias = [
            _generator(scenario.seed, _BIAS, i).standard_normal(6) for i in range(len(scenario.chasers))
        ]

    def measure(self, chaser: int, tick: int, state: BodyState) -> BodyState:
        """Return the measured ``state`` of a chaser; ``state`` itself if the scenario has no odometry errors."""
        errors = self._errors
        if not errors.any:
            return state
        noise = _generator(self._seed, _NOISE, chaser, tick).standard_normal(12)
        bias = self._bias[chaser]
        attitude_bias_rad = math.radians(errors.attitude_bias_deg)
        attitude_noise_rad = math.radians(errors.attitude_noise_deg)
        turn = attitude_bias_rad * bias[3:] + attitude_noise_rad * noise[3:6]
        return BodyState(
            state.position_m + errors.position_bias_m * bias[:3] + errors.position_noise_m * noise[:3],
            state.velocity_m_s + errors.velocity_noise_m_s * noise[6:9],
            rotations.multiply(state.q_wxyz, rotations.exp(turn)),
            state.omega_rad_s + math.radians(errors.omega_noise_deg_s) * noise[9:],
        )
