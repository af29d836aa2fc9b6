# SPDX-License-Identifier: Apache-2.0
"""Images of the emulated laboratory's cameras: a cuboid with printed markers in front of a wall,
with blur and noise. By homographies of OpenCV; shares no code with chaserdock.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from lab_devices import Exposure, Setup
from scipy.spatial.transform import Rotation

M_PX = 0.00025  # of a pixel in the texture of a face: edges of markers are then whole pixels
LEVELS = 5  # of textures, each half as large as the last
BODY, PAPER, INK = 150, 235, 18  # grey values
BLUR_PX, NOISE = 0.7, 2.0
SUPERSAMPLED = 4  # steps of a pixel's edge to which a face's outline is drawn
# Outward normal, and up direction of the markers, of the faces in the order of the ids.
FACES = (
    ((1, 0, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 0, 1)),
    ((0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)),
    ((0, 0, 1), (0, 1, 0)),
    ((0, 0, -1), (0, 1, 0)),
)


class Camera:
    """Draws what an exposure shows. ``matrix`` (3, 3): of the camera."""

    def __init__(self, setup: Setup) -> None:
        optics, rng = setup.optics, np.random.default_rng(5)
        self.size = (optics.width, optics.height)
        focal = optics.width / 2.0 / np.tan(np.radians(optics.hfov_deg) / 2.0)
        centre = (optics.width - 1) / 2.0, (optics.height - 1) / 2.0
        self.matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        coarse = rng.uniform(20, 70, (optics.height // 40, optics.width // 40)).astype(np.float32)
        self._wall = cv2.resize(coarse, self.size, interpolation=cv2.INTER_CUBIC).astype(np.uint8)
        # Noise of a larger image, a piece of which each image gets: drawing it anew takes longer.
        shape = (optics.height + 64, optics.width + 64)
        self._noise = rng.normal(0.0, NOISE, shape).round().astype(np.int8)
        self._faces = [_face(setup, number) for number in range(len(FACES))]

    def picture(self, exposure: Exposure) -> np.ndarray:
        """Return the image (h, w), uint8."""
        w, x, y, z = exposure.q_wxyz
        rotation, place = Rotation.from_quat([x, y, z, w]), exposure.target_m
        image = self._wall.copy()
        for textures, to_target, normal in self._faces:
            corner = rotation.apply(to_target[:, 2]) + place
            if rotation.apply(normal) @ corner >= 0.0:  # turned away
                continue
            axes = np.column_stack([rotation.apply(a) for a in to_target[:, :2].T])
            homography = self.matrix @ np.column_stack([axes, corner])
            self._draw(image, textures, homography)
        image = cv2.GaussianBlur(image, (5, 5), BLUR_PX)
        x0, y0 = exposure.number % 64, exposure.number // 64 % 64
        noise = self._noise[y0 : y0 + self.size[1], x0 : x0 + self.size[0]]
        return np.clip(image.astype(np.int16) + noise, 0, 255).astype(np.uint8)

    def _draw(self, image: np.ndarray, textures: list[np.ndarray], homography: np.ndarray) -> None:
        height, width = textures[0].shape
        ends = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]]) - (
            0.5,
            0.5,
            0,
        )
        seen = homography @ ends.T
        if (seen[2] < 0.02).any():  # beside or behind the lens
            return
        outline = (seen[:2] / seen[2]).T
        # A texture that is drawn small is averaged before, as else its lines would flicker.
        scale = np.linalg.norm(outline[1] - outline[0]) / width
        level = min(max(0, math.ceil(-math.log2(2.0 * scale))), LEVELS - 1)
        drawn = cv2.warpPerspective(
            textures[level],
            homography @ np.diag([2.0**level, 2.0**level, 1.0]),
            self.size,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        mask = np.zeros(image.shape, np.uint8)
        points = np.round(outline * 2**SUPERSAMPLED).astype(np.int32)
        cv2.fillConvexPoly(mask, points, 255, cv2.LINE_AA, SUPERSAMPLED)
        share = mask.astype(np.uint16)
        image[:] = ((drawn * share + image * (255 - share)) // 255).astype(np.uint8)


def _face(setup: Setup, number: int) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Return a face's textures (h, w), each half as large as the last; what maps pixels (u, v, 1)
    of the first to the target's axes (3, 3); and its normal (3,).
    """
    normal, up = (np.array(v, dtype=float) for v in FACES[number])
    right = np.cross(up, normal)
    size = setup.target.size_m
    width_m, height_m, depth_m = (float(np.abs(a) @ size) for a in (right, up, normal))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, setup.dictionary))
    cells = dictionary.markerSize + 2
    shape = round(height_m / M_PX), round(width_m / M_PX)
    texture = np.full(shape, BODY, np.uint8)

    def box(right_m: float, up_m: float, half_m: float) -> tuple[slice, slice]:
        u, v = (width_m / 2 + right_m) / M_PX, (height_m / 2 - up_m) / M_PX
        h = half_m / M_PX
        rows = slice(max(0, round(v - h)), min(shape[0], round(v + h)))
        return rows, slice(max(0, round(u - h)), min(shape[1], round(u + h)))

    for side, right_m, up_m in setup.layout:
        texture[box(right_m, up_m, side / 2 + setup.margin_m)] = PAPER
    for k, (side, right_m, up_m) in enumerate(setup.layout):
        where = box(right_m, up_m, side / 2)
        marker = cv2.aruco.generateImageMarker(dictionary, number * len(setup.layout) + k, cells)
        room = texture[where]
        marker = cv2.resize(marker, room.shape[::-1], interpolation=cv2.INTER_NEAREST)
        texture[where] = np.where(marker > 127, PAPER, INK)
    origin = right * (-width_m + M_PX) / 2 + up * (height_m - M_PX) / 2 + normal * depth_m / 2
    textures: list[Any] = [texture]
    while len(textures) < LEVELS:
        textures.append(cv2.pyrDown(textures[-1]))
    return textures, np.column_stack([right * M_PX, -up * M_PX, origin]), normal
