# SPDX-License-Identifier: Apache-2.0
"""Observability of camera calibration errors in flight.

Stacks the Jacobians of all poses measured in a minute with respect to the target's state (12) and
the errors of each camera (rotation of the mounting: 3; or rotation, position and focal length: 7).
Rows are divided by the sigma of a measurement, columns multiplied by the prior sigma. In
synchronized flight the chasers stay 1 m from the target and rotate with it; in the calibration
manoeuvre chaser 0 also turns about its line of sight.
"""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
from chaserdock_controller.estimation.joint.measurements import mounting_of, predict_sighting
from chaserdock_controller.estimation.joint.motion_models import constant_rates
from chaserdock_controller.estimation.joint.state import FOCAL, TURN, empty_state
from chaserdock_controller.guidance.pointing import CALIBRATION_S, calibration_turns
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from common import Figures, Group, Options

RATES = {"still": np.zeros(3), "tumbling": np.array([0.015, 0.045, 0.03])}
"""rad/s; tumbling: the paper's."""
ERRORS = FOCAL.stop - TURN.start
MOUNTING = mounting_of(Camera.from_hfov(640, 480, math.radians(60.0)))
IMAGE_HZ, DURATION_S = 5.0, 60.0
"""Rate of the images, and time over which their poses are stacked."""
MEASUREMENT_SIGMA = np.array([5e-4] * 3 + [math.radians(0.05)] * 3)
"""Of a measured pose: m and rad."""
# Prior: the target's state is unknown; 0.3 degrees, 2 mm and 0.1 % of each camera.
TARGET_SIGMA = np.array([10.0] * 3 + [1.0] * 3 + [3.0] * 3 + [1.0] * 3)
CAMERA_SIGMA = np.array([math.radians(0.3)] * 3 + [2e-3] * 3 + [1e-3])
"""Rotation (rad), position (m) and focal length (share) of a camera."""
YAWS_DEG = (0.0, 90.0, 180.0, 270.0)
"""Directions from which the chasers see the target."""


def jacobian(chasers: int, omega: Array, errors: int, manoeuvre: bool) -> Array:
    """Return the scaled Jacobian (M, 12 + errors * chasers); ``errors`` of each camera: 3 or 7."""
    rows = []
    yaws = [rotations.exp([0.0, 0.0, math.radians(yaw)]) for yaw in YAWS_DEG[:chasers]]
    state = empty_state(0, chasers)
    for t in np.arange(0.0, DURATION_S, 1.0 / IMAGE_HZ):
        q, _, transition = constant_rates(rotations.IDENTITY.copy(), omega, float(t))
        motion = np.eye(12)
        motion[0:3, 3:6] = t * np.eye(3)
        motion[6:12, 6:12] = transition
        state = msgspec.structs.replace(state, q_wxyz=q)
        for c, yaw in enumerate(yaws):
            position = rotations.rotate(q, rotations.rotate(yaw, [-1.0, 0.0, 0.0]))
            attitude = rotations.multiply(q, yaw)
            if manoeuvre and c == 0:
                turns = calibration_turns([t / DURATION_S * CALIBRATION_S])
                attitude = rotations.multiply(attitude, turns[0])
            state.positions_m[c], state.attitudes_wxyz[c] = position, attitude
            seen = predict_sighting(state, c, MOUNTING)
            row = np.zeros((6, 12 + errors * chasers))
            row[:, :12] = seen.by_target @ motion
            own = seen.by_chaser[:, TURN.start : TURN.start + errors]
            row[:, 12 + errors * c : 12 + errors * (c + 1)] = own
            rows.append(row / MEASUREMENT_SIGMA[:, None])
    return np.concatenate(rows) * np.concatenate([TARGET_SIGMA, *[CAMERA_SIGMA[:errors]] * chasers])


def observability(_: Options) -> Figures:
    """Compute the unobservable directions of camera errors, and the posterior sigma of a mounting's
    rotation (prior: 0.3 degrees).
    """
    figures: Figures = {}
    for errors, chasers, rate, manoeuvre in itertools.product(
        (3, ERRORS), (1, 2, 3, 4), RATES, (False, True)
    ):
        a = jacobian(chasers, RATES[rate], errors, manoeuvre)
        values = np.linalg.svd(a, compute_uv=False)
        posterior = np.linalg.inv(a.T @ a + np.eye(a.shape[1]))
        i = [12 + errors * c + k for c in range(chasers) for k in range(3)]
        sigmas_rad = np.sqrt(np.linalg.eigvalsh(posterior[np.ix_(i, i)])) * CAMERA_SIGMA[0]
        flight = "calibration" if manoeuvre else "synchronized"
        key = f"{chasers}_chasers_{errors}_errors_{rate}_{flight}"
        figures[f"{key}_unobservable"] = int((values <= 1e-9 * values[0]).sum())
        figures[f"{key}_worst_rotation_sigma_rad"] = float(sigmas_rad[-1])
        figures[f"{key}_best_rotation_sigma_rad"] = float(sigmas_rad[0])
    return figures


GROUP = Group({"observability": observability})
