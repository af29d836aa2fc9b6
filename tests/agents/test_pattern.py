# SPDX-License-Identifier: Apache-2.0
"""Corners of small markers by all their cells, in images made by supersampling."""

import cv2
import numpy as np
import pytest
from chaserdock_agents.chaser.perception import pattern
from chaserdock_models.camera import Camera

WHITE = np.pad([[1, 0, 1, 1], [0, 0, 1, 0], [1, 1, 0, 1], [0, 1, 0, 0]], 1).astype(np.uint8)[None]
CAMERA = Camera.from_hfov(64, 56, 0.1)
QUADS = {
    "upright": [[20.3, 18.2], [38.1, 19.4], [37.2, 37.7], [19.1, 36.0]],
    "askew": [[17.2, 26.3], [34.1, 14.8], [45.6, 23.1], [31.0, 36.9]],
    "tiny": [[24.2, 21.9], [33.6, 23.8], [31.8, 32.7], [22.7, 31.2]],
}
BORDER, NEXT = 0.25, (30.0, 150.0, 80.0, 110.0)


def image_of(quad, camera=CAMERA, outlined=True, noise=0.0, seed=0, blur_px=0.6):
    """Return an image of a marker with 30 grey levels in its black and 190 in its white cells.

    Beyond the white border there are other levels at each end or, not ``outlined``, is another
    marker on the right.
    """
    fine = 8
    columns, rows = np.meshgrid(*((np.arange(n * fine) + 0.5) / fine - 0.5 for n in (64, 56)))
    ideal = camera.undistort(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    back = cv2.getPerspectiveTransform(np.array(quad, dtype=np.float32), square)
    u, v = cv2.perspectiveTransform(ideal[None], back)[0].T
    cell = np.clip((np.stack([v, u]) * 6).astype(int), 0, 5)
    level = np.where(WHITE[0][cell[0], cell[1]] > 0, 190.0, 30.0)
    level[(np.minimum(u, v) < 0.0) | (np.maximum(u, v) > 1.0)] = 190.0
    if outlined:
        low, high = -BORDER, 1.0 + BORDER
        for beyond, grey in zip((v > high, v < low, u > high, u < low), NEXT, strict=True):
            level[beyond] = grey
    else:
        level[u > 1.0 + BORDER] = 30.0
    level = level.reshape(56 * fine, 64 * fine)
    level = np.asarray(cv2.GaussianBlur(level, (0, 0), blur_px * fine))
    level = level.reshape(56, fine, 64, fine).mean(axis=(1, 3))
    level += noise * np.random.default_rng(seed).normal(size=(56, 64))
    return np.clip(np.round(level), 0, 255).astype(np.uint8)


def fitted(image, start, camera=CAMERA, outlined=True, white=WHITE):
    return pattern.fit(
        image, camera, np.array([start]), white, np.array([BORDER]), np.array([outlined])
    )


@pytest.mark.parametrize("outlined", [True, False])
@pytest.mark.parametrize("name", QUADS)
def test_corners_are_found_from_two_thirds_of_a_pixel_away(name, outlined):
    quad = np.array(QUADS[name])
    off = np.array([[0.6, -0.3], [0.2, 0.6], [-0.5, -0.4], [0.3, -0.6]])
    found = fitted(image_of(quad, outlined=outlined), quad + off, outlined=outlined)
    assert found.good.all()
    assert np.abs(found.corners_px[0] - quad).max() < 0.03


def test_corners_through_a_lens_are_ideal():
    camera = Camera(64, 56, 150.0, 143.0, -40.0, -25.0, (-0.2, 0.05, 0.003, -0.002))
    quad = camera.undistort(np.array(QUADS["askew"]))
    found = fitted(image_of(quad, camera), quad + 0.3, camera)
    assert found.good.all()
    assert np.abs(found.corners_px[0] - quad).max() < 0.03
    assert np.abs(quad - QUADS["askew"]).max() > 1.0  # by how much the lens moves them


@pytest.mark.parametrize("outlined", [True, False])
@pytest.mark.parametrize("name", QUADS)
def test_errors_of_noise_are_as_stated(name, outlined):
    quad, squares = np.array(QUADS[name]), []
    exact = fitted(image_of(quad, outlined=outlined), quad, outlined=outlined).corners_px[0]
    for seed in range(100):
        image = image_of(quad, outlined=outlined, noise=4.0, seed=seed)
        found = fitted(image, quad, outlined=outlined)
        off = found.errors.whitening[0] @ (found.corners_px[0] - exact).ravel()
        squares.append(off @ off)
    assert 6.0 < np.mean(squares) < 9.5


def test_other_markers_and_corners_that_are_a_cell_off_are_not_found():
    quad = np.array(QUADS["upright"])
    image = image_of(quad)
    assert not fitted(image, quad, white=np.rot90(WHITE, axes=(1, 2)).copy()).good.any()
    inner = quad.mean(axis=0) + (quad - quad.mean(axis=0)) * 4.0 / 6.0
    assert not fitted(image, inner).good.any()
    assert not fitted(np.full_like(image, 90), quad).good.any()


def test_the_largest_small_markers_are_fitted_as_far_as_few_others_are_known():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    camera = Camera.from_hfov(640, 480, 1.0)
    quads = np.array([square * side + 200.0 for side in (12.0, 90.0, 20.0, 16.0)])
    assert pattern.which_to_fit(camera, quads, 6).tolist() == [2, 3, 0]
    assert pattern.which_to_fit(camera, quads, 6, pattern.ENOUGH - 3).tolist() == [2, 3]
    assert pattern.which_to_fit(camera, quads, 6, pattern.ENOUGH).tolist() == []
