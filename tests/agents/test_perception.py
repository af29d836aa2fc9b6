# SPDX-License-Identifier: Apache-2.0
"""Pose from rendered images: accuracy, consistency of the covariance, and images that should give
nothing.
"""

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import Method, Perception, corners, detect, pnp
from chaserdock_agents.chaser.perception.corners import CornerErrors
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import target_model
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.rasterizer import Renderer
from hypothesis import given, settings
from hypothesis import strategies as st

EYE, AHEAD = np.zeros(3), rotations.IDENTITY
HFOV = np.deg2rad(60.0)
LENS = (-0.25, 0.08, 1e-3, -5e-4, 0.0)
FACING = rotations.from_matrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]))


METHODS: tuple[Method, ...] = ("default", "paper")


class Scene:
    """A camera, a target, and what perception makes of images of it."""

    def __init__(self, name, width=640, height=480, distortion=(), method: Method = "default"):
        self.camera = Camera.from_hfov(width, height, HFOV, distortion=distortion)
        self.model = target_model(name)
        self.renderer = Renderer(self.camera, self.model, None, Effects().point_spread_px)
        self.effects = CameraEffects(width, height, Effects(), 11)
        self.perception = Perception(self.camera, self.model, method)

    def image(self, position, q, number=0, light=(-0.3, -0.5, -0.8)):
        exact = self.renderer.render(EYE, AHEAD, position, q, (), Light(tuple(light)))
        return self.effects.apply(exact, 0, number)

    def random_views(self, count, near_m, far_m, seed):
        generator = np.random.default_rng(seed)
        for number in range(count):
            z = generator.uniform(near_m, far_m)
            px = generator.uniform([0.3, 0.3], [0.7, 0.7]) * (
                self.camera.width_px,
                self.camera.height_px,
            )
            ideal = (px - (self.camera.cx_px, self.camera.cy_px)) / (
                self.camera.fx_px,
                self.camera.fy_px,
            )
            position, q = np.append(ideal, 1.0) * z, rotations.normalize(generator.normal(size=4))
            light = rotations.rotate(rotations.normalize(generator.normal(size=4)), [0.0, 0.0, 1.0])
            yield position, q, self.image(position, q, number, light)


def error_of(solution, position, q):
    turn = rotations.log(rotations.multiply(rotations.conjugate(solution.q_irf_trf_wxyz), q))
    return np.concatenate([position - solution.position_irf_m, turn])


# Bounds: about twice what thousands of views gave; position m and attitude deg, median and worst.
@pytest.mark.parametrize(
    ("name", "width", "height", "distortion", "bounds"),
    [
        ("servicer", 640, 480, (), (0.3e-3, 4e-3, 0.05, 0.7)),
        ("servicer", 640, 480, LENS, (0.6e-3, 6e-3, 0.07, 0.7)),
        ("servicer", 1280, 720, (), (0.1e-3, 2e-3, 0.02, 0.3)),
        ("paper", 1280, 720, (), (0.4e-3, 9e-3, 0.08, 2.5)),
    ],
)
def test_random_views(name, width, height, distortion, bounds):
    scene = Scene(name, width, height, distortion)
    errors, nees, seen = [], [], 0
    for position, q, image in scene.random_views(40, 0.6, 1.8, 3):
        sighting = scene.perception.estimate(image)
        if not sighting.solutions:
            continue
        seen += 1
        # Where a plane's tilt is ambiguous both are given, and one must be right.
        each = [error_of(s, position, q) for s in sighting.solutions]
        k = int(np.argmin([np.linalg.norm(e[3:]) for e in each]))
        errors.append(each[k])
        covariance = sighting.solutions[k].covariance
        assert np.array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        nees.append(each[k] @ np.linalg.solve(covariance, each[k]))
    assert seen >= 38
    far = np.linalg.norm(np.array(errors)[:, :3], axis=1)
    turn = np.degrees(np.linalg.norm(np.array(errors)[:, 3:], axis=1))
    assert np.median(far) < bounds[0]
    assert far.max() < bounds[1]
    assert np.median(turn) < bounds[2]
    assert turn.max() < bounds[3]
    # Six degrees of freedom. Mild distortion is drawn by resampling the image, which moves edges by
    # 0.01 px more than a lens does.
    assert 3.0 < np.mean(nees) < (11.0 if distortion else 8.5)


