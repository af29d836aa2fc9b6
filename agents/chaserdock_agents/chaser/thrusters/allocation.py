# SPDX-License-Identifier: Apache-2.0
"""Allocate a wrench to thrusters (docs/thrusters.md).

Feasible wrenches: of all thrusts in [0, max] that produce the wrench exactly, those with minimum
sum, and of these the minimum norm. As an exact regularization of the linear program this is one
strictly convex quadratic program (M. P. Friedlander and P. Tseng, SIAM J. Optim. 18, 2008), so the
solution is unique and continuous in the wrench. Infeasible wrenches: the closest thrusts in a norm
scaled by ``force_max_N`` and ``torque_max_N_m``. Both are solved by daqp, a deterministic dual
active-set method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import daqp
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.thrusters import Thruster, thrusts_max

_REGULARIZATION = 1e-2
"""Weight of the norm beside the sum: small enough for the minimum sum (measured to 1e-12), large
enough for well-conditioned steps.
"""
_SMALL = 1e-6
"""Weight of the norm beside the distance to the wrench, 1 per axis. Makes the solution unique, and
changes the wrench by a millionth.
"""
_BEYOND = 10.0
"""Thrust of the largest unit, over the scale of the axes on which it acts most: with units of 100,
as of a main engine beside small thrusters, the solver fails in one case of twenty.
"""
# daqp's codes for an equality constraint and for success
_EQUALITY, _SOLVED = 5, 1


@dataclass(frozen=True, eq=False)
class Allocation:
    """Thrusts (n,), N, within their limits; ``exact``: they produce the wrench, else the closest
    one.
    """

    thrusts_N: Array
    exact: bool


class Allocator:
    """Thruster allocation for one layout; ``scale`` (6,): unit of each axis in the norm, 0 for one
    on which the body cannot move.
    """

    def __init__(self, thrusters: Sequence[Thruster], scale: Array) -> None:
        self.matrix = wrench_matrix(thrusters)
        # In units of the axes and of full thrust, or of what is far beyond them, all numbers are
        # near one.
        self._axes = np.flatnonzero(scale)
        self._scale = scale[self._axes]
        rows = self.matrix[self._axes]
        most_N = _BEYOND / np.abs(rows / self._scale[:, None]).max(axis=0)
        self._unit_N = np.minimum(thrusts_max(thrusters), most_N)
        self._rows = rows * self._unit_N / self._scale[:, None]
        self._cost = self._unit_N / self._unit_N.max()

    def allocate(
        self, wrench: Array, thrusts_max_N: Array, cost_factors: Array | None = None
    ) -> Allocation:
        """Return thrusts for a wrench (6,), N and N m, body axes, within limits (n,) N, which may
        be zero.

        ``cost_factors`` (n,): how much more the thrust of each costs than otherwise.

        Raises ValueError for numbers that are not finite, RuntimeError if the solver fails.
        """
        target = wrench[self._axes] / self._scale
        limits = thrusts_max_N / self._unit_N
        if not (np.isfinite(target).all() and np.isfinite(limits).all() and (limits >= 0.0).all()):
            raise ValueError("wrench and limits must be finite, limits not negative")
        thrusts = np.zeros(len(limits))
        able = limits > 0.0
        if not able.any():
            return Allocation(thrusts, not target.any())
        rows, most = np.ascontiguousarray(self._rows[:, able]), limits[able]
        cost = self._cost if cost_factors is None else self._cost * cost_factors
        x, flag = _cheapest(rows, cost[able], target, most)
        exact = flag == _SOLVED
        if not exact:
            x, flag = _closest(rows, target, most)
            if flag != _SOLVED:
                raise RuntimeError(
                    f"thruster allocation: daqp failed with flag {flag} for wrench {wrench}"
                )
        thrusts[able] = np.clip(x, 0.0, most) * self._unit_N[able]
        return Allocation(thrusts, exact)


def _cheapest(rows: Array, cost: Array, target: Array, most: Array) -> tuple[Array, int]:
    """Solve min cost . x + small |x|^2 with rows x = target, 0 <= x <= most.

    Return daqp's solution and flag.
    """
    n, axes = len(most), len(target)
    upper, lower = np.concatenate([most, target]), np.concatenate([np.zeros(n), target])
    sense = np.array([0] * n + [_EQUALITY] * axes, dtype=np.int32)
    x, _, flag, _ = daqp.solve(_REGULARIZATION * np.eye(n), cost, rows, upper, lower, sense)
    return x, flag


def _closest(rows: Array, target: Array, most: Array) -> tuple[Array, int]:
    """Solve min |slack|^2 + small |x|^2 with rows x + slack = target, 0 <= x <= most.

    Return daqp's solution and flag.
    """
    n, axes = len(most), len(target)
    free = np.full(axes, 1e30)
    upper, lower = (
        np.concatenate([most, free, target]),
        np.concatenate([np.zeros(n), -free, target]),
    )
    sense = np.array([0] * (n + axes) + [_EQUALITY] * axes, dtype=np.int32)
    hessian = np.diag([_SMALL] * n + [1.0] * axes)
    x, _, flag, _ = daqp.solve(
        hessian,
        np.zeros(n + axes),
        np.ascontiguousarray(np.hstack([rows, np.eye(axes)])),
        upper,
        lower,
        sense,
    )
    return x[:n], flag


def allocator_of(body: Body) -> Allocator:
    """Return the thruster allocation of a body; the units of the norm are its maximum force and
    torque.
    """
    return Allocator(body.thrusters, body.wrench_max)
