# SPDX-License-Identifier: Apache-2.0
"""Random generators: the numbers are those of NumPy's own seeding."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models.random_numbers import generator


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 11])
def test_seeds_of_any_length_give_the_numbers_of_numpy(count: int) -> None:
    draw = np.random.default_rng(count)
    for _ in range(200):
        words = draw.integers(0, 2 ** int(draw.integers(1, 33)), count).tolist()
        expected = np.random.default_rng(words)
        found = generator(words)
        assert found.bit_generator.state == expected.bit_generator.state
        assert found.standard_normal(12).tobytes() == expected.standard_normal(12).tobytes()


@pytest.mark.parametrize("words", [(0,), (2**32 - 1, 0, 7), (2**32, 3), (2**64 + 5, 1, 2)])
def test_limits_of_a_word(words: tuple[int, ...]) -> None:
    assert generator(words).random() == np.random.default_rng(words).random()


def test_a_negative_number_is_refused_as_by_numpy() -> None:
    with pytest.raises(ValueError, match="non-negative"):
        generator((3, -1))
