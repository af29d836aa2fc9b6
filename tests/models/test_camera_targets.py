# SPDX-License-Identifier: Apache-2.0
"""The camera's projection and the geometry of the targets, against independent formulae."""

import cv2
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import clear_margin_m, target_model
from hypothesis import given, settings
from hypothesis import strategies as st

DISTORTION = (-0.25, 0.08, 1e-3, -5e-4, 0.01)


def test_hfov_puts_its_edge_at_the_edge_of_the_image():
    camera = Camera.from_hfov(640, 480, np.deg2rad(60.0))
    edge = camera.project([np.tan(np.deg2rad(30.0)), 0.0, 1.0])
    assert edge == pytest.approx([639.5, 239.5])


def test_forward_camera_looks_along_x_with_z_up():
    camera = Camera.from_hfov(640, 480, 1.0, (0.07, 0.0, 0.075))
    position, q = camera.irf_pose_in_world([1.0, 2.0, 3.0], rotations.IDENTITY)
    assert position == pytest.approx([1.07, 2.0, 3.075])
    ahead, left, up = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    assert rotations.rotate_inverse(q, ahead) == pytest.approx([0.0, 0.0, 1.0])
    assert rotations.rotate_inverse(q, left) == pytest.approx([-1.0, 0.0, 0.0])
    assert rotations.rotate_inverse(q, up) == pytest.approx([0.0, -1.0, 0.0])


def test_camera_pose_follows_the_chaser():
    camera = Camera.from_hfov(640, 480, 1.0, (0.1, 0.0, 0.0))
    q_chaser = rotations.exp([0.0, 0.0, np.pi / 2.0])
    position, q = camera.irf_pose_in_world([0.0, 0.0, 0.0], q_chaser)
    assert position == pytest.approx([0.0, 0.1, 0.0])
    assert rotations.rotate(q, [0.0, 0.0, 1.0]) == pytest.approx([0.0, 1.0, 0.0])


def test_distortion_is_opencvs():
    camera = Camera.from_hfov(1280, 720, np.pi / 3.0, distortion=DISTORTION)
    points = np.random.default_rng(1).uniform([-0.4, -0.25, 0.8], [0.4, 0.25, 1.5], (200, 3))
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix(), np.array(DISTORTION)
    )
    assert np.abs(camera.project(points) - np.reshape(expected, (-1, 2))).max() < 1e-9


@given(st.floats(0.0, 1279.0), st.floats(0.0, 719.0), st.sampled_from([(), DISTORTION]))
@settings(derandomize=True, deadline=None)
def test_undistort_inverts_distort(u, v, distortion):
    camera = Camera.from_hfov(1280, 720, np.pi / 3.0, distortion=distortion)
    assert camera.distort(camera.undistort([u, v])) == pytest.approx([u, v], abs=1e-6)


def test_points_behind_the_camera_have_no_pixel():
    camera = Camera.from_hfov(640, 480, 1.0)
    px = camera.project([[0.0, 0.0, -1.0], [0.1, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(px[:2]).all()
    assert np.isfinite(px[2]).all()


@pytest.mark.parametrize(
    "change",
    [{"width_px": 0}, {"fx_px": 0.0}, {"fy_px": float("nan")}, {"distortion": (0.1,)}],
)
def test_bad_cameras_are_refused(change):
    values = {
        "width_px": 4,
        "height_px": 3,
        "fx_px": 1.0,
        "fy_px": 1.0,
        "cx_px": 0.0,
        "cy_px": 0.0,
    } | change
    with pytest.raises(ValueError):  # noqa: PT011
        Camera(**values)


def test_bad_field_of_view_is_refused():
    with pytest.raises(ValueError, match="field of view"):
        Camera.from_hfov(640, 480, np.pi)


@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_markers_lie_flat_on_the_faces(name):
    model = target_model(name)
    half = np.array(model.size_m) / 2.0
    assert len({m.id for m in model.markers}) == len(model.markers)
    for marker in model.markers:
        corners = marker.corners_trf_m()
        assert np.all(np.abs(corners) <= half + 1e-12)
        normal = marker.normal_trf()
        assert corners @ normal == pytest.approx(np.full(4, np.abs(normal) @ half))
        # Clockwise as seen from outside: top left, top right, bottom right, bottom left.
        turn = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        assert turn / marker.side_m**2 == pytest.approx(-normal)
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        assert sides == pytest.approx(np.full(4, marker.side_m))


@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_markers_do_not_overlap(name):
    model = target_model(name)
    for marker in model.markers:
        assert clear_margin_m(model, marker) > 0.0


def test_models_have_the_stated_sizes():
    paper, servicer = target_model("paper"), target_model("servicer")
    assert paper.size_m == (0.10, 0.10, 0.20)
    assert [m.id for m in paper.markers] == list(range(6))
    assert clear_margin_m(paper, paper.markers[0]) == pytest.approx(0.005)
    assert servicer.size_m == (0.40, 0.32, 0.32)
    assert sorted(m.id for m in servicer.markers) == list(range(72))
    # Small markers are 11 mm apart, the large ones 14 mm from the middle-sized.
    assert clear_margin_m(servicer, servicer.markers[8]) == pytest.approx(0.011)
    assert clear_margin_m(servicer, servicer.markers[0]) == pytest.approx(0.014)
    assert servicer.marker(71) is servicer.markers[71]
    assert servicer.marker(72) is None


def test_unknown_target_names_the_known_ones():
    with pytest.raises(ValueError, match=r"'hubble'.*paper, servicer"):
        target_model("hubble")