def test_corners_are_reported_where_they_are_in_the_image():
    scene = Scene("servicer", distortion=LENS)
    position, q = (
        np.array([0.1, -0.05, 0.9]),
        rotations.multiply(FACING, rotations.exp([0.3, 0.4, -0.2])),
    )
    sighting = scene.perception.estimate(scene.image(position, q))
    assert len(sighting.marker_ids) >= 8
    assert sighting.corners_px.shape == (len(sighting.marker_ids), 4, 2)
    for marker_id, found in zip(sighting.marker_ids, sighting.corners_px, strict=True):
        marker = scene.model.marker(int(marker_id))
        assert marker is not None
        truth = scene.camera.project(rotations.rotate(q, marker.corners_trf_m()) + position)
        assert np.abs(found - truth).max() < 0.8


def test_fitted_sides_beat_contours_and_narrow_borders_do_not_bias_them():
    """The paper's marker at 1.6 m, 640 x 480: its border is 1.7 px wide."""
    scene = Scene("paper")
    table = pnp.MarkerTable.of(scene.model)
    raw, fitted = [], []
    for number in range(6):
        position = np.array([0.05 * number - 0.1, 0.02, 1.6])
        q = rotations.multiply(FACING, rotations.exp([0.5 * number, 0.1 * number - 0.3, 0.2]))
        image = scene.image(position, q, number)
        found = detect.detect(image, detect.dictionary_of(scene.model.dictionary), None)
        assert 0 in found.ids
        k = found.ids.tolist().index(0)
        px = found.corners_px[k : k + 1]
        refined = corners.refine(
            image, scene.camera, px, 7, table.margin_share[[0]], table.outlined[[0]]
        )
        assert refined.good.all()
        truth = scene.camera.project(rotations.rotate(q, table.corners[0]) + position)
        outwards = truth - truth.mean(axis=0)
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        raw.append(((px[0] - truth) * outwards).sum(axis=1))
        fitted.append(((refined.corners_px[0] - truth) * outwards).sum(axis=1))
    assert np.mean(raw) < -0.2
    assert abs(np.mean(fitted)) < 0.06
    assert np.abs(fitted).max() < 0.3


@pytest.mark.parametrize("distortion", [(), LENS])
def test_corners_do_not_depend_on_the_place_of_a_side_between_pixels(distortion):
    """Face-on without noise, moved by tenths of a pixel: an edge interpolated between pixels is off
    by up to 0.03 px.
    """
    scene = Scene("paper", 960, 540, distortion)
    table, margin = pnp.MarkerTable.of(scene.model), 0.5
    for tenths in range(0, 10, 3):
        position = (
            np.array([(margin + tenths / 10.0) * 0.7, (margin + tenths / 10.0) * 0.7, 0.0])
            / scene.camera.fx_px
        )
        position[2] = 0.7
        image = scene.renderer.render(EYE, AHEAD, position, FACING, (), Light((0.0, 0.0, -1.0)))
        truth = scene.camera.project_ideal(rotations.rotate(FACING, table.corners[0]) + position)
        found = corners.refine(
            image, scene.camera, truth[None], 7, table.margin_share[[0]], table.outlined[[0]]
        )
        assert found.good.all()
        assert np.abs(found.corners_px[0] - truth).max() < (0.025 if not distortion else 0.04)


@pytest.mark.parametrize("turn_rad", [0.4, 0.5])
def test_a_bright_face_beside_a_border_does_not_move_corners(turn_rad):
    """Beyond the border's outer edge is the brighter border of the adjacent face's marker: no fall,
    but a second rise.
    """
    scene = Scene("paper", 960, 540)
    table = pnp.MarkerTable.of(scene.model)
    q, position = (
        rotations.multiply(FACING, rotations.exp([0.0, 0.0, turn_rad])),
        np.array([0.0, 0.0, 1.2]),
    )
    seen = [k for k in range(6) if rotations.rotate(q, table.normals[k]) @ position < -0.2]
    assert len(seen) == 2
    for side in (-1.0, 1.0):  # the sun lights one face, then the other
        image = scene.image(position, q, light=(side, 0.0, -0.35))
        for k in seen:
            truth = scene.camera.project(rotations.rotate(q, table.corners[k]) + position)
            ends = table.outlined[[k]]
            found = corners.refine(
                image, scene.camera, truth[None], 7, table.margin_share[[k]], ends
            )
            assert found.good.all()
            assert np.abs(found.corners_px[0] - truth).max() < 0.25


