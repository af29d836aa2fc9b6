# SPDX-License-Identifier: Apache-2.0
"""Checks that sightings are poses with covariances, so that no damaged one reaches an estimator."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
from chaserdock_protocol.messages import Level, PoseSolution, Sighting

from .odometry_validation import UNIT_WITHIN

_ROUNDING = 1e-6
"""Asymmetry of a covariance, as a share of its largest element, that passes as rounding: perception
may compute in single precision.
"""


def why_invalid(solution: PoseSolution) -> str:
    """Return why a solution is not a pose with a positive definite covariance; empty if it is."""
    length = math.hypot(*solution.q_wxyz)
    if not abs(length - 1.0) <= UNIT_WITHIN:
        return f"q_wxyz has length {length:.3g}, not 1"
    covariance = np.array(solution.covariance).reshape(6, 6)
    if np.abs(covariance - covariance.T).max() > _ROUNDING * np.abs(covariance).max():
        return "covariance is not symmetric"
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return "covariance is not positive definite"
    return ""


def _are_valid(solutions: Sequence[PoseSolution]) -> bool:
    """Return whether ``why_invalid`` would pass all solutions, without a call for each."""
    if not all(abs(math.hypot(*s.q_wxyz) - 1.0) <= UNIT_WITHIN for s in solutions):
        return False
    covariances = np.array([s.covariance for s in solutions]).reshape(-1, 6, 6)
    transposed = covariances.transpose(0, 2, 1)
    if not (covariances == transposed).all():  # most are symmetric to the last bit
        largest = np.abs(covariances).max(axis=(1, 2))
        differences = np.abs(covariances - transposed).max(axis=(1, 2))
        if not (differences <= _ROUNDING * largest).all():
            return False
    try:
        np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        return False
    return True


def valid_sightings(
    sightings: Iterable[Sighting],
) -> tuple[tuple[Sighting, ...], list[tuple[Level, str]]]:
    """Return the sightings with their valid solutions, and an event for each sighting that has lost
    one.
    """
    valid: list[Sighting] = []
    events: list[tuple[Level, str]] = []
    sightings = tuple(sightings)
    if _are_valid([s for sighting in sightings for s in sighting.solutions]):
        return sightings, events
    for sighting in sightings:
        reasons = {id(s): reason for s in sighting.solutions if (reason := why_invalid(s))}
        if reasons:
            events.append(
                (
                    "warning",
                    f"chaser {sighting.chaser}: invalid sighting, ignored: "
                    f"{next(iter(reasons.values()))}",
                )
            )
            kept = tuple(s for s in sighting.solutions if id(s) not in reasons)
            sighting = msgspec.structs.replace(sighting, solutions=kept)
        valid.append(sighting)
    return tuple(valid), events
