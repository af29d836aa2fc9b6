# SPDX-License-Identifier: Apache-2.0
"""Sightings drawn from the true states: pose measurements with white noise, without images."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import PoseSolution, Sighting
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import States
from chaserdock_world.sensors.errors import true_camera

from chaserdock.experiments.perception import PerceptionModel

_LEAST_SIGMA = 1e-4
"""m and rad: the covariance of a measurement without noise must be positive definite, too."""


def measurement_model(
    scenario: Scenario,
    seed: int,
    position_sigma_m: float = 0.0,
    attitude_sigma_rad: float = 0.0,
    dropout: float = 0.0,
) -> PerceptionModel:
    """Return a perception that measures the target's true pose with white noise of these sigmas per
    axis.

    ``dropout``: the share of images without a detection. Each camera has the errors that the world
    gives it.
    """
    rng = np.random.default_rng([seed, 0xE1E])
    nominal = scenario.camera_model()
    cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]
    sigmas = [max(position_sigma_m, _LEAST_SIGMA)] * 3 + [max(attitude_sigma_rad, _LEAST_SIGMA)] * 3
    covariance = vector(np.diag(np.square(sigmas)))

    def measure(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        own, target = states[f"chaser/{chaser}"], states[TARGET]
        camera = cameras[chaser]
        eye, attitude = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        position = rotations.rotate_inverse(attitude, target.position_m - eye)
        # With a longer focal length than calibrated, the target seems nearer.
        position = position * [1.0, 1.0, nominal.fx_px / camera.fx_px]
        position = position + rng.normal(0.0, position_sigma_m, 3)
        q_world = rotations.multiply(
            target.q_wxyz, rotations.exp(rng.normal(0.0, attitude_sigma_rad, 3))
        )
        solution = PoseSolution(
            position_m=vector(position),
            q_wxyz=vector(rotations.multiply(rotations.conjugate(attitude), q_world)),
            covariance=covariance,
            reprojection_rms_px=0.1,
        )
        missed = rng.random() < dropout
        return Sighting(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            status="nothing" if missed else "seen",
            solutions=() if missed else (solution,),
            marker_ids=() if missed else (0, 1, 2, 3),
            corners_px=(),
            rejected_ids=(),
        )

    return measure
