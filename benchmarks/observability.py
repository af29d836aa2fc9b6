# SPDX-License-Identifier: Apache-2.0
"""Which calibration errors of the cameras show in flight: ``python benchmarks/observability.py [--json FILE]``.

The Jacobian of all measured poses of a minute by the target's twelve numbers and the cameras' (mounting's turn alone, or
turn, lens and focal length), stacked, each row over a measurement's sigma and each column over what is known before.
Its rank says what can be seen at all; its inverse, how well. Chasers in synchronized flight stand 1 m from the target
and turn with it; in the calibration manoeuvre, chaser 0 turns about.
"""

from __future__ import annotations

import math

import numpy as np
from chaserdock_controller.estimation.camera_calibration import ERRORS, NO_ERROR, predict_measurement
from chaserdock_controller.estimation.motion_models import constant_rates
from chaserdock_controller.estimation.types import CameraPose
from chaserdock_controller.guidance.pointing import CALIBRATION_S, calibration_turns
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Q_CRF_IRF_FORWARD_WXYZ
from results import options_of, write_json

TUMBLE, STILL = np.array([0.015, 0.045, 0.03]), np.zeros(3)
HZ, LAST_S = 5.0, 60.0
SIGMA = np.array([5e-4] * 3 + [math.radians(0.05)] * 3)
# Before: target's place and attitude unknown; turn 0.3 degrees, lens 2 mm, focal length 0.1 %.
TARGET = np.array([10.0] * 3 + [1.0] * 3 + [3.0] * 3 + [1.0] * 3)
CAMERA = np.array([math.radians(0.3)] * 3 + [2e-3] * 3 + [1e-3])
YAWS = (0.0, 90.0, 180.0, 270.0)


def jacobian(chasers: int, omega: Array, numbers: int, manoeuvre: bool) -> Array:
    """(M, 12 + numbers * chasers), scaled; ``numbers`` of each camera: 3 (turn) or 7."""
    rows = []
    looks = [rotations.exp([0.0, 0.0, math.radians(yaw)]) for yaw in YAWS[:chasers]]
    for t in np.arange(0.0, LAST_S, 1.0 / HZ):
        q, _, transition = constant_rates(rotations.IDENTITY.copy(), omega, float(t))
        motion = np.eye(12)
        motion[0:3, 3:6] = t * np.eye(3)
        motion[6:12, 6:12] = transition
        for c, look in enumerate(looks):
            place = rotations.rotate(q, rotations.rotate(look, [-1.0, 0.0, 0.0]))
            attitude = rotations.multiply(q, look)
            if manoeuvre and c == 0:
                attitude = rotations.multiply(attitude, calibration_turns([t / LAST_S * CALIBRATION_S])[0])
            eye = CameraPose(place, rotations.multiply(attitude, Q_CRF_IRF_FORWARD_WXYZ))
            seen = predict_measurement(eye, np.zeros(3), q, NO_ERROR)
            by_target = np.zeros((6, 12))
            by_target[:3, 0:3], by_target[3:, 6:9] = seen.by_position, np.eye(3)
            row = np.zeros((6, 12 + numbers * chasers))
            row[:, :12] = by_target @ motion
            row[:, 12 + numbers * c : 12 + numbers * (c + 1)] = seen.by_errors[:, :numbers]
            rows.append(row / SIGMA[:, None])
    scale = np.concatenate([TARGET, *[CAMERA[:numbers]] * chasers])
    return np.concatenate(rows) * scale


def main() -> None:
    options = options_of(__doc__).parse_args()
    figures: dict[str, float] = {}
    print(
        "chasers  numbers  target    manoeuvre   unknowns  rank   turn's sigma left, deg (known before: 0.3)"
    )
    for numbers in (3, ERRORS):
        for chasers in (1, 2, 3, 4):
            for name, omega in (("still", STILL), ("tumbling", TUMBLE)):
                for manoeuvre in (False, True):
                    a = jacobian(chasers, omega, numbers, manoeuvre)
                    values = np.linalg.svd(a, compute_uv=False)
                    rank = int((values > 1e-9 * values[0]).sum())
                    left = np.linalg.inv(a.T @ a + np.eye(a.shape[1]))
                    i = [12 + numbers * c + k for c in range(chasers) for k in range(3)]
                    sigma = np.sqrt(np.linalg.eigvalsh(left[np.ix_(i, i)])) * math.degrees(CAMERA[0])
                    key = f"{chasers}_chasers_{numbers}_numbers_{name}_{'turning_about' if manoeuvre else 'synchronized'}"
                    figures[f"{key}_unobservable"] = a.shape[1] - rank
                    figures[f"{key}_worst_turn_sigma_deg"] = float(sigma[-1])
                    figures[f"{key}_best_turn_sigma_deg"] = float(sigma[0])
                    print(
                        f"{chasers:7}  {numbers:7}  {name:8}  {manoeuvre!s:9}  {a.shape[1]:9}  {rank:4}   "
                        + " ".join(f"{s:.4f}" for s in sigma[::-1])
                    )
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
