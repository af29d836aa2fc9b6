# SPDX-License-Identifier: Apache-2.0
"""Array interface of the parts of the NMPC's compiled kernels, which a solver calls inside of one
kernel only.

Arrays are C-contiguous float64 (int64 where stated) of the given shapes; nothing is checked here.
"""

from __future__ import annotations

import ctypes
from ctypes import Structure, c_double, c_int, c_int64, c_void_p
from dataclasses import dataclass

import numpy as np
from chaserdock_controller.nmpc import NmpcInput, NmpcParameters
from chaserdock_controller.nmpc.kernels import MAX_ITERATIONS, Model
from chaserdock_controller.nmpc.native import LIBRARY, function
from chaserdock_controller.nmpc.problem import native_problem
from chaserdock_controller.nmpc.types import Array, IntArray
from chaserdock_models.native import address, location, scratch

# From native/ipm.c: return codes and final complementarity.
FREE, CONVERGED = 0, 1
MU_STOP = 1e-3


def roll_linearized(model: Model, x: Array, u: Array, limits: Array, mats: Array) -> None:
    """Roll out and linearize: mats (N, D, 12, 12) = [C B], B for inputs scaled by limits (N, 6)."""
    function("roll_linearized")(
        ctypes.byref(model), c_int64(u.shape[0]), c_int64(u.shape[1]), address(u), address(limits),
        address(x),
        address(mats),
    )  # fmt: skip


def quadratic_model(
    problem: NmpcInput, params: NmpcParameters, i: int, x: Array, u: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Quadratic cost model of chaser ``i`` about x (D+1, 13), u (D, 6), in changes of its state and
    scaled inputs w = u / limits; ``problem`` as `check_input` returns it.

    Returns q (D+1, 2, 6, 6), qx (D+1, 12), r_diag, r and w_bar (D, 6).
    """
    d, native = len(u), native_problem(problem, params)
    out = (
        np.empty((d + 1, 2, 6, 6)), np.empty((d + 1, 12)), np.empty((d, 6)), np.empty((d, 6)),
        np.empty((d, 6)),
    )  # fmt: skip
    arrays = (address(a) for a in (x, u, *out))
    function("quadratic_model")(ctypes.byref(native), c_int64(i), *arrays)
    return out


@LIBRARY.structure("Rows")
class _Rows(Structure):
    _fields_ = [
        ("width", c_int64),
        ("nodes", c_int64),
        ("reach", c_void_p),
        ("stage", c_void_p),
        ("n_rows", c_void_p),
        ("a", c_void_p),
        ("c", c_void_p),
        ("relief", c_void_p),
    ]


@dataclass(frozen=True)
class HalfSpaceRows:
    """Half-spaces a' dr_k >= c of each chaser, dr_k the changes of position and velocity: stage
    (N, M), a (N, M, 6), c (N, M); the first n_rows (N,) are used."""

    stage: IntArray
    a: Array
    c: Array
    n_rows: IntArray


def build_rows(
    problem: NmpcInput, params: NmpcParameters, x: Array, reach_m: Array
) -> HalfSpaceRows:
    """Build the rows of all chasers about rollouts x (N, D+1, 13); ``problem`` as `check_input`
    returns it.

    reach_m (N, D+1): how far admissible inputs can move a chaser from its rollout.
    """
    n, nodes, _ = x.shape
    extra = sum(
        0 if a is None else a.shape[k] for a, k in ((problem.boxes, 1), (problem.coasts, 2))
    )
    width = (nodes - 1) * (n + 2 + extra)
    rows = HalfSpaceRows(
        np.zeros((n, width), dtype=np.int64), np.zeros((n, width, 6)), np.zeros((n, width)),
        np.zeros(n, dtype=np.int64),
    )  # fmt: skip
    reach, relief = np.ascontiguousarray(reach_m), np.empty(n)
    arrays = (reach, rows.stage, rows.n_rows, rows.a, rows.c, relief)
    native = _Rows(width, nodes, *(location(a) for a in arrays))
    stated = native_problem(problem, params)
    function("build_rows")(ctypes.byref(stated), address(x), ctypes.byref(native))
    return rows


@LIBRARY.structure("Qp")
class _Qp(Structure):
    _fields_ = [
        ("stages", c_int64),
        ("n_rows", c_int64),
        ("max_iterations", c_int64),
        ("h", c_double),
        ("w1", c_double),
        ("w2", c_double),
        *(
            (name, c_void_p)
            for name in (
                "mats",
                "q",
                "qx",
                "r_diag",
                "r",
                "w_bar",
                "stage",
                "a",
                "c",
            )
        ),
    ]


@LIBRARY.structure("Answer")
class _Answer(Structure):
    _fields_ = [
        ("dx", c_void_p),
        ("dw", c_void_p),
        ("mul", c_void_p),
        ("residual", c_double),
        ("mu", c_double),
        ("iterations", c_int64),
    ]


@dataclass(frozen=True)
class QpAnswer:
    """dx (D+1, 12), dw (D, 6), multipliers (2 R + 12 D) in the order of native/ipm.c."""

    code: int
    iterations: int
    complementarity: float
    dx: Array
    dw: Array
    multipliers: Array


def solve_qp(
    mats: Array, h: float, model: tuple[Array, ...], stage: IntArray, a: Array, c: Array, w1: float,
    w2: float,
    max_iterations: int = MAX_ITERATIONS,
) -> QpAnswer:  # fmt: skip
    """Solve the QP of one chaser: mats (D, 12, 12), ``model`` as `quadratic_model` returns it, rows
    (R,), (R, 6), (R,)."""
    d, rows = len(mats), len(stage)
    dx, dw, mul = np.empty((d + 1, 12)), np.empty((d, 6)), np.empty(2 * rows + 12 * d)
    qp = _Qp(
        d,
        rows,
        max_iterations,
        h,
        w1,
        w2,
        *(location(v) for v in (mats, *model, stage, a, c)),
    )
    answer = _Answer(location(dx), location(dw), location(mul))
    work = scratch(function("qp_workspace", c_int64)(c_int64(d), c_int64(rows)))
    code = function("solve_qp", c_int)(ctypes.byref(qp), ctypes.byref(answer), address(work))
    return QpAnswer(code, answer.iterations, answer.mu, dx, dw, mul)
