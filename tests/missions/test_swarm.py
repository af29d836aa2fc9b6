# SPDX-License-Identifier: Apache-2.0
"""The scenario ``swarm-64``: everyone changes places twice; the first second in `simulate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT

from chaserdock.simulation.flight import fly_case

PATH = ROOT / "scenarios" / "swarm-64.toml"


def test_all_chasers_change_places_with_a_neighbour_twice() -> None:
    scenario = load_scenario(PATH)
    places = np.array([c.position_m for c in scenario.chasers])
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(64)
    assert gaps.min() > scenario.limits.min_distance_chasers_m + 0.3
    before = places
    for at_s in sorted({e.at_s for e in scenario.timeline}):
        goals = {e.chasers[0]: e.offset_m for e in scenario.timeline if e.at_s == at_s}
        after = np.array([goals[i] for i in range(64)])
        taken = np.linalg.norm(after[:, None] - before[None], axis=-1).argmin(axis=1)
        np.testing.assert_allclose(after, before[taken])
        assert (taken != np.arange(64)).all()
        assert (taken[taken] == np.arange(64)).all()
        assert np.linalg.norm(after - before, axis=1).max() < 1.01
        before = after


@pytest.mark.slow
def test_swarm_flies_its_first_second_without_a_violation(tmp_path: Path) -> None:
    case = {"extends": "swarm-64", "name": "swarm", "duration_s": 1.0, "settling_s": 0.5}
    result = fly_case(case, 0, tmp_path)
    assert result.violations == ()
    assert result.sim_time_s == pytest.approx(1.0)
