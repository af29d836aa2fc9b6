# SPDX-License-Identifier: Apache-2.0
"""The box of the inputs (paper, 4a)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array

from chaserdock_controller.nmpc.term import Constraint, address_of, checked_array, pointer
from chaserdock_controller.nmpc.types import NmpcInput

LIMIT_OF_LOST = 1e-3
"""Input limit (N, N m) of a lost chaser's row. The solver needs a positive one; this moves the
chaser by a millimetre.
"""


@dataclass(frozen=True)
class InputLimits(Constraint):
    """Keeps |u| <= input_max on each axis. Hard: back ends treat it as bounds of their variables
    and meet it to the last bit.
    """

    MEMBERS = (pointer("limits"),)

    def check(self, problem: NmpcInput, n: int, d: int) -> Mapping[str, Array]:
        """Return input_max (N, 6)."""
        return {"input_max": checked_array("input_max", problem.input_max, (n, 6))}

    def of_lost(self, problem: NmpcInput, margins_m: Sequence[float]) -> Mapping[str, Array]:
        """Return input_max with `LIMIT_OF_LOST` for lost chasers."""
        limits = np.full((len(margins_m), 6), LIMIT_OF_LOST)
        return {"input_max": np.concatenate([problem.input_max, limits])}

    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the address of the limits."""
        return (address_of(problem.input_max),)
