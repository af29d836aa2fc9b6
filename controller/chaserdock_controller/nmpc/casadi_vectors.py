# SPDX-License-Identifier: Apache-2.0
"""Vectors and rotations in CasADi."""

from __future__ import annotations

from typing import Any

import casadi as ca
from chaserdock_models.scalar_rotations import product_components, rotated_components

_SMOOTHING_M2 = 1e-12
"""Keeps the gradient of a length finite at zero; it changes 0.35 m by 1e-12 m."""


def multiply(a: Any, b: Any) -> Any:
    """Return the Hamilton product of CasADi quaternions (4)."""
    return ca.vertcat(*product_components(*ca.vertsplit(a), *ca.vertsplit(b)))


def conjugate(q: Any) -> Any:
    """Return the conjugate of a CasADi quaternion (4)."""
    return ca.vertcat(q[0], -q[1:4])


def rotate(q: Any, v: Any) -> Any:
    """Return the body vector ``v`` (3) in world axes; ``q`` (4) body to world."""
    return ca.vertcat(*rotated_components(*ca.vertsplit(q), *ca.vertsplit(v)))


def norm(a: Any) -> Any:
    """Return the length of a CasADi vector, m, smoothed at zero."""
    return ca.sqrt(ca.sumsqr(a) + _SMOOTHING_M2)
