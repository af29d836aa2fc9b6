# SPDX-License-Identifier: Apache-2.0
"""Calibrates camera matrix and distortion from images of a board, with OpenCV.

Outlier images are excluded and named: those whose RMS error exceeds three times the median and half
a pixel. This does not compensate for a board that is not flat.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from chaserdock_agents.chaser.perception.detect import dictionary_of
from chaserdock_models.arrays import Array
from chaserdock_protocol.output_files import write_atomically
from numpy.typing import NDArray

LEAST_IMAGES = 6
"""Least number of usable images: twice the three that determine a camera matrix (Z. Zhang, 2000),
to cover distortion and outliers.
"""
_LEAST_CORNERS = 8
"""Least number of corners in an image: twice the four that determine the pose of a plane."""
_OUTLIER_RATIO, _OUTLIER_PX = 3.0, 0.5
"""RMS error of an outlier: above this multiple of the median, and above this many pixels, which
sharp corners do not exceed.
"""
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


class BadBoard(Exception):
    """Invalid board, or a folder without images."""


class TooFew(Exception):
    """Too few usable images; the text gives the reason for each rejected one."""


@dataclass(frozen=True)
class Board:
    """A calibration board. ``points_m`` (n, 3): inner corners, board axes. ``charuco``: OpenCV's
    board. A chessboard has None there and ``size`` corners.
    """

    points_m: NDArray[np.float32]
    size: tuple[int, int]
    charuco: Any = None


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera and how well the images fit it.

    ``matrix`` (3, 3), pixels. ``distortion`` (5,): k1, k2, p1, p2, k3. ``sigma`` (4,): standard
    deviations of fx, fy, cx and cy, pixels. ``rms_px``: error of each image that was used.
    ``excluded``: why each other image was not.
    """

    width_px: int
    height_px: int
    matrix: Array
    distortion: Array
    sigma: Array
    total_rms_px: float
    rms_px: dict[str, float]
    excluded: dict[str, str]


def board_of(text: str, square_m: float, marker_m: float, dictionary: str) -> Board:
    """Parse a board such as ``charuco 8x6`` (squares) or ``chessboard 9x6`` (inner corners). Raise
    BadBoard.
    """
    parsed = re.fullmatch(r"(charuco|chessboard)\s+(\d+)x(\d+)", text.strip())
    if parsed is None or min(int(parsed[2]), int(parsed[3])) < 3:
        raise BadBoard(
            f"--board {text}: must be like 'charuco 8x6' or 'chessboard 9x6', 3 or more each way"
        )
    size = (int(parsed[2]), int(parsed[3]))
    if not square_m > 0.0:
        raise BadBoard(f"--square {square_m}: must be positive")
    if parsed[1] == "chessboard":
        grid = np.mgrid[: size[0], : size[1]].T.reshape(-1, 2) * square_m
        return Board(np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32), size)
    if not 0.0 < marker_m < square_m:
        raise BadBoard(f"--marker {marker_m}: must be smaller than a square ({square_m})")
    try:
        table = dictionary_of(dictionary)
    except ValueError as error:
        raise BadBoard(f"--dictionary: {error}") from None
    if size[0] * size[1] // 2 > len(table.bytesList):
        raise BadBoard(
            f"--board {text}: needs {size[0] * size[1] // 2} markers, {dictionary} has fewer"
        )
    charuco = cv2.aruco.CharucoBoard(size, square_m, marker_m, table)
    return Board(np.asarray(charuco.getChessboardCorners(), dtype=np.float32), size, charuco)


def calibrate_folder(folder: Path, board: Board) -> Calibration:
    """Calibrate with all images in a folder. Raise BadBoard without images, TooFew with too few
    usable ones.
    """
    paths = (
        sorted(p for p in folder.glob("*") if p.suffix.lower() in _SUFFIXES)
        if folder.is_dir()
        else []
    )
    if not paths:
        raise BadBoard(f"{folder}: contains no images ({', '.join(_SUFFIXES)})")
    images: dict[str, NDArray[np.uint8] | None] = {}
    for path in paths:
        image: Any = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        images[path.name] = image
    return calibrate(images, board)


def calibrate(images: dict[str, NDArray[np.uint8] | None], board: Board) -> Calibration:
    """Calibrate with grey images by name (None: unreadable). Raise TooFew."""
    excluded: dict[str, str] = {}
    views: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
    shapes = [p.shape for p in images.values() if p is not None]
    usual = max(sorted(set(shapes)), key=shapes.count) if shapes else (0, 0)

    for name, image in images.items():
        if image is None:
            excluded[name] = "not an image"
        elif image.shape != usual:
            excluded[name] = f"{image.shape[1]} x {image.shape[0]}, others {usual[1]} x {usual[0]}"
        else:
            points, px = find_board(image, board)
            if len(px) < _LEAST_CORNERS:
                excluded[name] = f"{len(px)} corners of the board found, {_LEAST_CORNERS} needed"
            else:
                views[name] = (points, px)

    # Calibrate without the worst image until none is an outlier.
    while True:
        if len(views) < LEAST_IMAGES:
            reasons = "".join(f"\n{name}: {reason}" for name, reason in excluded.items())
            raise TooFew(f"{len(views)} usable images, at least {LEAST_IMAGES} are needed{reasons}")

        points = [v[0] for v in views.values()]
        px = [v[1] for v in views.values()]
        size = (usual[1], usual[0])
        # The type stubs require initial matrices, which OpenCV treats as optional.
        solve: Any = cv2.calibrateCameraExtended
        total, matrix, lens, _, _, sigma, _, each = solve(points, px, size, None, None)

        rms = dict(zip(views, np.ravel(each).tolist(), strict=True))
        worst = max(rms, key=lambda name: rms[name])
        if rms[worst] <= max(_OUTLIER_RATIO * float(np.median(list(rms.values()))), _OUTLIER_PX):
            break
        excluded[worst] = f"outlier: RMS error {rms[worst]:.2f} px"
        del views[worst]

    return Calibration(
        usual[1],
        usual[0],
        np.asarray(matrix, dtype=float),
        np.ravel(lens).astype(float)[:5],
        np.ravel(sigma)[:4].astype(float),
        float(total),
        rms,
        excluded,
    )


def find_board(
    image: NDArray[np.uint8], board: Board
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Detect corners: return them in board axes (n, 3), metres, and in the image (n, 2), pixels."""
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32)
    if board.charuco is None:
        find: Any = cv2.findChessboardCornersSB
        ok, px = find(image, board.size, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
        return (board.points_m, np.asarray(px, np.float32).reshape(-1, 2)) if ok else nothing
    px, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco).detectBoard(image)
    if ids is None or px is None:
        return nothing
    return board.points_m[np.asarray(ids, dtype=np.intp).ravel()], np.asarray(
        px, np.float32
    ).reshape(-1, 2)


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write OpenCV's YAML, JSON or XML, by the file's suffix. Raise OSError."""
    store = cv2.FileStorage(path.name, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    store.write("image_width", calibration.width_px)
    store.write("image_height", calibration.height_px)
    store.write("camera_matrix", calibration.matrix)
    store.write("distortion_coefficients", calibration.distortion.reshape(1, -1))
    store.write("avg_reprojection_error", calibration.total_rms_px)
    store.write("nr_of_frames", len(calibration.rms_px))
    write_atomically(path, store.releaseAndGetString())
