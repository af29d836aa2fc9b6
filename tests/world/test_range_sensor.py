# SPDX-License-Identifier: Apache-2.0
"""The range sensor beside rendered images, and the bearing that a chaser measures in these."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_agents.chaser.perception import (
    BearingError,
    BearingFinder,
    FarPerception,
    RangedTarget,
    make_perception,
)
from chaserdock_agents.chaser.sighting import decode_image, look
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import Box
from chaserdock_protocol.codec import without_wall_time
from chaserdock_protocol.messages import Image
from chaserdock_protocol.scenario import Scenario, flight_scenario, parse_scenario
from chaserdock_world.rendering.cameras import Cameras, States
from chaserdock_world.rendering.pose_cameras import RangingCameras, make_cameras

CAMERA = {"width_px": 960, "height_px": 540}


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


def true_pose(flown: States) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of the target in the camera of chaser 0."""
    own, target = flown["chaser/0"], flown["target"]
    eye, attitude = scenario().camera_model().irf_pose_in_world(own.position_m, own.q_wxyz)
    q = rotations.multiply(rotations.conjugate(attitude), target.q_wxyz)
    return rotations.rotate_inverse(attitude, target.position_m - eye), q


def test_images_within_reach_and_view_have_a_range_and_an_attitude_with_the_stated_errors() -> None:
    cameras, flown = make_cameras(scenario()), states((-150.0, 3.0, -2.0))
    assert isinstance(cameras, RangingCameras)
    errors, true_m, true_q = [], *true_pose(flown)
    pixels = Cameras(scenario()).image(0, 0, 0, 0, flown)
    for number in range(200):
        # The measurement alone is drawn anew; rendering each image would tell nothing more.
        found = cameras._ranged(pixels, number, flown).ranging  # type: ignore[union-attr]
        assert found is not None
        turn = rotations.log(rotations.multiply(rotations.conjugate(true_q), found.q_wxyz))
        assert found.range_sigma_m == pytest.approx(math.hypot(0.02, 1e-4 * 150.0), rel=0.01)
        variances = np.diag(np.array(found.attitude_covariance_rad2).reshape(3, 3))
        assert np.sqrt(variances) == pytest.approx(np.full(3, math.radians(0.02)))
        of_range = (found.range_m - np.linalg.norm(true_m)) / found.range_sigma_m
        errors.append([of_range, *(turn / np.sqrt(variances))])
    assert np.mean(np.square(errors), axis=0) == pytest.approx(np.ones(4), abs=0.35)
    for hidden in ((-1500.0, 0.0, 0.0), (50.0, 0.0, 0.0), (-150.0, 150.0, 0.0)):
        assert cameras.image(0, 0, 0, 0, states(hidden)).ranging is None


def test_measurement_is_drawn_from_seed_chaser_and_number_only() -> None:
    assert image((-50.0, 0.0, 0.0)) == image((-50.0, 0.0, 0.0))
    assert image((-50.0, 0.0, 0.0)).ranging != image((-50.0, 0.0, 0.0), number=1).ranging
    assert image((-50.0, 0.0, 0.0)).ranging != image((-50.0, 0.0, 0.0), seed=1).ranging


def test_chaser_measures_by_ranging_far_away_and_by_markers_nearby() -> None:
    perception = make_perception(flight_scenario(scenario()))
    far = image((-50.0, 0.2, -0.1))
    assert far.ranging is not None
    sighting = look(perception, far, None)
    assert (sighting.status, sighting.marker_ids) == ("seen", ())
    (pose,) = sighting.solutions
    assert pose.q_wxyz == far.ranging.q_wxyz
    assert np.linalg.norm(pose.position_m) == pytest.approx(far.ranging.range_m)
    near = image((-1.5, 0.0, 0.0))
    assert near.ranging is not None
    sighting = look(perception, near, None)
    assert sighting.marker_ids
    assert near.ranging.q_wxyz != sighting.solutions[0].q_wxyz
    assert look(perception, image((-50.0, 0.2, -0.1), ranging=None), None).status == "nothing"


