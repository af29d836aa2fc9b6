# SPDX-License-Identifier: Apache-2.0
"""Bodies with meshes in the outside view of films."""

from pathlib import Path

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import load_scenario

from chaserdock.analysis.body_renderer import BodyRenderer
from chaserdock.analysis.chase_camera import Viewpoint

COLOURS = {0: np.array([40.0, 40.0, 250.0]), 1: np.array([250.0, 40.0, 40.0])}


def test_each_chaser_has_its_colour_and_the_target_is_grey() -> None:
    scenario = load_scenario(Path(__file__).parents[2] / "scenarios/markerless-docking.toml")
    mesh = scenario.target.nominal_mesh()
    assert mesh is not None
    look = Viewpoint(np.zeros(3), 5.0, -0.9, 0.45, 320, 240)
    places = {0: np.array([-1.4, 0.0, 0.0]), 1: np.array([1.4, 0.0, 0.0])}
    chasers = {i: (p, rotations.IDENTITY) for i, p in places.items()}
    target = (np.zeros(3), rotations.IDENTITY)
    found = BodyRenderer(scenario, mesh, look).render(look, target, chasers, lambda i: COLOURS[i])

    def beside(point_m: Array) -> Array:
        """Return the mean colour (3,) of the covered pixels near a point."""
        x, y = np.round(look.project(point_m)[0]).astype(int)
        near = np.s_[y - 6 : y + 7, x - 6 : x + 7]
        assert found.covered[near].sum() > 20
        return found.bgr[near][found.covered[near]].mean(axis=0)

    grey = beside(np.zeros(3))
    assert np.ptp(grey) < 2.0
    assert grey.mean() > 20.0
    for i, place in places.items():
        assert int(np.argmax(beside(place))) == int(np.argmax(COLOURS[i]))
        assert np.ptp(beside(place)) > 15.0
    assert 0.01 < found.covered.mean() < 0.2
