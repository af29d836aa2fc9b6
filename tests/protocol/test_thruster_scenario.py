# SPDX-License-Identifier: Apache-2.0
"""Thrusters in scenario files: shipped layouts give full control, and invalid ones are an error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_models.wrench_set import WrenchSet, wrench_matrix, wrench_set
from chaserdock_protocol.scenario import (
    ScenarioError,
    load_scenario,
    parse_scenario,
    scenario_from_json,
)
from chaserdock_protocol.scenario.thrusters import thrusts_max
from chaserdock_protocol.shipped_scenarios import find_scenario
from thruster_cases import box, mission

THRUSTER = {"position_m": [0.1, 0.0, 0.0], "direction": [0.0, 1.0, 0.0], "thrust_N": 1.0}


def pairs() -> list[dict[str, Any]]:
    """Twelve thrusters in opposed pairs: at +-a e_i, thrusting +-e_(i+1)."""
    out = []
    for axis in range(3):
        for place in (-0.163, 0.163):
            for way in (-1.0, 1.0):
                position, direction = [0.0] * 3, [0.0] * 3
                position[axis], direction[(axis + 1) % 3] = place, way
                out.append({"position_m": position, "direction": direction, "thrust_N": 1.5})
    return out


@pytest.mark.parametrize(
    "name", ["single-thrusters", "thruster-failure", "four-chaser-docking-thrusters"]
)
def test_shipped_scenarios_fly_with_thrusters(name: str) -> None:
    s = load_scenario(find_scenario(name))
    assert s.name == name
    assert s.chaser.actuation == "thrusters"
    assert scenario_from_json(s.model_dump_json(), "the same") == s


def thruster_set(body: str) -> tuple[WrenchSet, np.ndarray, np.ndarray]:
    s = mission(body)
    return wrench_set(wrench_matrix(s.chaser.thrusters)), thrusts_max(s.chaser.thrusters), box(s)


@pytest.mark.parametrize(("body", "kept"), [("slider", 1.0), ("tetra12", 0.5)])
def test_any_one_thruster_can_be_lost(body: str, kept: float) -> None:
    wrenches, full, limits = thruster_set(body)
    assert wrenches.box_scale(full, limits) > 1.0
    for thruster in range(len(full)):
        assert (
            wrenches.box_scale(np.where(np.arange(len(full)) == thruster, 0.0, full), limits) > kept
        )


def test_opposed_pairs_do_not_survive_one() -> None:
    s = mission(
        chaser={"body": None, "thrusters": pairs(), "force_max_N": 0.5, "torque_max_N_m": 0.05}
    )
    wrenches, full = wrench_set(wrench_matrix(s.chaser.thrusters)), thrusts_max(s.chaser.thrusters)
    full[0] = 0.0
    assert wrenches.box_scale(full, box(s)) == pytest.approx(0.0, abs=1e-9)


def test_the_scale_of_the_box_is_the_largest_that_fits() -> None:
    """Every corner of the scaled box is attainable; slightly beyond, some are not."""
    from chaserdock_agents.chaser.thrusters.allocation import Allocator

    s = mission()
    wrenches, full, limits = thruster_set("tetra12")
    scale, allocator = wrenches.box_scale(full, limits), Allocator(s.chaser.thrusters, limits)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 6)).reshape(6, -1).T * limits
    assert all(allocator.allocate(c * scale * 0.9999, full).exact for c in corners)
    assert not all(allocator.allocate(c * scale * 1.001, full).exact for c in corners)


def test_keys_override_the_predefined_body() -> None:
    s = mission(chaser={"mass_kg": 20.0})
    assert s.chaser.mass_kg == 20.0
    assert len(s.chaser.thrusters) == 12
    assert parse_scenario({**s.model_dump(), "chaser": {}}, "test").chaser.actuation == "ideal"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"chaser": {"body": "cube"}}, "chaser.body"),
        ({"chaser": {"body": None}}, "thrusters needs thrusters"),
        ({"chaser": {"thrusters": [THRUSTER] * 12}}, "no 6-DoF control"),
        ({"chaser": {"force_max_N": 9.0}}, "at most 0.2"),
        (
            {"chaser": {"thrusters": [{**THRUSTER, "direction": [0, 2, 0]}]}},
            "chaser.thrusters.0.direction: must be of unit",
        ),
        ({"chaser": {"thrusters": [{**THRUSTER, "thrust_N": -1}]}}, "chaser.thrusters.0.thrust_N"),
        (
            {"chaser": {"thrusters": [{**THRUSTER, "min_on_s": 0.001}]}},
            "min_on_s (0.001) must be at least rise_s",
        ),
        ({"chaser": {"thrusters": [THRUSTER] * 25}}, "chaser.thrusters"),
        (
            {"chaser": {"modulation": {"carrier_hz": 7}}},
            "multiple of chaser.modulation.carrier_hz (960, 7)",
        ),
        ({"chaser": {"modulation": {"carrier_hz": 120}}}, "shorter than the shortest pulse"),
        (
            {"thruster_failure": [{"chaser": 1, "thruster": 0, "at_s": 1, "kind": "stuck_on"}]},
            "there is no chaser 1",
        ),
        (
            {"thruster_failure": [{"chaser": 0, "thruster": 12, "at_s": 1, "kind": "stuck_on"}]},
            "there is no thruster 12",
        ),
        (
            {"thruster_failure": [{"chaser": 0, "thruster": 0, "at_s": 1, "kind": "weak"}]},
            "factor goes with",
        ),
        (
            {"thruster_failure": [{"chaser": 0, "thruster": 0, "at_s": 1, "kind": "loud"}]},
            "thruster_failure.0.kind",
        ),
        (
            {
                "thruster_failure": [
                    {"chaser": 0, "thruster": 0, "at_s": t, "kind": "stuck_off"} for t in (1, 2)
                ]
            },
            "fails twice",
        ),
        (
            {
                "chaser": {"actuation": "ideal"},
                "thruster_failure": [{"chaser": 0, "thruster": 0, "at_s": 1, "kind": "stuck_on"}],
            },
            "thrusters fail only with",
        ),
        ({"timeline": [{"at_s": 1, "command": "isolate", "chasers": [0]}]}, "thruster goes with"),
        (
            {"timeline": [{"at_s": 1, "command": "hold", "chasers": [0], "thruster": 1}]},
            "thruster goes with",
        ),
    ],
)
def test_invalid_thrusters_are_an_error(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError) as error:
        mission(**changes)
    assert words in str(error.value)
    assert "Traceback" not in str(error.value)
