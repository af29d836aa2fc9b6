# SPDX-License-Identifier: Apache-2.0
"""Validation of a problem, its warm start and its plan, common to all back ends."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .kernels import normalize_rows, shifted, sign_of
from .types import Array, NmpcInput, NmpcParameters, NmpcPlan

# Measured quaternions are normalized; a larger deviation is an error, not rounding.
QUATERNION_NORM_TOLERANCE = 0.1


def _array(name: str, value: object, shape: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=np.float64, order="C")
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    return array


def _poses(name: str, array: Array, first: int) -> None:
    code = normalize_rows(array, first, QUATERNION_NORM_TOLERANCE)
    if code == 1:
        raise ValueError(f"{name} holds a value that is not finite")
    if code == 2:
        raise ValueError(f"{name} holds a quaternion that is not of unit length")


def check_input(problem: NmpcInput, params: NmpcParameters, n_max: int) -> NmpcInput:
    """Return a copy of ``problem`` with contiguous arrays, unit quaternions and all optional values
    expanded: (N, D+1) target distances, (N, N) chaser distances, corridors, cuboids and distances
    of shapes.

    Raises ValueError for a wrong shape, a value that is not finite, a quaternion more than 10 % off
    unit length, a negative distance or limit, an asymmetric distance matrix, an invalid corridor,
    or more than ``n_max`` chasers.
    """
    states = np.asarray(problem.states, dtype=np.float64)
    if states.ndim != 2 or not 1 <= len(states) <= n_max:
        raise ValueError(
            f"states must have shape (N, 13) with N from 1 to {n_max}, not {states.shape}"
        )
    n, d = len(states), params.stages
    states = _array("states", states, (n, 13))
    references = _array("references", problem.references, (n, d + 1, 7))
    _poses("states", states, 6)
    _poses("references", references, 3)
    between = np.asarray(problem.min_distance_chasers_m, dtype=np.float64)
    if between.ndim == 0:
        between = np.full((n, n), float(between))
    between = _array("min_distance_chasers_m", between, (n, n))
    apart = (
        np.zeros((n, n)) if problem.min_distance_shapes_m is None else problem.min_distance_shapes_m
    )
    apart = _array("min_distance_shapes_m", apart, (n, n))
    for name, value in (("min_distance_chasers_m", between), ("min_distance_shapes_m", apart)):
        if n > 1 and (value != value.T).any():
            raise ValueError(f"{name} must be symmetric")
    shape = np.zeros((0, 15)) if problem.chaser_shape is None else np.asarray(problem.chaser_shape)
    shape = _array("chaser_shape", shape, (len(shape), 15))
    to_target = np.asarray(problem.min_distance_target_m, dtype=np.float64)
    if to_target.ndim == 1:
        to_target = np.repeat(to_target[:, None], d + 1, axis=1)
    to_target = _array("min_distance_target_m", to_target, (n, d + 1))
    corridors = np.zeros((n, d + 1, 5)) if problem.corridors is None else problem.corridors
    corridors = _array("corridors", corridors, (n, d + 1, 5))
    boxes = np.zeros((d + 1, 0, 15)) if problem.boxes is None else np.asarray(problem.boxes)
    boxes = _array("boxes", boxes, (d + 1, boxes.shape[1] if boxes.ndim == 3 else 0, 15))
    if boxes.shape[1] > params.boxes:
        raise ValueError(f"boxes must be at most {params.boxes}, not {boxes.shape[1]}")
    clearance = np.zeros(n) if problem.box_clearance_m is None else problem.box_clearance_m
    clearance = _array("box_clearance_m", clearance, (n,))
    input_max = _array("input_max", problem.input_max, (n, 6))
    u_ref = _array("u_ref", problem.u_ref, (n, d, 6))
    targets = _array("target_positions", problem.target_positions, (d + 1, 3))
    for name, value, may_be_negative in (
        ("min_distance_chasers_m", between, False),
        ("min_distance_target_m", to_target, False),
        ("input_max", input_max, False),
        ("u_ref", u_ref, True),
        ("target_positions", targets, True),
        ("corridors", corridors, True),
        ("boxes", boxes, True),
        ("box_clearance_m", clearance, False),
        ("chaser_shape", shape, True),
        ("min_distance_shapes_m", apart, False),
    ):
        code = sign_of(value)
        if code == 1:
            raise ValueError(f"{name} holds a value that is not finite")
        if code == 2 and not may_be_negative:
            raise ValueError(f"{name} must not be negative")
    if problem.corridors is not None:
        _check_corridors(corridors)
    return NmpcInput(
        states=states,
        references=references,
        u_ref=u_ref,
        target_positions=targets,
        min_distance_target_m=to_target,
        min_distance_chasers_m=between,
        input_max=input_max,
        corridors=corridors,
        boxes=boxes,
        box_clearance_m=clearance,
        chaser_shape=shape,
        min_distance_shapes_m=apart,
        coast_safety=problem.coast_safety,
    )


def _check_corridors(corridors: Array) -> None:
    length = np.linalg.norm(corridors[..., :3], axis=-1)
    used = length > 0.0
    if (np.abs(length[used] - 1.0) > 1e-6).any():
        raise ValueError("corridors must have axes of unit length, or zero for no corridor")
    angle = corridors[..., 3][used]
    if not ((angle > 0.0) & (angle < math.pi / 2)).all():
        raise ValueError("corridors must have half angles above 0 and below pi / 2")


def check_plan(plan: NmpcPlan, n: int, d: int) -> None:
    """Raise ValueError for a plan of other than ``n`` chasers or ``d`` stages, or with a value that
    is not finite.
    """
    for name, value, shape in (
        ("inputs", plan.inputs, (n, d, 6)),
        ("states", plan.states, (n, d + 1, 13)),
    ):
        if sign_of(_array(name, value, shape)) == 1:
            raise ValueError(f"{name} holds a value that is not finite")
    if len(plan.status) != n:
        raise ValueError(f"status must be of {n} chasers, not {len(plan.status)}")


def check_ids(ids: Sequence[int] | None, n: int) -> tuple[int, ...]:
    """Return the chasers' ids, 0..N-1 by default. Raises ValueError for a wrong number or a
    repetition.
    """
    chosen = tuple(range(n)) if ids is None else tuple(int(i) for i in ids)
    if len(chosen) != n or len(set(chosen)) != n:
        raise ValueError(f"ids must be {n} different numbers, not {chosen}")
    return chosen


def check_shift(shift_s: float) -> float:
    """Return the time since the previous solve, s. Raises ValueError if it is negative or not
    finite.
    """
    if not (math.isfinite(shift_s) and shift_s >= 0.0):
        raise ValueError(f"shift_s must be finite and not negative, not {shift_s!r}")
    return float(shift_s)


def shift_inputs(inputs: Array, shift_s: float, dt_s: float) -> Array:
    """Shift piecewise constant inputs (..., D, 6) by ``shift_s`` on the same grid.

    Each new value is the mean of the old plan over its interval, which preserves the impulse. The
    last value is held beyond the old horizon.
    """
    whole, part = divmod(shift_s / dt_s, 1.0)
    return shifted(inputs, int(min(whole, inputs.shape[-2])), part)


def warm_start(
    plans: dict[int, Array], names: tuple[int, ...], problem: NmpcInput, shift_s: float, dt_s: float
) -> Array:
    """Return the initial inputs (N, D, 6) within the box: each chaser's shifted plan, or u_ref
    without a plan.
    """
    start = problem.u_ref.copy()
    known = [row for row, name in enumerate(names) if name in plans]
    if known:
        start[known] = shift_inputs(np.array([plans[names[row]] for row in known]), shift_s, dt_s)
    limits = problem.input_max[:, None, :]
    return np.minimum(np.maximum(start, -limits), limits)
