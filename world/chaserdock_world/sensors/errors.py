"""What those who fly are told and is not quite so: the cameras' calibration and the chasers' own odometry.

Errors are drawn once for each chaser, noise for each tick, from the scenario's seed, the chaser's number and the
tick alone.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_protocol.scenario import Scenario

from chaserdock_world.physics.simulation import BodyState

# Keep the streams of random numbers apart from each other and from the images' noise.
_CALIBRATION, _BIAS, _NOISE = 101, 102, 103


def _generator(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def true_camera(scenario: Scenario, chaser: int) -> Camera:
    """The camera that chaser ``chaser`` really has: as calibrated, but for a calibration error."""
    told, error = scenario.camera_model(), scenario.camera.calibration_error
    if not error.any:
        return told
    draw = _generator(scenario.seed, _CALIBRATION, chaser).standard_normal(9)
    scale = 1.0 + error.focal_length_share * draw[0]
    turn = rotations.exp(math.radians(error.mounting_deg) * draw[3:6])
    qw, qx, qy, qz = rotations.multiply(turn, told.q_crf_irf_wxyz).tolist()
    x, y, z = (np.array(told.position_crf_m) + error.mounting_m * draw[6:9]).tolist()
    return replace(
        told,
        fx_px=told.fx_px * scale,
        fy_px=told.fy_px * scale,
        cx_px=told.cx_px + error.centre_px * float(draw[1]),
        cy_px=told.cy_px + error.centre_px * float(draw[2]),
        position_crf_m=(x, y, z),
        q_crf_irf_wxyz=(qw, qx, qy, qz),
    )


class Navigation:
    """The chasers' own odometry as their sensors give it."""

    def __init__(self, scenario: Scenario):
        self._seed, self._o = scenario.seed, scenario.odometry
        self._bias = [
            _generator(scenario.seed, _BIAS, i).standard_normal(6) for i in range(len(scenario.chasers))
        ]

    def sensed(self, chaser: int, tick: int, state: BodyState) -> BodyState:
        """What chaser ``chaser`` knows of its ``state``; the very same without noise and bias."""
        o = self._o
        if not o.any:
            return state
        noise = _generator(self._seed, _NOISE, chaser, tick).standard_normal(12)
        bias = self._bias[chaser]
        turn = math.radians(o.attitude_bias_deg) * bias[3:] + math.radians(o.attitude_noise_deg) * noise[3:6]
        return BodyState(
            state.position_m + o.position_bias_m * bias[:3] + o.position_noise_m * noise[:3],
            state.velocity_m_s + o.velocity_noise_m_s * noise[6:9],
            rotations.multiply(state.q_wxyz, rotations.exp(turn)),
            state.omega_rad_s + math.radians(o.omega_noise_deg_s) * noise[9:],
        )
