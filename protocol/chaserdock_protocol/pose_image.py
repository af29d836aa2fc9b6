# SPDX-License-Identifier: Apache-2.0
"""Encode a pose as an image, for the perception ``statistical``.

One row of pixels holds the bytes of nine numbers: the pose of the target in the camera, and the
seed of the perception's errors. World and chaser exchange it as a ``mono8`` image, so that
everything but rendering and detection stays as it is.
"""

from __future__ import annotations

import math
import struct

import numpy as np
from chaserdock_models.arrays import Array
from numpy.typing import NDArray

from .codec import UNIT_QUATERNION_TOLERANCE

NAME = "statistical"
"""Value of ``perception.name``."""
_NUMBERS = 9  # position (3), rotation (4) and seed (2)
WIDTH_PX = 8 * _NUMBERS
_NUMBERS_OF = struct.Struct(f"<{_NUMBERS}d")


class UnusableImage(ValueError):
    """An image that a perception cannot use: not of its camera, or damaged."""


def encode_pose(position_irf_m: Array, q_irf_trf_wxyz: Array, seed: tuple[int, int]) -> bytes:
    """Return the pixels of an image (1, ``WIDTH_PX``): position in IRF, rotation TRF to IRF, two
    numbers below 2^32.
    """
    return np.concatenate([position_irf_m, q_irf_trf_wxyz, seed]).astype("<f8").tobytes()


def decode_pose(image: NDArray[np.uint8]) -> tuple[Array, Array, tuple[int, int]]:
    """Return position, rotation and seed. Raises UnusableImage for any other."""
    if image.shape != (1, WIDTH_PX):
        raise UnusableImage(f"an image of {image.shape} is none of perception {NAME!r}")
    numbers = _NUMBERS_OF.unpack(image.tobytes())
    position, q, seeds = numbers[:3], numbers[3:7], numbers[7:]
    seeds_valid = all(0.0 <= seed < 2.0**32 for seed in seeds)
    unit = abs(math.hypot(*q) - 1.0) <= UNIT_QUATERNION_TOLERANCE
    if not (all(map(math.isfinite, position)) and unit and seeds_valid):
        raise UnusableImage("damaged image")
    return np.array(position), np.array(q), (int(seeds[0]), int(seeds[1]))
