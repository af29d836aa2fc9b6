# SPDX-License-Identifier: Apache-2.0
"""Rendered images against projected ground truth, occlusion, and camera effects."""

import cv2
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.shape_distance import chaser_boxes
from chaserdock_models.targets import Box, TargetModel, target_model
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import SPACE_LEVEL, Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.rasterizer import Renderer
from chaserdock_world.rendering.scene_geometry import VisibleBox, paint_order
from chaserdock_world.rendering.textures import finest_texture, marker_cells
from hypothesis import given, settings
from hypothesis import strategies as st

EYE, AHEAD = np.zeros(3), rotations.IDENTITY  # the camera at the origin, IRF = WRF
CAMERA = Camera.from_hfov(640, 480, np.deg2rad(60.0))
LENS = Camera.from_hfov(640, 480, np.deg2rad(60.0), distortion=(-0.25, 0.08, 1e-3, -5e-4, 0.0))
# Rotation that shows the +X face (ids 0 and up) upright to a camera that looks along z with y down.
FACING = rotations.from_matrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]))
FULL_SUN = Light((0.0, 0.0, -1.0))


def turned(*rotation_vector):
    return rotations.multiply(FACING, rotations.exp(rotation_vector))


def level_at(image, camera, point_irf):
    u, v = np.rint(camera.project(point_irf)).astype(int)
    return int(image[v, u])


def blank(*boxes):
    return TargetModel("blank", boxes, (), "DICT_4X4_50", (0.2, 0.2, 0.2), 0.0)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_marker_corners_are_at_their_projection(camera, name):
    model = target_model(name)
    position = np.array([0.05, -0.03, 0.45 if name == "paper" else 0.8])
    q = turned(0.2, -0.3, 0.4)
    image = Renderer(camera, model).render(EYE, AHEAD, position, q, (), FULL_SUN)
    # Each side's edge, found where the grey level is half way from black to white, against its true
    # place: lines across the side in 3-D, projected. (A large marker, so that its border is many
    # pixels wide.)
    marker = model.markers[0]
    corners = marker.corners_trf_m()
    across_m = np.linspace(-0.003, 0.003, 61)
    errors = []
    for k in range(4):
        start, end = corners[k], corners[(k + 1) % 4]
        out = 0.5 * (start + end) - corners.mean(axis=0)
        out /= np.linalg.norm(out)
        for share in np.linspace(0.2, 0.8, 13):
            line = start + share * (end - start) + across_m[:, None] * out
            px = camera.project(rotations.rotate(q, line) + position).astype(np.float32)
            levels = np.ravel(cv2.remap(image, px[:, :1], px[:, 1:], cv2.INTER_LINEAR)).astype(
                float
            )
            half = 0.5 * (levels[0] + levels[-1])
            assert levels[-1] - levels[0] > 50
            i = int(np.flatnonzero(levels >= half)[0])
            at = i - 1 + (half - levels[i - 1]) / (levels[i] - levels[i - 1])
            errors.append((at - 30.0) * np.linalg.norm(px[1] - px[0]))
    assert np.abs(errors).max() < 0.25
    assert abs(np.mean(errors)) < 0.03


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_marker_cells_have_their_grey_level(camera, name):
    model = target_model(name)
    position, q = np.array([0.02, 0.03, 0.8]), turned(0.3, 0.4, -0.4)
    image = Renderer(camera, model).render(EYE, AHEAD, position, q, (), FULL_SUN)
    checked = 0
    for marker in model.markers:
        normal = rotations.rotate(q, marker.normal_trf())
        centre = rotations.rotate(q, marker.position_trf_m) + position
        if normal @ centre > -0.3 * np.linalg.norm(centre) or marker.side_m < 0.08:
            continue
        cells = marker_cells(model.dictionary, marker.id)
        n = len(cells)
        top_left, top_right, _, bottom_left = marker.corners_trf_m()
        for row in range(n):
            for column in range(n):
                at = top_left + (column + 0.5) / n * (top_right - top_left)
                at = at + (row + 0.5) / n * (bottom_left - top_left)
                level = level_at(image, camera, rotations.rotate(q, at) + position)
                assert (level > 45) == bool(cells[row, column]), (marker.id, row, column, level)
                checked += 1
    assert checked >= 49


