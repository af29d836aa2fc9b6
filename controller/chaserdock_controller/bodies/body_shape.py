# SPDX-License-Identifier: Apache-2.0
"""Shape of a rigid body, all that its free rotation depends on: the inertia up to a factor and the
centre of mass, eight numbers.

The error of the inertia over its trace is a symmetric matrix without trace, hence five coordinates.
In these the angular acceleration is nearly linear and an uncertain inertia is nearly Gaussian.
Neither holds in logarithms of the second moments.

A rigid body with inertia I exists if and only if its second moments 1/2 trace(I) 1 - I are positive
(Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
identification", 2018). This set is convex. An estimate outside it is replaced by the nearest one
inside, which is closer to every possible inertia.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array

SHAPE = 8
"""Components of the error of a shape: inertia over trace in ``RATIO_BASIS``, then the centre of
mass, m (TRF).
"""
RATIOS, CENTRE_OF_MASS = slice(0, 5), slice(5, 8)
INERTIA_ROWS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Order of the elements of an inertia in covariances."""
_LEAST_MOMENT = 1e-4
"""Least second moment along an axis over the trace of the inertia: almost that of a disc."""


def _basis() -> Array:
    basis = np.zeros((5, 3, 3))
    basis[0] = np.diag([1.0, -1.0, 0.0]) / math.sqrt(2.0)
    basis[1] = np.diag([1.0, 1.0, -2.0]) / math.sqrt(6.0)
    for k, (i, j) in enumerate(INERTIA_ROWS[3:]):
        basis[2 + k, i, j] = basis[2 + k, j, i] = 1.0 / math.sqrt(2.0)
    return basis


RATIO_BASIS = _basis()
"""Orthonormal basis (5, 3, 3) of the symmetric matrices without trace."""


@dataclass(frozen=True, eq=False)
class BodyShape:
    """Inertia up to a factor and centre of mass of a rigid body.

    ``inertia`` (3, 3): about the centre of mass, TRF axes, with trace 1. ``centre_m`` (3,): centre
    of mass, TRF.
    """

    inertia: Array
    centre_m: Array

    def corrected(self, error: Array) -> BodyShape:
        """Return the shape that differs by an error (8,); if no rigid body has it, the nearest
        possible one.
        """
        inertia = _physical(self.inertia + np.tensordot(error[RATIOS], RATIO_BASIS, 1))
        return BodyShape(inertia, self.centre_m + error[CENTRE_OF_MASS])

    def error_of(self, other: BodyShape) -> Array:
        """Return the error (8,) by which ``corrected`` gives ``other``."""
        ratios = np.tensordot(RATIO_BASIS, other.inertia - self.inertia, 2)
        return np.concatenate([ratios, other.centre_m - self.centre_m])


def shape_of(inertia: Array, centre_m: Array) -> BodyShape:
    """Return the shape of a body with this inertia (3, 3), in any unit, about its centre of mass
    (3,), TRF.
    """
    return BodyShape(inertia / np.trace(inertia), np.array(centre_m, dtype=float))


def shape_covariance(inertia: Array, covariance: Array) -> Array:
    """Return the covariance (8, 8) of the error of ``shape_of`` of a body.

    ``covariance`` (9, 9): of its centre of mass (m) and its inertia (elements in the order of
    ``INERTIA_ROWS``; unit of ``inertia``).
    """
    trace = float(np.trace(inertia))
    jacobian = np.zeros((SHAPE, 9))
    jacobian[CENTRE_OF_MASS, :3] = np.eye(3)
    for k, (i, j) in enumerate(INERTIA_ROWS):
        change = np.zeros((3, 3))
        change[i, j] = change[j, i] = 1.0
        ratios = (change - inertia * (np.trace(change) / trace)) / trace
        jacobian[RATIOS, 3 + k] = np.tensordot(RATIO_BASIS, ratios, 2)
    return jacobian @ covariance @ jacobian.T


def mass_covariance(covariance: Array, trace: float) -> Array:
    """Return the covariance (9, 9) of centre of mass and inertia, as in ``shape_covariance``.

    ``covariance`` (8, 8): of the error of the shape. ``trace``: of the inertia, kg m².
    """
    jacobian = np.zeros((9, SHAPE))
    jacobian[:3, CENTRE_OF_MASS] = np.eye(3)
    jacobian[3:, RATIOS] = trace * np.stack([RATIO_BASIS[:, i, j] for i, j in INERTIA_ROWS])
    return jacobian @ covariance @ jacobian.T


def _physical(inertia: Array) -> Array:
    """Return the nearest inertia (3, 3) with trace 1 whose second moments are not less than
    ``_LEAST_MOMENT``.

    The moments are projected onto their simplex (Duchi et al., "Efficient projections onto the
    l1-ball", 2008).
    """
    values, axes = np.linalg.eigh(inertia)
    moments = 0.5 - values - _LEAST_MOMENT  # descending, sum 1/2 - 3 _LEAST_MOMENT
    if moments[2] >= 0.0:
        return inertia
    excess = (np.cumsum(moments) - (0.5 - 3.0 * _LEAST_MOMENT)) / np.arange(1, 4)
    kept = np.maximum(moments - excess[np.flatnonzero(moments > excess)[-1]], 0.0)
    return (axes * (0.5 - _LEAST_MOMENT - kept)) @ axes.T
