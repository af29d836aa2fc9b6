# SPDX-License-Identifier: Apache-2.0
"""Points on what moves in front of a background."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from chaserdock_agents.chaser.perception.features import (
    FeatureTracker,
    KnownTarget,
    TrackedPoints,
    TrackingTuning,
    describe,
)
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.pose_image import UnusableImage
from numpy.typing import ArrayLike, NDArray

CAMERA = Camera.from_hfov(320, 240, np.deg2rad(60.0))
TUNING = TrackingTuning(most_points=60)
RANGE_M = 2.0


def plate(turn_rad: float, shift_px: float = 0.0) -> NDArray[np.uint8]:
    """Return an image of a textured plate, turned and shifted, over a limb and stars."""
    rng = np.random.default_rng(5)
    sky = np.full((240, 320), 8, np.uint8)
    sky[:, 230:] = 60
    for x, y in rng.integers(10, 220, (12, 2)):
        cv2.circle(sky, (int(x), int(y)), 1, 200, -1)
    texture = cv2.resize(rng.integers(40, 220, (16, 16)).astype(np.uint8), (100, 100))
    matrix = cv2.getRotationMatrix2D((50, 50), np.rad2deg(turn_rad), 1.0)
    matrix[:, 2] += (90 + shift_px, 70)
    inside = cv2.warpAffine(np.full((100, 100), 255, np.uint8), matrix, (320, 240))
    moved = cv2.warpAffine(texture, matrix, (320, 240), flags=cv2.INTER_LINEAR)
    return np.where(inside > 128, moved, sky).astype(np.uint8)


def tracked(shifts_px: list[float], known: KnownTarget | None = None) -> list[TrackedPoints]:
    tracker = FeatureTracker(CAMERA, TUNING)
    return [
        tracker.track(plate(0.0, s), 0.2 * k, np.zeros(3), rotations.IDENTITY, known)
        for k, s in enumerate(shifts_px)
    ]


def test_only_what_moves_is_published() -> None:
    points = tracked([2.0 * k for k in range(12)])[-1]
    assert len(points.ids) > 20
    x, y = (points.px - (90 + 22, 70)).T
    assert ((x > -4) & (x < 104) & (y > -4) & (y < 104)).mean() > 0.95


def test_a_scene_that_stands_still_gives_no_points() -> None:
    assert all(len(points.ids) == 0 for points in tracked([0.0] * 40))


def test_tracks_follow_the_motion_and_are_bounded() -> None:
    images = tracked([2.0 * k for k in range(20)])
    assert all(len(points.ids) <= TUNING.most_points for points in images)
    a, b = images[10], images[18]
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    moved = b.px[j] - a.px[i]
    assert len(moved) > 15
    assert np.median(np.abs(moved - (16.0, 0.0))) < 0.1


def test_equal_images_give_equal_points() -> None:
    one, other = (tracked([1.5 * k for k in range(12)])[-1] for _ in range(2))
    assert np.array_equal(one.ids, other.ids)
    assert np.array_equal(one.px, other.px)


def test_excluded_discs_hold_no_points() -> None:
    tracker = FeatureTracker(CAMERA, TUNING)
    disc = (150.0, 120.0, 40.0)
    points = [
        tracker.track(plate(0.0, 2.0 * k), 0.2 * k, np.zeros(3), rotations.IDENTITY, None, [disc])
        for k in range(10)
    ][-1]
    assert len(points.ids) > 5
    assert (np.linalg.norm(points.px - disc[:2], axis=1) > 39.0).all()


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(UnusableImage, match="expected a uint8 image"):
        FeatureTracker(CAMERA).track(
            np.zeros((10, 10), np.uint8), 0.0, np.zeros(3), rotations.IDENTITY
        )


class Swinging:
    """A plate at 2 m that moves to the side and back."""

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        times = np.asarray(time_s, dtype=float)
        x = np.array([shift_at(t) for t in times]) * RANGE_M / CAMERA.fx_px
        place = np.column_stack([x, np.zeros(len(x)), np.full(len(x), RANGE_M)])
        return place, np.repeat(np.eye(3)[None], len(x), axis=0)


def shift_at(time_s: float) -> float:
    """Return the shift, px: to the side within 4 s, away from the image's side for 10 s, back."""
    return 10.0 * min(time_s, 4.0) if time_s < 14.0 else 40.0 - 10.0 * (time_s - 14.0)


def test_points_are_found_again_under_their_old_ids() -> None:
    tracker = FeatureTracker(CAMERA, TUNING)
    motion, first, points = Swinging(), None, None
    for k in range(90):
        at_s = 0.2 * k
        hidden = 5.0 < at_s < 15.0
        image = np.full((240, 320), 8, np.uint8) if hidden else plate(0.0, shift_at(at_s))
        known = None
        if first is not None:
            place = motion.at([first[0]])[0][0]
            rays = CAMERA.normalized(first[1].px)
            known = KnownTarget(
                motion, first[1].ids, np.column_stack([rays, np.ones(len(rays))]) * RANGE_M - place
            )
        points = tracker.track(image, at_s, np.zeros(3), rotations.IDENTITY, known)
        if first is None and len(points.ids) > 30 and at_s > 1.5:
            first = (at_s, points)
    assert first is not None
    assert points is not None
    again, i, j = np.intersect1d(first[1].ids, points.ids, return_indices=True)
    assert len(again) > 10
    moved = points.px[j] - first[1].px[i]
    expected = shift_at(0.2 * 89) - shift_at(first[0])
    assert np.median(np.abs(moved - (expected, 0.0))) < 0.3


def test_descriptions_turn_with_the_target() -> None:
    px = np.array([[140.0, 120.0], [120.0, 100.0], [150.0, 95.0]])
    ids = np.arange(3)
    turn = 0.4
    matrix = rotations.to_matrix(rotations.exp(np.array([0.0, 0.0, -turn])))
    centre = np.array([140.0, 120.0])
    turned = (px - centre) @ matrix[:2, :2].T + centre
    place = np.array([0.0, 0.0, RANGE_M])
    before = describe(plate(0.0), CAMERA, ids, px, PoseInCamera(place, np.eye(3)))
    after = describe(plate(turn), CAMERA, ids, turned, PoseInCamera(place, matrix))
    a, b = before.values.astype(float) / 512.0, after.values.astype(float) / 512.0
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    assert (np.diag(distance) < 0.4).all()
    assert (np.argmin(distance, axis=1) == ids).all()
