# SPDX-License-Identifier: Apache-2.0
"""Apply camera effects to the rendered image: exposure, noise.

Point spread and distortion are part of rendering (``lens``). Deterministic: the noise of an image
depends on the seed, the chaser and the image number only. It is added in C (native/noise.c): 1280 x
960 pixels take 0.3 ms, with NumPy 4 ms, with OpenCV 7 ms.
"""

from __future__ import annotations

from ctypes import c_double, c_int64, c_void_p

import cv2
import numpy as np
from chaserdock_models.native import address
from chaserdock_protocol.scenario.camera import Effects
from numpy.typing import NDArray

from .native import function

# Numbers of pixels, coprime, by which the noise bank exceeds an image: as many offsets as their
# product.
_SPARE_ROWS, _SPARE_COLUMNS = 251, 256
# Fixed-point steps per unit of white noise: 16 bits hold eight standard deviations.
_NOISE_STEPS = 4096.0
_METERED_SHARE, _LARGEST_GAIN = 0.01, 8.0
"""Automatic exposure: share of the brightest pixels by which it is set, and its largest gain, 18 dB
(docs/cameras.md). Smaller share: fewer pixels saturate; larger gain: a brighter target at night,
with more noise.
"""


def exposure_gain(image: NDArray[np.uint8], level: float) -> float:
    """Return the factor, 1/8 to 8, that brings the brightest hundredth of the pixels to ``level``.

    It is set by the darkest pixel of these.
    """
    above = np.cumsum(np.bincount(image.ravel(), minlength=256)[::-1])
    bright = 255 - int(np.searchsorted(above, _METERED_SHARE * image.size))
    return float(np.clip(level / max(bright, 1), 1.0 / _LARGEST_GAIN, _LARGEST_GAIN))


class CameraEffects:
    """Apply gain, read noise and shot noise to images of one size; ``seed`` fixes all noise."""

    def __init__(self, width_px: int, height_px: int, effects: Effects, seed: int):
        self.effects = effects
        self.seed = seed
        self._shape = (height_px, width_px)
        level = np.arange(256, dtype=np.float64)
        sigma = np.sqrt(effects.read_noise**2 + effects.shot_noise * level)
        self._bank: NDArray[np.int16] | None = None
        if sigma.any():
            # One bank of white noise is read at a random offset for each image: new noise for every
            # image would cost several times as much as all other effects.
            generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0])))
            size = (height_px + _SPARE_ROWS, width_px + _SPARE_COLUMNS)
            noise = generator.standard_normal(size, dtype=np.float32) * np.float32(_NOISE_STEPS)
            self._bank = np.clip(np.rint(noise), -32767, 32767).astype(np.int16)
            # Fixed-point steps per grey level of standard deviation: the largest power of two that
            # 16 bits hold.
            steps = 2.0 ** min(np.floor(np.log2(32767.0 / sigma.max())), 64.0)
            self._sigma = np.rint(sigma * steps).astype(np.int16)
            self._to_levels = 1.0 / (_NOISE_STEPS * steps)

    def apply(self, image: NDArray[np.uint8], chaser: int, number: int) -> NDArray[np.uint8]:
        """Return image ``number`` of chaser ``chaser`` with the effects, a new array (h, w), uint8.

        Raises ValueError for an image of another size or type than the camera's.
        """
        if image.shape != self._shape or image.dtype != np.uint8:
            raise ValueError(
                f"expected a uint8 image of {self._shape}, got {image.dtype} {image.shape}"
            )
        out = image
        gain = (
            exposure_gain(image, self.effects.auto_exposure)
            if self.effects.auto_exposure
            else self.effects.gain
        )
        if gain != 1.0:
            out = np.asarray(cv2.convertScaleAbs(out, alpha=gain), dtype=np.uint8)
        if self._bank is not None:
            return self._add_noise(out, self._bank, chaser, number)
        return out.copy() if out is image else out

    def _add_noise(
        self, image: NDArray[np.uint8], bank: NDArray[np.int16], chaser: int, number: int
    ) -> NDArray[np.uint8]:
        # The 1 separates these streams from that of the bank.
        seeds = np.random.SeedSequence([self.seed, 1, chaser, number]).generate_state(3)
        row, column = int(seeds[0]) % (_SPARE_ROWS + 1), int(seeds[1]) % (_SPARE_COLUMNS + 1)
        noise = bank[row : row + self._shape[0], column : column + self._shape[1]]
        sign = 1.0 if seeds[2] & 1 else -1.0
        # Noise is rounded to whole grey levels before it is added, which is exact as the levels are
        # whole.
        image, noisy = np.ascontiguousarray(image), np.empty(self._shape, dtype=np.uint8)
        function("add_noise")(
            c_void_p(image.ctypes.data), c_void_p(noise.ctypes.data), c_int64(bank.shape[1]),
            address(self._sigma),
            c_double(sign * self._to_levels), *map(c_int64, self._shape), address(noisy),
        )  # fmt: skip
        return noisy
