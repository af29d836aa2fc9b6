# SPDX-License-Identifier: Apache-2.0
"""Draw random numbers that depend on the scenario's seed and a key only, not on the order of
drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from chaserdock_models import random_numbers
from chaserdock_models.arrays import Array


class Stream(IntEnum):
    """Separate the random streams from each other and from that of the image noise."""

    CALIBRATION = 101
    BIAS = 102
    NOISE = 103
    DRIFT = 104
    PLANT = 105
    INERTIA = 106
    THRUST = 107
    DISTURBANCE = 108
    DELAY = 109
    SCATTER = 110
    UNKNOWN_CALIBRATION = 111
    MARKERS = 112
    MESH = 113


TARGET_KEY = 10_000
"""Key of the target where others have the number of a chaser."""


def generator(seed: int, stream: Stream, *key: int) -> np.random.Generator:
    """Return the generator of a key."""
    return random_numbers.generator((seed, int(stream), *key))


class GaussMarkov:
    """Stationary Gauss-Markov processes of unit variance, one per time constant, sampled every
    ``period_s``.

    x(k+1) = exp(-dt/T) x(k) + sqrt(1 - exp(-2 dt/T)) n is the exact discretization.
    """

    def __init__(
        self, seed: int, stream: Stream, key: int, times_s: Sequence[float], period_s: float
    ) -> None:
        self._seed, self._stream, self._key = seed, stream, key
        decay = period_s / np.asarray(times_s, dtype=float)
        self._kept, self._new = np.exp(-decay), np.sqrt(-np.expm1(-2.0 * decay))
        self._tick, self._value = 0, self._drawn(0)

    def _drawn(self, tick: int) -> Array:
        return generator(self._seed, self._stream, self._key, tick).standard_normal(len(self._kept))

    def at(self, tick: int) -> Array:
        """Return the values (n,) at a tick.

        Cheap for the next tick, otherwise computed from the first.
        """
        if tick < self._tick:
            self._tick, self._value = 0, self._drawn(0)
        while self._tick < tick:
            self._tick += 1
            self._value = self._kept * self._value + self._new * self._drawn(self._tick)
        return self._value