def test_neighbours_beside_a_part_of_a_side_do_not_enlarge_far_markers():
    scene, generator = Scene("servicer", 960, 540), np.random.default_rng(4)
    errors, nees = [], []
    for number in range(24):
        position = np.array([*generator.uniform(-0.1, 0.1, 2), generator.uniform(5.0, 5.6)])
        q = rotations.multiply(FACING, rotations.exp(generator.normal(0.0, 0.05, 3)))
        sighting = scene.perception.estimate(scene.image(position, q, number))
        each = [error_of(s, position, q) for s in sighting.solutions]
        squares = [
            e @ np.linalg.solve(s.covariance, e)
            for e, s in zip(each, sighting.solutions, strict=True)
        ]
        if each:
            errors.append(each[int(np.argmin(squares))])
            nees.append(min(squares))
    assert len(errors) > 20
    assert abs(np.median(np.array(errors)[:, 2])) < 0.02
    assert np.median(nees) < 8.0


def test_a_prediction_changes_where_is_looked_but_not_what_is_found():
    scene = Scene("paper", 1280, 720)
    position, q = (
        np.array([0.1, 0.05, 1.0]),
        rotations.multiply(FACING, rotations.exp([0.2, 0.5, 0.3])),
    )
    image = scene.image(position, q)
    assert detect.region_of(scene.camera, scene.model, position, q) is not None
    plain = scene.perception.estimate(image)
    for offset in (
        [0.0, 0.0, 0.0],
        [0.02, -0.01, 0.05],
        [0.5, 0.0, 0.0],
        [0.0, 0.0, -3.0],
        [np.nan, 0.0, 0.0],
    ):
        guided = scene.perception.estimate(image, (position + offset, q))
        assert np.array_equal(np.sort(guided.marker_ids), np.sort(plain.marker_ids))
        error = error_of(guided.solutions[0], position, q)
        assert np.linalg.norm(error[:3]) < 1.5e-3


@pytest.mark.parametrize("name", ["servicer", "paper"])
def test_markers_are_read_where_a_prediction_puts_them_without_a_search(name, monkeypatch):
    scene, generator = Scene(name, 960, 540), np.random.default_rng(8)
    search, searched, nees, apart = detect.detect, [], [], []

    def counted(*arguments):
        searched.append(True)
        return search(*arguments)

    monkeypatch.setattr(detect, "detect", counted)
    for position, q, image in scene.random_views(40, 0.6, 1.8, 3):
        plain = scene.perception.estimate(image)
        searched.clear()
        turn = rotations.exp(np.radians(0.3) * generator.normal(size=3))
        predicted = position + 2e-3 * generator.normal(size=3), rotations.multiply(q, turn)
        guided = scene.perception.estimate(image, predicted)
        if searched:
            continue
        best, other = guided.solutions[0], plain.solutions[0]
        error = error_of(best, position, q)
        nees.append(error @ np.linalg.solve(best.covariance, error))
        change = error_of(best, other.position_irf_m, other.q_irf_trf_wxyz)
        apart.append(change @ np.linalg.solve(best.covariance, change))
        assert np.array_equal(np.sort(guided.marker_ids), np.sort(plain.marker_ids))
    assert len(nees) >= 28
    assert 3.0 < np.mean(nees) < 8.5
    assert np.median(apart) < 0.1  # of 6


def test_estimates_repeat_bit_for_bit_and_keep_no_memory():
    scene = Scene("servicer")
    position, q = (
        np.array([0.0, 0.0, 1.0]),
        rotations.multiply(FACING, rotations.exp([0.2, 0.5, 0.3])),
    )
    image, other = scene.image(position, q), scene.image(position, FACING)
    before = image.copy()
    first = scene.perception.estimate(image)
    scene.perception.estimate(other)
    again = scene.perception.estimate(image)
    assert np.array_equal(image, before)
    assert np.array_equal(first.solutions[0].covariance, again.solutions[0].covariance)
    assert np.array_equal(first.solutions[0].position_irf_m, again.solutions[0].position_irf_m)
    assert np.array_equal(first.corners_px, again.corners_px)


