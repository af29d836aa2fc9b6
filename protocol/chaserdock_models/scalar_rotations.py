# SPDX-License-Identifier: Apache-2.0
"""Rotations of one quaternion at a time, in plain Python floats.

The conventions are those of ``rotations`` (Hamilton, scalar first, unit length, body to world),
which handles arrays of rotations. For a single quaternion these functions are five to twenty times
faster; the estimator calls them several hundred times in an update.

The functions ``*_components`` hold the formulas. They use ``+ - *`` only, so ``rotations``
evaluates them on arrays and the NMPC on CasADi symbols. Formulas: J. Sola, "Quaternion kinematics
for the error-state Kalman filter", 2017.
"""

from __future__ import annotations

import math

import numpy as np

from .arrays import Array


def product_components(aw, ax, ay, az, bw, bx, by, bz) -> list:
    """Return the components of the Hamilton product a (x) b (Sola eq. 12)."""
    return [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]


def cross_components(ax, ay, az, bx, by, bz) -> list:
    """Return the components of the cross product a x b."""
    return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]


def rotated_components(w, x, y, z, vx, vy, vz) -> list:
    """Return the components of v rotated by the unit quaternion (w, u): v + w t + u x t with t = 2
    u x v.
    """
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return [
        vx + w * tx + (y * tz - z * ty),
        vy + w * ty + (z * tx - x * tz),
        vz + w * tz + (x * ty - y * tx),
    ]


def matrix_components(w, x, y, z) -> list[list]:
    """Return the rows of the rotation matrix of a unit quaternion."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product (4,): the rotation ``b`` followed by ``a``."""
    return np.array(product_components(*a.tolist(), *b.tolist()))


def inverse_multiply(a: Array, b: Array) -> Array:
    """Return conj(a) (x) b (4,): the attitude ``b`` relative to ``a``, both unit quaternions."""
    w, x, y, z = a.tolist()
    return np.array(product_components(w, -x, -y, -z, *b.tolist()))


def normalize(q: Array) -> Array:
    """Return the unit quaternion (4,) along ``q``, which must not be zero."""
    return q / math.sqrt(float(q @ q))


def exp(phi: Array) -> Array:
    """Return the unit quaternion (4,) of a rotation vector (3,), rad (Sola eq. 101)."""
    x, y, z = phi.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    s = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(half) / angle
    return np.array([math.cos(half), s * x, s * y, s * z])


def log(q: Array) -> Array:
    """Return the shortest rotation vector (3,), rad, of a unit quaternion (4,) (Sola eq. 105)."""
    w, x, y, z = q.tolist()
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    n = math.sqrt(x * x + y * y + z * z)
    s = 2.0 / w if n < 1e-9 else 2.0 * math.atan2(n, w) / n
    return np.array([s * x, s * y, s * z])


def to_matrix(q: Array) -> Array:
    """Return the rotation matrix (3, 3), body to world, of a unit quaternion (4,)."""
    return np.array(matrix_components(*q.tolist()))


def skew(v: Array) -> Array:
    """Return the matrix (3, 3) with ``skew(v) @ w == cross(v, w)``."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def right_jacobian(phi: Array) -> Array:
    """Return the right Jacobian of SO(3) (3, 3): exp(phi + d) = exp(phi) exp(Jr(phi) d) to first
    order (Sola eq. 183)."""
    x, y, z = phi.tolist()
    a2 = x * x + y * y + z * z
    if a2 < 1e-8:
        b, c = 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    else:
        a = math.sqrt(a2)
        b, c = (1.0 - math.cos(a)) / a2, (a - math.sin(a)) / (a2 * a)
    d = 1.0 - c * a2
    return np.array(
        [
            [d + c * x * x, c * x * y + b * z, c * x * z - b * y],
            [c * x * y - b * z, d + c * y * y, c * y * z + b * x],
            [c * x * z + b * y, c * y * z - b * x, d + c * z * z],
        ]
    )
