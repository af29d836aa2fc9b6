# SPDX-License-Identifier: Apache-2.0
"""The criterion ``success.reached``: evaluation and validation."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.scenario import Scenario, ScenarioError, load_scenario

from chaserdock.analysis.criteria import not_reached, reached_time

PATH = Path(__file__).resolve().parents[2] / "scenarios" / "collision-avoidance.toml"


def scenario(*overrides: str) -> Scenario:
    return load_scenario(PATH, overrides)


def flight(s: Scenario, chaser_m: np.ndarray, target_q: np.ndarray) -> Any:
    """Return a stub of a recorded flight with one row per second."""
    n = len(chaser_m)
    target = SimpleNamespace(time_s=np.arange(n, dtype=float), position_m=np.zeros((n, 3)), q_wxyz=target_q)
    return SimpleNamespace(scenario=s, truth={"target": target, "chaser/0": SimpleNamespace(
        time_s=target.time_s, position_m=chaser_m)})  # fmt: skip


def test_goal_counts_as_reached_from_when_the_chaser_stays() -> None:
    """The goal rotates with the target. Passing through it and being there before the command do not count."""
    s, n = scenario(), 80
    turning = np.array([rotations.exp([0.0, 0.0, 0.01 * k]) for k in range(n)])
    goal = rotations.rotate(turning, np.tile([1.0, 0.0, 0.0], (n, 1)))
    away = np.zeros((n, 3))
    away[:40] = [0.0, 0.0, 0.021]
    away[30] = 0.0
    assert reached_time(flight(s, goal + away, turning), 0) == 40.0
    assert reached_time(flight(s, goal, turning), 0) == 10.0
    away[-1] = [0.021, 0.0, 0.0]
    assert reached_time(flight(s, goal + away, turning), 0) is None
    assert reached_time(flight(s, goal, turning), 1) is None  # has no goto


@pytest.mark.parametrize(
    ("time_s", "violations"),
    [
        (69.9, []),
        (70.1, ["chaser 0 reached its goal after 60.1 s, at most 60 s allowed"]),
        (None, ["chaser 0 is not within 0.02 m of its goal"]),
    ],
)
def test_violations_name_chaser_and_limit(time_s: float | None, violations: list[str]) -> None:
    assert not_reached(scenario(), 0, time_s) == violations
    assert not_reached(scenario(), 1, None) == []


def test_last_goto_defines_the_goal() -> None:
    s = scenario()
    first = s.timeline[0]
    later = first.model_copy(update={"at_s": 30.0, "offset_m": (0.0, 0.0, 1.0)})
    both = s.model_copy(update={"timeline": (later, first)})
    assert both.goal_of(0) == (30.0, (0.0, 0.0, 1.0))
    assert both.goal_of(1) is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("success.reached=[1]", "success.reached: no goto of the timeline names chaser 1"),
        ("success.reached=[5]", "success.reached: there is no chaser 5; this mission has 0 to 1"),
        ("success.reached_position_m=0", "success.reached_position_m"),
    ],
)
def test_invalid_criteria_are_named(override: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message.replace(".", r"\.")):
        scenario(override)
