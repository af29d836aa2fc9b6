# SPDX-License-Identifier: Apache-2.0
"""What the mean of a quantity over a flight should be, in one flight and over many."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

ENSEMBLE_SIGMAS = 4.0
"""Standard errors by which the mean over many flights may miss its bounds: chance alone exceeds
them in one ensemble of 30,000. Larger: accuracy may be lost unnoticed; smaller: sound sources fail.
"""
LEAST_FLIGHTS, LEAST_SAMPLES = 20, 5
"""Least number of flights whose mean is judged, and of values, one a second, in such a flight."""


@dataclass(frozen=True)
class Expectation:
    """Mean of a quantity over a flight: between ``least`` and ``most`` on average over flights,
    with a standard deviation ``spread`` between flights, and at most ``flight_most`` in any.
    ``invariant``: name of the check to which it belongs.
    """

    invariant: str
    name: str
    least: float
    most: float
    spread: float
    flight_most: float

    def defect_of(self, values: Sequence[float]) -> str | None:
        """Return why the values of one flight are not as expected; None if they are or are few."""
        if len(values) < LEAST_SAMPLES or (mean := sum(values) / len(values)) <= self.flight_most:
            return None
        return f"mean {self.name} {mean:.1f} in one flight, at most {self.flight_most:g}"

    def defect_over(self, means: Sequence[float]) -> str | None:
        """Return why the means of many flights are not as expected; None if they are or are few."""
        if len(means) < LEAST_FLIGHTS:
            return None
        mean, error = sum(means) / len(means), ENSEMBLE_SIGMAS * self.spread / math.sqrt(len(means))
        if self.least - error <= mean <= self.most + error:
            return None
        return (
            f"mean {self.name} {mean:.2f} over {len(means)} flights, allowed "
            f"{max(0.0, self.least - error):.2f} to {self.most + error:.2f}"
        )
