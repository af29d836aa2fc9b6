# SPDX-License-Identifier: Apache-2.0
"""Monitor of passive safety in the controller: what it logs, and which scenarios it accepts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from chaserdock_controller.interfaces import TargetEstimation
from chaserdock_controller.nmpc.passive_safety import PassiveSafetyMonitor
from chaserdock_protocol.scenario import FlightScenario, ScenarioError, flight_scenario, parse_scenario


def mission(limits: dict[str, Any], **changes: Any) -> FlightScenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 10.0,
        "target": {"velocity_m_s": [0.0, 0.0, 0.0]},
        "limits": limits,
        "chasers": [{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return flight_scenario(parse_scenario(values | changes, "x"))


def estimation(latched: frozenset[int] = frozenset()) -> TargetEstimation:
    target = SimpleNamespace(position_m=np.array([1.0, 0.0, 0.0]), velocity_m_s=np.array([0.1, 0.0, 0.0]))
    covariance = {0: np.diag([1e-6] * 3 + [1e-10] * 3)}
    values = SimpleNamespace(at_effect=target, motion_covariances=covariance, latched=latched)
    return cast(TargetEstimation, values)


def plan(closing_m_s: float) -> np.ndarray:
    """Three states of a chaser 5 m behind the target of ``estimation``, which it follows and closes in on."""
    states = np.zeros((1, 3, 13))
    speed = 0.1 + closing_m_s
    states[0, :, 0] = -4.0 + speed * 0.1 * np.arange(3)
    states[0, :, 3] = speed
    return states


def test_changes_are_logged_once_with_margin_and_time() -> None:
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "monitor"}))
    assert monitor.duration_s == 600.0
    first = monitor.update((0,), plan(0.0), estimation())
    assert [level for level, _ in first] == ["info"]
    assert "chaser 0: passively safe: without thrust it comes to 5.00 m" in first[0][1]
    assert monitor.update((0,), plan(0.0), estimation()) == ()
    assert monitor.update((0,), plan(0.05), estimation(), 100_000_000) == ()  # not yet: it may be noise
    ((level, text),) = monitor.update((0,), plan(0.05), estimation(), 1_100_000_000)
    assert level == "warning"
    assert "not passively safe" in text
    assert "0.00 m of the target after 100 s" in text
    assert monitor.update((0,), plan(0.05), estimation(latched=frozenset({0}))) == ()
    assert monitor.certificates == {}


def test_coast_lasts_two_orbits_or_as_long_as_stated() -> None:
    orbit = {"orbit": {"altitude_m": 4e5}}
    assert PassiveSafetyMonitor(mission({}, **orbit)).duration_s == pytest.approx(2 * 5553.6, rel=1e-3)
    assert PassiveSafetyMonitor(mission({"passive_safety_s": 50.0}, **orbit)).duration_s == 50.0


def test_monitor_needs_the_joint_estimator() -> None:
    with pytest.raises(ScenarioError, match=r"limits.passive_safety: needs the covariance of estimator.name"):
        mission({"passive_safety": "monitor"}, estimator={"name": "mekf"})


def test_chaser_counts_once_it_was_safe_for_a_while_and_then_has_to_abort_when_it_is_not_for_a_second() -> (
    None
):
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "enforce"}))
    second = 1_000_000_000
    for k in range(3):  # not yet converged
        monitor.update((0,), plan(0.05), estimation(), k * second)
        assert monitor.unsafe(k * second) == {}
    for k in range(3, 14):
        monitor.update((0,), plan(0.0), estimation(), k * second)
    monitor.update((0,), plan(0.05), estimation(), 14 * second)
    assert monitor.unsafe(14 * second) == {}
    monitor.update((0,), plan(0.05), estimation(), 15 * second)
    assert "not passively safe" in monitor.unsafe(15 * second)[0]
    monitor.update((0,), plan(0.0), estimation(), 16 * second)
    assert monitor.unsafe(16 * second) == {}


def test_chaser_that_never_was_safe_has_to_abort_after_a_minute() -> None:
    monitor = PassiveSafetyMonitor(mission({"passive_safety": "enforce"}))
    for time_s in (0, 30, 59, 61):
        monitor.update((0,), plan(0.05), estimation(), time_s * 1_000_000_000)
        assert bool(monitor.unsafe(time_s * 1_000_000_000)) == (time_s > 60)
