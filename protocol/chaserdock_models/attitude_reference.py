# SPDX-License-Identifier: Apache-2.0
"""Compute reference attitudes that keep a chaser facing the target at any offset from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .plane import flattened
from .rotations import multiply, normalize


def facing_attitudes(
    nominal_m: ArrayLike,
    q_nominal_wxyz: ArrayLike,
    offsets_m: ArrayLike,
    up: Array | None = None,
) -> Array:
    """Return the attitudes (K, 4), chaser body to TRF, at offsets (K, 3) in TRF.

    The nominal attitude (4,) belongs to the nominal offset (3,). It is rotated by the shortest
    rotation from the nominal direction a to the direction b of the offset, q = normalize([1 + a .
    b, a x b]). For an offset opposite to the nominal one the axis is not unique: the axis
    perpendicular to a that is closest to z (to x if a is along z) is used. At the target's centre
    the attitude is the nominal one. With ``up`` (3,), TRF, a chaser turns about this axis only:
    towards directions in the plane across it.
    """
    offsets = np.atleast_2d(np.asarray(offsets_m, dtype=float))
    nominal = np.asarray(nominal_m, dtype=float)
    if up is not None:
        offsets, nominal = flattened(offsets, up), flattened(nominal, up)
    a = nominal / np.linalg.norm(nominal)
    length = np.sqrt(np.add.reduce(offsets * offsets, axis=1, keepdims=True))
    b = np.where(length > 1e-9, offsets / np.maximum(length, 1e-9), a)
    turn = np.empty((len(b), 4))
    turn[:, 0] = 1.0 + b @ a
    for k in range(3):  # a x b, without the checks of np.cross
        i, j = (k + 1) % 3, (k + 2) % 3
        turn[:, k + 1] = a[i] * b[:, j] - a[j] * b[:, i]
    turned = np.sqrt(np.add.reduce(turn * turn, axis=1, keepdims=True))
    if turned.min() >= 1e-6:
        return multiply(normalize(turn), np.asarray(q_nominal_wxyz, dtype=float))
    axis = np.eye(3)[2 if abs(a[2]) < 0.9 else 0] if up is None else up
    axis = axis - (axis @ a) * a
    half_turn = np.concatenate([[0.0], axis / np.linalg.norm(axis)])
    turn = np.where(turned < 1e-6, half_turn, turn)
    return multiply(normalize(turn), np.asarray(q_nominal_wxyz, dtype=float))
