# SPDX-License-Identifier: Apache-2.0
"""Seeded variations of ``collision-avoidance`` and ``swap``, and the figures of a flight."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_models import rotations
from flights.measured_poses import measurement_model
from flights.transfers import SYMMETRIC_EVERY, avoidance, fly_transfer, swap


@pytest.mark.parametrize("seed", range(20))
def test_every_fourth_variation_is_symmetric_and_starts_are_safe(seed: int) -> None:
    scenario = avoidance(seed)
    own, watcher = scenario.chasers
    goal = np.array(scenario.timeline[0].offset_m)
    symmetric = seed % SYMMETRIC_EVERY == 0
    exact = bool((goal == -np.array(own.position_m)).all()) and not any(
        (*own.start_offset_m, *own.start_rotation_rad)
    )
    assert exact == symmetric
    assert (scenario.target.q_wxyz != (1.0, 0.0, 0.0, 0.0)) == (seed > 11 or not symmetric)
    for i in range(2):
        ahead = rotations.rotate(scenario.chasers[i].q_wxyz, [1.0, 0.0, 0.0])
        place = np.array(scenario.chasers[i].position_m)
        assert ahead @ place == pytest.approx(-np.linalg.norm(place))
        position, _ = scenario.start_pose(i)
        assert np.linalg.norm(position) > scenario.limits.min_distance_target_m
    assert (
        np.linalg.norm(np.array(watcher.position_m) - goal) > scenario.limits.min_distance_chasers_m
    )
    assert avoidance(seed) == scenario


def test_swaps_differ_by_seed_and_seed_zero_is_exactly_head_on() -> None:
    assert all(c.start_offset_m == (0.0, 0.0, 0.0) for c in swap(0).chasers)
    assert swap(1) == swap(1)
    assert swap(1).chasers != swap(2).chasers
    assert math.hypot(*swap(3).target.omega_rad_s) == pytest.approx(
        math.hypot(*swap(0).target.omega_rad_s)
    )


@pytest.mark.parametrize(("within_m", "reached"), [(0.02, True), (1e-6, False)])
def test_figures_of_a_short_transfer(within_m: float, reached: bool) -> None:
    """A transfer of 5 cm: least distances as in the scenario, reached at the end; an unmet
    tolerance is not reached.
    """
    scenario = avoidance(0)
    (entry,) = scenario.timeline
    entry = entry.model_copy(update={"at_s": 1.0, "offset_m": (-1.05, 0.0, 0.0)})
    success = scenario.success.model_copy(update={"reached_position_m": within_m})
    short = {"duration_s": 9.0, "timeline": (entry,), "success": success}
    scenario = scenario.model_copy(update=short)
    flown = fly_transfer(0, scenario, measurement_model(scenario, 0, 0.002, math.radians(0.1)))
    assert flown.to_target_m == pytest.approx(1.0, abs=0.01)
    assert flown.between_m == pytest.approx(math.sqrt(2.0), abs=0.02)
    assert flown.failed == flown.contacts == 0
    assert flown.end_m < 0.02
    assert math.isnan(flown.reached_s) != reached
    if reached:
        assert 0.5 < flown.reached_s < 7.0