def test_chaser_in_front_occludes_the_target_and_one_behind_does_not():
    model = target_model("servicer")
    renderer = Renderer(CAMERA, model)
    position = np.array([0.0, 0.0, 1.5])
    plain = renderer.render(EYE, AHEAD, position, FACING)
    front = [(chaser_boxes(), [0.0, 0.0, 0.8], rotations.exp([0.2, 0.1, 0.3]))]
    behind = [(chaser_boxes(), [0.0, 0.0, 3.0], turned(0.3, 0.2, 0.1))]
    covered = renderer.render(EYE, AHEAD, position, FACING, front)
    assert np.array_equal(plain, renderer.render(EYE, AHEAD, position, FACING, behind))
    # The chaser's body is a single shade at its middle, where the target shows markers.
    window = np.s_[235:245, 315:325]
    assert np.ptp(covered[window]) == 0
    assert np.mean(covered != plain) > 0.02


def test_probe_in_contact_is_painted_before_the_body():
    """Camera of the docked chaser: its probe's tip touches the target's face."""
    model = blank(Box((0.2, 0.2, 0.2), shade=1.0))
    camera = Camera.from_hfov(640, 480, np.deg2rad(60.0), (0.07, 0.0, 0.075))
    eye, q_eye = camera.irf_pose_in_world([-0.45, 0.0, 0.0], rotations.IDENTITY)
    chaser = (chaser_boxes(), [-0.45, 0.0, 0.0], rotations.IDENTITY)
    image = Renderer(camera, model).render(
        eye, q_eye, [0.0, 0.0, 0.0], rotations.IDENTITY, [chaser], Light((-1, 0, 0.3))
    )
    plain = Renderer(camera, model).render(
        eye, q_eye, [0.0, 0.0, 0.0], rotations.IDENTITY, [], Light((-1, 0, 0.3))
    )
    for x in (0.2, 0.25, 0.3, 0.34):  # along the probe's upper edge, in CRF
        at = rotations.rotate_inverse(
            camera.q_crf_irf_wxyz, np.array([x, 0.0, 0.006]) - camera.position_crf_m
        )
        u, v = np.rint(camera.project(at)).astype(int)
        if 0 <= v < 480:
            assert image[v, u] < 0.7 * plain[v, u]


