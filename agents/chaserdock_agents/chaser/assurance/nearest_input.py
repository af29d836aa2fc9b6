# SPDX-License-Identifier: Apache-2.0
"""Find the force or torque nearest to a commanded one that satisfies linear conditions.

A strictly convex quadratic program with bounds, solved by daqp (deterministic, dual active set).
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np
from chaserdock_models.arrays import Array, IntArray

_SOLVED = 1  # daqp's code
_FREE = 1e30  # daqp takes a bound as large as none
_TOLERANCE = 1e-9
"""Violation of a condition that rounding may leave, m/s² or rad/s²."""
_REGULARIZATION = 1e-3
"""Weight of the distance from the command beside the least margin, where no input satisfies all
conditions: the margin decides."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """Linear conditions ``rows`` (k, 3) @ input >= ``least`` (k,) on a force or a torque, body
    axes, within ``limits`` (3,) on each axis; 0 for one on which the body cannot move.
    """

    rows: Array
    least: Array
    limits: Array

    def margins(self, asked: Array) -> Array:
        """Return by how much an input (3,), clipped to its limits, exceeds each condition, (k,)."""
        within = np.minimum(np.maximum(asked, -self.limits), self.limits)
        return self.rows @ within - self.least

    def missed(self, asked: Array) -> IntArray:
        """Return the numbers (m,) of the conditions that an input (3,) does not satisfy."""
        return (self.margins(asked) < -_TOLERANCE).nonzero()[0]


def nearest_input(asked: Array, conditions: Conditions) -> tuple[Array, bool]:
    """Return the input (3,) nearest to ``asked`` that satisfies the conditions, and True.

    Distances are in units of the limits of each axis. If none satisfies them: that with the
    greatest least margin, and False.

    Raises RuntimeError if the solver fails.
    """
    if not len(conditions.missed(asked)):
        return np.clip(asked, -conditions.limits, conditions.limits), True
    axes = np.flatnonzero(conditions.limits)
    unit = conditions.limits[axes]
    rows = np.ascontiguousarray(conditions.rows[:, axes] * unit)
    wanted = np.clip(asked[axes] / unit, -1.0, 1.0)
    n, k = len(axes), len(conditions.least)
    out = np.zeros(3)
    x, _, flag, _ = daqp.solve(
        np.eye(n),
        -wanted,
        rows,
        np.concatenate([np.ones(n), np.full(k, _FREE)]),
        np.concatenate([-np.ones(n), conditions.least]),
        np.zeros(n + k, dtype=np.int32),
    )
    satisfied = flag == _SOLVED
    if not satisfied:
        x = _of_greatest_margin(wanted, rows, conditions.least)
    out[axes] = np.clip(x, -1.0, 1.0) * unit
    return out, satisfied


def _of_greatest_margin(wanted: Array, rows: Array, least: Array) -> Array:
    """Return the inputs (n,) within -1 to 1 that maximize t with rows x - t >= least."""
    n, k = len(wanted), len(least)
    x, _, flag, _ = daqp.solve(
        _REGULARIZATION * np.eye(n + 1),
        np.concatenate([-_REGULARIZATION * wanted, [-1.0]]),
        np.ascontiguousarray(np.hstack([rows, -np.ones((k, 1))])),
        np.concatenate([np.ones(n), [_FREE], np.full(k, _FREE)]),
        np.concatenate([-np.ones(n), [-_FREE], least]),
        np.zeros(n + 1 + k, dtype=np.int32),
    )
    if flag != _SOLVED:
        raise RuntimeError(f"assurance: daqp failed with flag {flag}")
    return x[:n]
