# SPDX-License-Identifier: Apache-2.0
"""Allocates a wrench of the stack to its thrusters: exact in direction, with the largest possible
magnitude. Pure functions.

Linear programme: maximize the common scale s <= 1 of the wrench, then minimize the sum of thrusts,
subject to B f = s w and 0 <= f <= f_max. It is solved as a strictly convex quadratic programme with
the same solution (M. P. Friedlander and P. Tseng, SIAM J. Optim. 18, 2008), which makes the thrusts
unique. Solver: daqp, a deterministic dual active-set method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import daqp
import numpy as np
from chaserdock_models.arrays import Array

_REGULARIZATION = 1e-2
"""Quadratic cost of thrusts, relative to a linear cost of 1 for the largest thrust. It makes the
solution unique and continuous and costs at most 1 % of the thrust.
"""
_SCALE_FIRST = 1e3
"""Weight of the scale over that of the thrusts. A gain in scale that costs more thrust than this
(gains below 1e-3) is not taken.
"""
_EQUALITY = 5  # daqp's codes for an equality constraint and for success
_SOLVED = 1  # see above
_NOTHING = 1e-12
"""Norm of a wrench (N, N m) below which it is rounding, not a request."""
_TOLERANCE = 1e-5
"""Norm of a wrench (N, N m) that lies within the solver's tolerance. A smaller result in a
direction that cannot be served counts as none.
"""


@dataclass(frozen=True, eq=False)
class StackAllocation:
    """Thrusts ``thrusts_N`` (n,) within their limits, which give ``scale`` times the requested
    wrench.
    """

    thrusts_N: Array
    scale: float


@dataclass(frozen=True)
class MinimumTime:
    """Shortest time (s) in which thrusters can stop a momentum while the stack does not turn, and
    the sum of their impulses (N s).
    """

    time_s: float
    impulse_N_s: float


def units_of(wrenches: Array, limits_N: Array) -> tuple[float, float]:
    """Return a force and a torque typical of the thrusters. Scaled by them, all numbers of the
    programme are near one.
    """
    force_N = float((np.linalg.norm(wrenches[:3], axis=0) * limits_N).max(initial=0.0))
    torque_N_m = float((np.linalg.norm(wrenches[3:], axis=0) * limits_N).max(initial=0.0))
    return force_N or 1.0, torque_N_m or 1.0


def allocate(wrenches: Array, wrench: Array, limits_N: Array) -> StackAllocation:
    """Return thrusts within ``limits_N`` (n,) that give the largest share of ``wrench`` (6,) at the
    least sum.

    ``wrenches`` (6, n): per 1 N of each thruster. Raises ValueError for numbers that are not
    finite, RuntimeError if the solver fails.
    """
    if not (
        np.isfinite(wrenches).all() and np.isfinite(wrench).all() and np.isfinite(limits_N).all()
    ):
        raise ValueError("wrenches and limits must be finite")

    thrusts = np.zeros(len(limits_N))
    able = limits_N > 0.0
    force, torque = units_of(wrenches[:, able], limits_N[able])
    units = np.array([force] * 3 + [torque] * 3)

    asked = wrench / units
    size = float(np.linalg.norm(asked))
    if size <= _NOTHING:
        return StackAllocation(thrusts, 1.0)
    if not able.any():
        return StackAllocation(thrusts, 0.0)

    # Variables: each thrust over its limit, then the scale times the size of the request.
    rows = np.hstack(
        [wrenches[:, able] * limits_N[able] / units[:, None], -(asked / size)[:, None]]
    )
    n = rows.shape[1]
    cost = np.concatenate([limits_N[able] / limits_N[able].max(), [-_SCALE_FIRST]])
    zeros = np.zeros(6)
    upper = np.concatenate([np.ones(n - 1), [size], zeros])
    lower = np.concatenate([np.zeros(n), zeros])
    sense = np.array([0] * n + [_EQUALITY] * 6, dtype=np.int32)

    x, _, flag, _ = daqp.solve(
        _REGULARIZATION * np.eye(n), cost, np.ascontiguousarray(rows), upper, lower, sense
    )
    if flag != _SOLVED:
        raise RuntimeError(f"allocation of the stack's thrusters: daqp failed with flag {flag}")

    thrusts[able] = np.clip(x[:-1], 0.0, 1.0) * limits_N[able]
    return StackAllocation(thrusts, float(np.clip(x[-1] / size, 0.0, 1.0)))


def spans_all_directions(wrenches: Array, limits_N: Array) -> bool:
    """Return whether thrusts within ``limits_N`` (n,) can give force and torque in every direction.

    They can if ``wrenches`` (6, n) has full rank and some strictly positive thrusts cancel: a
    multiple of these makes the thrusts of any combination positive.
    """
    able = limits_N > 0.0
    b = wrenches[:, able] * limits_N[able]
    force, torque = units_of(wrenches[:, able], limits_N[able])
    b = b / np.array([force] * 3 + [torque] * 3)[:, None]
    if b.shape[1] < 7 or np.linalg.matrix_rank(b, tol=1e-6) < 6:
        return False
    # Put all thrusters at a floor, and add what cancels it.
    floor = -b.sum(axis=1)
    return (
        allocate(
            b, floor / max(1.0, float(np.linalg.norm(floor))) * 1e-3, np.ones(b.shape[1])
        ).scale
        > 0.5
    )


def minimum_time(wrenches: Array, momentum: Array, limits_N: Array) -> MinimumTime | None:
    """Return the shortest time to stop ``momentum`` (6,) by constant thrusts while the stack does
    not turn; None if impossible.

    Linear programme for the thrusts that give the largest share of -momentum per second.
    """
    if not momentum.any():
        return MinimumTime(0.0, 0.0)
    most = float(np.linalg.norm(momentum)) * 1e-3
    asked = -momentum / most
    found = allocate(wrenches, asked, limits_N)
    if found.scale * float(np.linalg.norm(asked)) <= _TOLERANCE:
        return None
    time_s = most / found.scale
    return MinimumTime(time_s, float(found.thrusts_N.sum()) * time_s)


def feedback(wrenches: Array, momentum: Array, limits_N: Array, time_s: float) -> StackAllocation:
    """Return thrusts that stop ``momentum`` (6,) in ``time_s``, or as fast as possible in this
    direction.
    """
    if not time_s > 0.0 or not math.isfinite(time_s):
        raise ValueError(f"time_s must be positive, not {time_s!r}")
    return allocate(wrenches, -momentum / time_s, limits_N)
