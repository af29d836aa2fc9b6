# SPDX-License-Identifier: Apache-2.0
"""Scenarios on a floor: what leaves the plane is refused, with its key and what would be right."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import planar_cases
import pytest
from chaserdock_protocol.scenario import ScenarioError, load_scenario, parse_scenario
from chaserdock_protocol.scenario.planar import height_m, up_in_target
from chaserdock_protocol.shipped_scenarios import find_scenario
from planar_cases import HEIGHT_M, UP_TRF, in_trf, scenario, values, yawed
from scenario_samples import good

Change = Callable[[dict[str, Any]], object]


def put(*keys: str | int, value: Any) -> Change:
    """Return a function that sets a key of a scenario."""

    def change(own: Any) -> None:
        for key in keys[:-1]:
            own = own.setdefault(key, {}) if isinstance(own, dict) else own[key]
        own[keys[-1]] = value

    return change


LEAN = [math.cos(0.1), math.sin(0.1), 0.0, 0.0]
UP_OFF_M = (0.01 * UP_TRF).tolist()
GOTO = {"at_s": 1.0, "command": "goto", "chasers": [0]}


def test_the_vertical_in_the_target_follows_from_the_chasers_attitudes() -> None:
    s = scenario()
    assert up_in_target(s) == pytest.approx(UP_TRF, abs=1e-12)
    assert height_m(s, 1, UP_TRF) == pytest.approx(HEIGHT_M)
    assert up_in_target(parse_scenario(good(), "test")) is None


def test_a_planar_body_has_authority_in_the_plane_only() -> None:
    assert scenario().chaser.wrench_max == pytest.approx([1.5, 1.5, 0.0, 0.0, 0.0, 0.15])


@pytest.mark.parametrize("name", ["planar-tracking", "planar-docking"])
def test_shipped_scenarios_are_planar_with_a_target_that_turns_at_3_degrees_per_second(
    name: str,
) -> None:
    s = load_scenario(find_scenario(name))
    assert s.chaser.is_planar
    assert np.degrees(s.target.omega_rad_s) == pytest.approx([0.0, 0.0, 3.0])
    thrusters = [(t.thrust_N, *np.abs(t.position_m[:2])) for t in s.chaser.thrusters]
    assert thrusters == [(1.5, 0.17, 0.17)] * 8
    assert (s.chaser.mass_kg, s.chaser.inertia[2]) == (17.8, 0.315)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("chasers", 1, "q_wxyz", value=LEAN), "chasers.1.q_wxyz: its Z axis (TRF) must be"),
        (
            put("chasers", 0, "q_wxyz", value=yawed(0.0)),
            "chasers.0: its camera does not see the target's centre from its reference",
        ),
        (
            put("docking", "ports", 0, "axis", value=in_trf(math.cos(0.1), 0.0, math.sin(0.1))),
            "docking.ports.0.axis: points out of the plane of the floor",
        ),
        (
            put("docking", "ports", 1, "position_m", value=in_trf(0.0, 0.25, 0.02)),
            "docking.ports.1.position_m: 0.02 m above the target's centre, but chaser 1 is on a "
            "floor, at -0.05 m",
        ),
        (
            put("timeline", value=[GOTO | {"offset_m": in_trf(-1.2, 0.1, 0.07)}]),
            "timeline.0.offset_m: 0.07 m above the target's centre",
        ),
        (
            put("timeline", value=[{"at_s": 1.0, "command": "detumble", "chasers": [0]}]),
            "timeline.0.command: detumble needs six degrees of freedom",
        ),
        (put("target", "q_wxyz", value=[1.0, 0.0, 0.0, 0.0]), "target.q_wxyz: the target leans"),
        (
            put("target", "velocity_m_s", value=[0.0, 0.0, 0.01]),
            "target.velocity_m_s: must be in the plane of the floor (its vertical part is 0.01 m/s",
        ),
        (
            put("target", "omega_rad_s", value=[0.0, 0.0, 0.05]),
            "target.omega_rad_s: must be about the vertical, in TRF along [-0.6065",
        ),
        (
            put("chasers", 0, "start_offset_m", value=UP_OFF_M),
            "chasers.0.start_offset_m: must be in the plane",
        ),
        (
            put("chasers", 1, "start_rotation_rad", value=[0.0, 0.01, 0.1]),
            "chasers.1.start_rotation_rad: must be about Z",
        ),
        (
            put("chasers", 1, "start_velocity_m_s", value=[0.0, 0.0, 0.01]),
            "chasers.1.start_velocity_m_s: must be in the plane",
        ),
        (
            put("docking", value={"kind": "held"}),
            "chasers.0.position_m: -0.05 m above the target's centre; docking.kind held approaches",
        ),
        (put("orbit", value={"altitude_m": 4e5}), "orbit: excludes"),
        (
            put(
                "chaser",
                value={"body": "tetra12", "actuation": "thrusters", "degrees_of_freedom": "planar"},
            ),
            "thrusters.0.direction: pushes a planar body up or down",
        ),
    ],
)
def test_what_leaves_the_plane_is_refused(change: Change, words: str) -> None:
    own = copy.deepcopy(values())
    change(own)
    with pytest.raises(ScenarioError) as error:
        parse_scenario(own, "test")
    assert words in str(error.value)


def test_thrusters_that_do_not_turn_a_planar_body_are_refused() -> None:
    own = values()
    thruster = {"position_m": [0.0, 0.0, 0.0], "thrust_N": 1.0}
    ways = ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0])
    own["chaser"] = own["chaser"] | {"thrusters": [thruster | {"direction": w} for w in ways]}
    with pytest.raises(ScenarioError, match="no control of x, y and yaw"):
        parse_scenario(own, "test")


def test_a_static_target_and_an_ideal_planar_actuator_need_no_rates_and_thrusters() -> None:
    own = values()
    own["target"] |= {"motion": "static", "omega_rad_s": [0.1, 0.2, 0.3]}
    own["target"] |= {"inertia_products_kg_m2": [0.0, 0.0, 0.0]}
    own["chaser"] = {"degrees_of_freedom": "planar", "size_m": [0.2, 0.3, 0.3]}
    own["docking"] = {"kind": "held"}
    own["chasers"] = [planar_cases.chaser(x, height_m=0.0) for x in (0.0, math.pi / 2)]
    del own["truth"]
    assert parse_scenario(own, "test").chaser.wrench_max[2] == 0.0
