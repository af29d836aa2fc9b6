# SPDX-License-Identifier: Apache-2.0
"""Lens models against OpenCV and against finite differences, and where they end."""

import math

import cv2
import numpy as np
import pytest
from chaserdock_models.camera import Camera, focal_and_centre
from chaserdock_models.lenses import COEFFICIENTS, LensModel
from numpy.testing import assert_allclose

FOUR = (-0.25, 0.08, 1.1e-3, -0.6e-3)
RATIONAL = (0.22, -0.03, 0.8e-3, -0.6e-3, 0.004, 0.41, 0.012, 0.003)
PRISM = (0.9e-3, -0.4e-3, -0.7e-3, 0.3e-3)
FISHEYE = (-0.0023, 0.0412, -0.0387, 0.0067)


def camera(coefficients: tuple[float, ...], model: LensModel = "perspective") -> Camera:
    """A camera in general position: pixels not square, the principal point off the middle."""
    fx, fy = (335.1, 329.7) if model == "equidistant" else (512.3, 497.8)
    return Camera(640, 480, fx, fy, 331.7, 228.4, coefficients, lens_model=model)


CAMERAS = {
    "none": camera(()),
    "4": camera(FOUR),
    "5": camera((*FOUR, 0.011)),
    "8": camera(RATIONAL),
    "12": camera((*RATIONAL, *PRISM)),
    "14": camera((*RATIONAL, *PRISM, 0.031, -0.022)),
    "equidistant": camera(FISHEYE, "equidistant"),
    "plain fisheye": camera((0.0, 0.0, 0.0, 0.0), "equidistant"),
}


def opencv_projects(c: Camera, rays):
    points, zero = rays.reshape(-1, 1, 3), np.zeros(3)
    if c.lens_model == "equidistant":
        px = cv2.fisheye.projectPoints(points, zero, zero, c.matrix(), np.array(c.distortion))[0]
    else:
        px = cv2.projectPoints(points, zero, zero, c.matrix(), np.array(c.distortion))[0]
    return np.reshape(px, (*rays.shape[:-1], 2))


def opencv_undistorts(c: Camera, px):
    points, matrix, k = px.reshape(-1, 1, 2), c.matrix(), np.array(c.distortion)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    if c.lens_model == "equidistant":
        found = cv2.fisheye.undistortPoints(points, matrix, k, None, None, matrix, criteria)
    else:
        found = cv2.undistortPoints(points, matrix, k, None, None, matrix, criteria=criteria)
    return np.reshape(found, px.shape)


def whole_image(c: Camera, step=13.0):
    u, v = np.arange(0.0, c.width_px, step), np.arange(0.0, c.height_px, step)
    corner = np.array([c.width_px - 1.0, c.height_px - 1.0])
    return np.vstack([np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2), corner])


