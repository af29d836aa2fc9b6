"""Rotations of one quaternion at a time, in plain floats.

The same mathematics and conventions as ``chaserdock_models.rotations`` (a test holds them equal); for
single quaternions these are five to twenty times faster than the broadcasting versions, and the filter
calls them some hundred times an update.
"""

from __future__ import annotations

import math

import numpy as np

from .types import Array


def qmul(a: Array, b: Array) -> Array:
    """Hamilton product (4,) of quaternions (4,), scalar first."""
    aw, ax, ay, az = a.tolist()
    bw, bx, by, bz = b.tolist()
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def qinv_mul(a: Array, b: Array) -> Array:
    """conj(a) (x) b, (4,): the attitude ``b`` seen from ``a``, both unit."""
    aw, ax, ay, az = a.tolist()
    bw, bx, by, bz = b.tolist()
    return np.array(
        [
            aw * bw + ax * bx + ay * by + az * bz,
            aw * bx - ax * bw - ay * bz + az * by,
            aw * by + ax * bz - ay * bw - az * bx,
            aw * bz - ax * by + ay * bx - az * bw,
        ]
    )


def qnormalize(q: Array) -> Array:
    """Unit quaternion (4,) along ``q``; the caller guarantees that it is not zero."""
    return q / math.sqrt(float(q @ q))


def qexp(phi: Array) -> Array:
    """Rotation vector (3,), rad, to unit quaternion (4,)."""
    x, y, z = phi.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    s = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(half) / angle
    return np.array([math.cos(half), s * x, s * y, s * z])


def qlog(q: Array) -> Array:
    """Unit quaternion (4,) to the shortest rotation vector (3,), rad."""
    w, x, y, z = q.tolist()
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    n = math.sqrt(x * x + y * y + z * z)
    s = 2.0 / w if n < 1e-9 else 2.0 * math.atan2(n, w) / n
    return np.array([s * x, s * y, s * z])


def qmatrix(q: Array) -> Array:
    """Rotation matrix (3, 3), body to world, of a unit quaternion (4,)."""
    w, x, y, z = q.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def skew(v: Array) -> Array:
    """Matrix (3, 3) with ``skew(v) @ w == cross(v, w)``."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def right_jacobian(phi: Array) -> Array:
    """Right Jacobian of SO(3) (3, 3): exp(phi + d) = exp(phi) exp(Jr(phi) d) to first order.

    Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, eq. 183.
    """
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
