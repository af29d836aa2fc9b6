# SPDX-License-Identifier: Apache-2.0
"""Small markers, markers at the border of the image, and those whose sides cannot be fitted."""

import dataclasses

import cv2
import numpy as np
import pytest
from chaserdock_agents.chaser.perception import Perception, corners, detect, pnp
from chaserdock_agents.chaser.perception.corners import CornerErrors
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel, target_model
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.rasterizer import Renderer

FACING = rotations.from_matrix(np.diag([1.0, -1.0, -1.0]))
HFOV = np.deg2rad(60.0)


class Scene:
    """A camera of 640 x 480, a target, and what perception makes of images of it."""

    def __init__(self, model: TargetModel):
        self.camera, self.model = Camera.from_hfov(640, 480, HFOV), model
        self.renderer = Renderer(self.camera, model, None, Effects().point_spread_px)
        self.effects = CameraEffects(640, 480, Effects(), 11)
        self.perception = Perception(self.camera, model)

    def image(self, position, q, number=0, light=(0.2, 0.3, -1.0)):
        exact = self.renderer.render(
            np.zeros(3), rotations.IDENTITY, position, q, (), Light(tuple(light))
        )
        return self.effects.apply(exact, 0, number)

    def random_views(self, count, near_m, far_m, seed):
        rng = np.random.default_rng(seed)
        for number in range(count):
            position = np.append(rng.uniform(-0.12, 0.12, 2), 1.0) * rng.uniform(near_m, far_m)
            q = rotations.normalize(rng.normal(size=4))
            yield position, q, self.image(position, q, number, rng.normal(size=3))

    def right_ids(self, image, position, q):
        """Return the ids that OpenCV's detector finds at the right place with its defaults."""
        dictionary = detect.dictionary_of(self.model.dictionary)
        found, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
        right = set()
        for px, number in zip(found, [] if ids is None else ids.ravel().tolist(), strict=True):
            marker = self.model.marker(number)
            if marker is not None:
                at = self.camera.project(rotations.rotate(q, marker.corners_trf_m()) + position)
                if np.abs(at - px[0]).max() < 5.0:
                    right.add(number)
        return right


def nees_of(solutions, position, q):
    squares = []
    for s in solutions:
        turn = rotations.log(rotations.multiply(rotations.conjugate(s.q_irf_trf_wxyz), q))
        error = np.concatenate([position - s.position_irf_m, turn])
        squares.append(float(error @ np.linalg.solve(s.covariance, error)))
    return min(squares)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "near_m", "far_m"),
    [("servicer", 0.4, 1.5), ("servicer", 1.5, 4.0), ("paper", 0.5, 2.5)],
)
def test_no_fewer_markers_than_by_the_detectors_defaults(name, near_m, far_m):
    scene = Scene(target_model(name))
    fewer = ours = theirs = 0
    for position, q, image in scene.random_views(30, near_m, far_m, 7):
        used = len(scene.perception.estimate(image).marker_ids)
        right = len(scene.right_ids(image, position, q))
        fewer, ours, theirs = fewer + (used < right), ours + used, theirs + right
    assert fewer <= 1
    assert ours >= theirs


def one_marker(share: float) -> TargetModel:
    """Return a cube with one marker of 9 cm and a white border of this share of it."""
    base = target_model("paper")
    marker, side_m = base.markers[0], base.markers[0].side_m
    size_m = (side_m * (1.0 + 2.0 * share) + 0.04,) * 3
    place = tuple((marker.normal_trf() * size_m[0] / 2.0).tolist())
    marker = dataclasses.replace(marker, position_trf_m=place)
    box = dataclasses.replace(base.boxes[0], size_m=size_m)
    return dataclasses.replace(
        base, boxes=(box,), size_m=size_m, markers=(marker,), white_margin_m=share * side_m
    )


@pytest.mark.parametrize("border_px", [6, 7, 9, 10, 11, 12])
def test_whole_marker_near_the_border_of_the_image_is_seen(border_px):
    scene = Scene(one_marker(0.06))
    marker = scene.model.markers[0]
    face = rotations.conjugate(np.array(marker.q_trf_marker_wxyz))
    q = rotations.multiply(rotations.multiply(rotations.exp([0.12, -0.2, 0.0]), FACING), face)
    position = np.array([0.0, 0.0, 0.5])
    for _ in range(30):
        px = scene.camera.project(rotations.rotate(q, marker.corners_trf_m()) + position)
        position[0] += (border_px - px[:, 0].min()) * position[2] / scene.camera.fx_px
    solutions = scene.perception.estimate(scene.image(position, q)).solutions
    assert solutions
    assert np.linalg.norm(solutions[0].position_irf_m - position) < 0.01


def test_two_detections_of_one_marker_do_not_contradict_each_other():
    """The contours of the marker and of its white border."""
    camera, model = Camera.from_hfov(640, 480, HFOV), target_model("paper")
    table = pnp.MarkerTable.of(model)
    q = rotations.multiply(rotations.exp([0.3, 0.2, 0.1]), FACING)
    row = int(np.argmin(rotations.rotate(q, table.normals)[:, 2]))
    position = np.array([0.05, -0.02, 0.8])
    px = camera.project_ideal(rotations.rotate(q, table.corners[row]) + position)
    outer = px.mean(axis=0) + 1.1 * (px - px.mean(axis=0))
    both, errors = np.array([px, outer]), CornerErrors.even(np.full(2, 0.1))
    solutions, used = pnp.solve(camera, table, np.array([row, row]), both, errors)
    assert solutions
    assert len(used) == 1
    apart = np.array([px, px + 150.0])
    assert pnp.solve(camera, table, np.array([row, row]), apart, errors)[0] == ()


