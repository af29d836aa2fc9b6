# SPDX-License-Identifier: Apache-2.0
"""Covariance of a target and of chasers that are independent of each other given the target. Pure
functions; ``covariance`` says where it is used and what it neglects.

H: number of components of the target's error, with its shape if it has one. A pair is the error of
the target (12), of one chaser (CHASER) and of the shape: the layout of the kernels for one chaser.
"""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from msgspec import Struct

from .kernels import CHASER, TARGET

PAIR = TARGET + CHASER
_LEAST_SHARE = 1e-12
"""Least eigenvalue of a correlation matrix that counts as above zero: rounding is smaller."""


class ChasersGivenTarget(Struct, frozen=True, eq=False):
    """Errors of the chasers by that of the target (and its shape), of H components; what this
    leaves is independent of all else.

    gains (N, CHASER, H): error by the target's. covariances (N, CHASER, CHASER): of the rest.
    """

    gains: Array
    covariances: Array

    def of(self, chaser: int) -> tuple[Array, Array]:
        """Return gain and covariance of a chaser."""
        return self.gains[chaser], self.covariances[chaser]

    @classmethod
    def of_covariances(cls, hub: Array, cross: Array, own: Array) -> ChasersGivenTarget:
        """Return the same from covariances: of the target ``hub`` (H, H), of each chaser with it
        (N, CHASER, H), and of each chaser (N, CHASER, CHASER).
        """
        gains = regression(hub, cross)
        rest = own - gains @ cross.transpose(0, 2, 1)
        return cls(gains, 0.5 * (rest + rest.transpose(0, 2, 1)))

    def covariances_by(self, hub: Array) -> tuple[Array, Array]:
        """Return ``cross`` and ``own`` of ``of_covariances``, both new."""
        cross = self.gains @ hub
        return cross, self.covariances + cross @ self.gains.transpose(0, 2, 1)

    def after(self, before: Array, f: Array, noise: Array, hub: Array) -> ChasersGivenTarget:
        """Return the same for the target's error after a step, while the chasers' own stay.

        The step changes its covariance from ``before`` to ``hub`` = F ``before`` F' + ``noise``.
        The error before it follows from that after it by a gain B but for a rest r, whose
        covariance is in Joseph's form. Gain by r makes the N chasers dependent: A r, with A the
        gains of all. As (A r) (A r)' is at most N times its diagonal blocks, chasers with N times
        the covariance of their part, and independent, have a covariance that is not smaller.
        """
        back = regression(hub, before @ f.T)
        kept = np.eye(len(before)) - back @ f
        lost = len(self.gains) * (kept @ before @ kept.T + back @ noise @ back.T)
        rest = self.covariances + self.gains @ lost @ self.gains.transpose(0, 2, 1)
        return ChasersGivenTarget(self.gains @ back, rest)


def pair(hub: Array, gain: Array, rest: Array) -> Array:
    """Return the covariance of a pair from that of the target, ``hub`` (H, H), the gain (CHASER, H)
    of the chaser by it, and the covariance ``rest`` (CHASER, CHASER) of what this leaves.
    """
    cross = gain @ hub
    return assembled(hub, cross, rest + cross @ gain.T)


def split(covariance: Array) -> tuple[Array, Array, Array]:
    """Return ``hub``, ``gain`` and ``rest`` of the covariance of a pair; see ``pair``."""
    hub, cross, own = taken_apart(covariance)
    gain = regression(hub, cross)
    rest = own - gain @ cross.T
    return hub, gain, 0.5 * (rest + rest.T)


def assembled(hub: Array, cross: Array, own: Array) -> Array:
    """Return the matrix of a pair, symmetric, from its blocks: target and shape (H, H), chaser by
    these (CHASER, H), and chaser (CHASER, CHASER).
    """
    size = CHASER + len(hub)
    out = np.empty((size, size))
    out[:TARGET, :TARGET], out[TARGET:PAIR, TARGET:PAIR] = hub[:TARGET, :TARGET], own
    out[TARGET:PAIR, :TARGET] = cross[:, :TARGET]
    out[:TARGET, TARGET:PAIR] = cross[:, :TARGET].T
    if size > PAIR:
        out[:TARGET, PAIR:], out[PAIR:, :TARGET] = hub[:TARGET, TARGET:], hub[TARGET:, :TARGET]
        out[PAIR:, PAIR:] = hub[TARGET:, TARGET:]
        out[TARGET:PAIR, PAIR:] = cross[:, TARGET:]
        out[PAIR:, TARGET:PAIR] = cross[:, TARGET:].T
    return out


def taken_apart(matrix: Array) -> tuple[Array, Array, Array]:
    """Return the blocks of ``assembled``."""
    own = matrix[TARGET:PAIR, TARGET:PAIR]
    if len(matrix) == PAIR:
        return matrix[:TARGET, :TARGET], matrix[TARGET:PAIR, :TARGET], own
    rows = np.r_[:TARGET, PAIR : len(matrix)]
    return matrix[rows[:, None], rows], matrix[TARGET:PAIR, rows], own


def regression(hub: Array, cross: Array) -> Array:
    """Return the gain of errors with the covariance ``cross`` (..., H) with the target's.

    What the target's covariance ``hub`` states as exactly known has no influence.
    """
    sigmas = np.sqrt(hub.diagonal())
    per_sigma = np.divide(1.0, sigmas, out=np.zeros_like(sigmas), where=sigmas > 0.0)
    scaled = hub * per_sigma * per_sigma[:, None]
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:  # singular, as without a known target
        factor = np.zeros((1, 1))
    if factor.diagonal().min() ** 2 > _LEAST_SHARE:
        factor = np.linalg.inv(factor)
        inverse = factor.T @ factor
    else:
        inverse = np.linalg.pinv(scaled, rcond=_LEAST_SHARE, hermitian=True)
    return (cross * per_sigma) @ inverse * per_sigma
