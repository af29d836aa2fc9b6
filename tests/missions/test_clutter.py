# SPDX-License-Identifier: Apache-2.0
"""Many chasers exchange places at random in clutter: all arrive, and none comes nearer than the
limits allow.
"""

from __future__ import annotations

import numpy as np
import pytest
from flights.transfers import CLUTTER, DENSE_CLUTTER, clutter, fly_transfer


@pytest.mark.parametrize("places_m", [CLUTTER, DENSE_CLUTTER])
def test_random_places_keep_the_distances_of_the_limits(
    places_m: tuple[float, float, float],
) -> None:
    scenario = clutter(7, places_m=places_m)
    for places in (
        np.array([c.position_m for c in scenario.chasers]),
        np.array([entry.offset_m for entry in scenario.timeline]),
    ):
        assert len(places) == 16
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + np.eye(16)
        assert apart.min() >= places_m[2] > scenario.limits.min_distance_chasers_m
        away = np.linalg.norm(places, axis=1)
        assert places_m[0] <= away.min()
        assert away.max() <= places_m[1]


@pytest.mark.slow
def test_sixteen_chasers_arrive_in_dense_clutter() -> None:
    scenario = clutter(0, places_m=DENSE_CLUTTER)
    out = fly_transfer(0, scenario, None, stay_s=3.0)
    assert out.missed == out.failed == out.contacts == 0
    assert out.reached_s < 90.0
    limits = scenario.limits
    assert out.to_target_m >= limits.min_distance_target_m
    assert out.between_m >= limits.min_distance_chasers_m
