# SPDX-License-Identifier: Apache-2.0
"""Slack weights of the distance constraints, common to all back ends."""

from __future__ import annotations

import numpy as np

from .problem import NmpcParameters
from .terms.position import PositionCost
from .types import Array

SLACK_L1 = 1e5
"""L1 weight of the slacks of the distance constraints, 1/m. The penalty is exact only above the
constraint's multiplier: at 1e3 the terminal weight pushed chasers to 0.32 m of 0.35 m. At 2e5 a
plan in 300 ends at its iteration limit.
"""
SLACK_L2 = 1e5
"""L2 weight of the slacks, 1/m^2, which rounds the corner of the L1 price. At half and twice, two
plans in 300 of one flight end at their iteration limit; distances are the same.
"""
SLACK_L1_OVER_SLOPE = 10.0
"""Ratio of the L1 weight to the slope of the terminal cost, where that gives more: multipliers grow
with the distance to the reference. 5 and 20 keep the same distances.
"""


def slack_l1_weight(params: NmpcParameters, distance_m: Array) -> Array:
    """Return the L1 weight of the slacks of chasers at ``distance_m`` (...) from their references.
    A common weight follows from the farthest.
    """
    (position,) = params.of_kind(PositionCost)
    slope = position.final_slope(distance_m)
    return np.maximum(SLACK_L1, SLACK_L1_OVER_SLOPE * slope)