def test_one_far_marker_always_lists_its_true_pose():
    scene, rng, seen = Scene(target_model("paper")), np.random.default_rng(5), 0
    for number in range(30):
        tilt = rotations.exp(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-3.0, 3.0)))
        face = rotations.conjugate(np.array(scene.model.markers[0].q_trf_marker_wxyz))
        q = rotations.multiply(rotations.multiply(tilt, FACING), face)
        position = np.array([0.03, -0.02, rng.uniform(2.0, 2.4)])
        image = scene.image(position, q, number, rng.normal(size=3) - (0.0, 0.0, 2.0))
        solutions = scene.perception.estimate(image).solutions
        if solutions:
            seen += 1
            assert nees_of(solutions, position, q) < 30.0
    assert seen >= 28


@pytest.mark.slow
def test_covariance_is_consistent_for_small_and_large_markers():
    """Sixty views of a kind, so that the mean of one scatters by a tenth and more."""
    means = []
    for name, near_m, far_m in (
        ("servicer", 0.5, 1.5), ("servicer", 2.5, 4.0), ("servicer", 4.0, 5.5),
        ("paper", 0.5, 1.5), ("paper", 1.5, 2.5),
    ):  # fmt: skip
        scene, squares = Scene(target_model(name)), []
        for position, q, image in scene.random_views(60, near_m, far_m, 9):
            solutions = scene.perception.estimate(image).solutions
            if solutions:
                squares.append(nees_of(solutions, position, q))
        means.append(np.mean(squares))
        assert 3.0 < means[-1] < 10.0
    assert 4.5 < np.mean(means) < 7.5, means


def test_corners_that_cannot_be_fitted_are_kept_with_the_error_of_a_contour():
    """A sigma of a pixel, and of 6 % of the side of a large marker."""
    camera = Camera.from_hfov(640, 480, HFOV)
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    quads = np.array([300.0 + 10.0 * square, 200.0 + 100.0 * square])
    assert corners.coarse_sigma_px(camera, quads) == pytest.approx([1.0, 6.0])


def test_neighbours_of_one_far_marker_are_found_and_those_of_a_false_id_are_not(monkeypatch):
    """Its corners are off by half a pixel, which moves the others by more than a cell."""
    scene = Scene(target_model("servicer"))
    marker = scene.model.markers[0]
    face = rotations.conjugate(np.array(marker.q_trf_marker_wxyz))
    tilt = rotations.exp([0.5, 0.3, 0.2])
    q, position = (
        rotations.multiply(rotations.multiply(tilt, FACING), face),
        np.array([0.1, 0, 4.8]),
    )
    image = scene.image(position, q)
    px = scene.camera.project(rotations.rotate(q, marker.corners_trf_m()) + position)
    px += np.array([[0.5, -0.5], [-0.5, 0.4], [0.5, 0.5], [-0.4, -0.5]])
    for number, seen in ((marker.id, True), (scene.model.markers[1].id, False)):
        only = detect.Detections(np.array([number]), px[None])
        monkeypatch.setattr(detect, "detect", lambda *_, only=only: only)
        result = scene.perception.estimate(image)
        assert bool(result.solutions) == seen
        if seen:
            assert {0, 1, 2, 3} <= {*result.marker_ids.tolist()}
            assert np.linalg.norm(result.solutions[0].position_irf_m - position) < 0.1


def test_far_markers_have_the_accuracy_of_all_their_cells():
    """Cells of 2.5 pixels: single sides are drawn to inner cells, by 3 degrees and a NEES of 9."""
    scene, rng = Scene(target_model("servicer")), np.random.default_rng(24)
    squares, angles_rad = [], []
    for number in range(20):
        q, z = rotations.exp(rng.normal(0.0, 0.15, 3)), rng.uniform(4.0, 4.3)
        q, position = rotations.multiply(q, FACING), np.append(rng.normal(0.0, 0.2, 2), z)
        solutions = scene.perception.estimate(scene.image(position, q, number)).solutions
        squares.append(nees_of(solutions, position, q))
        angles_rad.append(min(rotations.angle_between(s.q_irf_trf_wxyz, q) for s in solutions))
    assert np.degrees(np.sqrt(np.mean(np.square(angles_rad)))) < 0.6
    assert 3.0 < np.mean(squares) < 8.5


def test_markers_with_cells_of_a_pixel_are_read_by_the_blur_that_they_have():
    """The blur leaves a correlation of 0.5 with the cells of this one."""
    scene = Scene(target_model("servicer"))
    q = rotations.normalize([0.802, 0.0958, -0.4648, -0.3625])
    position = np.array([0.17062531, 0.15614545, 2.62794457])
    ids = scene.perception.estimate(
        scene.image(position, q, light=(-0.057, 2.296, -0.178))
    ).marker_ids
    assert 17 in ids


def test_the_place_of_a_marker_tells_how_far_its_corners_move_together():
    white = CornerErrors.of_places(np.array([0.5])).whitening[0]
    assert white @ np.tile([1.0, -0.5], 4) == pytest.approx([2.0, -1.0, *np.zeros(6)])
    assert white @ [1.0, 0.0, -1.0, 0.0, 1.0, 0.0, -1.0, 0.0] == pytest.approx(np.zeros(8))
