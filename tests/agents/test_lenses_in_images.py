# SPDX-License-Identifier: Apache-2.0
"""Strong lenses: markers are found where projection says, and poses are as accurate as their
covariance says.
"""

import cv2
import numpy as np
import pytest
from chaserdock_agents.chaser.perception import Perception, corners, detect
from chaserdock_agents.chaser.perception.lens import LEAST_STRETCH, MarkerFrames
from chaserdock_agents.chaser.perception.pnp import MarkerTable
from chaserdock_agents.chaser.perception.statistical import StatisticalPerception
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import target_model
from chaserdock_protocol.pose_image import encode_pose
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.mesh_renderer import MeshRenderer, mesh_of_boxes
from chaserdock_world.rendering.rasterizer import Renderer

RATIONAL = (0.41, -0.13, 8e-4, -6e-4, -0.012, 0.72, -0.09, -0.03)
TILTED = (
    0.22,
    -0.03,
    8e-4,
    -6e-4,
    0.004,
    0.41,
    0.012,
    0.003,
    9e-4,
    -4e-4,
    -7e-4,
    3e-4,
    0.03,
    -0.02,
)
FISHEYE = (-0.0023, 0.0412, -0.0387, 0.0067)
LENSES = {
    "rational": Camera(640, 480, 480.0, 471.0, 322.7, 236.2, RATIONAL),
    "tilted": Camera(640, 480, 520.0, 508.0, 322.7, 236.2, TILTED),
    "wide angle": Camera(
        640, 360, 319.56, 319.56, 320.0, 180.0, (-0.2535, 0.0924, -6e-4, 7e-4, -0.0191)
    ),
    "fisheye": Camera(640, 480, 285.1, 279.3, 318.2, 243.9, FISHEYE, lens_model="equidistant"),
}
MODEL = target_model("servicer")


def views(camera, count, low, high, seed=3):
    """Poses that lie ``low`` to ``high`` of the way from the middle of the image to its border."""
    rng = np.random.default_rng(seed)
    half = 0.5 * np.array([camera.width_px, camera.height_px])
    for _ in range(count):
        turn, share = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(low, high)
        px = half * (1.0 + share * np.array([np.cos(turn), np.sin(turn)])) - 0.5
        ray = np.append(camera.normalized(camera.undistort(px)), 1.0)
        position = ray / np.linalg.norm(ray) * rng.uniform(0.8, 1.5)
        light = rotations.rotate(rotations.normalize(rng.normal(size=4)), [0.0, 0.0, 1.0])
        yield position, rotations.normalize(rng.normal(size=4)), Light(tuple(light))


def corners_px(camera, marker, position, q):
    """Project the corners of a marker."""
    known = MODEL.marker(marker)
    assert known is not None
    return camera.project(rotations.rotate(q, known.corners_trf_m()) + position)


def error_of(solutions, position, q):
    """The error (6,) of the solution with the better attitude, and its covariance."""
    errors = [
        np.concatenate([
            position - s.position_irf_m,
            rotations.log(rotations.multiply(rotations.conjugate(s.q_irf_trf_wxyz), q)),
        ])
        for s in solutions
    ]  # fmt: skip
    k = int(np.argmin([np.linalg.norm(e[3:]) for e in errors]))
    return errors[k], solutions[k].covariance


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("place", [(0.0, 0.3), (0.5, 0.8)], ids=["middle", "border"])
def test_markers_are_where_projection_says_and_poses_as_good_as_stated(camera, place):
    renderer = Renderer(camera, MODEL, None, Effects().point_spread_px)
    effects = CameraEffects(camera.width_px, camera.height_px, Effects(), 11)
    perception = Perception(camera, MODEL)
    corner_errors, nees, far = [], [], []
    for number, (position, q, light) in enumerate(views(camera, 12, *place)):
        exact = renderer.render(np.zeros(3), rotations.IDENTITY, position, q, (), light)
        found = perception.estimate(effects.apply(exact, 0, number))
        assert found.solutions
        for marker, px in zip(found.marker_ids.tolist(), found.corners_px, strict=True):
            corner_errors.append(px - corners_px(camera, marker, position, q))
        error, covariance = error_of(found.solutions, position, q)
        nees.append(error @ np.linalg.solve(covariance, error))
        far.append(np.linalg.norm(error[:3]))
    # A plain camera of 285 px: median 0.016 px, poses 0.1 mm; NEES 5. Mild distortion is drawn by
    # resampling the image, which moves edges by 0.01 px more.
    assert np.median(np.abs(corner_errors)) < 0.04
    assert np.median(far) < 0.8e-3
    assert 1.0 < np.median(nees) < 12.0


def largest_shape(image):
    """Area and centroid of the largest connected part that is brighter than space."""
    _, _, stats, centroids = cv2.connectedComponentsWithStats((image > 8).astype(np.uint8))
    k = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return float(stats[k, cv2.CC_STAT_AREA]), centroids[k]


