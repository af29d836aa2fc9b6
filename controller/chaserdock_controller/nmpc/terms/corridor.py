# SPDX-License-Identifier: Apache-2.0
"""The cone in which a chaser approaches a port."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from numpy.typing import NDArray

from chaserdock_controller.nmpc.term import (
    ChaserConstraint,
    ChaserStage,
    address_of,
    checked_array,
    pointer,
)
from chaserdock_controller.nmpc.types import NmpcInput

_UNIT_TOLERANCE = 1e-6
"""Largest deviation of an axis from unit length. Guidance normalizes it, so that more is an
error.
"""


@dataclass(frozen=True)
class CorridorCone(ChaserConstraint):
    """Keeps the chaser inside the cone: its distance from the surface, positive inside, is not
    negative.

    In C: the plane that touches the cone where the chaser is nearest, `corridor_room` in
    native/planes.c.
    """

    MEMBERS = (pointer("corridors"),)
    DATA = 5

    def check(self, problem: NmpcInput, n: int, d: int) -> Mapping[str, Array]:
        """Return corridors (N, D+1, 5)."""
        if problem.corridors is None:
            return {"corridors": np.zeros((n, d + 1, 5))}
        corridors = checked_array("corridors", problem.corridors, (n, d + 1, 5), negative=True)
        length = np.linalg.norm(corridors[..., :3], axis=-1)
        used = length > 0.0
        if (np.abs(length[used] - 1.0) > _UNIT_TOLERANCE).any():
            raise ValueError("corridors must have axes of unit length, or zero for no corridor")
        angle = corridors[..., 3][used]
        if not ((angle > 0.0) & (angle < math.pi / 2)).all():
            raise ValueError("corridors must have half angles above 0 and below pi / 2")
        return {"corridors": corridors}

    def of_lost(self, problem: NmpcInput, margins_m: Sequence[float]) -> Mapping[str, Array | None]:
        """Return the corridors extended by none for lost chasers."""
        corridors = problem.corridors
        if corridors is None:
            return {}
        none = np.zeros((len(margins_m), *corridors.shape[1:]))
        return {"corridors": np.concatenate([corridors, none])}

    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the address of the corridors."""
        return (address_of(problem.corridors),)

    def data(self, problem: NmpcInput) -> Array:
        """Return the corridors (N, D+1, 5)."""
        assert problem.corridors is not None
        return problem.corridors

    def applies(self, problem: NmpcInput) -> NDArray[np.bool_]:
        """Return where there is a corridor."""
        return np.any(self.data(problem)[..., :3] != 0.0, axis=-1)

    def margin(self, stage: ChaserStage, data: Any) -> Any:
        """See `ChaserConstraint.margin`."""
        import casadi as ca

        from chaserdock_controller.nmpc.casadi_vectors import norm

        axis, half_angle, apex = data[0:3], data[3], data[4]
        r = stage.x[0:3] - stage.target
        along = ca.dot(axis, r)
        aside = norm(r - along * axis)
        return ca.sin(half_angle) * (along - apex) - ca.cos(half_angle) * aside
