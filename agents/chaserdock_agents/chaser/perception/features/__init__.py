# SPDX-License-Identifier: Apache-2.0
"""Detect, track and describe points on a target of unknown shape in grey images."""

from __future__ import annotations

from .description import PointDescriptions, describe
from .ellipses import EllipseTuning, ImageEllipses, find_ellipses, region_around
from .memory import KnownTarget, SupposedMotion
from .pose import MapPoseTuning, NoMapPose, SeenLandmarks, pose_by_map
from .tracker import BYTES_PER_POINT, FeatureTracker, TrackedPoints, TrackingTuning

__all__ = [
    "BYTES_PER_POINT",
    "EllipseTuning",
    "FeatureTracker",
    "ImageEllipses",
    "KnownTarget",
    "MapPoseTuning",
    "NoMapPose",
    "PointDescriptions",
    "SeenLandmarks",
    "SupposedMotion",
    "TrackedPoints",
    "TrackingTuning",
    "describe",
    "find_ellipses",
    "pose_by_map",
    "region_around",
]
