# SPDX-License-Identifier: Apache-2.0
"""Targets with a mesh in a scenario: what the flight software knows of it, and errors in its
keys.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models.meshes import mass_properties
from chaserdock_models.satellites import satellite
from chaserdock_protocol.scenario import Scenario, ScenarioError, flight_scenario, parse_scenario
from scenario_samples import good


def with_mesh(*overrides: str) -> Scenario:
    base = ('target.model="geo_servicer"', 'perception.name="model"')
    return parse_scenario(good(), "test", (*base, *overrides))


def test_flight_software_receives_the_nominal_simplified_mesh() -> None:
    scenario = with_mesh(
        'target.knowledge.missing=["dish", "antenna_whip"]',
        "target.knowledge.simplification_m=0.004",
    )
    known = flight_scenario(scenario).target.known_mesh()
    assert known is not None
    nominal = satellite("geo_servicer", 0.004)
    assert set(nominal.part_names) - set(known.part_names) == {"dish", "antenna_whip"}
    assert known.triangle_count < 0.5 * satellite("geo_servicer").triangle_count
    bus = next(p for p in known.parts if p.name == "bus")
    np.testing.assert_array_equal(bus.vertices_m, nominal.parts[0].vertices_m)


def test_known_mesh_does_not_depend_on_the_seed() -> None:
    texts = {flight_scenario(with_mesh(f"seed={seed}")).model_dump_json() for seed in (1, 2)}
    assert len(texts) == 1


def test_target_without_mesh_has_none() -> None:
    assert parse_scenario(good(), "test").target.known_mesh() is None


def test_inertia_is_that_of_the_mesh() -> None:
    scenario = with_mesh("target.mass_kg=9.0")
    np.testing.assert_allclose(
        scenario.target.inertia_tensor, mass_properties(satellite("geo_servicer"), 9.0)[1]
    )
    assert scenario.target.moments == tuple(np.diag(scenario.target.inertia_tensor))
    stated = with_mesh("target.inertia_kg_m2=[0.1, 0.2, 0.25]")
    np.testing.assert_array_equal(stated.target.inertia_tensor, np.diag([0.1, 0.2, 0.25]))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ('target.knowledge.missing=["mast"]', "geo_servicer has no part 'mast'"),
        ("target.knowledge.panel_deg=11.0", "target.knowledge.panel_deg"),
        ("target.knowledge.simplification_m=0.0", "target.knowledge.simplification_m"),
        ("target.knowledge.scale_share=-0.1", "target.knowledge.scale_share"),
        (
            'perception.name="default"',
            "'default' needs markers; the target 'geo_servicer' has none",
        ),
        ('chaser.mesh="boat"', "chaser.mesh"),
    ],
)
def test_invalid_keys_are_one_line(override: str, message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        with_mesh(override)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_knowledge_without_a_mesh_is_an_error() -> None:
    with pytest.raises(ScenarioError, match=r"knowledge.panel_deg: '\w+' has no mesh"):
        parse_scenario(good(), "test", ("target.knowledge.panel_deg=1.0",))


def test_chaser_mesh_needs_a_target_with_a_mesh() -> None:
    assert with_mesh('chaser.mesh="chaser_body"').chaser.mesh == "chaser_body"
    with pytest.raises(
        ScenarioError,
        match=r"chaser\.mesh: drawn only with a target that has a mesh; 'paper' has none",
    ):
        parse_scenario(good(), "test", ('chaser.mesh="chaser_body"',))