@pytest.mark.parametrize("method", METHODS)
def test_images_of_nothing_give_nothing(method):
    scene = Scene("servicer", method=method)
    noise = np.random.default_rng(0).integers(0, 256, (480, 640)).astype(np.uint8)
    checks = (np.indices((480, 640)).sum(axis=0) // 40 % 2 * 255).astype(np.uint8)
    for image in (
        np.zeros((480, 640), np.uint8),
        np.full((480, 640), 255, np.uint8),
        noise,
        checks,
    ):
        sighting = scene.perception.estimate(image)
        assert sighting.solutions == ()
        assert len(sighting.marker_ids) == 0
        assert sighting.corners_px.shape == (0, 4, 2)


@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_a_mirrored_image_gives_nothing(name):
    scene = Scene(name)
    for number, turn in enumerate(([0.2, 0.5, 0.3], [0.0, 0.0, 0.0], [1.0, -0.4, 0.2])):
        image = scene.image(
            np.array([0.0, 0.0, 0.9]), rotations.multiply(FACING, rotations.exp(turn)), number
        )
        assert scene.perception.estimate(image).solutions
        assert scene.perception.estimate(np.ascontiguousarray(image[:, ::-1])).solutions == ()


def test_markers_of_another_target_are_foreign():
    paper, servicer = Scene("paper"), Scene("servicer")
    image = servicer.image(np.array([0.0, 0.0, 0.9]), FACING)
    assert servicer.perception.estimate(image).solutions
    assert paper.perception.estimate(image).solutions == ()


def test_two_equal_targets_in_one_image_are_not_mixed_up():
    """Every id is there twice, so its marker is ambiguous."""
    scene = Scene("paper", 1280, 720)
    image = scene.image(np.array([-0.15, 0.0, 0.9]), FACING)
    image[:, 640:] = scene.image(np.array([0.15, 0.0, 0.9]), FACING, 1)[:, 640:]
    sighting = scene.perception.estimate(image)
    assert sighting.solutions == ()
    assert sighting.rejected_ids == (0, 0)


def test_a_second_copy_of_one_marker_is_thrown_out_by_the_others():
    scene = Scene("servicer", 1280, 720)
    position, q = (
        np.array([-0.2, 0.0, 1.0]),
        rotations.multiply(FACING, rotations.exp([0.0, 0.3, 0.2])),
    )
    image = scene.image(position, q)
    marker = scene.model.markers[0]
    px = scene.camera.project(rotations.rotate(q, marker.corners_trf_m()) + position)
    left, top = np.floor(px.min(axis=0)).astype(int) - 8
    right, bottom = np.ceil(px.max(axis=0)).astype(int) + 8
    copy = image[top:bottom, left:right]
    image[top : top + copy.shape[0], 1000 : 1000 + copy.shape[1]] = copy
    sighting = scene.perception.estimate(image)
    assert 0 in sighting.rejected_ids
    assert np.linalg.norm(error_of(sighting.solutions[0], position, q)[:3]) < 1e-3


def exact_detections(scene, position, q, rows):
    table = pnp.MarkerTable.of(scene.model)
    at = rotations.rotate(q, table.corners[rows]) + position
    return table, scene.camera.project_ideal(at)


@given(st.integers(0, 1000), st.integers(1, 3))
@settings(derandomize=True, deadline=None, max_examples=25)
def test_false_ids_are_voted_out(seed, false_ones):
    """Large markers of one face, some of them with a wrong id."""
    scene_camera = Camera.from_hfov(640, 480, HFOV)
    model = target_model("servicer")
    table = pnp.MarkerTable.of(model)
    generator = np.random.default_rng(seed)
    position, q = (
        np.array([0.0, 0.0, 1.0]),
        rotations.multiply(FACING, rotations.exp(0.4 * generator.normal(size=3))),
    )
    rows = np.arange(12)
    px = scene_camera.project_ideal(rotations.rotate(q, table.corners[rows]) + position)
    px += generator.normal(scale=0.05, size=px.shape)
    errors = CornerErrors.even(np.full(12, 0.05))
    wrong = generator.choice(12, false_ones, replace=False)
    rows[wrong] = generator.choice(np.arange(12, 72), false_ones, replace=False)
    solutions, used = pnp.solve(scene_camera, table, rows, px, errors)
    assert not set(used.tolist()) & set(wrong.tolist())
    error = error_of(solutions[0], position, q)
    assert np.linalg.norm(error[:3]) < 2e-3
    assert np.linalg.norm(error[3:]) < 0.01


def test_a_small_marker_far_away_gives_both_of_its_poses():
    camera, model = Camera.from_hfov(640, 480, HFOV), target_model("paper")
    table = pnp.MarkerTable.of(model)
    position, q = (
        np.array([0.0, 0.0, 3.0]),
        rotations.multiply(FACING, rotations.exp([0.0, 0.5, 0.0])),
    )
    px = camera.project_ideal(rotations.rotate(q, table.corners[:1]) + position)
    px += np.random.default_rng(2).normal(scale=0.05, size=px.shape)
    solutions, used = pnp.solve(
        camera, table, np.array([0]), px, CornerErrors.even(np.full(1, 0.1))
    )
    assert used.tolist() == [0]
    assert len(solutions) == 2
    errors = [float(rotations.angle_between(s.q_irf_trf_wxyz, q)) for s in solutions]
    assert min(errors) < 0.1
    assert max(errors) > 0.5
    assert solutions[0].reprojection_rms_px <= solutions[1].reprojection_rms_px


@pytest.mark.parametrize("name", ["paper", "servicer"])
@pytest.mark.parametrize("distance_m", [0.4, 0.5, 0.75, 1.0, 1.5])
def test_a_face_exactly_ahead_is_seen_without_any_noise(name, distance_m):
    scene = Scene(name, 1280, 720)
    position = np.array([0.0, 0.0, distance_m])
    exact = scene.renderer.render(EYE, AHEAD, position, FACING, (), Light((0.2, 0.1, -1.0)))
    solutions = scene.perception.estimate(exact).solutions
    assert solutions
    assert np.linalg.norm(error_of(solutions[0], position, FACING)[:3]) < 1e-3
    assert np.linalg.norm(error_of(solutions[0], position, FACING)[3:]) < np.deg2rad(0.1)


def test_a_single_marker_at_a_grazing_angle_is_not_trusted():
    camera, model = Camera.from_hfov(1280, 720, HFOV), target_model("paper")
    table = pnp.MarkerTable.of(model)
    for angle, trusted in ((1.0, True), (1.45, False)):
        position, q = (
            np.array([0.0, 0.0, 1.0]),
            rotations.multiply(FACING, rotations.exp([0.0, angle, 0.0])),
        )
        px = camera.project_ideal(rotations.rotate(q, table.corners[:1]) + position)
        solutions, _ = pnp.solve(
            camera, table, np.array([0]), px, CornerErrors.even(np.full(1, 0.1))
        )
        assert bool(solutions) is trusted


@pytest.mark.parametrize("common_px", [0.0, 0.5])
@pytest.mark.parametrize("stated", [1.0, 0.7])
def test_covariance_matches_the_spread_of_the_solutions(stated: float, common_px: float):
    """Errors of 0.5 px, ``stated`` times as large; with an outward error that all markers of an
    image have in common: the scatter of many solutions against their covariance.
    """
    camera, model = Camera.from_hfov(640, 480, HFOV), target_model("servicer")
    table = pnp.MarkerTable.of(model)
    position, q = (
        np.array([0.05, 0.0, 1.2]),
        rotations.multiply(FACING, rotations.exp([0.1, 0.5, 0.3])),
    )
    rows = np.arange(12)
    exact = camera.project_ideal(rotations.rotate(q, table.corners[rows]) + position)
    outwards = common_px * np.sign(exact - exact.mean(axis=1, keepdims=True))
    white = CornerErrors.even(np.full(12, 0.5 * stated)).whitening
    corner_errors = CornerErrors(white, (white @ outwards.reshape(12, 8, 1))[:, :, 0])
    generator = np.random.default_rng(4)
    errors, covariances = [], []
    for _ in range(300):
        px = exact + generator.normal(scale=0.5, size=exact.shape)
        px += generator.normal() * outwards
        solutions, used = pnp.solve(camera, table, rows, px, corner_errors)
        if len(used) == 12:
            errors.append(error_of(solutions[0], position, q))
            covariances.append(solutions[0].covariance)
    assert len(errors) > 250
    ratio = np.std(errors, axis=0) / np.sqrt(np.diag(np.mean(covariances, axis=0)))
    assert np.all((ratio > 0.8) & (ratio < 1.2)), ratio
    nees = [e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)]
    assert 5.0 < np.mean(nees) < 7.2


