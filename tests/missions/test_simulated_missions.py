# SPDX-License-Identifier: Apache-2.0
"""Complete missions as ``chaserdock simulate`` flies them: no invariant is violated, and where
nothing disturbs them they meet their criteria of success.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from chaserdock.analysis.summary import summarize
from chaserdock.simulation.flight import fly_case
from chaserdock.simulation.seeds import SeedOptions, fly_seed

STATISTICAL = {"perception": {"name": "statistical"}}
EARLY_DOCKING: dict[str, Any] = {
    "duration_s": 66.0,
    "settling_s": 14.0,
    "steady_until_s": 20.0,
    "timeline": [{"at_s": 20.0, "command": "approach", "chasers": [0, 3]}],
}
"""The main job, but for the wait before its approach: 20 s rather than 60 s."""
UNDISTURBED: dict[str, dict[str, Any]] = {
    "single": {"duration_s": 40.0, "camera": {"width_px": 640, "height_px": 360}},
    "two-chaser-tracking": {"duration_s": 40.0, **STATISTICAL},
    "collision-avoidance": STATISTICAL,
    "four-chaser-docking": {**EARLY_DOCKING, **STATISTICAL},
    "docking-contact": {"duration_s": 46.0, "world": {"engine": "mujoco"}, **STATISTICAL},
}
"""What is changed of each scenario: one flies by images, one in MuJoCo."""
SEEDS = (("fault-drill", 12), ("docking-contact", 1))
"""Scenarios, and the seeds by which ``simulate`` disturbs them."""


@pytest.mark.slow
@pytest.mark.parametrize("name", UNDISTURBED)
def test_undisturbed_mission_succeeds_without_violations(name: str, tmp_path: Path) -> None:
    flown = fly_case({"extends": name, **UNDISTURBED[name]}, 0, tmp_path)
    assert [str(violation) for violation in flown.violations] == []
    summary = summarize(tmp_path / "run" / "mission.mcap")
    assert summary["success"], summary["failures"]
    assert summary["collisions"] == 0
    if not summary["chasers"]["0"].get("capture"):
        estimate = summary["target_estimate"]
        assert estimate["max_position_error_m"] < 0.01
        assert estimate["max_orientation_error_rad"] < math.radians(1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), SEEDS)
def test_disturbed_mission_violates_no_invariant(name: str, seed: int) -> None:
    flown = fly_seed(SeedOptions(name), seed)
    assert [str(violation) for violation in flown.violations] == []
