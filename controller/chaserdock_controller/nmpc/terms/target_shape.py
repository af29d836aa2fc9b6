# SPDX-License-Identifier: Apache-2.0
"""The cuboids of the target's shape, from which chasers' shapes keep clear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import c_int64
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array

from chaserdock_controller.nmpc.term import Constraint, address_of, checked_array, pointer
from chaserdock_controller.nmpc.types import NmpcInput


@dataclass(frozen=True)
class ShapeClearance(Constraint):
    """Keeps a chaser's shape at least box_clearance_m from each cuboid; 0 switches it off.

    In C: a plane between both, normal to the line from the cuboid's nearest point to the chaser's
    centre, `box_rows` in native/planes.c. Only `rti` keeps it, because the distance is not smooth.
    """

    MEMBERS = (("n_boxes", c_int64), pointer("boxes"), pointer("clearance"))

    def check(self, problem: NmpcInput, n: int, d: int) -> Mapping[str, Array]:
        """Return boxes (D+1, C, 15) and box_clearance_m (N,)."""
        boxes = np.zeros((d + 1, 0, 15)) if problem.boxes is None else np.asarray(problem.boxes)
        shape = (d + 1, boxes.shape[1] if boxes.ndim == 3 else 0, 15)
        clearance = np.zeros(n) if problem.box_clearance_m is None else problem.box_clearance_m
        return {
            "boxes": checked_array("boxes", boxes, shape, negative=True),
            "box_clearance_m": checked_array("box_clearance_m", clearance, (n,)),
        }

    def of_lost(self, problem: NmpcInput, margins_m: Sequence[float]) -> Mapping[str, Array | None]:
        """Return box_clearance_m with 0 for lost chasers."""
        clearance = problem.box_clearance_m
        if clearance is None:
            return {}
        return {"box_clearance_m": np.concatenate([clearance, np.zeros(len(margins_m))])}

    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the number of cuboids, and the addresses."""
        boxes = problem.boxes
        assert boxes is not None
        return boxes.shape[1], address_of(boxes), address_of(problem.box_clearance_m)