@given(st.integers(0, 10_000))
@settings(derandomize=True, deadline=None, max_examples=40)
def test_paint_order_agrees_with_ray_casting(seed):
    """Random boxes apart from each other, each of its own shade: the first one a ray hits is
    seen.
    """
    generator = np.random.default_rng(seed)
    boxes, shades = [], iter(np.linspace(0.3, 1.0, 5))
    while len(boxes) < 5:
        size, at = (
            generator.uniform(0.05, 0.5, 3),
            generator.uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 2.5]),
        )
        box = Box(tuple(size), tuple(at), tuple(rotations.normalize(generator.normal(size=4))), 0.5)
        radius = np.linalg.norm(size) / 2.0
        if all(
            np.linalg.norm(at - b.position_m) > radius + np.linalg.norm(b.size_m) / 2.0
            for b in boxes
        ):
            boxes.append(box)
            continue
        if generator.random() < 0.02:  # no room left for this shape: start again
            boxes.clear()
    boxes = [Box(b.size_m, b.position_m, b.q_wxyz, float(next(shades))) for b in boxes]
    renderer = Renderer(CAMERA, blank(boxes[0]))
    others = [([b], [0.0, 0.0, 0.0], rotations.IDENTITY) for b in boxes[1:]]
    image = renderer.render(EYE, AHEAD, [0, 0, 0], rotations.IDENTITY, others, FULL_SUN)
    pixels = generator.uniform([0, 0], [639, 479], (400, 2)).astype(int)
    rays = np.column_stack(
        [
            (pixels[:, 0] - CAMERA.cx_px) / CAMERA.fx_px,
            (pixels[:, 1] - CAMERA.cy_px) / CAMERA.fy_px,
            np.ones(400),
        ]
    )
    nearest, which, normals = np.full(400, np.inf), np.full(400, -1), np.zeros((400, 3))
    for i, box in enumerate(boxes):
        r = rotations.to_matrix(box.q_wxyz)
        o, d = -r.T @ np.array(box.position_m), rays @ r
        half = np.array(box.size_m) / 2.0
        t0, t1 = (-half * np.sign(d) - o) / d, (half * np.sign(d) - o) / d
        enter, leave = t0.max(axis=1), t1.min(axis=1)
        hit = (enter < leave) & (enter < nearest)
        axis = t0.argmax(axis=1)
        normal = -np.sign(d[np.arange(400), axis])[:, None] * r.T[axis]
        nearest[hit], which[hit], normals[hit] = enter[hit], i, normal[hit]
    inside = which >= 0
    lit = 0.35 + 0.65 * np.maximum(0.0, normals @ FULL_SUN.direction_w)
    expected = 235.0 * lit * np.array([b.shade for b in boxes])[which]
    seen = image[pixels[:, 1], pixels[:, 0]].astype(float)
    wrong = np.abs(seen - expected)[inside] > 2.0
    # Pixels cut by an edge are mixtures.
    assert np.mean(wrong) < 0.12 if inside.sum() > 20 else True
    assert np.mean(seen[~inside] > 60) < 0.05


def placed(*boxes):
    """Boxes (centre, half edges), as seen from the origin, whose images overlap."""
    out = np.zeros(len(boxes), dtype=VisibleBox)
    for row, (centre, half) in zip(out, boxes, strict=True):
        row["centre"], row["half"], row["rotation"], row["high_px"] = centre, half, np.eye(3), 1.0
    return out


def test_wide_near_box_occludes_though_its_centre_is_farther():
    wide, small = ([3.0, 0.0, 1.0], [4.0, 0.5, 0.1]), ([-0.5, 0.0, 1.3], [0.1, 0.1, 0.1])
    assert np.linalg.norm(wide[0]) > np.linalg.norm(small[0])
    boxes = placed(wide, small)
    assert paint_order(boxes) == [1, 0]
    assert paint_order(placed(small, wide)) == [0, 1]
    # Boxes that are disjoint in the image are ordered by distance, the farther one first.
    boxes["low_px"][1], boxes["high_px"][1] = 5.0, 6.0
    assert paint_order(boxes) == [0, 1]


