# SPDX-License-Identifier: Apache-2.0
"""Detect, track and describe points on a target of unknown shape in grey images."""

from __future__ import annotations

from .description import PointDescriptions, describe
from .memory import KnownTarget, SupposedMotion
from .tracker import BYTES_PER_POINT, FeatureTracker, TrackedPoints, TrackingTuning

__all__ = [
    "BYTES_PER_POINT",
    "FeatureTracker",
    "KnownTarget",
    "PointDescriptions",
    "SupposedMotion",
    "TrackedPoints",
    "TrackingTuning",
    "describe",
]
