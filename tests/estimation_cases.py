# SPDX-License-Identifier: Apache-2.0
"""A target in steady motion, what cameras see of it, and the errors of an estimate."""

from __future__ import annotations

import math

import numpy as np
from chaserdock_controller.estimation import (
    CameraPose,
    Measurement,
    Mekf,
    MekfParameters,
    PaperEstimator,
    PoseHypothesis,
    TargetState,
)
from chaserdock_controller.estimation.camera_calibration import predict_measurement
from chaserdock_models import rotations as rot
from chaserdock_models.camera import Q_CRF_IRF_FORWARD_WXYZ
from hypothesis import settings
from hypothesis import strategies as st

V = np.array([0.015, 0.0075, 0.03])
W = np.array([0.015, 0.045, 0.03])
HZ = 15
SIGMA_P, SIGMA_A = 1e-3, math.radians(0.2)
R = np.diag([SIGMA_P**2] * 3 + [SIGMA_A**2] * 3)
NO_BIAS = MekfParameters(
    bias_position_m=0.0,
    bias_attitude_rad=0.0,
    bias_focal_share=0.0,
    floor_position_m=0.0,
    floor_attitude_rad=0.0,
    considered_ratio=0.0,
)
Q0 = rot.normalize([0.4, -0.5, 0.6, 0.2])

deterministic = settings(derandomize=True, deadline=None, max_examples=30)
vectors = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)
rotation_vectors = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)


def ns(k: float) -> int:
    return round(k / HZ * 1e9)


def truth(time_ns: int) -> tuple[np.ndarray, np.ndarray]:
    t = time_ns * 1e-9
    return np.array([1.0, -2.0, 0.5]) + V * t, rot.integrate(Q0, W, t)


LOOKS = [rot.exp([0.0, 0.0, 0.5 * math.pi * c]) for c in range(4)]
"""Attitudes, chaser to TRF, of chasers all round the target's z axis, each facing it."""


def eye_of(chaser: int, time_ns: int) -> CameraPose:
    """The camera of a chaser in synchronized flight 1 m from the target."""
    p, q = truth(time_ns)
    place = p + rot.rotate(q, rot.rotate(LOOKS[chaser % 4], [-1.0, 0.0, 0.0]))
    return CameraPose(
        place, rot.multiply(rot.multiply(q, LOOKS[chaser % 4]), Q_CRF_IRF_FORWARD_WXYZ)
    )


def see(
    rng: np.random.Generator,
    chaser: int,
    time_ns: int,
    *,
    shift: np.ndarray | None = None,
    turn: np.ndarray | None = None,
    flip: np.ndarray | None = None,
    wrong_first: bool = False,
    markers: int = 4,
    camera: np.ndarray | None = None,
) -> Measurement:
    """A measurement with white noise R; ``shift`` and ``turn`` are errors in TRF; ``flip`` is a
    rotation vector in TRF axes that makes the second hypothesis of an ambiguous view; ``camera``
    (7,): its calibration errors."""
    p, q = truth(time_ns)
    eye = eye_of(chaser, time_ns)
    if camera is not None:
        p, q, _, _ = predict_measurement(eye, p, q, camera)
    p = p + rng.normal(size=3) * SIGMA_P
    if shift is not None:
        p = p + rot.rotate(q, shift)
    if turn is not None:
        q = rot.multiply(q, rot.exp(turn))
    q = rot.multiply(q, rot.exp(rng.normal(size=3) * SIGMA_A))
    hypotheses = [PoseHypothesis(p, q, R)]
    if flip is not None:
        hypotheses.append(PoseHypothesis(p, rot.multiply(q, rot.exp(flip)), R))
    if wrong_first:
        hypotheses.reverse()
    return Measurement(chaser, time_ns, tuple(hypotheses), markers, eye)


def errors(e: TargetState) -> np.ndarray:
    """True minus estimated state (12,), in the order of the covariance."""
    p, q = truth(e.time_ns)
    dtheta = rot.log(rot.multiply(rot.conjugate(e.q_wxyz), q))
    return np.concatenate([p - e.position_m, V - e.velocity_m_s, dtheta, W - e.omega_rad_s])


def nees(e: TargetState) -> float:
    d = errors(e)
    return float(d @ np.linalg.solve(e.covariance, d))


def fly(
    estimator: Mekf | PaperEstimator, chasers: int, seconds: float, seed: int = 0
) -> list[TargetState]:
    rng = np.random.default_rng(seed)
    return [
        estimator.update([see(rng, c, ns(k)) for c in range(chasers)], ns(k))
        for k in range(int(seconds * HZ))
    ]


def same(a: TargetState, b: TargetState) -> bool:
    """Equal bit for bit."""
    arrays = ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s", "covariance")
    plain = ("time_ns", "status", "sightings", "rejected")
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in arrays) and all(
        getattr(a, n) == getattr(b, n) for n in plain
    )
