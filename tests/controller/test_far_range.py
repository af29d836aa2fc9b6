# SPDX-License-Identifier: Apache-2.0
"""Far range: measurements by range and bearing, speed limit by range, approach cone, hold points,
and what scenarios are refused.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_models import rotations
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.pose_image import WIDTH_PX, encode_pose
from chaserdock_protocol.scenario import Scenario, ScenarioError, flight_scenario, parse_scenario
from flight_cases import fleet_of, order
from flights import load_shipped
from flights.abort_study import study


def scenario(**changes: Any) -> Scenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 100.0,
        "perception": {"name": "statistical"},
        "ranging": {},
        "approach": {"max_speed_m_s": 0.03, "closing_per_s": 0.004, "cone_deg": 10.0},
        "limits": {"max_reference_distance_m": 300.0},
        "chasers": [{"position_m": [-200.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return parse_scenario(values | changes, "test")


def image_at(position: tuple[float, float, float], seed: int) -> np.ndarray:
    pixels = np.frombuffer(
        encode_pose(np.array(position), np.array([1.0, 0.0, 0.0, 0.0]), (seed, 7)), np.uint8
    )
    return pixels.reshape(1, WIDTH_PX)


def test_far_target_is_measured_by_range_and_bearing_with_the_stated_errors() -> None:
    perception = make_perception(flight_scenario(scenario()))
    errors, covariance = [], np.eye(6)
    for seed in range(300):
        (pose,) = perception.estimate(image_at((3.0, -2.0, 150.0), seed)).solutions
        turn = rotations.log(pose.q_irf_trf_wxyz)
        errors.append(np.concatenate([pose.position_irf_m - (3.0, -2.0, 150.0), turn]))
        covariance = pose.covariance
    errors = np.array(errors)
    squared = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(covariance), errors)
    assert np.mean(squared) == pytest.approx(6.0, abs=0.6)
    sigma = np.sqrt(np.diag(covariance))
    assert sigma[2] == pytest.approx(math.hypot(0.02, 1e-4 * 150.0), rel=0.01)
    assert sigma[0] == pytest.approx(math.radians(0.005) * 150.0, rel=0.01)


def test_markers_replace_ranging_nearby_and_nothing_is_seen_out_of_the_image_or_of_reach() -> None:
    perception = make_perception(flight_scenario(scenario()))
    near = perception.estimate(image_at((0.0, 0.0, 1.0), 1))
    assert len(near.marker_ids) > 0
    for hidden in ((200.0, 0.0, 100.0), (0.0, 0.0, 1500.0), (0.0, 0.0, -50.0)):
        assert perception.estimate(image_at(hidden, 1)).solutions == ()
    without = make_perception(flight_scenario(scenario(ranging=None)))
    assert without.estimate(image_at((0.0, 0.0, 150.0), 1)).solutions == ()


def test_goto_keeps_the_speed_limit_by_range_all_along_its_way() -> None:
    machine = fleet_of(flight_scenario(scenario()), acquired_s=0.0)
    machine.chasers[0].position_m = np.array([-200.0, 0.0, 0.0])
    assert order(
        machine, OperatorCommand(command="goto", chaser=0, offset_m=(-20.0, 0.0, 0.0)), 0.0
    ).accepted
    move = machine.chasers[0].state.move
    positions, velocities, _ = move.at(np.linspace(0.0, move.duration_s, 500))
    share = np.linalg.norm(velocities, axis=1) / (0.06 + 0.004 * np.linalg.norm(positions, axis=1))
    assert 0.9 < share.max() < 1.001
    assert np.linalg.norm(velocities, axis=1).max() > 0.3  # much faster than nearby


def test_goto_out_of_the_approach_cone_is_refused() -> None:
    machine = fleet_of(flight_scenario(scenario()), acquired_s=0.0)
    refused = order(
        machine, OperatorCommand(command="goto", chaser=0, offset_m=(-50.0, 20.0, 0.0)), 0.0
    )
    assert not refused.accepted
    assert "21.8 degrees off the approach axis; the approach cone has 10 degrees" in refused.reason


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {
                "timeline": [
                    {"at_s": 1.0, "command": "goto", "chasers": [0], "offset_m": [-0.2, 0.0, 0.0]}
                ]
            },
            r"timeline\.0\.offset_m: 0\.2 m from the target, inside the keep-out of "
            r"limits\.min_distance_target_m \(0\.35 m\)",
        ),
        (
            {
                "timeline": [
                    {"at_s": 1.0, "command": "goto", "chasers": [0], "offset_m": [-400.0, 0.0, 0.0]}
                ]
            },
            r"timeline\.0\.offset_m: 400 m from the target, farther than "
            r"limits\.max_reference_distance_m",
        ),
        (
            {
                "timeline": [
                    {"at_s": 1.0, "command": "goto", "chasers": [0], "offset_m": [-50.0, 50.0, 0.0]}
                ]
            },
            r"timeline\.0\.offset_m: 45 degrees off the approach axis of chaser 0, outside "
            r"approach\.cone_deg \(10 degrees\)",
        ),
        (
            {"approach": {"cone_deg": 60.0}},
            r"approach\.cone_deg: from the edge of the cone the target is 60 degrees off",
        ),
        ({"orbit": {"altitude_m": 1e5, "inclination_deg": 200.0}}, r"orbit\.inclination_deg"),
        ({"orbit": {"semi_major_axis_m": 6e6}}, r"orbit: the orbit lies inside the Earth"),
        (
            {"perception": {"name": "model"}},
            r"ranging: needs a perception by markers \(default, paper, paper_iterative, "
            r"statistical\), not 'model'",
        ),
    ],
)
def test_invalid_scenarios_are_refused_in_one_clear_line(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ScenarioError, match=message) as caught:
        scenario(**changes)
    assert str(caught.value).count("\n") <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["v-bar", "r-bar"])
def test_aborts_of_the_rendezvous_stay_out_of_the_keep_out(name: str) -> None:
    found = study(load_shipped(name), 6, seed=2)
    assert found.entered == 0
    assert found.certified >= 5
    assert found.profile_s > 1200.0
