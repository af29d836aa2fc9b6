# SPDX-License-Identifier: Apache-2.0
"""The classical Runge-Kutta method, for references that use nothing of the tested module."""

from __future__ import annotations

from collections.abc import Callable

from chaserdock_models.arrays import Array


def rk4(slope: Callable[[Array], Array], x: Array, step_s: float, steps: int) -> Array:
    """Return the state after ``steps`` of ``step_s`` of x' = slope(x)."""
    h = step_s
    for _ in range(steps):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        k4 = slope(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x
