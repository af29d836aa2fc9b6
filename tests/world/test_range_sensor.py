# SPDX-License-Identifier: Apache-2.0
"""The range sensor beside rendered images: its measurement, and when a chaser uses it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.sighting import look
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.codec import without_wall_time
from chaserdock_protocol.messages import Image
from chaserdock_protocol.scenario import Scenario, flight_scenario, parse_scenario
from chaserdock_world.rendering.cameras import Cameras, States
from chaserdock_world.rendering.pose_cameras import RangingCameras, make_cameras

CAMERA = {"width_px": 960, "height_px": 540, "position_m": [0.0, 0.0, 0.0]}


def scenario(**changes: Any) -> Scenario:
    values = {
        "name": "range",
        "duration_s": 10.0,
        "target": {"model": "servicer", "motion": "static"},
        "navigation": {"grade": "exact"},
        "camera": CAMERA,
        "ranging": {},
        "limits": {"max_reference_distance_m": 2000.0},
        "chasers": [{"position_m": [-200.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return parse_scenario(values | changes, "test")


def states(offset_m: tuple[float, float, float]) -> States:
    """Return target and chaser, which looks along +X of WRF at an offset from the target."""
    zero, still = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    return {
        "target": BodyState(zero, zero, still, zero),
        "chaser/0": BodyState(np.array(offset_m), zero, still, zero),
    }


def image(offset_m: tuple[float, float, float], number: int = 0, **changes: Any) -> Image:
    return make_cameras(scenario(**changes)).image(0, number, number, 0, states(offset_m))


def test_images_have_a_measurement_with_the_stated_errors_where_the_target_is_in_reach_and_in_view() -> None:
    cameras, flown = make_cameras(scenario()), states((-150.0, 3.0, -2.0))
    assert isinstance(cameras, RangingCameras)
    camera, errors, covariance = scenario().camera_model(), [], np.eye(6)
    eye, attitude = camera.irf_pose_in_world(
        *(getattr(flown["chaser/0"], k) for k in ("position_m", "q_wxyz"))
    )
    true_m, true_q = rotations.rotate_inverse(attitude, -eye), rotations.conjugate(attitude)
    pixels = Cameras(scenario()).image(0, 0, 0, 0, flown)
    for number in range(200):
        # The measurement alone is drawn anew; rendering each image would tell nothing more.
        found = cameras._ranged(pixels, number, flown).ranging  # type: ignore[union-attr]
        assert found is not None
        turn = rotations.log(rotations.multiply(rotations.conjugate(true_q), found.q_wxyz))
        errors.append(np.concatenate([np.array(found.position_m) - true_m, turn]))
        covariance = np.array(found.covariance).reshape(6, 6)
    squared = np.einsum("ki,ij,kj->k", np.array(errors), np.linalg.inv(covariance), np.array(errors))
    assert np.mean(squared) == pytest.approx(6.0, abs=0.75)
    assert math.sqrt(covariance[2, 2]) == pytest.approx(math.hypot(0.02, 1e-4 * 150.0), rel=0.01)
    assert math.sqrt(covariance[0, 0]) == pytest.approx(math.radians(0.005) * 150.0, rel=0.01)
    for hidden in ((-1500.0, 0.0, 0.0), (50.0, 0.0, 0.0), (-150.0, 150.0, 0.0)):
        assert cameras.image(0, 0, 0, 0, states(hidden)).ranging is None


def test_measurement_is_drawn_from_seed_chaser_and_number_only() -> None:
    assert image((-50.0, 0.0, 0.0)) == image((-50.0, 0.0, 0.0))
    assert image((-50.0, 0.0, 0.0)).ranging != image((-50.0, 0.0, 0.0), number=1).ranging
    assert image((-50.0, 0.0, 0.0)).ranging != image((-50.0, 0.0, 0.0), seed=1).ranging


def test_chaser_measures_by_ranging_far_away_and_by_markers_nearby() -> None:
    perception = make_perception(flight_scenario(scenario()))
    far = image((-50.0, 0.2, -0.1))
    sighting = look(perception, far, None)
    assert (sighting.status, sighting.marker_ids, sighting.solutions) == ("seen", (), (far.ranging,))
    near = image((-1.5, 0.0, 0.0))
    assert near.ranging is not None
    sighting = look(perception, near, None)
    assert sighting.marker_ids
    assert near.ranging not in sighting.solutions
    assert look(perception, image((-50.0, 0.2, -0.1), ranging=None), None).status == "nothing"


def test_images_without_ranging_are_those_of_before_and_keep_their_digest() -> None:
    plain = image((-1.5, 0.0, 0.0), ranging=None)
    assert isinstance(make_cameras(scenario(ranging=None)), Cameras)
    assert "ranging" not in without_wall_time(plain)
    assert "ranging" in without_wall_time(image((-1.5, 0.0, 0.0)))
    assert image((-1.5, 0.0, 0.0)).data == plain.data
