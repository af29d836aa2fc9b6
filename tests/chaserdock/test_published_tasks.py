# SPDX-License-Identifier: Apache-2.0
"""Published tasks: the criteria are met, and would be violated by other flights."""

from __future__ import annotations

import numpy as np
import pytest
from flights import published_tasks as tasks


def test_deputies_dock_below_the_speed_limit() -> None:
    found = tasks.afrl_docking(20, seed=1)
    assert (found.docked, found.too_fast, found.too_near, found.late) == (20, 0, 0, 0)
    assert found.speed_margin_m_s > 0.0
    assert found.apart_m > tasks.AFRL_APART_M
    assert tasks.afrl_speed_limit(np.array(100.5)) == pytest.approx(0.2 + 2 * 0.001027 * 100.0)


def test_a_law_that_is_too_fast_or_does_nothing_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def rush(x: np.ndarray, waits: np.ndarray) -> np.ndarray:
        return np.clip(-0.1 * x[..., :3], -1.0, 1.0)

    monkeypatch.setattr(tasks, "afrl_force", rush)
    assert tasks.afrl_docking(5, seed=1).too_fast == 5
    monkeypatch.setattr(tasks, "afrl_force", lambda x, waits: np.zeros_like(x[..., :3]))
    assert tasks.afrl_docking(5, seed=1).docked == 0


def test_rendezvous_of_arch_comp_keeps_its_three_properties() -> None:
    found = tasks.arch_comp(200, 1, (0.0, 240.0), step_min=0.25)
    assert found.violations == 0
    assert 0 < found.attempts < 200
    assert min(found.cone_margin_m, found.speed_margin_m_s, found.clearance_m) > 0.0


def test_properties_are_violated_by_another_initial_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the side the chaser enters outside the cone, and from far away too fast."""
    monkeypatch.setattr(tasks, "ARCH_CENTRE", np.array([-140.0, -400.0, 0.0, 0.0]))
    assert tasks.arch_comp(20, 1, (1e9, 1e9), step_min=0.25).outside_cone == 20
    monkeypatch.setattr(tasks, "ARCH_CENTRE", np.array([-100.0, 0.0, 8.0, 0.0]))
    monkeypatch.setattr(tasks, "ARCH_HALF", np.zeros(4))
    assert tasks.arch_comp(2, 1, (1e9, 1e9), step_min=0.25).too_fast == 2