def test_of_bearing_and_markers_the_more_accurate_position_is_used() -> None:
    used: list[bool] = []
    for range_noise_m in (1e-3, 0.02):  # that of markers is 4 mm there
        ranging = {"range_noise_m": range_noise_m}
        perception = make_perception(flight_scenario(scenario(ranging=ranging)))
        assert isinstance(perception, FarPerception)
        taken = image((-6.5, 0.0, -0.05), ranging=ranging)
        (markers, *_) = perception.estimate(decode_image(taken)).solutions
        sighting = look(perception, taken, None)
        sigma = [
            math.sqrt(np.trace(np.reshape(c, (6, 6))[:3, :3]))
            for c in (markers.covariance, sighting.solutions[0].covariance)
        ]
        used.append(bool(sighting.marker_ids))
        assert sigma[1] <= sigma[0]
    assert used == [False, True]


@pytest.mark.slow
def test_bearing_is_measured_in_the_image_with_the_stated_errors() -> None:
    rng, squares = np.random.default_rng(24), []
    for sun in ([1.0, 0.3, 0.2], [-1.0, 0.3, 0.5], [0.0, 0.0, 1.0], [-0.2, 1.0, 0.1]):
        lit = scenario(
            camera=CAMERA | {"sun_direction": sun}, target={"model": "servicer", "motion": "static"}
        )
        cameras, perception = make_cameras(lit), make_perception(flight_scenario(lit))
        for k, metres in enumerate((9.0, 14.0, 25.0, 60.0, 100.0) * 3):
            flown = states((-metres, *(rng.uniform(-0.2, 0.2, 2) * metres).tolist()))
            turned = BodyState(
                np.zeros(3), np.zeros(3), rotations.normalize(rng.normal(size=4)), np.zeros(3)
            )
            flown["target"] = turned
            true_m, true_q = true_pose(flown)
            sighting = look(perception, cameras.image(0, k, k, 0, flown), (true_m, true_q))
            assert len(sighting.solutions) == 1, (sighting.detail, metres, sun)
            if sighting.marker_ids:
                continue
            (pose,) = sighting.solutions
            along = true_m / np.linalg.norm(true_m)
            basis = np.linalg.svd(along[None])[2][1:]
            error = basis @ (np.array(pose.position_m) - true_m)
            covariance = basis @ np.array(pose.covariance).reshape(6, 6)[:3, :3] @ basis.T
            squares.append(float(error @ np.linalg.solve(covariance, error)) / 2.0)
            # Less than half a pixel.
            assert np.linalg.norm(error) < 1.0 * metres / lit.camera_model().fx_px
    assert len(squares) > 50
    assert 0.5 < np.mean(squares) < 2.0
    assert max(squares) < 10.0


@pytest.mark.parametrize("range_m", [-1.0, 0.0, 0.3, 1e9, math.inf, math.nan])
def test_impossible_ranges_give_no_bearing(range_m: float) -> None:
    finder = BearingFinder(scenario().camera_model(), scenario().target_model())
    target = RangedTarget(range_m, 0.02, np.array([1.0, 0.0, 0.0, 0.0]), 1e-7 * np.eye(3))
    with pytest.raises(BearingError, match="too near or too far"):
        finder.find(decode_image(image((-20.0, 0.0, 0.0))), target)


@pytest.mark.parametrize("share", [0.5, 2.0])
def test_spot_of_another_size_is_not_the_target(share: float) -> None:
    perception, far = make_perception(flight_scenario(scenario())), image((-20.0, 0.2, -0.1))
    assert far.ranging is not None
    assert look(perception, far, None).status == "seen"
    other = msgspec.structs.replace(far.ranging, range_m=far.ranging.range_m * share)
    sighting = look(perception, msgspec.structs.replace(far, ranging=other), None)
    assert (sighting.status, sighting.solutions) == ("nothing", ())
    assert "no spot of the target's size" in sighting.detail


