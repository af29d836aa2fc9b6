# SPDX-License-Identifier: Apache-2.0
"""Motion on a floor: bodies slide along x and y of WRF and turn about z, which points up. Pure
functions; SI units.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array

AXES = (0, 1, 5)
"""Components of a wrench in body axes that move a level body: force along x and y, torque about
z.
"""
UP: Array = np.array([0.0, 0.0, 1.0])
"""Up in WRF, and of a chaser's body (CRF)."""


def flattened(vectors: ArrayLike, up: Array, height: float = 0.0) -> Array:
    """Return vectors (..., 3) with ``height`` as their component along the unit vector ``up``
    (3,).
    """
    v = np.asarray(vectors, dtype=float)
    return v + (height - v @ up)[..., None] * up


def across(up: Array) -> Array:
    """Return two unit vectors (2, 3) perpendicular to the unit vector ``up`` (3,) and to each
    other.
    """
    first = rotations.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first = first / np.linalg.norm(first)
    return np.array([first, rotations.cross(up, first)])


def levelled(q_wxyz: Array, up: Array) -> Array:
    """Return the attitude (4,), body to WRF, nearest to ``q_wxyz`` at which ``up`` (3,), body axes,
    is vertical.
    """
    leaning = rotations.rotate(q_wxyz, up)
    # The shortest rotation from a to b: [1 + a . b, a x b], normalized.
    upright = np.concatenate([[1.0 + leaning[2]], rotations.cross(leaning, UP)])
    return rotations.normalize(rotations.multiply(rotations.normalize(upright), q_wxyz))


def lean_rad(q_wxyz: ArrayLike, up: ArrayLike) -> float:
    """Return the angle (rad) between ``up`` (3,), body axes, and the vertical."""
    x, y, z = rotations.rotate(q_wxyz, up).tolist()
    return float(np.arctan2(np.hypot(x, y), z))
