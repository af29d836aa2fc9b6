# SPDX-License-Identifier: Apache-2.0
"""The distances between two chasers (paper, 4c): of their centres and of their shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import c_int64
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array

from chaserdock_controller.nmpc.term import PairConstraint, address_of, checked_array, pointer
from chaserdock_controller.nmpc.types import NmpcInput


@dataclass(frozen=True)
class Separation(PairConstraint):
    """Keeps |p - p_other| >= min_distance_chasers_m. Where min_distance_shapes_m is positive, also
    at least what two shapes need for that distance along the line between the centres.

    In C: a plane between the two, half the distance to each side, `pair_rows` in native/planes.c.
    Only `rti` keeps the distance of shapes, because that is not smooth.
    """

    MEMBERS = (pointer("between"), pointer("apart"), ("n_shape", c_int64), pointer("shape"))

    def check(self, problem: NmpcInput, n: int, d: int) -> Mapping[str, Array]:
        """Return min_distance_chasers_m and min_distance_shapes_m (N, N), chaser_shape (S, 15)."""
        between = np.asarray(problem.min_distance_chasers_m, dtype=np.float64)
        if between.ndim == 0:
            between = np.full((n, n), float(between))
        apart, shape = problem.min_distance_shapes_m, problem.chaser_shape
        checked = {
            "min_distance_chasers_m": between,
            "min_distance_shapes_m": np.zeros((n, n)) if apart is None else apart,
        }
        for name, value in checked.items():
            checked[name] = checked_array(name, value, (n, n))
            if n > 1 and (checked[name] != checked[name].T).any():
                raise ValueError(f"{name} must be symmetric")
        shape = np.zeros((0, 15)) if shape is None else np.asarray(shape)
        checked["chaser_shape"] = checked_array(
            "chaser_shape", shape, (len(shape), 15), negative=True
        )
        return checked

    def of_lost(self, problem: NmpcInput, margins_m: Sequence[float]) -> Mapping[str, Array | None]:
        """Return the distances extended by lost chasers: to others the largest of the distances
        plus the margin, none between lost ones.
        """
        n, apart = len(problem.states), problem.min_distance_shapes_m
        return {
            "min_distance_chasers_m": _extended(problem.min_distance_chasers_m, n, margins_m),
            "min_distance_shapes_m": None if apart is None else _extended(apart, n, margins_m),
        }

    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the addresses of distances and shape."""
        shape = problem.chaser_shape
        assert shape is not None
        between, apart = problem.min_distance_chasers_m, problem.min_distance_shapes_m
        return address_of(between), address_of(apart), len(shape), address_of(shape)

    def data(self, problem: NmpcInput) -> Array:
        """Return the distances of centres (N, N)."""
        return np.asarray(problem.min_distance_chasers_m)

    def margin(self, one: Any, other: Any, data: Any) -> Any:
        """See `PairConstraint.margin`."""
        from chaserdock_controller.nmpc.casadi_vectors import norm

        return norm(one[0:3] - other[0:3]) - data


def _extended(distances_m: Array | float, n: int, margins_m: Sequence[float]) -> Array:
    total = n + len(margins_m)
    out = np.zeros((total, total))
    out[:n, :n] = distances_m
    for row, margin in enumerate(margins_m, start=n):
        out[row, :n] = out[:n, row] = float(np.max(distances_m)) + margin
    return out