def test_a_side_fitted_to_something_else_counts_little():
    """One side of two markers is 1 px off, with a stated error of 0.02 px."""
    camera, model = Camera.from_hfov(640, 480, HFOV), target_model("servicer")
    table, rows = pnp.MarkerTable.of(model), np.array([0, 3])
    q = rotations.multiply(FACING, rotations.exp([0.1, 0.5, 0.3]))
    position = np.array([0.05, 0.0, 1.2])
    px = camera.project_ideal(rotations.rotate(q, table.corners[rows]) + position)
    px += np.random.default_rng(1).normal(scale=0.02, size=px.shape)
    along = np.roll(px, -1, axis=1) - px
    normals = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    whitening = np.zeros((2, 8, 8))
    for marker, side, end in np.ndindex(2, 4, 2):
        k = (side + end) % 4
        whitening[marker, 2 * side + end, 2 * k : 2 * k + 2] = normals[marker, side] / 0.02
    errors = CornerErrors(whitening, np.zeros((2, 8)))
    # The first side moves outwards: its corners move along the sides beside it.
    wrong = px.copy()
    wrong[0, 0] += along[0, 3] / np.abs(along[0, 3] @ normals[0, 0])
    wrong[0, 1] -= along[0, 1] / np.abs(along[0, 1] @ normals[0, 0])
    for corners_px in (px, wrong):
        solution = pnp.solve(camera, table, rows, corners_px, errors)[0][0]
        error = error_of(solution, position, q)
        assert error @ np.linalg.solve(solution.covariance, error) < 22.5  # one of 1,000


