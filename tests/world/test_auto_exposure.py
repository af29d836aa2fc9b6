# SPDX-License-Identifier: Apache-2.0
"""Auto-exposure: the brightest hundredth of an image reaches the stated grey level, within bounds;
off by default.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.effects import CameraEffects, exposure_gain


def scene(level: int, share: float) -> np.ndarray:
    image = np.full((100, 100), 4, np.uint8)
    image.reshape(-1)[: round(share * image.size)] = level
    return image


def test_bright_part_reaches_the_level() -> None:
    effects = Effects(auto_exposure=180.0, read_noise=0.0, shot_noise=0.0, gain=3.0)
    for level in (40, 90, 250):
        image = CameraEffects(100, 100, effects, 1).apply(scene(level, 0.3), 0, 0)
        assert abs(int(image.max()) - 180) <= 1


@pytest.mark.parametrize(
    ("level", "share", "gain"),
    [(90, 0.3, 2.0), (90, 0.011, 2.0), (90, 0.009, 8.0), (2, 0.3, 8.0), (0, 1.0, 8.0)],
)
def test_gain_follows_the_brightest_hundredth_within_bounds(
    level: int, share: float, gain: float
) -> None:
    assert exposure_gain(scene(level, share), 180.0) == pytest.approx(gain)


def test_it_is_off_by_default() -> None:
    image = scene(40, 0.3)
    effects = Effects(read_noise=0.0, shot_noise=0.0)
    np.testing.assert_array_equal(CameraEffects(100, 100, effects, 1).apply(image, 0, 0), image)