def test_boxes_on_opposite_sides_of_the_camera_do_not_occlude():
    # At equal distance the order is that of the boxes; an occlusion would reverse one of the two.
    for ends in ((2.0, -2.0), (-2.0, 2.0)):
        assert paint_order(placed(*(([0.0, 0.0, z], [0.5, 0.5, 0.5]) for z in ends))) == [0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_target_outside_the_field_of_view_is_not_drawn(camera):
    renderer = Renderer(camera, target_model("servicer"))
    empty = renderer.render(EYE, AHEAD, [0.0, 0.0, -2.0], FACING)
    for position in ([0.0, 0.0, -1.0], [0.0, 0.0, -0.3], [5.0, 0.0, 1.0], [0.0, -5.0, 1.0]):
        assert np.array_equal(renderer.render(EYE, AHEAD, position, FACING), empty)


def test_box_reaching_behind_the_camera_is_clipped():
    """A long wall on the right, from far ahead to behind the camera: the left half stays empty."""
    model = blank(Box((0.02, 1.0, 6.0), shade=1.0))
    image = Renderer(CAMERA, model).render(
        EYE, AHEAD, [0.3, 0.0, 0.0], rotations.IDENTITY, (), Light((-1.0, 0.0, 0.0))
    )
    empty = Renderer(CAMERA, model).render(
        EYE, AHEAD, [0.0, 0.0, -9.0], rotations.IDENTITY, (), Light((-1.0, 0.0, 0.0))
    )
    edge = CAMERA.project([0.29, 0.0, 3.0])[0]
    assert np.array_equal(image[:, : int(edge) - 2], empty[:, : int(edge) - 2])
    assert np.all(image[240, int(edge) + 2 :] > 200)


def test_marked_face_reaching_behind_the_camera_is_correct_where_visible():
    model = target_model("servicer")
    q = rotations.IDENTITY
    position = np.array(
        [0.21, 0.0, 0.1]
    )  # the -X face (x = 0.01 in IRF) passes beside the camera, z -0.06 to 0.26
    image = Renderer(CAMERA, model).render(EYE, AHEAD, position, q, (), Light((-1.0, 0.0, 0.0)))
    checked = 0
    for marker in model.markers:
        if marker.normal_trf()[0] > -0.5:
            continue
        cells = marker_cells(model.dictionary, marker.id)
        n = len(cells)
        top_left, top_right, _, bottom_left = marker.corners_trf_m()
        for row in range(n):
            for column in range(n):
                at = (
                    top_left
                    + (column + 0.5) / n * (top_right - top_left)
                    + (row + 0.5) / n * (bottom_left - top_left)
                )
                at = at + position
                if at[2] < 0.05 or marker.side_m < 0.1:
                    continue
                u, v = CAMERA.project(at)
                if 5 < u < 634 and 5 < v < 474:
                    assert (image[round(v), round(u)] > 100) == bool(cells[row, column])
                    checked += 1
    assert checked > 20


def test_rendering_is_stateless_and_repeatable():
    model = target_model("paper")
    views = [([0.0, 0.0, z], turned(0.1 * z, 0.2, z)) for z in (0.4, 0.8, 1.6)]
    first, second = Renderer(CAMERA, model), Renderer(CAMERA, model)
    forward = [first.render(EYE, AHEAD, *view) for view in views]
    backward = [second.render(EYE, AHEAD, *view) for view in reversed(views)][::-1]
    assert all(np.array_equal(a, b) for a, b in zip(forward, backward, strict=True))
    assert forward[0].shape == (480, 640)
    assert forward[0].dtype == np.uint8


def test_sunlit_faces_are_brighter_than_shaded_ones():
    model = blank(Box((0.2, 0.2, 0.2), shade=0.5))
    renderer = Renderer(CAMERA, model)
    lit = renderer.render(EYE, AHEAD, [0.0, 0.0, 1.0], rotations.IDENTITY, (), FULL_SUN)
    dark = renderer.render(
        EYE, AHEAD, [0.0, 0.0, 1.0], rotations.IDENTITY, (), Light((0.0, 0.0, 1.0))
    )
    assert lit[240, 320] == round(235 * 0.5)
    assert dark[240, 320] == round(235 * 0.5 * 0.35)
    with pytest.raises(ValueError, match="direction to the sun"):
        Light((0.0, 0.0, 0.0))


def test_scene_with_sixteen_chasers_renders():
    generator = np.random.default_rng(5)
    crowd = [
        (
            chaser_boxes(),
            generator.uniform([-0.8, -0.6, 0.5], [0.8, 0.6, 3.0]),
            rotations.normalize(generator.normal(size=4)),
        )
        for _ in range(16)
    ]
    renderer = Renderer(CAMERA, target_model("servicer"))
    alone = renderer.render(EYE, AHEAD, [0.0, 0.0, 2.0], FACING)
    image = renderer.render(EYE, AHEAD, [0.0, 0.0, 2.0], FACING, crowd)
    assert np.mean(image != alone) > 0.05


def test_texture_levels_preserve_the_mean():
    texture = finest_texture(target_model("paper"), 0, 4)
    assert texture is not None
    cells = marker_cells("DICT_5X5_50", 4)
    share = 0.05 + 0.9 * cells.mean()
    marked = 0.09**2 / 0.1**2
    assert texture.mean() / 255.0 == pytest.approx(marked * share + (1.0 - marked) * 0.95, abs=2e-3)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(320, 240, 200.0, 200.0, 160.0, 120.0, (-0.9, 0.0, 0.0, 0.0)),
        Camera(320, 240, 75.0, 74.0, 157.0, 122.0, (0.02, 0.0, 0.0, 0.0), lens_model="equidistant"),
    ],
    ids=["turns back", "ends at 90 degrees"],
)
def test_an_image_is_drawn_up_to_where_the_lens_ends(camera):
    """A large white wall in front: white up to the rim, black beyond."""
    renderer = Renderer(camera, target_model("paper"))
    wall = (Box((60.0, 60.0, 0.1), shade=1.0),)
    image = renderer.render(
        EYE, AHEAD, [0.0, 0.0, -9.0], FACING, [(wall, np.array([0.0, 0.0, 2.0]), AHEAD)],
        Light((0.0, 0.0, -1.0)),
    )  # fmt: skip
    grid = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)
    away = np.linalg.norm(camera.normalized(camera.undistort(grid)), axis=-1)
    assert np.all(image[away < min(0.8 * camera.lens.valid_radius, 3.0)] > 200)
    outside = cv2.erode(np.isnan(away).astype(np.uint8), np.ones((3, 3)), borderValue=1) > 0
    assert outside.any()
    assert np.all(image[outside] == SPACE_LEVEL)


