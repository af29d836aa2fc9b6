# SPDX-License-Identifier: Apache-2.0
"""Detection of stuck thrusters of latched chasers in the motion of the whole stack. No I/O.

Generalized likelihood ratio test on the innovations of the identification filter (A. S. Willsky and
H. L. Jones, IEEE Trans. Automatic Control 21, 1976). For every thruster and kind of failure, the
signature of the failure in the filter's state is propagated and the log-likelihood ratio to the
fault-free hypothesis is summed. A sum that falls below zero restarts, as in a CUSUM test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from chaserdock_models.arrays import Array, BoolArray, IntArray

from .composite import RATE, VELOCITY, StackInnovation, StackPrediction

_LEAST_GAIN = 25.0
"""Least log-likelihood ratio to the fault-free hypothesis."""
_LEAST_MARGIN = 6.0
"""Least difference to the best hypothesis about another thruster."""


@dataclass(frozen=True)
class StackFault:
    """A failed thruster of a latched chaser. ``ticks``: number of ticks since the likeliest begin
    of the failure.
    """

    chaser: int
    thruster: int
    kind: Literal["stuck_off", "stuck_on"]
    ticks: int


@dataclass(frozen=True, eq=False)
class DetectorState:
    """State of the tests: signatures (size, 2 u), log-likelihood ratios (2 u,) and numbers of ticks
    (2 u,) over which they were summed.
    """

    signatures: Array
    gains: Array
    ticks: IntArray


class StackFaultDetector:
    """Tests all thrusters that may fire, each for being stuck off and stuck on.

    Signatures (size, 2 u) and log-likelihood ratios (2 u,): first those of stuck off, then those of
    stuck on.
    """

    def __init__(self, thrusters: Sequence[tuple[int, int]], size: int, full_N: Array) -> None:
        self._thrusters, self._full_N = tuple(thrusters), full_N
        self._signatures = np.zeros((size, 2 * len(self._thrusters)))
        self.gains = np.zeros(2 * len(self._thrusters))
        self._ticks = np.zeros(2 * len(self._thrusters), dtype=np.int64)

    def reset(self) -> None:
        """Restart all tests."""
        self._signatures[:], self.gains[:], self._ticks[:] = 0.0, 0.0, 0

    def save(self) -> DetectorState:
        """Return a copy of the state."""
        return DetectorState(self._signatures.copy(), self.gains.copy(), self._ticks.copy())

    def load(self, state: DetectorState) -> None:
        """Replace the state by a saved one. Raises ValueError if that belongs to other
        thrusters.
        """
        if state.signatures.shape != self._signatures.shape or not (
            len(state.gains) == len(state.ticks) == len(self.gains)
        ):
            raise ValueError("the state is of other thrusters")
        self._signatures, self.gains = state.signatures.copy(), state.gains.copy()
        self._ticks = state.ticks.copy()

    def predict(self, prediction: StackPrediction) -> None:
        """Propagate the signatures over a tick."""
        count = len(self._thrusters)
        self._signatures = prediction.transition @ self._signatures
        missing = -prediction.pushed * prediction.impulses_N_s
        full = self._full_N * prediction.step_s
        beyond = prediction.pushed * np.maximum(full - prediction.impulses_N_s, 0.0)
        for part, rows in ((VELOCITY, slice(0, 3)), (RATE, slice(3, 6))):
            self._signatures[part, :count] += missing[rows]
            self._signatures[part, count:] += beyond[rows]
        self._ticks = np.where(self._signatures.any(axis=0), self._ticks + 1, 0)

    def update(self, innovation: StackInnovation, suspects: BoolArray) -> StackFault | None:
        """Add a tick's innovation to the tests. Returns a failure that they prove, or None.
        ``suspects`` (u,): thrusters that are tested.
        """
        shift = innovation.matrix @ self._signatures
        weighted = np.linalg.solve(innovation.covariance, shift)
        self.gains += innovation.residual @ weighted - 0.5 * np.sum(shift * weighted, axis=0)
        self._signatures = self._signatures - innovation.gain @ shift
        again = (self.gains < 0.0) | np.tile(~suspects, 2)
        self.gains[again], self._signatures[:, again], self._ticks[again] = 0.0, 0.0, 0
        best = int(np.argmax(self.gains))
        count = len(self._thrusters)
        other = np.delete(self.gains, [best % count, best % count + count])
        if (
            self.gains[best] < _LEAST_GAIN
            or self.gains[best] - other.max(initial=0.0) < _LEAST_MARGIN
        ):
            return None
        chaser, thruster = self._thrusters[best % count]
        kind, ticks = "stuck_off" if best < count else "stuck_on", int(self._ticks[best])
        self.reset()
        return StackFault(chaser, thruster, kind, ticks)
