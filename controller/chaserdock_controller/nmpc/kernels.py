# SPDX-License-Identifier: Apache-2.0
"""Array interface of the compiled NMPC kernels (`native`); names are the same.

Arrays are C-contiguous float64 (int64 where stated) of the given shapes. Nothing is checked here.
"""

from __future__ import annotations

import ctypes
from ctypes import Structure, c_double, c_int64, c_void_p

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.native import address, location, scratch

from .native import LIBRARY, function

LIMIT, BROKEN = 2, 3
"""Return codes of a chaser's QP, as in native/ipm.c."""
MAX_ITERATIONS = 40
"""Iteration limit of the interior point for one chaser. Closed loops take at most 29. A chaser at
the limit flies the best point, and the next tick continues from there.
"""


@LIBRARY.structure("Model")
class Model(Structure):
    """`Model` of native/model.h."""

    _fields_ = [
        ("step_s", c_double),
        ("mass_kg", c_double),
        ("per_mass", c_double),
        ("inertia", c_double * 9),
        ("inverse", c_double * 9),
        ("nodes", c_double * 4),
        ("weights", c_double * 4),
        ("parts", c_int64),
    ]


def normalize_rows(array: Array, first: int, tolerance: float) -> int:
    """Normalize the quaternions in columns first..first+3 of ``array`` (..., width) in place.

    Returns 1 for a value that is not finite, 2 for a quaternion further off unit length than
    ``tolerance``, else 0.
    """
    width = array.shape[-1]
    return function("normalize_rows", c_int64)(
        address(array),
        c_int64(array.size // width),
        c_int64(width),
        c_int64(first),
        c_double(tolerance),
    )


def sign_of(array: Array) -> int:
    """Return 1 if a value is not finite, else 2 if one is negative, else 0."""
    return function("sign_of", c_int64)(address(array), c_int64(array.size))


def shifted(inputs: Array, whole: int, part: float) -> Array:
    """Shift piecewise constant inputs (..., D, 6) by ``whole + part`` steps on the same grid; 0 <=
    part < 1.
    """
    out, d = np.empty_like(inputs), inputs.shape[-2]
    n = inputs.size // (6 * d)
    function("shift_inputs")(
        c_int64(n), c_int64(d), c_int64(whole), c_double(part), address(inputs), address(out)
    )
    return out


def roll(model: Model, x: Array, u: Array) -> None:
    """Roll out u (N, D, 6) from x[:, 0] into x (N, D+1, 13)."""
    function("roll")(
        ctypes.byref(model), c_int64(u.shape[0]), c_int64(u.shape[1]), address(u), address(x)
    )


def plan_cost(problem: Structure, x: Array, u: Array) -> Array:
    """Return the cost (eq. 6) of every chaser (N,) for x (N, D+1, 13), u (N, D, 6); ``problem`` as
    `native_problem` returns it.
    """
    cost = np.empty(len(x))
    function("plan_cost")(ctypes.byref(problem), address(x), address(u), address(cost))
    return cost


def plan_violation(problem: Structure, x: Array) -> Array:
    """Return the deepest violation of the distances, m (N,), by plans x (N, D+1, 13); ``problem``
    as `native_problem` returns it.
    """
    worst = np.empty(len(x))
    function("plan_violation")(ctypes.byref(problem), address(x), address(worst))
    return worst


@LIBRARY.structure("Tick")
class _Tick(Structure):
    """`Tick` of native/tick.c."""

    _fields_ = [
        ("model", c_void_p),
        ("problem", c_void_p),
        *((name, c_void_p) for name in ("states", "reach", "w1", "inputs")),
        ("w2", c_double),
        ("budget", c_int64),
        ("most", c_int64),
        ("code", c_void_p),
        ("iterations", c_void_p),
    ]


def tick_workspace(n: int, d: int, extra: int) -> Array:
    """Allocate working memory of `solve_tick` for up to ``n`` chasers, ``d`` stages and ``extra``
    cuboids and coasts. One thread at a time may use it.
    """
    return scratch(function("tick_workspace", c_int64)(c_int64(n), c_int64(d), c_int64(extra)))


def solve_tick(
    model: Model,
    problem: Structure,
    states: Array,
    inputs: Array,
    reach_m_per_N: Array,
    w1: Array,
    w2: float,
    budget: int,
    workspace: Array,
) -> tuple[IntArray, IntArray]:
    """Run one real-time iteration for every chaser. ``inputs`` (N, D, 6): initial plan, replaced by
    the solution.

    ``problem``: from `native_problem`. states (N, 13). reach_m_per_N (D+1,): displacement of a
    chaser by each stage per 1 N on each axis. w1 (N,), w2: slack weights. ``budget``: total
    iterations. ``workspace``: from `tick_workspace`. Returns codes and iterations, each (N,). The
    inputs of a chaser with code BROKEN are unchanged.
    """
    n = len(inputs)
    code, iterations = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    tick = _Tick(
        ctypes.addressof(model), ctypes.addressof(problem), location(states),
        location(reach_m_per_N), location(w1), location(inputs), w2, budget, MAX_ITERATIONS,
        location(code),
        location(iterations),
    )  # fmt: skip
    function("solve_tick")(ctypes.byref(tick), address(workspace))
    return code, iterations