def test_target_at_the_border_or_hidden_and_stars_are_not_measured() -> None:
    perception, far = make_perception(flight_scenario(scenario())), image((-20.0, 0.0, 0.0))
    # The target is at the left border of the image; stars are all over it.
    edge = image((-20.0, 11.45, 0.0))
    assert edge.ranging is not None
    assert look(perception, edge, None).status == "nothing"
    away = image((20.0, 0.0, 0.0))
    sighting = look(perception, msgspec.structs.replace(away, ranging=far.ranging), None)
    assert (sighting.status, sighting.solutions) == ("nothing", ())


def test_first_sighting_of_a_spot_as_small_as_a_star_is_near_the_optical_axis() -> None:
    perception = make_perception(flight_scenario(scenario()))
    lit = CAMERA | {"sun_direction": [-1.0, 0.2, 0.2]}
    true_m, true_q = true_pose(states((-200.0, 30.0, 0.0)))
    aside = image((-200.0, 30.0, 0.0), camera=lit)
    detail = look(perception, aside, None).detail
    assert detail == "spots of the target's size may be stars, away from the optical axis"
    (pose,) = look(perception, aside, (true_m, true_q)).solutions
    assert np.linalg.norm(np.array(pose.position_m) - true_m) < 0.3
    (pose,) = look(perception, image((-200.0, 0.0, 0.0), camera=lit), None).solutions
    assert np.linalg.norm(pose.position_m - true_pose(states((-200.0, 0.0, 0.0)))[0]) < 0.3


# A face of 0.32 x 0.32 m of the servicer at this range is 10 pixels wide; +Y of TRF is to the
# right.
FACING = rotations.from_matrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]))
FACE_AT_M = scenario().camera_model().fx_px * 0.032


def test_origin_of_the_target_beside_its_silhouette_is_measured() -> None:
    camera, model = scenario().camera_model(), scenario().target_model()
    pixels = np.full((camera.height_px, camera.width_px), 4, dtype=np.uint8)
    pixels[200:210, 300:310] = 120
    beside = dataclasses.replace(model, boxes=(Box((0.4, 0.32, 0.32), (0.0, 0.16, 0.0)),))
    target = RangedTarget(FACE_AT_M, 0.02, FACING, 1e-7 * np.eye(3))
    found = BearingFinder(camera, beside).find(pixels, target)
    assert camera.project(found.position_irf_m) == pytest.approx([304.5 - 5.0, 204.5], abs=0.15)


def test_bright_spots_alike_are_told_apart_by_the_prediction_only() -> None:
    camera, rng = scenario().camera_model(), np.random.default_rng(3)
    pixels = np.clip(rng.normal(4.0, 1.5, (camera.height_px, camera.width_px)), 0, 255).astype(
        np.uint8
    )
    pixels[200:210, 300:310] = pixels[300:310, 600:610] = 120
    finder = BearingFinder(camera, scenario().target_model())
    target = RangedTarget(FACE_AT_M, 0.02, FACING, 1e-7 * np.eye(3))
    with pytest.raises(BearingError, match="2 spots of the target's size"):
        finder.find(pixels, target)
    for u, v in ((304.5, 204.5), (604.5, 304.5)):
        ray = np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0])
        found = finder.find(pixels, target, 25.0 * ray)
        assert camera.project(found.position_irf_m) == pytest.approx([u, v], abs=0.15)


def test_images_without_ranging_are_those_of_before_and_keep_their_digest() -> None:
    plain = image((-1.5, 0.0, 0.0), ranging=None)
    assert isinstance(make_cameras(scenario(ranging=None)), Cameras)
    assert "ranging" not in without_wall_time(plain)
    assert "ranging" in without_wall_time(image((-1.5, 0.0, 0.0)))
    assert image((-1.5, 0.0, 0.0)).data == plain.data
