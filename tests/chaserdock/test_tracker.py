# SPDX-License-Identifier: Apache-2.0
"""Tracker: poses of printed sheets in photographs by an independent renderer, and its input."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import TargetPose
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import target_model
from chaserdock_world.rendering.background import Light
from markerless_cases import satellite_image
from numpy.typing import NDArray
from sheet_views import Lens, Photograph, printed, random_view, rotation_of, sheet_target

import chaserdock as cd
from chaserdock.analysis.pose_errors import normalized_square, pose_error
from chaserdock.tracking.motion import ConstantVelocity

SMALL = Lens(640, 480, 600.0, 598.0, 322.3, 237.1, samples=3)
PAPER = target_model("paper")


def errors_of(lens: Lens, number: int, photo: Photograph) -> tuple[NDArray, NDArray, int]:
    """Return the pose errors (n, 6), m and rad, and NEES (n,) of views at 1 m, and the number of
    those without a pose.
    """
    sheet = printed(PAPER)
    tracker = cd.Tracker(lens.camera(), sheet_target(PAPER, sheet))
    rng = np.random.default_rng(17)
    errors, squares = [], []
    for _ in range(number):
        position, rotation = random_view(rng, lens, 1.0, math.radians(50.0), 0.15)
        image = photo.of(sheet, position, rotation, rng)
        tracker.reset()
        pose = tracker.track(image, 0).pose
        if pose is not None:
            true = position, rotations.from_matrix(rotation)
            errors.append(pose_error(*true, pose.position_m, pose.q_wxyz))
            squares.append(float(normalized_square(errors[-1], pose.covariance)))
    return np.array(errors), np.array(squares), number - len(errors)


@pytest.mark.slow(1)
def test_views_of_a_sheet_at_one_metre() -> None:
    """None lost, none false; errors and their covariance as docs/evidence/cameras.md states of
    200 views.
    """
    lens = Lens()
    errors, squares, lost = errors_of(lens, 30, Photograph(lens))
    away, turned = (np.linalg.norm(e, axis=1) for e in (errors[:, :3], errors[:, 3:]))
    assert lost == 0
    assert away.max() < 1e-3
    assert turned.max() < math.radians(0.5)
    assert np.median(away) <= 1e-4
    assert np.median(turned) <= math.radians(0.02)
    assert 3.5 < squares.mean() < 7.5  # six are expected


@pytest.mark.slow(1)
def test_small_images_are_as_accurate_as_their_covariance_says() -> None:
    lens = replace(SMALL, samples=6)
    errors, squares, lost = errors_of(lens, 20, Photograph(lens))
    assert lost == 0
    assert np.median(np.linalg.norm(errors[:, :3], axis=1)) < 4e-4
    assert 3.0 < squares.mean() < 9.0  # of twenty views


@pytest.fixture(scope="module")
def view() -> tuple[NDArray[np.uint8], NDArray, NDArray]:
    """Image of the sheet, position and rotation."""
    position = np.array([0.02, -0.01, 0.6])
    rotation = rotation_of([0.3, -0.4, 0.2]) @ np.diag([1.0, -1.0, -1.0])
    image = Photograph(SMALL).of(printed(PAPER), position, rotation, np.random.default_rng(3))
    return image, position, rotation


@pytest.fixture(scope="module")
def tracker() -> cd.Tracker:
    return cd.Tracker(SMALL.camera(), {0: 0.09, 1: 0.09}, dictionary=PAPER.dictionary)


def test_each_marker_has_its_own_pose(
    view: tuple[NDArray[np.uint8], NDArray, NDArray], tracker: cd.Tracker
) -> None:
    image, position, rotation = view
    tracker.reset()
    seen = tracker.track(image, 0)
    assert [t.name for t in seen.targets] == ["marker-0", "marker-1"]
    width, height = printed(PAPER).sheet.size_mm
    for target, (marker, x, y) in zip(seen.targets, printed(PAPER).sheet.markers, strict=True):
        assert target.marker_ids.tolist() == [marker.id]
        assert target.pose is not None
        centre = rotation @ [1e-3 * (x - width / 2), 1e-3 * (height / 2 - y), 0.0] + position
        np.testing.assert_allclose(target.pose.position_m, centre, atol=1e-3)
        turned = rotations.angle_between(target.pose.q_wxyz, rotations.from_matrix(rotation))
        assert float(turned) < math.radians(1.0)
        assert 0.0 < target.pose.sigma_m < 2e-3
        assert target.pose.residual_px < 0.3


def test_colour_and_grey_give_the_same_pose(
    view: tuple[NDArray[np.uint8], NDArray, NDArray], tracker: cd.Tracker
) -> None:
    image, _, _ = view
    poses = []
    for form in (image, image[..., None], np.repeat(image[..., None], 3, axis=2)):
        tracker.reset()
        pose = tracker.track(form, 0).pose
        assert pose is not None
        poses.append(pose.position_m)
    np.testing.assert_array_equal(poses[0], poses[1])
    np.testing.assert_allclose(poses[0], poses[2], atol=1e-9)


def test_an_image_without_the_target_is_lost(tracker: cd.Tracker) -> None:
    seen = tracker.track(np.full((480, 640), 90, np.uint8), 5)
    assert (seen.time_ns, seen.pose) == (5, None)
    assert {t.status for t in seen.targets} == {"lost"}


@pytest.mark.parametrize(
    ("image", "text"),
    [
        (np.zeros((720, 1280), np.uint8), "1280 x 720 pixels, the camera is calibrated for 640 x"),
        (np.zeros((480, 640)), "must be an array of uint8, not float64"),
        (np.zeros((480, 640, 4), np.uint8), r"must be \(h, w\) or \(h, w, 3\)"),
        (None, "not NoneType"),
    ],
)
def test_images_that_are_not_of_the_camera_are_refused(
    image: NDArray, text: str, tracker: cd.Tracker
) -> None:
    with pytest.raises(cd.ChaserdockError, match=text):
        tracker.track(image, 0)


CAMERA = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)


@pytest.mark.parametrize(
    ("target", "options", "text"),
    [
        ({}, {}, "no markers given"),
        ({70: 0.1}, {}, "marker 70: DICT_4X4_50 has 0 to 49"),
        ({1: -0.1}, {}, "its side must be positive"),
        ({1: 0.1}, {"margin_m": 0.0}, "white border must be positive"),
        ({1: 0.1}, {"dictionary": "DICT_X"}, "unknown ArUco dictionary"),
        ({1: 0.1}, {"perception": "model"}, "must be one of default, paper"),
        ("nothing", {}, "unknown target 'nothing'; known: client"),
        ("nothing.toml", {}, r"nothing\.toml: cannot be read"),
        ("nothing.stl", {}, r"nothing\.stl"),
        ("cubesat_12u", {"perception": "default"}, "needs markers, and cubesat_12u has none"),
        ("paper", {"perception": "statistical"}, "needs no images"),
        ("paper", {"perception": "mine"}, "perception 'mine' is unknown"),
    ],
)
def test_targets_that_cannot_be_tracked_are_refused(
    target: object, options: dict, text: str
) -> None:
    with pytest.raises(cd.ChaserdockError, match=text):
        cd.Tracker(CAMERA, target, **options)  # type: ignore[arg-type]


def test_a_calibration_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(cd.ScenarioError, match=r"none\.yaml: no such calibration file"):
        cd.Tracker(tmp_path / "none.yaml", "paper")


def test_a_target_file_gives_its_markers(tmp_path: Path) -> None:
    (tmp_path / "t.toml").write_text(
        'dictionary = "DICT_5X5_50"\n[[cuboids]]\nsize_m = [0.1, 0.1, 0.2]\n'
        '[[markers]]\nid = 3\nside_m = 0.09\nface = "+x"\n'
    )
    tracker = cd.Tracker(CAMERA, tmp_path / "t.toml")
    assert tracker.names == ("t",)
    assert [m.id for m in tracker.models[0].markers] == [3]


# -- Motion ----------------------------------------------------------------------------------------


def pose_of(t_s: float, rms_px: float = 0.1, flipped: bool = False) -> TargetPose:
    """A target that moves and turns about an oblique axis at constant rates."""
    turn = rotations.exp(np.array([0.2, -0.5, 0.3]) * t_s)
    q = rotations.multiply(turn, rotations.exp([0.4, 0.3, -0.7]))
    if flipped:
        q = rotations.multiply(q, rotations.exp([0.9, 0.0, 0.0]))
    position = np.array([0.1, -0.2, 1.5]) + np.array([0.05, 0.03, -0.08]) * t_s
    return TargetPose(position, q, np.eye(6), rms_px)


def test_a_target_is_expected_at_constant_velocity() -> None:
    motion = ConstantVelocity()
    motion.take(1_000_000_000, (pose_of(0.0),))
    first = motion.predicted(1_100_000_000)
    assert first is not None
    np.testing.assert_allclose(first[0], pose_of(0.0).position_irf_m)
    motion.take(1_100_000_000, (pose_of(0.1),))
    found = motion.predicted(1_350_000_000)
    assert found is not None
    np.testing.assert_allclose(found[0], pose_of(0.35).position_irf_m, atol=1e-12)
    assert float(rotations.angle_between(found[1], pose_of(0.35).q_irf_trf_wxyz)) < 1e-6


@pytest.mark.parametrize("time_ns", [999_999_999, 1_000_000_000, 1_600_000_000])
def test_nothing_is_expected_before_or_long_after_a_pose(time_ns: int) -> None:
    motion = ConstantVelocity()
    motion.take(1_000_000_000, (pose_of(0.0),))
    assert motion.predicted(time_ns) is None


def test_a_single_better_fit_does_not_turn_an_ambiguous_target() -> None:
    motion = ConstantVelocity()
    for k in range(8):
        right, wrong = pose_of(0.1 * k, 0.10), pose_of(0.1 * k, 0.12, flipped=True)
        motion.take(k * 100_000_000 + 1, (right, wrong))
    right, wrong = pose_of(0.8, 0.11), pose_of(0.8, 0.10, flipped=True)
    assert motion.take(800_000_001, (wrong, right)) == (right, wrong)
    later = ConstantVelocity()
    assert later.take(800_000_001, (right, wrong)) == (wrong, right)


# -- Shapes ----------------------------------------------------------------------------------------


@pytest.mark.slow(1)
def test_a_target_without_markers_is_tracked_by_its_shape(tmp_path: Path) -> None:
    """At the first image of a recording, and over several images of a camera."""
    camera = Camera.from_hfov(960, 540, math.radians(60.0))
    shape, light = rotations.exp([0.5, 0.8, -0.3]), Light((-0.4, -0.5, -0.8))
    true = PoseInCamera(np.array([0.05, -0.04, 1.6]), rotations.to_matrix(shape))
    tracker = cd.Tracker(camera, "geo_servicer")
    image = satellite_image(true, light, 0)
    pose = tracker.track(image, 0).pose
    assert pose is not None
    assert np.linalg.norm(pose.position_m - true.position) < 0.01
    assert float(rotations.angle_between(pose.q_wxyz, shape)) < math.radians(1.0)

    live = cd.Tracker(camera, "geo_servicer", live=True)
    states = []
    for k in range(200):
        seen = live.track(image, 33_000_000 * k)
        states.append(seen.targets[0].status)
        if seen.pose is not None:
            break
    assert states[0] == "searching"
    assert states[-1] == "tracked"
