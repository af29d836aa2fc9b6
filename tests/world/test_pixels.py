# SPDX-License-Identifier: Apache-2.0
"""Pixel operations of rendering are bit-identical to OpenCV and NumPy on every instruction set."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from chaserdock_models.camera import Camera
from chaserdock_models.native.build import X86_64
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering import background, effects, lens
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.native import LIBRARY
from chaserdock_world.rendering.rasterizer import upsample
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

SIZES = [
    (480, 640),
    (64, 64),
    (65, 67),
    (70, 96),
    (64, 161),
    (217, 333),
    (3, 5),
    (1, 1),
    (2, 40),
    (40, 2),
]


@pytest.fixture(params=[number for number, _ in X86_64], autouse=True)
def instruction_set(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if LIBRARY.level == 0 or request.param > LIBRARY.level:
        pytest.skip(f"this processor has no copy {request.param}")
    own = LIBRARY.function
    for module in (effects, background):
        monkeypatch.setattr(
            module, "function", lambda name, result=None: own(name, result, request.param)
        )


def images(size: tuple[int, int]) -> list[Pixels]:
    """Noise, space with a few stars and a patch of noise, all white, black and white."""
    rng = np.random.default_rng(size)
    noise = rng.integers(0, 256, size, dtype=np.uint8)
    space = np.full(size, 4, dtype=np.uint8)
    space[: size[0] // 3, : size[1] // 2] = noise[: size[0] // 3, : size[1] // 2]
    space[rng.integers(0, size[0], 8), rng.integers(0, size[1], 8)] = rng.integers(0, 256, 8)
    white = np.full(size, 255, dtype=np.uint8)
    return [noise, space, white, np.where(noise > 127, white, np.uint8(0))]


@pytest.mark.parametrize("size", [(480, 640), (33, 97)])
@pytest.mark.parametrize(("read", "shot"), [(1.5, 0.025), (0.0, 0.5), (60.0, 2.0), (3000.0, 0.0)])
def test_noise_kernel_equals_numpy(size: tuple[int, int], read: float, shot: float) -> None:
    camera = CameraEffects(
        size[1], size[0], Effects(point_spread_px=0.0, read_noise=read, shot_noise=shot), seed=3
    )
    assert camera._bank is not None
    for number, image in enumerate(images(size)):
        seeds = np.random.SeedSequence([3, 1, 2, number]).generate_state(3)
        row, column = seeds[0] % 252, seeds[1] % 257
        white = camera._bank[row : row + size[0], column : column + size[1]].astype(np.float32)
        scale = np.float32((1.0 if seeds[2] & 1 else -1.0) * camera._to_levels)
        noise = np.clip(camera._sigma[image].astype(np.float32) * white * scale, -255.0, 255.0)
        expected = np.clip(image + np.rint(noise), 0.0, 255.0).astype(np.uint8)
        np.testing.assert_array_equal(camera.apply(image, 2, number), expected)


@pytest.mark.parametrize("number", [2, 4])
def test_upsampling_equals_nearest_neighbour_interpolation(number: int) -> None:
    rng = np.random.default_rng(number)
    for rows, columns in SIZES:
        view = rng.integers(0, 256, (rows + 5, columns + 7), dtype=np.uint8)[
            2 : 2 + rows, 3 : 3 + columns
        ]
        size = (number * columns, number * rows)
        expected = cv2.resize(view, size, interpolation=cv2.INTER_NEAREST)
        np.testing.assert_array_equal(upsample(view, number), expected)


def test_stars_are_drawn_at_their_projection() -> None:
    rng = np.random.default_rng(4)
    for camera in (Camera.from_hfov(640, 480, 1.0), Camera.from_hfov(64, 64, 2.6)):
        origin, size = np.array([-9.0, -7.0]), (camera.width_px + 11, camera.height_px + 8)
        seen = background.Background(camera, origin, size)
        for q in rng.normal(size=(20, 4)):
            q = q / np.linalg.norm(q)
            expected = np.full(size[::-1], background.SPACE_LEVEL, dtype=np.uint8)
            stars = seen._stars @ background.rotations.to_matrix(q)
            for star, level in zip(stars, seen._star_levels, strict=True):
                column, row = np.rint(camera.project_ideal(star) - origin)
                if star[2] > 0.1 and 0 <= column < size[0] and 0 <= row < size[1]:
                    expected[int(row), int(column)] = level
            sky = seen.draw(q)
            np.testing.assert_array_equal(sky.image, expected)
            assert sky.stars is not None
            for sigma_px in (0.0, 0.5, 1.3):
                blurred = lens.spread_points(expected, sigma_px)
                np.testing.assert_array_equal(lens.spread_sky(sky, sigma_px), blurred)


@pytest.mark.parametrize("sigma_px", [0.0, 0.3, 1.2, 2.6, 8.0])
@pytest.mark.parametrize("size", [(2, 2), (6, 130), (64, 128), (130, 262)])
def test_a_supersampled_image_is_blurred_and_averaged_to_a_rounding(
    size: tuple[int, int], sigma_px: float
) -> None:
    fine = np.random.default_rng(6).integers(0, 256, size, dtype=np.uint8)
    got = lens.spread_and_halve(fine, sigma_px)
    reach = math.ceil(3.0 * sigma_px)
    exact = np.pad(fine.astype(float), reach, mode="edge")
    if reach:
        kernel = cv2.getGaussianKernel(2 * reach + 1, sigma_px, cv2.CV_64F)
        exact = cv2.sepFilter2D(exact, -1, kernel, kernel)
    exact = exact[reach : reach + size[0], reach : reach + size[1]]
    exact = exact.reshape(size[0] // 2, 2, size[1] // 2, 2).mean(axis=(1, 3))
    # Weights are rounded to 1/256.
    assert np.abs(got - exact).max() <= (0.5 if sigma_px == 0.0 else 3.0)
    if exact.size > 1000:  # ties of four levels' mean are rounded up
        assert abs(np.mean(got - exact)) < 0.15


def test_stars_at_the_border_and_beside_each_other_are_blurred_as_the_whole_image_is(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(lens, "_STAR_PIXELS", 0)
    image = np.full((30, 40), background.SPACE_LEVEL, dtype=np.uint8)
    at = np.array([[0, 0], [39, 0], [1, 28], [39, 29], [20, 15], [21, 15], [23, 17], [20, 15]])
    image[at[:, 1], at[:, 0]] = [180, 90, 120, 60, 200, 150, 30, 201]
    for sigma_px in (0.4, 0.8, 2.0):
        blurred = lens.spread_sky(background.Sky(image, at), sigma_px)
        np.testing.assert_array_equal(blurred, lens.spread_points(image, sigma_px))
