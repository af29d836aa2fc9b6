# SPDX-License-Identifier: Apache-2.0
"""Rotations: Hamilton quaternions, scalar first, unit length, body to world.

``q_wxyz`` rotates a vector given in body axes into world axes: ``v_world = rotate(q, v_body)``.
Every function takes arrays whose last axis is the quaternion (4) or vector (3) and broadcasts over
the leading axes. A single quaternion gives the same bits as an array of them. ``scalar_rotations``
is faster for single quaternions in inner loops. Formulas: J. Sola, "Quaternion kinematics for the
error-state Kalman filter", 2017.
"""

from __future__ import annotations

import math
from ctypes import c_int64
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .native import address, function
from .scalar_rotations import (
    cross_components,
    matrix_components,
    product_components,
    rotated_components,
)

IDENTITY: Array = np.array([1.0, 0.0, 0.0, 0.0])
_CONJUGATED: Array = np.array([1.0, -1.0, -1.0, -1.0])


def normalize(q: ArrayLike) -> Array:
    """Return the unit quaternion (..., 4) along ``q`` (..., 4). Raises ValueError for a zero or
    non-finite one.
    """
    q = np.asarray(q, dtype=float)
    if q.ndim == 1:
        length = math.hypot(*q.tolist())
        if not 0.0 < length < math.inf:
            raise ValueError(f"quaternion cannot be normalized: {q.tolist()}")
        return q / length
    out = np.empty(q.shape)
    if not function("unit_rows", c_int64)(c_int64(q.size // 4), _operand(q), address(out)):
        raise ValueError(f"quaternion cannot be normalized: {q.tolist()}")
    return out


def conjugate(q: ArrayLike) -> Array:
    """Return the conjugate (..., 4), the inverse of a unit quaternion."""
    return np.asarray(q, dtype=float) * _CONJUGATED


def multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the Hamilton product (..., 4): the rotation ``b`` followed by ``a`` (Sola eq. 12)."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:  # Python floats: several times faster than NumPy on so few numbers
        return np.array(product_components(*a.tolist(), *b.tolist()))
    return _by_rows("multiply_rows", a, b)


def _by_rows(kernel: str, a: Array, b: Array) -> Array:
    """Call a kernel that works row by row, and return its result (..., n).

    Operands (..., m) and (..., n) are repeated along leading axes.
    """
    lead_a, lead_b = a.shape[:-1], b.shape[:-1]
    if not lead_b or lead_a[-len(lead_b) :] == lead_b:
        lead = lead_a
    elif not lead_a or lead_b[-len(lead_a) :] == lead_a:
        lead = lead_b
    else:
        lead = np.broadcast_shapes(lead_a, lead_b)
    out = np.empty((*lead, b.shape[-1]))
    a, b = _repeatable(a, lead), _repeatable(b, lead)
    function(kernel)(
        c_int64(out.size // out.shape[-1]),
        _operand(a),
        c_int64(a.size // a.shape[-1]),
        _operand(b),
        c_int64(b.size // b.shape[-1]),
        address(out),
    )
    return out


def _repeatable(operand: Array, lead: tuple[int, ...]) -> Array:
    """Return the rows that, repeated, give ``operand`` with the leading axes ``lead``."""
    own = operand.shape[:-1]
    if own != lead[len(lead) - len(own) :]:
        operand = np.broadcast_to(operand, (*lead, operand.shape[-1]))
    return operand


def _operand(array: Array) -> Any:
    """Pass an array, which may be read-only, to a kernel."""
    array = np.ascontiguousarray(array)
    try:
        return address(array)
    except TypeError:
        return address(array.copy())


def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Return the body-axes vector ``v`` (..., 3) in world axes."""
    q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
    if q.ndim == v.ndim == 1:
        return np.array(rotated_components(*q.tolist(), *v.tolist()))
    return _by_rows("rotate_rows", q, v)


def cross(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the cross product (..., 3); faster than np.cross on single vectors."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:
        return np.array(cross_components(*a.tolist(), *b.tolist()))
    return _by_rows("cross_rows", a, b)


def rotate_inverse(q: ArrayLike, v: ArrayLike) -> Array:
    """Return the world-axes vector ``v`` (..., 3) in body axes."""
    return rotate(conjugate(q), v)


def exp(phi: ArrayLike) -> Array:
    """Return the unit quaternion (..., 4) of a rotation vector (..., 3), rad (Sola eq. 101)."""
    phi = np.asarray(phi, dtype=float)
    if phi.ndim == 1:
        # Repeats the operations below with NumPy's sine and cosine, for equal bits.
        x, y, z = phi.tolist()
        angle = math.sqrt(x * x + y * y + z * z)
        half = math.pi * (angle / (2.0 * math.pi) or 1e-20)
        scale = 0.5 * (float(np.sin(half)) / half)
        return np.array([float(np.cos(angle / 2.0)), scale * x, scale * y, scale * z])
    # The operations of np.linalg.norm and np.sinc, without their checks.
    angle = np.sqrt(np.add.reduce(phi * phi, axis=-1, keepdims=True))
    half = np.pi * (angle / (2.0 * np.pi))
    half = np.where(half, half, 1e-20)
    return np.concatenate([np.cos(angle / 2.0), 0.5 * (np.sin(half) / half) * phi], axis=-1)


def log(q: ArrayLike) -> Array:
    """Return the shortest rotation vector (..., 3), rad, of a unit quaternion (..., 4) (Sola eq.
    105).
    """
    q = np.asarray(q, dtype=float)
    if q.ndim == 1:
        return np.array(_log_components(*q.tolist()))
    q = np.where(q[..., :1] < 0.0, -q, q)
    n = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(n, q[..., :1])
    # Near the identity 2 half / n tends to 2 / w. np.where evaluates both branches, so both
    # divisors are kept nonzero.
    small = n <= 1e-9
    scale = np.where(
        small, 2.0 / np.where(small, q[..., :1], 1.0), 2.0 * half / np.where(small, 1.0, n)
    )
    return scale * q[..., 1:]


def _log_components(w: float, x: float, y: float, z: float) -> list[float]:
    """Return ``log`` of one quaternion, with the bits of the array branch.

    Uses NumPy's arctan2, whose last bits differ from those of ``math``.
    """
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    n = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if n <= 1e-9 else 2.0 * float(np.arctan2(n, w)) / n
    return [scale * x, scale * y, scale * z]


def angle_between(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the angle (...), 0 to pi rad, of the rotation that takes attitude ``a`` to ``b``."""
    phi = log(multiply(conjugate(a), b))
    if phi.ndim == 1:
        x, y, z = phi.tolist()
        angle: Any = np.float64(math.sqrt(x * x + y * y + z * z))
        return angle
    return np.linalg.norm(phi, axis=-1)


def to_matrix(q: ArrayLike) -> Array:
    """Return the rotation matrix (..., 3, 3), body to world, of a unit quaternion (..., 4)."""
    q = np.asarray(q, dtype=float)
    if q.ndim == 1:
        return np.array(matrix_components(*q.tolist()))
    rows = matrix_components(*(q[..., i] for i in range(4)))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(r: ArrayLike) -> Array:
    """Return the unit quaternion (4,), scalar part not negative, of a rotation matrix (3, 3), body
    to world.

    Shepperd's method: the largest of the four squared components is the pivot.
    """
    r = np.asarray(r, dtype=float)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    choice = int(np.argmax([trace, r[0, 0], r[1, 1], r[2, 2]]))
    q = np.empty(4)
    if choice == 0:
        q[0] = 1.0 + trace
        q[1] = r[2, 1] - r[1, 2]
        q[2] = r[0, 2] - r[2, 0]
        q[3] = r[1, 0] - r[0, 1]
    else:
        i = choice - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[1 + i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        q[1 + j] = r[j, i] + r[i, j]
        q[1 + k] = r[k, i] + r[i, k]
        q[0] = r[k, j] - r[j, k]
    q = normalize(q)
    return -q if q[0] < 0.0 else q


def integrate(q: ArrayLike, omega_body: ArrayLike, dt_s: float | Array) -> Array:
    """Return the attitude (..., 4) after ``dt_s`` (or (..., 1)) at constant body rate
    ``omega_body`` (..., 3), rad/s (exact).
    """
    return multiply(q, exp(np.asarray(omega_body, dtype=float) * dt_s))


def skew(v: ArrayLike) -> Array:
    """Return the matrix (..., 3, 3) with ``skew(v) @ w == cross(v, w)``."""
    v = np.asarray(v, dtype=float)
    if v.ndim == 1:  # the usual case, without the overhead of arrays
        a, b, c = v.tolist()
        return np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
