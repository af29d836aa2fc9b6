# SPDX-License-Identifier: Apache-2.0
"""A target in steady motion, what chasers around it see, and the errors of an estimate."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from chaserdock_controller.estimation.types import Estimate, EstimatorInputs, MeasuredChaser
from chaserdock_controller.interfaces import AppliedImpulse, TargetState
from chaserdock_models import rotations as rot
from chaserdock_models.camera import Camera
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry, PoseSolution, Sighting
from hypothesis import settings
from hypothesis import strategies as st

V = np.array([0.015, 0.0075, 0.03])
W = np.array([0.015, 0.045, 0.03])
HZ = 15
SIGMA_P, SIGMA_A = 1e-3, math.radians(0.2)
R = np.diag([SIGMA_P**2] * 3 + [SIGMA_A**2] * 3)
Q0 = rot.normalize([0.4, -0.5, 0.6, 0.2])
CAMERA = Camera.from_hfov(640, 480, math.radians(60.0), (0.07, 0.0, 0.075))
ZERO = (0.0, 0.0, 0.0)

deterministic = settings(derandomize=True, deadline=None, max_examples=30)
vectors = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)
rotation_vectors = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)

Seen = tuple[Odometry, Sighting]
"""What a chaser measures at an exposure."""


def ns(k: float) -> int:
    return round(k / HZ * 1e9)


def truth(time_ns: int) -> tuple[np.ndarray, np.ndarray]:
    t = time_ns * 1e-9
    return np.array([1.0, -2.0, 0.5]) + V * t, rot.integrate(Q0, W, t)


LOOKS = [rot.exp([0.0, 0.0, 0.5 * math.pi * c]) for c in range(4)]
"""Attitudes, chaser to TRF, of chasers all round the target's z axis, each facing it."""


def see(
    rng: np.random.Generator, chaser: int, time_ns: int, shift: np.ndarray | None = None
) -> Seen:
    """What a chaser measures in synchronized flight 1 m from the target, with white noise ``R``;
    ``shift``: an error in TRF."""
    p, q = truth(time_ns)
    place = p + rot.rotate(q, rot.rotate(LOOKS[chaser % 4], [-1.0, 0.0, 0.0]))
    attitude = rot.multiply(q, LOOKS[chaser % 4])
    p = p + rng.normal(size=3) * SIGMA_P
    if shift is not None:
        p = p + rot.rotate(q, shift)
    q = rot.multiply(q, rot.exp(rng.normal(size=3) * SIGMA_A))
    lens, q_lens = CAMERA.irf_pose_in_world(place, attitude)
    solution = PoseSolution(
        position_m=vector(rot.rotate_inverse(q_lens, p - lens)),
        q_wxyz=vector(rot.multiply(rot.conjugate(q_lens), q)),
        covariance=vector(R),
        reprojection_rms_px=0.1,
    )
    head: dict[str, Any] = {
        "tick": round(time_ns * HZ / 1e9),
        "sim_time_ns": time_ns,
        "chaser": chaser,
    }
    return (
        Odometry(
            **head, position_m=vector(place), q_wxyz=vector(attitude), velocity_m_s=ZERO,
            omega_rad_s=ZERO,
        ),
        Sighting(
            **head, status="seen", solutions=(solution,), marker_ids=(0, 1, 2, 3), corners_px=(),
            rejected_ids=(),
        ),
    )  # fmt: skip


def inputs_of(time_ns: int, seen: Iterable[Seen]) -> EstimatorInputs:
    """The inputs of a tick; what was measured before it arrives late."""
    seen = list(seen)
    chasers = [MeasuredChaser(i, AppliedImpulse.steady(np.zeros(6))) for i in range(4)]
    for o, _ in seen:
        field = "odometry" if o.sim_time_ns == time_ns else "outdated"
        chasers[o.chaser] = replace(chasers[o.chaser], **{field: o})
    return EstimatorInputs(time_ns, 1.0 / HZ, tuple(chasers), tuple(s for _, s in seen))


def errors(e: TargetState) -> np.ndarray:
    """True minus estimated state (12,), in the order of the covariance."""
    p, q = truth(e.time_ns)
    dtheta = rot.log(rot.multiply(rot.conjugate(e.q_wxyz), q))
    return np.concatenate([p - e.position_m, V - e.velocity_m_s, dtheta, W - e.omega_rad_s])


def same(a: Estimate, b: Estimate) -> bool:
    """Equal bit for bit, but for the time."""
    arrays = ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s", "covariance")
    plain = ("status", "sightings", "rejected")
    return all(
        getattr(a.target, n).tobytes() == getattr(b.target, n).tobytes() for n in arrays
    ) and all(getattr(a.target, n) == getattr(b.target, n) for n in plain)
