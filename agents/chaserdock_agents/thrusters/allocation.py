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
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario_bodies import Body
from chaserdock_protocol.scenario_thrusters import Thruster, thrusts_max
from chaserdock_protocol.wrench_set import wrench_matrix

_REGULARIZATION = 1e-2
"""Small enough for the least sum (measured to 1e-12), large enough for well-conditioned steps."""
_NEARLY_FLAT = 1e-9
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
        n = len(thrusters)
        self.matrix = wrench_matrix(thrusters)
        self._full_N = thrusts_max(thrusters)
        # In parts of the scale and of full thrust all numbers are near one.
        self._rows = np.ascontiguousarray(self.matrix * self._full_N / scale[:, None])
        self._scale = scale
        self._hessian = _REGULARIZATION * np.eye(n)
        self._cost = self._full_N / self._full_N.max()
        self._sense = np.array([0] * n + [_EQUALITY] * 6, dtype=np.int32)
        self._lower, self._upper = np.zeros(n + 6), np.zeros(n + 6)
        self._closest_hessian = self._rows.T @ self._rows + _NEARLY_FLAT * np.eye(n)

    def allocate(self, wrench: Array, thrusts_max_N: Array) -> Allocation:
        """Thrusts for a wrench (6,), N and N m, body axes, under limits (n,) N, which may be zero.

        Raises ValueError for numbers that are not finite, RuntimeError should the solver break down.
        """
        asked = wrench / self._scale
        limits = thrusts_max_N / self._full_N
        if not (np.isfinite(asked).all() and np.isfinite(limits).all() and (limits >= 0.0).all()):
            raise ValueError("wrench and limits must be finite, limits not negative")
        n = len(limits)
        self._upper[:n] = limits
        self._lower[n:] = self._upper[n:] = asked
        x, _, flag, _ = daqp.solve(
            self._hessian, self._cost, self._rows, self._upper, self._lower, self._sense
        )
        exact = flag == _SOLVED
        if not exact:
            x, _, flag, _ = daqp.solve(
                self._closest_hessian, -self._rows.T @ asked, np.zeros((0, n)), limits, np.zeros(n)
            )
            if flag != _SOLVED:
                raise RuntimeError(f"thruster selection: daqp gave up with flag {flag} on wrench {wrench}")
        return Allocation(np.clip(x, 0.0, limits) * self._full_N, exact)


def allocator_of(body: Body) -> Allocator:
    """Thruster selection for a body; one unit of the norm is its greatest force and torque."""
    return Allocator(body.thrusters, np.array([body.force_max_N] * 3 + [body.torque_max_N_m] * 3))
