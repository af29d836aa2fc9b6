# SPDX-License-Identifier: Apache-2.0
"""Errors of the observation ``statistical``: those of a filter of the perception's measurements.

Each axis of the target's pose in CRF has a filter of its own, the steady Kalman filter of a white
acceleration with the estimator's density (`TARGET_NOISE`, or ``[estimator]``) and of measurements
with the standard deviation that the statistical perception states at that distance, seen from the
side of the goal in the goal's attitude. Correlations between axes are neglected.
"""

from __future__ import annotations

import numpy as np
from chaserdock_agents.chaser.perception.statistical import StatisticalPerception
from chaserdock_controller.estimation.joint.parameters import parameters_of
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.pose_image import encode_pose
from chaserdock_protocol.scenario import Scenario

BINS = 256
"""Distances of the table. In 256 steps over the distances of `docking-contact` (0.3 to 2.5 m) the
deviation changes by less than 3 % from one to the next.
"""
_DOUBLINGS = 20
"""Steps of the doubling algorithm: those of a million periods of the filter, which forgets its
start within a few thousand.
"""
_MOVE = np.array([[1.0, 1.0], [0.0, 1.0]])
"""Prediction of error and rate over a period."""


def sensor_table(scenario: Scenario, goal_m: Array, goal_wxyz: Array, distances_m: Array) -> Array:
    """Return the columns of ``sensor`` (native/batch.h) at distances (n,), (n, 6, 9).

    ``goal_m`` (3,), ``goal_wxyz`` (4,): place of the chaser in TRF. Raises ScenarioError if no
    marker is seen at any distance.
    """
    sigma = _deviations(scenario, goal_m, goal_wxyz, distances_m)
    seen = np.isfinite(sigma[:, 0])
    if not seen.any():
        raise ScenarioError(
            'learning.observation: "statistical" needs markers that the camera sees from '
            f"{distances_m[0]:.2f} to {distances_m[-1]:.2f} m; it sees none of "
            f"{scenario.target.model!r}"
        )
    rows = np.flatnonzero(seen)
    nearest = rows[np.abs(np.arange(len(seen))[:, None] - rows).argmin(axis=1)]
    sigma = sigma[nearest]
    parameters = parameters_of(scenario)
    density = parameters.target_noise[parameters.target.motion_model]
    period_s = 1.0 / scenario.time.image_hz
    table = np.empty((len(distances_m), 6, 9))
    table[:, :, 0] = seen[:, None]
    for first, noise in ((0, density[0]), (3, density[1])):
        axes = slice(first, first + 3)
        table[:, axes, 1:] = _filters(sigma[:, axes], noise, period_s)
    return table


def _deviations(scenario: Scenario, goal_m: Array, goal_wxyz: Array, distances_m: Array) -> Array:
    """Return standard deviations (n, 6) of the measured position and rotation of the target per
    axis, in CRF and TRF; NaN where no pose is measured.
    """
    camera = scenario.camera_model()
    perception = StatisticalPerception(camera, scenario.target_model())
    mount = rotations.to_matrix(camera.q_crf_irf_wxyz)
    towards = goal_m / np.linalg.norm(goal_m)
    sigma = np.full((len(distances_m), 6), np.nan)
    for k, distance_m in enumerate(distances_m.tolist()):
        eye, attitude = camera.irf_pose_in_world(distance_m * towards, goal_wxyz)
        position = rotations.rotate_inverse(attitude, -eye)
        image = np.frombuffer(
            encode_pose(position, rotations.conjugate(attitude), (0, 0)), np.uint8
        )
        poses = perception.estimate(image[None, :]).solutions
        if poses:
            covariance = poses[0].covariance
            in_crf = mount @ covariance[:3, :3] @ mount.T
            sigma[k] = np.sqrt(np.concatenate([np.diag(in_crf), np.diag(covariance[3:, 3:])]))
    return sigma


def _filters(sigma: Array, density: float, period_s: float) -> Array:
    """Return GAIN to RATE_ERROR_ALONE (native/batch.h) for measurements with deviations (n, k), m
    or rad, and a white acceleration of this density, per s²/√Hz, (n, k, 8).

    In each update the error is multiplied and gets a noise such that its covariance stays the
    filter's.
    """
    # In units of the deviation and the period.
    noise = (density**2 * period_s**3 / sigma**2)[..., None, None] * np.array(
        [[1.0 / 3.0, 0.5], [0.5, 1.0]]
    )
    ahead = _predicted(noise)
    gain = ahead[..., :, :1] / (ahead[..., :1, :1] + 1.0)
    steady = ahead - gain @ ahead[..., :1, :]
    keep = (np.eye(2) - gain * np.array([1.0, 0.0])) @ _MOVE
    factors = [
        np.linalg.cholesky(c) for c in (steady - keep @ steady @ np.swapaxes(keep, -1, -2), steady)
    ]
    rate = sigma / period_s
    columns = [gain[..., 0, 0], gain[..., 1, 0] / period_s]
    for factor in factors:
        columns += [factor[..., 0, 0] * sigma, factor[..., 1, 0] * rate, factor[..., 1, 1] * rate]
    return np.stack(columns, axis=-1)


def _predicted(noise: Array) -> Array:
    """Return the steady covariance (..., 2, 2) of the prediction for a process noise (..., 2, 2)
    and measurements of unit variance: the solution of the Riccati equation, by doubling (E. Chu et
    al., "A structure-preserving doubling algorithm", 2005).
    """
    a, g = np.broadcast_to(_MOVE.T, noise.shape), np.zeros(noise.shape)
    g[..., 0, 0] = 1.0
    h = noise
    for _ in range(_DOUBLINGS):
        inner = np.linalg.inv(np.eye(2) + g @ h)
        a_t = np.swapaxes(a, -1, -2)
        a, g, h = a @ inner @ a, g + a @ inner @ g @ a_t, h + a_t @ h @ inner @ a
    return h
