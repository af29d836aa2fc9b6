# SPDX-License-Identifier: Apache-2.0
"""The ball about the target that chasers stay out of (paper, 4b)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array

from chaserdock_controller.nmpc.term import (
    ChaserConstraint,
    ChaserStage,
    address_of,
    checked_array,
    pointer,
)
from chaserdock_controller.nmpc.types import NmpcInput


@dataclass(frozen=True)
class KeepOut(ChaserConstraint):
    """|p - p_target| >= min_distance_target_m; 0 switches it off. In C: the plane that touches the
    ball where the rollout is nearest, `keep_out_rows` in native/planes.c.
    """

    MEMBERS = (pointer("to_target"),)
    DATA = 1

    def check(self, problem: NmpcInput, n: int, d: int) -> Mapping[str, Array]:
        """Return min_distance_target_m (N, D+1)."""
        distance = np.asarray(problem.min_distance_target_m, dtype=np.float64)
        if distance.ndim == 1:
            distance = np.repeat(distance[:, None], d + 1, axis=1)
        name = "min_distance_target_m"
        return {name: checked_array(name, distance, (n, d + 1))}

    def of_lost(self, problem: NmpcInput, margins_m: Sequence[float]) -> Mapping[str, Array]:
        """Return min_distance_target_m with 0 for lost chasers."""
        distance = problem.min_distance_target_m
        free = np.zeros((len(margins_m), *distance.shape[1:]))
        return {"min_distance_target_m": np.concatenate([distance, free])}

    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the address of the distances."""
        return (address_of(problem.min_distance_target_m),)

    def data(self, problem: NmpcInput) -> Array:
        """Return the distances (N, D+1, 1)."""
        return problem.min_distance_target_m[..., None]

    def margin(self, stage: ChaserStage, data: Any) -> Any:
        """See `ChaserConstraint.margin`."""
        from chaserdock_controller.nmpc.casadi_vectors import norm

        return norm(stage.x[0:3] - stage.target) - data
