# SPDX-License-Identifier: Apache-2.0
"""Bodies in the outside view of films: colours, numbers, shapes that claim no more than stated."""

from pathlib import Path

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.analysis.body_renderer import BodyRenderer, coloured_space
from chaserdock.analysis.chase_camera import Viewpoint
from chaserdock.analysis.dressed_bodies import WHITE, chaser_body, target_body, tint

SCENARIOS = Path(__file__).parents[2] / "scenarios"
AT_REST = (np.zeros(3), rotations.IDENTITY)


def test_each_chaser_has_its_colour_and_the_target_is_foil() -> None:
    scenario = load_scenario(SCENARIOS / "markerless-docking.toml")
    look = Viewpoint(np.zeros(3), 5.0, -0.9, 0.45, 320, 240)
    places = {0: np.array([-1.4, 0.0, 0.0]), 1: np.array([1.4, 0.0, 0.0])}
    chasers = {i: (p, rotations.IDENTITY) for i, p in places.items()}
    found = BodyRenderer(scenario, (0, 1), look).render(look, AT_REST, chasers)

    def beside(point_m: Array) -> Array:
        """Return the mean colour (3,) of the covered pixels near a point."""
        x, y = np.round(look.project(point_m)[0]).astype(int)
        near = np.s_[y - 6 : y + 7, x - 6 : x + 7]
        assert found.covered[near].sum() > 20
        return found.bgr[near][found.covered[near]].mean(axis=0)

    for i, place in places.items():
        hue = beside(place)
        wanted = int(np.argmax(tint(i)))
        rails = found.bgr[found.covered].astype(int)
        assert np.count_nonzero(rails.argmax(axis=1) == wanted) > 20
        assert hue.max() > 20.0
    assert 0.01 < found.covered.mean() < 0.2


@pytest.mark.parametrize("name", ["demo", "four-chaser-docking", "markerless-docking", "single"])
def test_a_chaser_is_dressed_within_its_stated_size(name: str) -> None:
    """But for probe, and for thrusters with their struts, which are where the scenario says."""
    scenario = load_scenario(find_scenario(name))
    own = scenario.chaser
    half = np.array(own.size_m) / 2.0 + 1.3e-3  # with paint on faces
    body = chaser_body(scenario, 3)
    for part, _ in body.parts:
        if part.name in ("strut", "hub", "nozzle"):
            reach = np.max(np.abs([t.position_m for t in own.thrusters]), axis=0) + 0.02
            assert (np.abs(part.vertices_m) <= np.maximum(half, reach)).all(), part.name
        elif part.name == "probe":
            assert part.vertices_m[:, 0].max() == pytest.approx(own.probe_reach_m)
        else:
            assert (np.abs(part.vertices_m) <= half).all(), part.name
    if own.actuation == "thrusters":
        nozzles = [p.vertices_m for p, _ in body.parts if p.name == "nozzle"]
        assert len(nozzles) == len(own.thrusters)
        for vertices, thruster in zip(nozzles, own.thrusters, strict=True):
            axis = np.array(thruster.direction)
            arms = vertices - thruster.position_m
            assert ((arms @ axis) <= 1e-6).all()  # blows against its force
            assert np.linalg.norm(arms, axis=1).max() < 0.025


def test_numbers_are_painted_and_differ() -> None:
    scenario = load_scenario(find_scenario("demo"))

    def painted(number: int) -> Array:
        body = chaser_body(scenario, number)
        return np.concatenate([p.vertices_m for p, coat in body.parts if coat is WHITE])

    assert len(painted(0)) > 100
    assert painted(0).shape != painted(1).shape or not np.allclose(painted(0), painted(1))
    assert len(painted(12)) > len(painted(1))


def test_markers_end_at_the_faces_of_the_target() -> None:
    scenario = load_scenario(find_scenario("demo"))
    (shape,) = scenario.target_model().boxes
    for part, _ in target_body(scenario).parts:
        assert (np.abs(part.vertices_m) <= np.array(shape.size_m) / 2.0 + 2.5e-3).all()


def test_the_earth_is_blue_with_white_clouds_and_space_is_black() -> None:
    space, sea, cloud = coloured_space(np.array([[4, 40, 200]], np.uint8))[0].astype(int)
    assert space.max() == 0
    assert sea[0] > 2 * sea[2]
    assert np.ptp(cloud) < 5