def test_mesh_and_boxes_are_drawn_through_the_same_lens():
    camera, model = LENSES["fisheye"], target_model("paper")
    both = (Renderer(camera, model), MeshRenderer(camera, mesh_of_boxes(model.boxes)))
    everywhere = Light((0.0, 0.0, -1.0), 0.0, 1.0)
    for position, q, _ in views(camera, 2, 0.4, 0.8):
        pose = (np.zeros(3), rotations.IDENTITY, 0.4 * position, q, (), everywhere)
        (area, centre), (other_area, other) = (largest_shape(r.render(*pose)) for r in both)
        assert np.abs(centre - other).max() < 0.5
        assert area == pytest.approx(other_area, rel=0.03)


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_statistical_perception_sees_what_is_in_the_image(camera):
    """Markers near the border of a fisheye's image lie far outside of an ideal image."""
    perception = StatisticalPerception(camera, MODEL)
    nees, beyond = [], 0
    for number, (position, q, _) in enumerate(views(camera, 60, 0.3, 0.75)):
        image = np.frombuffer(encode_pose(position, q, (7, number)), np.uint8).reshape(1, -1)
        found = perception.estimate(image)
        assert found.solutions
        px = found.corners_px
        assert np.all((px >= 2.0) & (px <= (camera.width_px - 3.0, camera.height_px - 3.0)))
        truth = [corners_px(camera, int(m), position, q) for m in found.marker_ids]
        assert np.abs(px - truth).max() < 1e-6
        ideal = camera.undistort(px)
        beyond += bool(np.any((ideal < 0.0) | (ideal > (camera.width_px, camera.height_px))))
        error, covariance = error_of(found.solutions, position, q)
        nees.append(error @ np.linalg.solve(covariance, error))
    assert 4.5 < np.mean(nees) < 7.5
    assert beyond > 0


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_frames_keep_corners_and_have_the_scale_of_the_image(camera):
    centres = camera.undistort(np.array([[330.0, 200.0], [60.0, 60.0], [560.0, 290.0]]))
    square = np.array([[-3.0, 3.0], [3.0, 3.0], [3.0, -3.0], [-3.0, -3.0]])
    corners = centres[:, None] + square
    frames = MarkerFrames.of(camera, corners)
    assert frames.framed[1] == (camera is not LENSES["tilted"])
    assert np.allclose(frames.out_of(frames.into(corners)), corners, atol=1e-9)
    for k in np.flatnonzero(frames.framed):
        ahead = np.linalg.inv(frames.to_ray[k]) @ np.append(camera.normalized(centres[k]), 1.0)
        assert np.allclose(ahead[:2], 0.0, atol=1e-9)
        steps = np.array([[0.5, 0.0, 1.0], [-0.5, 0.0, 1.0], [0.0, 0.5, 1.0], [0.0, -0.5, 1.0]])
        px = camera.project(steps @ frames.to_ray[k].T)
        assert np.allclose([px[0] - px[1], px[2] - px[3]], np.eye(2), atol=1e-3)


def test_corners_are_as_uncertain_as_the_lens_stretches_them():
    """Whitened errors of corners, in ideal pixels, near the border of a fisheye's image."""
    camera = LENSES["fisheye"]
    renderer = Renderer(camera, MODEL, None, Effects().point_spread_px)
    effects = CameraEffects(camera.width_px, camera.height_px, Effects(), 11)
    table, cells = MarkerTable.of(MODEL), detect.dictionary_of(MODEL.dictionary).markerSize + 2
    perception, squares = Perception(camera, MODEL), []
    for number, (position, q, light) in enumerate(views(camera, 4, 0.75, 0.8)):
        exact = renderer.render(np.zeros(3), rotations.IDENTITY, position, q, (), light)
        image = effects.apply(exact, 0, number)
        rows = np.searchsorted(table.ids, perception.estimate(image).marker_ids)
        at = [corners_px(camera, int(m), position, q) for m in table.ids[rows]]
        truth = camera.undistort(np.array(at))
        found = corners.refine(
            image, camera, truth, cells, table.margin_share[rows], table.outlined[rows]
        )
        strong = found.good & (camera.stretch(truth.mean(axis=1)) > 1.2 * LEAST_STRETCH)
        off = (found.corners_px - truth)[strong].reshape(-1, 8, 1)
        squares += np.square(found.errors.whitening[strong] @ off).ravel().tolist()
    assert len(squares) > 60
    assert 0.1 < np.median(squares) < 0.8  # 0.45 of a normal distribution


def test_whitened_errors_do_not_depend_on_coordinates():
    camera = LENSES["fisheye"]
    square = np.array([[-3.0, 3.0], [3.0, 3.0], [3.0, -3.0], [-3.0, -3.0]])
    ideal = camera.undistort(np.array([[330.0, 200.0], [60.0, 60.0]]))[:, None] + square
    frames, rng = MarkerFrames.of(camera, ideal), np.random.default_rng(3)
    moved = ideal + 1e-4 * rng.normal(size=ideal.shape)
    white, at = rng.normal(size=(2, 8, 8)), frames.into(ideal)
    in_frame = white @ (frames.into(moved) - at).reshape(2, 8, 1)
    outside = frames.whitening_of(white, at) @ (moved - ideal).reshape(2, 8, 1)
    assert np.allclose(in_frame, outside, rtol=1e-3, atol=1e-7)
