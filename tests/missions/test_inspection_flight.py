# SPDX-License-Identifier: Apache-2.0
"""The shipped inspection, shortened: its images, smaller, tell the geometry, and the trackers take
it over.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.perception.model.perception import ModelPerception
from chaserdock_agents.chaser.sighting import apply_geometry, look
from chaserdock_protocol.messages import GeometryEstimate, OperatorCommand, Sighting
from chaserdock_protocol.scenario import load_scenario
from chaserdock_world.plant import true_geometry_errors
from chaserdock_world.rendering.cameras import States
from chaserdock_world.rendering.pose_cameras import make_cameras

from chaserdock.experiments.in_process import InProcessMission

ROOT = Path(__file__).parents[2]
INSPECT = tuple(OperatorCommand(command="inspect", chaser=i) for i in (0, 1))


@pytest.mark.slow
def test_geometry_is_estimated_in_flight_and_corrects_the_trackers() -> None:
    scenario = load_scenario(
        ROOT / "scenarios/markerless-inspection.toml",
        (
            "duration_s=27.0",
            "camera.width_px=640",
            "camera.height_px=360",
            "inspection.speed_m_s=0.35",
            "timeline=[]",
        ),
    )
    cameras, perceptions = (
        make_cameras(scenario),
        [make_perception(scenario) for _ in scenario.chasers],
    )

    def sighting(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        return look(perceptions[chaser], cameras.image(chaser, tick, tick, time_ns, states), None)

    estimates: list[GeometryEstimate] = []
    with InProcessMission(scenario, sighting) as flight:
        for _ in range(scenario.ticks):
            commands = INSPECT if flight.tick == 180 else ()
            outputs = flight.step(commands).outputs
            assert outputs is not None
            for i, wrench in outputs.wrenches.items():
                assert not apply_geometry(perceptions[i], wrench.geometry)
                estimates += [wrench.geometry] if wrench.geometry is not None else []
        assert {flight.phase(i) for i in flight.chasers} == {"inspect"}
        assert not flight.contacts
    first, last = estimates[0], estimates[-1]
    assert last.views >= 6
    scale, turns = true_geometry_errors(scenario)
    true = np.append(np.concatenate(list(turns.values())), scale) / last.sigmas[:-1]
    off = np.array(last.values[:-1]) / last.sigmas[:-1] - true
    covariance = np.array(last.covariance).reshape(len(last.names), -1) / np.outer(
        last.sigmas, last.sigmas
    )
    assert off @ np.linalg.solve(covariance[:-1, :-1], off) < 4.0 * len(off)
    assert np.linalg.norm(off) < 0.6 * np.linalg.norm(true)
    assert np.trace(covariance) < np.trace(
        np.array(first.covariance).reshape(covariance.shape) / np.outer(last.sigmas, last.sigmas)
    )
    known = make_perception(scenario)
    for perception in perceptions:
        assert isinstance(perception, ModelPerception)
        assert isinstance(known, ModelPerception)
        assert not np.array_equal(perception.mesh.vertices_m, known.mesh.vertices_m)