@pytest.mark.slow
def test_the_papers_method_works_where_it_can_and_fails_where_epnp_does():
    scene = Scene("servicer", 1280, 720, LENS, method="paper")
    errors = []
    for position, q, image in scene.random_views(30, 0.6, 1.5, 8):
        sighting = scene.perception.estimate(image)
        if sighting.solutions:
            assert len(sighting.solutions) == 1
            assert sighting.solutions[0].covariance.shape == (6, 6)
            errors.append(np.linalg.norm(error_of(sighting.solutions[0], position, q)[:3]))
    assert len(errors) >= 28
    assert 0.2e-3 < np.median(errors) < 10e-3


def test_iterative_pnp_solves_single_faces_on_which_epnp_fails():
    worst = {}
    for method in ("paper", "paper_iterative"):
        scene = Scene("paper", 1280, 720, method=method)
        errors = []
        for k in range(10):
            tilt = rotations.exp([0.2 * np.sin(k), 0.2 * np.cos(k), 0.1 * k])
            position, q = (
                np.array([0.05, 0.03, 0.8 + 0.08 * k]),
                rotations.multiply(tilt, rotations.exp([np.pi / 2, 0, 0])),
            )
            sighting = scene.perception.estimate(scene.image(position, q, k))
            if len(sighting.marker_ids) == 1:
                errors.append(np.linalg.norm(error_of(sighting.solutions[0], position, q)[:3]))
        assert len(errors) >= 8
        worst[method] = max(errors)
    assert worst["paper"] > 1.0
    assert worst["paper_iterative"] < 0.03


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 641), np.uint8),
        np.zeros((480, 640, 3), np.uint8),
        np.zeros((480, 640), np.float32),
        [[0]],
    ],
)
def test_wrong_images_are_refused(image):
    scene = Scene("paper")
    with pytest.raises(ValueError, match="image"):
        scene.perception.estimate(image)


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="magic"):
        Perception(Camera.from_hfov(640, 480, HFOV), target_model("paper"), "magic")  # type: ignore[arg-type]
