"""Thruster selection: which thrusts give a wrench (docs/thrusters.md).

Inside the feasible set: of all thrusts in [0, max] that give the wrench exactly, those of the least sum, and of these
the least norm. As an exact regularization of the linear programme this is one strictly convex quadratic programme
(M. P. Friedlander and P. Tseng, SIAM J. Optim. 18, 2008), so the answer is unique and moves little with the wrench.
Outside: thrusts that come closest, in a norm that counts force in parts of ``force_max_N`` and torque in parts of
``torque_max_N_m``. Both are solved by daqp, a dual active-set method: no iteration limit is met in practice, and equal
wrenches have equal answers.
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
"""Small enough for the least sum (measured to 1e-12), large enough for well-conditioned steps."""
_NEXT_TO_NOTHING = 1e-6
_EQUALITY = 5  # daqp's codes of kinds of constraints and of success
_SOLVED = 1


@dataclass(frozen=True, eq=False)
class Allocation:
    """``thrusts_N`` (n,) within their limits; ``exact``: they give the wrench, and not only come closest."""

    thrusts_N: Array
    exact: bool


class Allocator:
    """Thruster selection for one layout; ``scale`` (6,) is the unit of each axis in the norm."""

    def __init__(self, thrusters: Sequence[Thruster], scale: Array) -> None:
        self.matrix = wrench_matrix(thrusters)
        self._full_N = thrusts_max(thrusters)
        # In parts of the scale and of full thrust all numbers are near one.
        self._rows = self.matrix * self._full_N / scale[:, None]
        self._scale = scale
        self._cost = self._full_N / self._full_N.max()

    def allocate(self, wrench: Array, thrusts_max_N: Array) -> Allocation:
        """Thrusts for a wrench (6,), N and N m, body axes, under limits (n,) N, which may be zero.

        Raises ValueError for numbers that are not finite, RuntimeError should the solver break down.
        """
        asked = wrench / self._scale
        limits = thrusts_max_N / self._full_N
        if not (np.isfinite(asked).all() and np.isfinite(limits).all() and (limits >= 0.0).all()):
            raise ValueError("wrench and limits must be finite, limits not negative")
        thrusts = np.zeros(len(limits))
        able = limits > 0.0
        if not able.any():
            return Allocation(thrusts, not asked.any())
        rows, most = np.ascontiguousarray(self._rows[:, able]), limits[able]
        x, flag = _cheapest(rows, self._cost[able], asked, most)
        exact = flag == _SOLVED
        if not exact:
            x, flag = _closest(rows, asked, most)
            if flag != _SOLVED:
                raise RuntimeError(f"thruster selection: daqp gave up with flag {flag} on wrench {wrench}")
        thrusts[able] = np.clip(x, 0.0, most) * self._full_N[able]
        return Allocation(thrusts, exact)


def _cheapest(rows: Array, cost: Array, asked: Array, most: Array) -> tuple[Array, int]:
    """min cost . x + small |x|^2 with rows x = asked, 0 <= x <= most; daqp's answer and flag."""
    n = len(most)
    upper, lower = np.concatenate([most, asked]), np.concatenate([np.zeros(n), asked])
    sense = np.array([0] * n + [_EQUALITY] * 6, dtype=np.int32)
    x, _, flag, _ = daqp.solve(_REGULARIZATION * np.eye(n), cost, rows, upper, lower, sense)
    return x, flag


def _closest(rows: Array, asked: Array, most: Array) -> tuple[Array, int]:
    """min |slack|^2 + next to nothing |x|^2 with rows x + slack = asked, 0 <= x <= most; daqp's answer and flag."""
    n = len(most)
    free = np.full(6, 1e30)
    upper, lower = np.concatenate([most, free, asked]), np.concatenate([np.zeros(n), -free, asked])
    sense = np.array([0] * (n + 6) + [_EQUALITY] * 6, dtype=np.int32)
    hessian = np.diag([_NEXT_TO_NOTHING] * n + [1.0] * 6)
    x, _, flag, _ = daqp.solve(
        hessian, np.zeros(n + 6), np.ascontiguousarray(np.hstack([rows, np.eye(6)])), upper, lower, sense
    )
    return x[:n], flag


def allocator_of(body: Body) -> Allocator:
    """Thruster selection for a body; one unit of the norm is its greatest force and torque."""
    return Allocator(body.thrusters, np.array([body.force_max_N] * 3 + [body.torque_max_N_m] * 3))
