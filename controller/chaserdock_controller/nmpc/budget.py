# SPDX-License-Identifier: Apache-2.0
"""Converts a real-time budget in seconds into an iteration limit, by the measured durations of
solves.

A solve is limited by iterations and never reads a clock. Its result therefore depends on its inputs
and that limit only. In lock-step the limit comes from the scenario, which makes flights
reproducible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

_DECAY = 0.05
"""Share of the difference by which a faster solve lowers the estimate. A disturbed solve thus
counts for 20 ticks, 1.3 s at 15 Hz.
"""
_INITIAL_ITERATION_S = 1e-4
"""Assumed time of an iteration before one is measured, s: 2.6 times that on one core of 2024 (38
us), so that the first solve keeps its budget.
"""


class Bounded(Protocol):
    """A solver whose iteration limit can be set before each solve."""

    max_iterations: int | None


@dataclass
class SolveBudget:
    """Tracks the duration of a solve as seconds without iterations plus seconds per iteration.

    Both follow an increase immediately and a decrease by `_DECAY` of it per solve, so that a
    disturbed solve counts for a while. ``most``: upper bound of the limit. Raises ValueError for a
    budget that is not positive.
    """

    budget_s: float
    most: int | None = None
    base_s: float = 0.0
    iteration_s: float = _INITIAL_ITERATION_S

    def __post_init__(self) -> None:
        if not self.budget_s > 0.0:
            raise ValueError(f"budget_s must be positive, not {self.budget_s!r}")

    def iterations(self) -> int:
        """Return the iteration limit of the next solve. With 0 the plan is the shifted one, or a
        solution that needs no iterations.
        """
        fit = max(0, int((self.budget_s - self.base_s) / self.iteration_s))
        return fit if self.most is None else min(fit, self.most)

    def note(self, took_s: float, iterations: int) -> None:
        """Record a solve: wall time and total iterations of all chasers."""
        if iterations == 0:
            self.base_s = _update_peak(self.base_s, took_s)
        else:
            self.iteration_s = _update_peak(
                self.iteration_s, max(1e-6, (took_s - self.base_s) / iterations)
            )


def _update_peak(kept: float, now: float) -> float:
    return now if now > kept else kept + _DECAY * (now - kept)
