# SPDX-License-Identifier: Apache-2.0
"""Array interface of the compiled NMPC kernels (`native`), with the same names.

Arrays are C-contiguous float64 (int64 where stated) of the given shapes; nothing is checked here.
"""

from __future__ import annotations

import ctypes
from ctypes import Structure, c_double, c_int64, c_void_p

import numpy as np
from chaserdock_models.native import address, location, scratch

from .native import function
from .types import Array, IntArray, NmpcInput, NmpcParameters

# Explicit Runge-Kutta tableaus with one subdiagonal, sufficient for euler and rk4.
RK_NODES = {"euler": (0.0,), "rk4": (0.0, 0.5, 0.5, 1.0)}
RK_WEIGHTS = {"euler": (1.0,), "rk4": (1.0 / 6.0, 2.0 / 6.0, 2.0 / 6.0, 1.0 / 6.0)}

# From native/ipm.c: return codes; from native/tick.c: iteration limit of a chaser.
LIMIT, BROKEN = 2, 3
MAX_ITERATIONS = 40


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


def model_of(params: NmpcParameters, step_s: float | None = None) -> Model:
    """Return body and discretization, with step ``params.dt_s`` by default."""
    inertia = np.array(params.inertia_kg_m2, dtype=float)
    nodes, weights = RK_NODES[params.integrator], RK_WEIGHTS[params.integrator]
    return Model(
        params.dt_s if step_s is None else step_s, params.mass_kg, 1.0 / params.mass_kg,
        (c_double * 9)(*inertia.ravel()),
        (c_double * 9)(*np.linalg.inv(inertia).ravel()), (c_double * 4)(*nodes), (c_double * 4)(*weights), len(nodes),
    )  # fmt: skip


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


class _Weights(Structure):
    _fields_ = [
        ("stages", c_int64),
        ("position", c_void_p),
        ("orientation", c_void_p),
        ("input", c_void_p),
    ]


class Weights:
    """The cost's weights: of position and orientation at each stage, each (D+1,), and of the inputs
    (6,).
    """

    def __init__(self, params: NmpcParameters) -> None:
        self.position, self.orientation = params.stage_weights()
        self.input = np.array([params.weight_force] * 3 + [params.weight_torque] * 3)
        arrays = (location(a) for a in (self.position, self.orientation, self.input))
        self.native = _Weights(params.stages, *arrays)


def plan_cost(weights: Weights, x: Array, u: Array, refs: Array, u_ref: Array) -> Array:
    """Return the cost (eq. 6) of every chaser (N,) for x (N, D+1, 13), u (N, D, 6)."""
    cost = np.empty(len(x))
    arrays = (address(a) for a in (x, u, refs, u_ref, cost))
    function("plan_cost")(ctypes.byref(weights.native), c_int64(len(x)), *arrays)
    return cost


class _Zones(Structure):
    _fields_ = [
        ("n", c_int64),
        ("stages", c_int64),
        ("references", c_void_p),
        ("targets", c_void_p),
        ("to_target", c_void_p),
        ("between", c_void_p),
        ("corridors", c_void_p),
        ("outer", c_double),
        ("n_boxes", c_int64),
        ("boxes", c_void_p),
        ("clearance", c_void_p),
        ("n_shape", c_int64),
        ("shape", c_void_p),
        ("apart", c_void_p),
        ("n_coasts", c_int64),
        ("coasts", c_void_p),
        ("step_s", c_double),
    ]


def zones_of(problem: NmpcInput, outer: float, step_s: float = 1.0) -> _Zones:
    n, nodes, _ = problem.references.shape
    between, corridors = problem.min_distance_chasers_m, problem.corridors
    assert isinstance(between, np.ndarray)
    boxes, clearance = problem.boxes, problem.box_clearance_m
    shape, apart = problem.chaser_shape, problem.min_distance_shapes_m
    assert corridors is not None
    assert boxes is not None
    assert clearance is not None
    assert shape is not None
    assert apart is not None
    coasts = problem.coasts
    return _Zones(
        n, nodes - 1, location(problem.references), location(problem.target_positions),
        location(problem.min_distance_target_m), location(between), location(corridors), outer,
        boxes.shape[1], location(boxes), location(clearance), len(shape), location(shape), location(apart),
        *((0, None) if coasts is None else (coasts.shape[2], location(coasts))), step_s,
    )  # fmt: skip


def plan_violation(problem: NmpcInput, x: Array, outer_m: float) -> Array:
    """Return the deepest violation of the distances, m (N,), by plans x (N, D+1, 13); ``problem``
    as `check_input` returns it."""
    worst, zones = np.empty(len(x)), zones_of(problem, outer_m)
    function("plan_violation")(ctypes.byref(zones), address(x), address(worst))
    return worst


class _Tick(Structure):
    _fields_ = [
        ("model", c_void_p),
        ("weights", c_void_p),
        ("zones", c_void_p),
        *((name, c_void_p) for name in ("states", "u_ref", "limits", "reach", "w1", "inputs")),
        ("w2", c_double),
        ("budget", c_int64),
        ("code", c_void_p),
        ("iterations", c_void_p),
    ]


def tick_workspace(n: int, d: int, extra: int) -> Array:
    """Allocate working memory of `solve_tick` for up to ``n`` chasers, ``d`` stages and ``extra``
    cuboids and coasts; for one thread at a time."""
    return scratch(function("tick_workspace", c_int64)(c_int64(n), c_int64(d), c_int64(extra)))


def solve_tick(
    model: Model, weights: Weights, problem: NmpcInput, inputs: Array, outer_m: float, reach_m_per_N: Array, w1: Array,
    w2: float, budget: int, workspace: Array,
) -> tuple[IntArray, IntArray]:  # fmt: skip
    """Run one real-time iteration for every chaser; ``inputs`` (N, D, 6) hold the start and receive
    the solution.

    ``problem`` from `check_input`. reach_m_per_N (D+1,): displacement of a chaser by each stage for
    1 N on each axis. w1 (N,), w2: slack weights. ``budget``: total iterations. ``workspace`` from
    `tick_workspace`. Returns code and iterations, each (N,); the inputs of a chaser with code
    BROKEN are unchanged.
    """
    n = len(inputs)
    zones = zones_of(problem, outer_m, model.step_s)
    code, iterations = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    tick = _Tick(
        ctypes.addressof(model), ctypes.addressof(weights.native), ctypes.addressof(zones), location(problem.states),
        location(problem.u_ref), location(problem.input_max), location(reach_m_per_N), location(w1), location(inputs), w2,
        budget, location(code), location(iterations),
    )  # fmt: skip
    function("solve_tick")(ctypes.byref(tick), address(workspace))
    return code, iterations