@pytest.mark.parametrize("c", CAMERAS.values(), ids=CAMERAS)
def test_every_lens_agrees_with_opencv_both_ways_over_the_image(c):
    px = whole_image(c)
    ideal = c.undistort(px)
    assert np.isfinite(ideal).all()
    assert_allclose(ideal, opencv_undistorts(c, px), rtol=0.0, atol=1e-6)
    rays = np.concatenate([c.normalized(ideal), np.ones((len(px), 1))], axis=1)
    rays *= np.random.default_rng(2).uniform(0.3, 9.0, (len(px), 1))
    assert_allclose(c.project(rays), opencv_projects(c, rays), rtol=0.0, atol=1e-6)
    assert_allclose(c.project(rays), px, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("c", CAMERAS.values(), ids=CAMERAS)
def test_jacobian_is_the_derivative(c):
    ideal, step = c.undistort(whole_image(c, 61.0)), 1e-3
    for axis in range(2):
        change = np.zeros(2)
        change[axis] = step
        slope = (c.distort(ideal + change) - c.distort(ideal - change)) / (2.0 * step)
        assert_allclose(c.distortion_jacobian(ideal)[..., axis], slope, rtol=0.0, atol=2e-8)
    stretch = c.stretch(ideal)
    assert_allclose(np.linalg.det(c.distortion_jacobian(ideal)) * stretch**2, 1.0, rtol=1e-12)


# Turns back beyond the corners; a rational one with a pole; a polynomial fisheye that turns.
ENDING = {
    "wide angle": camera((-0.2535, 0.0924, -0.6e-3, 0.7e-3, -0.0191)),
    "strong": camera((-0.9, 0.0, 0.0, 0.0)),
    "pole": camera((0.1, 0.0, 0.0, 0.0, 0.0, -0.8, 0.0, 0.0)),
    "fisheye": camera((-0.3, 0.0, 0.0, 0.0), "equidistant"),
}


@pytest.mark.parametrize("c", ENDING.values(), ids=ENDING)
def test_beyond_its_valid_radius_a_lens_images_nothing(c):
    radius, turn = c.lens.valid_radius, np.linspace(0.0, 2.0 * math.pi, 37)
    unit = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    assert math.isfinite(radius)
    assert np.isnan(c.lens.distort(1.0001 * radius * unit)).all()
    # Up to it, every image comes from one ray.
    for share in (0.3, 0.9, 0.999):
        seen = c.lens.distort(share * radius * unit)
        assert_allclose(c.lens.undistort(seen, 1e-12), share * radius * unit, rtol=0.0, atol=1e-7)
    outside = np.linalg.norm(c.lens.distort(0.999999 * radius * unit), axis=-1).max()
    if c is not ENDING["pole"]:  # whose image is unbounded
        assert np.isnan(c.lens.undistort(1.01 * outside * unit, 1e-12)).all()


def test_known_radii_of_the_end():
    assert ENDING["strong"].lens.valid_radius == pytest.approx(1.0 / math.sqrt(2.7), rel=1e-6)
    assert ENDING["pole"].lens.valid_radius == pytest.approx(math.sqrt(1.25), rel=1e-6)
    fisheye = math.tan(1.0 / math.sqrt(0.9))
    assert ENDING["fisheye"].lens.valid_radius == pytest.approx(fisheye, rel=1e-9)
    assert CAMERAS["5"].lens.valid_radius == math.inf


def test_angles_to_the_borders_are_those_of_the_rays():
    for c in CAMERAS.values():
        for angle, axis, end in zip(
            c.angles_to_borders(), (0, 1, 0, 1), (0.0, 0.0, 639.0, 479.0), strict=True
        ):
            px = np.array([c.cx_px, c.cy_px])
            px[axis] = end
            ray = c.normalized(c.undistort(px))
            assert angle == pytest.approx(math.atan(abs(ray[axis])))
    ends = ENDING["strong"].angles_to_borders()
    assert ends == pytest.approx([math.atan(ENDING["strong"].lens.valid_radius)] * 4)


@pytest.mark.parametrize("model", COEFFICIENTS)
@pytest.mark.parametrize("count", range(16))
def test_wrong_numbers_of_coefficients_are_refused(model, count):
    if count in COEFFICIENTS[model]:
        assert len(camera((0.01,) * count, model).distortion) == count
    else:
        with pytest.raises(ValueError, match=f"takes .* not {count}"):
            camera((0.01,) * count, model)


def test_unknown_models_and_matrices_with_skew_are_refused():
    with pytest.raises(ValueError, match="unknown lens model 'fov'; known: perspective, equid"):
        camera((0.1,), "fov")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="finite"):
        camera((math.nan, 0.0, 0.0, 0.0))
    matrix = np.array([[500.0, 0.0, 300.0], [0.0, 490.0, 200.0], [0.0, 0.0, 1.0]])
    assert focal_and_centre(matrix) == (500.0, 490.0, 300.0, 200.0)
    matrix[0, 1] = 0.4
    with pytest.raises(ValueError, match=r"skew of 0\.4 px"):
        focal_and_centre(matrix)
    matrix[0, 1], matrix[2, 0] = 0.0, 1.0
    with pytest.raises(ValueError, match="must be"):
        focal_and_centre(matrix)


def test_ros_names_the_models():
    assert CAMERAS["none"].ros_distortion() == ("plumb_bob", [0.0] * 5)
    assert CAMERAS["4"].ros_distortion() == ("plumb_bob", [*FOUR, 0.0])
    assert CAMERAS["8"].ros_distortion() == ("rational_polynomial", list(RATIONAL))
    assert CAMERAS["equidistant"].ros_distortion() == ("equidistant", list(FISHEYE))
