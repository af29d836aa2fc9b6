# SPDX-License-Identifier: Apache-2.0
"""Camera calibration from rendered boards."""

import cv2
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_protocol.scenario import load_scenario
from chaserdock_world.rendering.lens import LensMap

from chaserdock.calibration.intrinsics import (
    BadBoard,
    TooFew,
    board_of,
    calibrate,
    write_calibration,
)

SCENARIO = """
name = "calibrated"
duration_s = 1.0
[target]
model = "paper"
[[chasers]]
position_m = [-1.0, 0.0, 0.0]
q_wxyz = [1.0, 0.0, 0.0, 0.0]
[camera]
calibration = "camera.yaml"
"""
TRUE = Camera(640, 480, 615.0, 612.0, 325.0, 236.0, (-0.22, 0.06, 8e-4, -5e-4, 0.0))


def board_images(board, count, seed=3):
    """Draw the board, warp it into the ideal image (4 samples per pixel side), and distort it."""
    rows, columns = (6, 8)
    scale = 4000.0  # pixels a metre of the drawing
    if board.charuco is not None:
        drawing = board.charuco.generateImage(
            (round(columns * 0.03 * scale), round(rows * 0.03 * scale))
        )
        origin = 0.0
    else:
        squares = (np.indices((board.size[1] + 1, board.size[0] + 1)).sum(axis=0) % 2 * 255).astype(
            np.uint8
        )
        drawing = np.kron(squares, np.ones((120, 120), np.uint8))
        origin = 0.03
    drawing = cv2.copyMakeBorder(drawing, 80, 80, 80, 80, cv2.BORDER_CONSTANT, value=255)
    origin += 80 / scale
    generator, lens, out = np.random.default_rng(seed), LensMap(TRUE), {}
    for k in range(count):
        turn = rotations.to_matrix(rotations.exp(generator.uniform(-0.5, 0.5, 3)))
        centre = np.array([*generator.uniform(-0.03, 0.03, 2), generator.uniform(0.38, 0.5)])
        middle = (
            np.array([columns, rows]) * 0.015
            if board.charuco is not None
            else board.points_m.mean(axis=0)[:2]
        )
        at = centre - turn @ np.append(middle, 0.0)
        # Pixel of the drawing -> metres on the board -> ideal pixel -> sample.
        to_board = np.array(
            [[1 / scale, 0, 0.5 / scale - origin], [0, 1 / scale, 0.5 / scale - origin], [0, 0, 1]]
        )
        shift = 1.5 - 4.0 * lens.origin_px
        to_sample = np.array([[4.0, 0, shift[0]], [0, 4.0, shift[1]], [0, 0, 1]])
        homography = to_sample @ TRUE.matrix() @ np.column_stack([turn[:, :2], at]) @ to_board
        size = (4 * lens.size_px[0], 4 * lens.size_px[1])
        fine = cv2.warpPerspective(drawing, homography, size, flags=cv2.INTER_AREA, borderValue=90)
        ideal = np.asarray(cv2.resize(fine, lens.size_px, interpolation=cv2.INTER_AREA), np.uint8)
        noisy = lens.distort(ideal) * 0.85 + generator.normal(0.0, 1.5, (480, 640))
        out[f"{k:02}.png"] = np.clip(noisy, 0, 255).astype(np.uint8)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["charuco 8x6", "chessboard 7x5"])
def test_calibration_recovers_the_camera_of_rendered_boards(kind, tmp_path):
    board = board_of(kind, 0.03, 0.022, "DICT_4X4_50")
    images: dict = board_images(board, 14)
    images["empty.png"] = np.zeros((480, 640), np.uint8)
    images["small.png"] = np.zeros((100, 100), np.uint8)
    images["broken.png"] = None
    # A bent board: every corner is detected, at a wrong place.
    bent = images["13.png"]
    x, y = np.meshgrid(np.arange(640, dtype=np.float32), np.arange(480, dtype=np.float32))
    images["bent.png"] = np.asarray(
        cv2.remap(bent, x + 6 * np.sin(y / 40), y, cv2.INTER_LINEAR), np.uint8
    )
    found = calibrate(images, board)
    assert found.excluded.keys() == {"empty.png", "small.png", "broken.png", "bent.png"}
    assert "outlier" in found.excluded["bent.png"]
    assert found.total_rms_px < 0.3
    truth = (TRUE.fx_px, TRUE.fy_px, TRUE.cx_px, TRUE.cy_px)
    matrix = found.matrix
    got = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    assert np.abs(np.subtract(got, truth)).max() < 2.5
    # The decisive measure: projections over the image, except its corners, agree within half a
    # pixel.
    fx, fy, cx, cy = (float(v) for v in got)
    ours = Camera(640, 480, fx, fy, cx, cy, tuple(found.distortion.tolist()))
    rays = np.stack(
        [*np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.22, 0.22, 7)), np.ones((7, 9))],
        axis=-1,
    )
    away = ours.project(rays) - TRUE.project(rays)
    assert np.linalg.norm(away - away.mean(axis=(0, 1)), axis=-1).max() < 0.5

    write_calibration(found, tmp_path / "camera.yaml")
    (tmp_path / "s.toml").write_text(SCENARIO)
    camera = load_scenario(tmp_path / "s.toml").camera_model()
    assert camera.matrix() == pytest.approx(matrix)
    assert camera.distortion == pytest.approx(tuple(found.distortion))


def test_too_few_images_and_invalid_boards_raise_errors():
    board = board_of("charuco 8x6", 0.03, 0.022, "DICT_4X4_50")
    with pytest.raises(TooFew, match=r"0 usable[\s\S]*a\.png: 0 corners"):
        calibrate({"a.png": np.zeros((480, 640), np.uint8)}, board)
    for wrong in (
        ("charuco 2x6", 0.03, 0.02),
        ("checkers", 0.03, 0.02),
        ("charuco 8x6", 0.03, 0.04),
    ):
        with pytest.raises(BadBoard):
            board_of(*wrong, "DICT_4X4_50")