def test_chaser_boxes_reach_to_the_probe_tip():
    body, probe = chaser_boxes((0.25, 0.25, 0.05), 0.35)
    assert body.size_m == (0.25, 0.25, 0.05)
    assert probe.position_m[0] + probe.size_m[0] / 2.0 == pytest.approx(0.35)
    assert probe.position_m[0] - probe.size_m[0] / 2.0 == pytest.approx(0.125)
    with pytest.raises(ValueError, match="probe"):
        chaser_boxes(probe_reach_m=0.1)


def test_noise_repeats_for_equal_chaser_and_image_and_differs_otherwise():
    image = np.full((480, 640), 100, dtype=np.uint8)
    one, other = (CameraEffects(640, 480, Effects(), 42) for _ in range(2))
    a = one.apply(image, 0, 7)
    one.apply(image, 3, 8)
    assert np.array_equal(a, one.apply(image, 0, 7))
    assert np.array_equal(a, other.apply(image, 0, 7))
    for different in (
        one.apply(image, 1, 7),
        one.apply(image, 0, 8),
        CameraEffects(640, 480, Effects(), 43).apply(image, 0, 7),
    ):
        assert np.mean(a == different) < 0.5


@pytest.mark.parametrize("level", [40, 100, 220])
def test_noise_has_the_stated_variance(level):
    image = np.full((480, 640), level, dtype=np.uint8)
    noisy = (
        CameraEffects(640, 480, Effects(point_spread_px=0.0, read_noise=2.0, shot_noise=0.05), 1)
        .apply(image, 0, 0)
        .astype(float)
    )
    assert noisy.mean() == pytest.approx(level, abs=0.05)
    # A twelfth is added by rounding to whole grey levels.
    assert noisy.var() == pytest.approx(4.0 + 0.05 * level + 1.0 / 12.0, rel=0.03)


NO_EFFECTS = Effects(gain=1.0, point_spread_px=0.0, read_noise=0.0, shot_noise=0.0)


def test_disabled_effects_do_not_change_the_image():
    image = np.random.default_rng(0).integers(0, 256, (480, 640)).astype(np.uint8)
    before = image.copy()
    out = CameraEffects(640, 480, NO_EFFECTS, 1).apply(image, 0, 0)
    assert np.array_equal(out, image)
    out[:] = 0
    CameraEffects(640, 480, Effects(), 1).apply(image, 0, 0)
    assert np.array_equal(image, before)
    with pytest.raises(ValueError, match="uint8"):
        CameraEffects(640, 480, NO_EFFECTS, 1).apply(image[:-1], 0, 0)
    with pytest.raises(ValueError, match="read_noise"):
        Effects(read_noise=-1.0)
