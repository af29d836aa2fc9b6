# SPDX-License-Identifier: Apache-2.0
"""The scenario ``sixteen-chasers``: geometry of the formation, convergence without approaches below
the limit.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT

from chaserdock.experiments.flight_record import record_flight
from chaserdock.experiments.perfect_knowledge import PerfectEstimator

PATH = ROOT / "scenarios" / "sixteen-chasers.toml"


def test_formation_is_two_rings_of_eight() -> None:
    places = np.array([c.position_m for c in load_scenario(PATH).chasers])
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 1.2435, atol=1e-4)
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(16)
    np.testing.assert_allclose(gaps.min(axis=1), 0.8419, atol=1e-4)
    assert (places[:, 2] > 0.0).sum() == 8


@pytest.mark.slow
def test_sixteen_chasers_converge_without_close_approaches() -> None:
    """From scattered starts every chaser converges on its position; perfect target state."""
    mission = load_scenario(PATH, ("duration_s=8.0", "settling_s=1.0"))
    trace, truth = record_flight(mission), PerfectEstimator(mission.target)
    there = np.array([truth.estimate_at(round(t * 1e9)).position_m for t in trace.time_s])
    places = trace.states[:, :, :3]
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + 9.0 * np.eye(16)
    assert gaps.min() > 0.6
    assert np.linalg.norm(places - there[:, None], axis=-1).min() > 1.0
    assert trace.failed_solves == 0
    assert (trace.position_error_m[-1] < 0.6 * trace.position_error_m[0]).all()
