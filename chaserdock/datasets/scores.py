# SPDX-License-Identifier: Apache-2.0
"""Scores of poses: the SPEED score of both ESA challenges, and ADD and ADD-S.

With e_q the angle between attitudes, rad, and e_t the error of the position over the range, the
score of an image is e_q + e_t (M. Kisantal et al., "Satellite Pose Estimation Challenge: Dataset,
Competition Design and Results", 2020). The challenge of 2021 sets e_q below 0.169 degrees and e_t
below 2.173 mm per m to zero, each by itself (T. H. Park et al., "Satellite Pose Estimation
Competition 2021: Results and Analyses", 2023). ADD is the mean distance of the model's points
between two poses, ADD-S that to the closest point (S. Hinterstoisser et al., 2012).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from scipy.spatial import KDTree

from .types import PoseLabel, TargetShape

ANGLE_2021_RAD, SHARE_2021 = math.radians(0.169), 2.173e-3
MISSED = math.pi + 1.0
"""Score of an image without a pose: that of the largest attitude error and a position at the
camera.
"""
ADD_SHARE = 0.1
"""A pose counts as right when ADD is below this share of the diameter."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of one pose: attitude (rad), position (m, and as a share of the range), and ADD, for a
    symmetric target ADD-S (m).
    """

    attitude_rad: float
    position_m: float
    position_share: float
    add_m: float | None

    @property
    def score_2019(self) -> float:
        """SPEED score of the challenge of 2019."""
        return self.attitude_rad + self.position_share

    @property
    def score_2021(self) -> float:
        """SPEED score of the challenge of 2021."""
        return (self.attitude_rad if self.attitude_rad >= ANGLE_2021_RAD else 0.0) + (
            self.position_share if self.position_share >= SHARE_2021 else 0.0
        )


def pose_errors(estimate: PoseLabel, truth: PoseLabel, shape: TargetShape | None) -> PoseErrors:
    """Return the errors of a pose. ADD needs ``shape``."""
    position_m = float(np.linalg.norm(estimate.position_irf_m - truth.position_irf_m))
    range_m = float(np.linalg.norm(truth.position_irf_m))
    angle = float(rotations.angle_between(estimate.q_irf_trf_wxyz, truth.q_irf_trf_wxyz))
    add = None if shape is None else add_m(estimate, truth, shape)
    return PoseErrors(angle, position_m, position_m / range_m, add)


def add_m(estimate: PoseLabel, truth: PoseLabel, shape: TargetShape) -> float:
    """Return ADD, or ADD-S of a symmetric target, m."""
    a, b = (
        rotations.rotate(p.q_irf_trf_wxyz, shape.points_m) + p.position_irf_m
        for p in (estimate, truth)
    )
    if shape.symmetric:
        return float(np.mean(KDTree(a).query(b)[0]))
    return float(np.mean(np.linalg.norm(a - b, axis=1)))


def summarize(errors: Sequence[PoseErrors | None], shape: TargetShape | None) -> dict[str, float]:
    """Return the figures of a dataset: scores over all images, with None for an image without a
    pose, and errors of the poses.
    """
    found = [e for e in errors if e is not None]
    missed = len(errors) - len(found)
    figures: dict[str, float] = {"images": len(errors), "with_pose": len(found)}
    for year in ("2019", "2021"):
        scores = [float(getattr(e, f"score_{year}")) for e in found]
        figures[f"speed_score_{year}"] = (sum(scores) + missed * MISSED) / len(errors)
        figures[f"speed_score_{year}_with_pose"] = float(np.mean(scores)) if scores else math.nan
    columns = {
        "attitude_rad": [e.attitude_rad for e in found],
        "position_m": [e.position_m for e in found],
        "position_share": [e.position_share for e in found],
    }
    if shape is not None:
        adds = [e.add_m for e in found if e.add_m is not None]
        name = "add_s" if shape.symmetric else "add"
        columns[f"{name}_m"] = adds
        figures[f"{name}_right_share"] = sum(a < ADD_SHARE * shape.diameter_m for a in adds) / len(
            errors
        )
        figures["diameter_m"] = shape.diameter_m
    for name, values in columns.items():
        figures |= _distribution(name, np.array(values))
    return figures


def _distribution(name: str, values: Array) -> dict[str, float]:
    if not len(values):
        return {f"{name}_{key}": math.nan for key in ("mean", "p50", "p95")}
    p50, p95 = np.percentile(values, (50, 95))
    return {
        f"{name}_mean": float(values.mean()),
        f"{name}_p50": float(p50),
        f"{name}_p95": float(p95),
    }
