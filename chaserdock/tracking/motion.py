# SPDX-License-Identifier: Apache-2.0
"""Motion of a target from image to image: where it is expected, and which of two poses it has."""

from __future__ import annotations

import math
from dataclasses import dataclass

from chaserdock_agents.chaser.perception import TargetPose
from chaserdock_models import rotations
from chaserdock_models.arrays import Array


@dataclass(frozen=True)
class MotionLimits:
    """Limits within which a motion is extrapolated."""

    # Age of a pose, s, above which it predicts nothing. Larger: a target is found again near where
    # it was lost; smaller: less search where it is not. A wrong prediction costs time only.
    memory_s: float = 0.5
    # Share of earlier evidence that an image keeps, about ten images: longer, and a wrong choice
    # between two poses stays; shorter, and noise changes it.
    evidence_kept: float = 0.9


_LIMITS = MotionLimits()


@dataclass(frozen=True)
class _Hypothesis:
    """One of several poses in the last image, and how badly it has fitted so far, px²."""

    pose: TargetPose
    misfit_px2: float


class ConstantVelocity:
    """Predicts a pose from the last two, at constant velocity and angular velocity."""

    def __init__(self) -> None:
        self._time_ns = 0
        self._hypotheses: tuple[_Hypothesis, ...] = ()
        self._before: tuple[int, TargetPose] | None = None

    def predicted(self, time_ns: int) -> tuple[Array, Array] | None:
        """Return position (3,), m, and rotation (4,) of the target in the camera at a time; None
        without a recent pose.
        """
        if not self._hypotheses or not 0 < time_ns - self._time_ns <= 1e9 * _LIMITS.memory_s:
            return None
        return self._extrapolated(self._hypotheses[0].pose, time_ns)

    def _extrapolated(self, last: TargetPose, time_ns: int) -> tuple[Array, Array]:
        if self._before is None:
            return last.position_irf_m, last.q_irf_trf_wxyz
        before_ns, before = self._before
        share = (time_ns - self._time_ns) / (self._time_ns - before_ns)
        moved = last.position_irf_m + share * (last.position_irf_m - before.position_irf_m)
        turn = rotations.log(
            rotations.multiply(last.q_irf_trf_wxyz, rotations.conjugate(before.q_irf_trf_wxyz))
        )
        # Never beyond half a turn, where the sense of a rotation is unknown.
        angle = float(math.hypot(*turn.tolist()))
        turn = turn * min(share, math.pi / 2.0 / max(angle, 1e-12))
        return moved, rotations.multiply(rotations.exp(turn), last.q_irf_trf_wxyz)

    def take(self, time_ns: int, solutions: tuple[TargetPose, ...]) -> tuple[TargetPose, ...]:
        """Remember the poses of an image; return them with the most likely one first.

        Of several poses about as likely, that one comes first which has fitted better over the last
        images; so noise does not let the pose jump between them.
        """
        if not solutions:
            return ()
        recent = 0 < time_ns - self._time_ns <= 1e9 * _LIMITS.memory_s
        earlier = self._hypotheses if recent else ()
        ranked = sorted(
            (
                _Hypothesis(pose, pose.reprojection_rms_px**2 + self._misfit_of(pose, earlier))
                for pose in solutions
            ),
            key=lambda h: h.misfit_px2,
        )
        self._before = None
        if earlier and _nearest(ranked[0].pose, earlier) is earlier[0]:
            self._before = (self._time_ns, earlier[0].pose)
        self._time_ns, self._hypotheses = time_ns, tuple(ranked)
        return tuple(h.pose for h in ranked)

    @staticmethod
    def _misfit_of(pose: TargetPose, earlier: tuple[_Hypothesis, ...]) -> float:
        if not earlier:
            return 0.0
        return _LIMITS.evidence_kept * _nearest(pose, earlier).misfit_px2


def _nearest(pose: TargetPose, among: tuple[_Hypothesis, ...]) -> _Hypothesis:
    return min(
        among,
        key=lambda h: float(rotations.angle_between(h.pose.q_irf_trf_wxyz, pose.q_irf_trf_wxyz)),
    )
