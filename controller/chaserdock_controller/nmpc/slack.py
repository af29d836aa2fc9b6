# SPDX-License-Identifier: Apache-2.0
"""Slack weights of the distance constraints, common to all back ends."""

from __future__ import annotations

import numpy as np

from .problem import NmpcParameters
from .terms.position import PositionCost
from .types import Array

# L1 and L2 weights of the slacks of the distance constraints. The L1 weight must exceed the
# constraint's multiplier for the penalty to be exact; at 1e3 the terminal weight pushed chasers to
# 0.32 m of 0.35 m.
SLACK_L1 = 1e5
SLACK_L2 = 1e5
# Multipliers grow with the distance to the reference: ratio of the L1 weight to the slope of the
# terminal cost.
SLACK_L1_OVER_SLOPE = 10.0


def slack_l1_weight(params: NmpcParameters, distance_m: Array) -> Array:
    """Return the L1 weight of the slacks of chasers ``distance_m`` (...) from their references (of
    the farthest, if one for all)."""
    (position,) = params.of_kind(PositionCost)
    slope = position.final_slope(distance_m)
    return np.maximum(SLACK_L1, SLACK_L1_OVER_SLOPE * slope)
