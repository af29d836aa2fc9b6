"""A budget in seconds, for real time: how many iterations fit into it, by what the solves before took.

A solve is bounded in iterations and never looks at a clock, so that it is one calculation whose result depends on its
inputs and that number alone. In lock-step the number is the scenario's, and a flight is the same anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

_FORGETS = 0.05
_FIRST_GUESS_S = 1e-4


class Bounded(Protocol):
    """A solver whose iterations can be bounded anew before each solve."""

    max_iterations: int | None


@dataclass
class SolveBudget:
    """Learns what a solve takes: seconds without an iteration, and seconds an iteration.

    Both follow what is slower at once, and what is faster by a twentieth a solve: one that was disturbed counts for a
    while. ``most``: never more iterations than this. Raises ValueError for a budget that is not positive.
    """

    budget_s: float
    most: int | None = None
    base_s: float = 0.0
    iteration_s: float = _FIRST_GUESS_S

    def __post_init__(self) -> None:
        if not self.budget_s > 0.0:
            raise ValueError(f"budget_s must be positive, not {self.budget_s!r}")

    def iterations(self) -> int:
        """How many the next solve may take; 0 leaves the shifted plan or what needs no iteration."""
        fit = max(0, int((self.budget_s - self.base_s) / self.iteration_s))
        return fit if self.most is None else min(fit, self.most)

    def note(self, took_s: float, iterations: int) -> None:
        """A solve took ``took_s`` of wall time and so many iterations of all chasers together."""
        if iterations == 0:
            self.base_s = _followed(self.base_s, took_s)
        else:
            self.iteration_s = _followed(self.iteration_s, max(1e-6, (took_s - self.base_s) / iterations))


def _followed(kept: float, now: float) -> float:
    return now if now > kept else kept + _FORGETS * (now - kept)
