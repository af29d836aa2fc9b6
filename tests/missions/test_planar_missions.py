# SPDX-License-Identifier: Apache-2.0
"""Whole missions on a floor keep all invariants and end docked, on both engines and with any axes
of the target.
"""

from __future__ import annotations

from typing import Any

import planar_cases
import pytest

from chaserdock.simulation.flight import fly_case

DRAWN = {"perception": {"name": "statistical"}}
APPROACH = {"at_s": 12.0, "command": "approach", "chasers": [0, 1]}


def flown(case: dict[str, Any]) -> tuple[str, tuple[str, ...]]:
    result = fly_case(DRAWN | case, 0)
    return result.outcome, tuple(map(str, result.violations))


@pytest.mark.slow
def test_free_flyers_dock_with_a_target_that_turns_on_the_floor() -> None:
    """In PyBullet; the next test flies in MuJoCo."""
    assert flown({"extends": "planar-docking", "seed": 7}) == ("docked", ())


@pytest.mark.slow
def test_a_target_with_leaning_axes_is_docked_with() -> None:
    """Its axes, yaw, place, velocity and inertia are in general position."""
    case = planar_cases.values(
        "mujoco",
        duration_s=50.0,
        settling_s=8.0,
        steady_until_s=12.0,
        time={"rate_hz": 10, "image_hz": 10},
        timeline=[APPROACH],
        success={"latched": [0, 1]},
    )
    assert flown(case) == ("docked", ())


@pytest.mark.slow
def test_free_flyers_track_and_may_be_lost_their_way_back() -> None:
    """A goto, an abort and a lost sight on the floor: references turn about the vertical only."""
    case = {
        "extends": "planar-tracking",
        "seed": 5,
        "duration_s": 45.0,
        "approach": {"face_target": True},
        "timeline": [
            {"at_s": 10.0, "command": "goto", "chasers": [0], "offset_m": [-0.9, 0.6, -0.05]},
            {"at_s": 16.0, "command": "abort", "chasers": [0]},
        ],
        "fault": [{"kind": "camera_off", "process": "chaser/1", "at_s": 12.0, "duration_s": 6.0}],
    }
    assert flown(case)[1] == ()
