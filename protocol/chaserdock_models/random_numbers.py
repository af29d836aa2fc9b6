# SPDX-License-Identifier: Apache-2.0
"""NumPy's random generators of many short sequences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def generator(words: Sequence[int]) -> np.random.Generator:
    """Return the generator that ``numpy.random.default_rng(words)`` returns, for numbers below 2^32
    in half its time.
    """
    small = (
        len(words) > 0 and min(words) >= 0 and max(words) < 2**32
    )  # each is one word of the seed
    sequence = np.random.SeedSequence(np.array(words, dtype=np.uint32) if small else words)
    return np.random.Generator(np.random.PCG64(sequence))
