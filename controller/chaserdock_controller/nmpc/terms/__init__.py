# SPDX-License-Identifier: Apache-2.0
"""The terms of the problem, one a file."""

from __future__ import annotations

from chaserdock_controller.nmpc.term import Term

from .attitude import AttitudeCost
from .coast import PassiveCoasts
from .corridor import CorridorCone
from .input import InputCost
from .input_limits import InputLimits
from .keep_out import KeepOut
from .outer_bound import OuterBound
from .position import PositionCost
from .separation import Separation
from .target_shape import ShapeClearance

TERMS: tuple[type[Term], ...] = (
    AttitudeCost,
    PassiveCoasts,
    CorridorCone,
    InputCost,
    InputLimits,
    KeepOut,
    OuterBound,
    PositionCost,
    Separation,
    ShapeClearance,
)
"""All terms, in the order of their members in C's `Problem`: that of the files."""
