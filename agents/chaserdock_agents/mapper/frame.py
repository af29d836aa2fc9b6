# SPDX-License-Identifier: Apache-2.0
"""Keep the frame of a map on the target while the map improves.

An adjustment fixes its axes to those of WRF at its reference time, so that they turn on the target
when its rates change. What flies relative to the target needs axes that stay on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray

from .adjustment import right_jacobian
from .types import ConstantRates

_LEAST_COMMON = 10
"""Landmarks that two maps must share to be aligned: three fix a frame, others may have moved."""


@dataclass(frozen=True, eq=False)
class MotionInFrame:
    """Motion of a frame at a time: position, velocity (3,), WRF, attitude (4,), frame to WRF, rate
    (3,), frame axes, and covariance (12, 12) over these, as `chaserdock_protocol.TargetEstimate`.
    """

    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    covariance: Array


class MapFrame:
    """Frame whose origin is on the axis of rotation, at first in the middle of the landmarks, and
    which the landmarks of two maps in a row place alike.

    A place x in the adjustment's TRF is ``turn`` (x - ``origin_m``) in this one.
    """

    def __init__(self) -> None:
        self.turn, self.origin_m = np.eye(3), np.zeros(3)
        self._keys: IntArray = np.zeros(0, dtype=np.int64)
        self._landmarks_m = np.zeros((0, 3))

    def align(self, keys: IntArray, landmarks_m: Array, omega_rad_s: Array) -> Array:
        """Align the frame to a new map with landmarks (n, 3) of ``keys`` (n,), ascending. Returns
        these in the frame.

        ``omega_rad_s`` (3,): axis of rotation, adjustment's TRF.
        """
        _, before, now = np.intersect1d(self._keys, keys, assume_unique=True, return_indices=True)
        if len(now) >= _LEAST_COMMON:
            self._fit(self._landmarks_m[before], landmarks_m[now], omega_rad_s)
        elif not len(self._keys):
            self.origin_m = _on_axis(np.median(landmarks_m, axis=0), omega_rad_s)
        placed = (landmarks_m - self.origin_m) @ self.turn.T
        self._keys, self._landmarks_m = keys, placed
        return placed

    def _fit(self, before: Array, now: Array, omega_rad_s: Array) -> None:
        """Set turn and origin so that places ``now`` come to lie on those ``before`` (k, 3), least
        squares (Umeyama 1991, without scale).
        """
        middle, target = now.mean(axis=0), before.mean(axis=0)
        u, _, v = np.linalg.svd((before - target).T @ (now - middle))
        self.turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        self.origin_m = _on_axis(middle - self.turn.T @ target, omega_rad_s)

    def moments(self, covariances_m2: Array) -> Array:
        """Return covariances (n, 3, 3) of landmarks in the frame."""
        return self.turn @ covariances_m2 @ self.turn.T

    def motion_at(self, motion: ConstantRates, covariance: Array, time_s: float) -> MotionInFrame:
        """Return the motion at a time. ``covariance`` (9, 9): of ``motion.vector()``.

        The origin is on the axis, so that it moves as that of the adjustment does.
        """
        after_s = time_s - motion.time_s
        positions, turned = motion.at([time_s])
        q = rotations.normalize(rotations.from_matrix(turned[0] @ self.turn.T))
        by = np.zeros((12, 9))
        by[:3, :3], by[:3, 3:6], by[3:6, 3:6] = np.eye(3), after_s * np.eye(3), np.eye(3)
        phi = motion.omega_rad_s * after_s
        by[6:9, 6:] = after_s * self.turn @ right_jacobian(phi[None])[0]
        by[9:, 6:] = self.turn
        spread = by @ covariance @ by.T
        return MotionInFrame(
            positions[0] + turned[0] @ self.origin_m,
            motion.velocity_m_s,
            q,
            self.turn @ motion.omega_rad_s,
            0.5 * (spread + spread.T),
        )


def _on_axis(place_m: Array, omega_rad_s: Array) -> Array:
    """Return the point of the axis of rotation through the origin that is nearest to a place."""
    axis = omega_rad_s / np.linalg.norm(omega_rad_s)
    return axis * float(axis @ place_m)
