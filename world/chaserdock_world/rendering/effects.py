"""What a camera adds to the image of the world: exposure, point spread, noise.

(Lens distortion is geometry, and the renderer's.) Deterministic: an image's noise depends on the seed,
the chaser and the number of the image alone.
"""

from __future__ import annotations

from ctypes import c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from chaserdock_models.native import address
from numpy.typing import NDArray

from .native import function

# The noise bank is larger than an image by these (coprime) numbers of pixels: as many different offsets.
_SPARE_ROWS, _SPARE_COLUMNS = 251, 256
# Fixed-point steps a unit of white noise: 16 bits hold eight standard deviations.
_NOISE_STEPS = 4096.0
# Pixels of a block in native/pixels.h: the farthest that native/blur.c reaches.
_BLOCK_PX = 32


@dataclass(frozen=True)
class Effects:
    """Strengths of the camera's effects; each is off at the value given in brackets.

    ``gain`` (1): exposure, factor on grey levels. ``point_spread_px`` (0): sigma of a Gaussian blur.
    ``read_noise`` (0): standard deviation in grey levels. ``shot_noise`` (0): variance in squared grey
    levels per grey level, i.e. 255 over the number of electrons at white.
    Raises ValueError for negative or non-finite strengths.
    """

    gain: float = 1.0
    point_spread_px: float = 0.6
    read_noise: float = 1.5
    shot_noise: float = 0.025

    def __post_init__(self) -> None:
        for name in ("gain", "point_spread_px", "read_noise", "shot_noise"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and not negative: {value}")


NO_EFFECTS = Effects(1.0, 0.0, 0.0, 0.0)


class CameraEffects:
    """Applies ``effects`` to images of one size; ``seed`` fixes all noise it will ever give."""

    def __init__(self, width_px: int, height_px: int, effects: Effects, seed: int):
        self.effects = effects
        self.seed = seed
        self._shape = (height_px, width_px)
        level = np.arange(256, dtype=np.float64)
        sigma = np.sqrt(effects.read_noise**2 + effects.shot_noise * level)
        self._bank: NDArray[np.int16] | None = None
        if sigma.any():
            # One bank of white noise, read at a random place for each image: drawing fresh noise for
            # every image costs several times what the rest of the effects does.
            generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0])))
            size = (height_px + _SPARE_ROWS, width_px + _SPARE_COLUMNS)
            noise = generator.standard_normal(size, dtype=np.float32) * np.float32(_NOISE_STEPS)
            self._bank = np.clip(np.rint(noise), -32767, 32767).astype(np.int16)
            # Steps a grey level of standard deviation: a power of two, as many as 16 bits hold.
            steps = 2.0 ** min(np.floor(np.log2(32767.0 / sigma.max())), 64.0)
            self._sigma = np.rint(sigma * steps).astype(np.int16)
            self._to_levels = 1.0 / (_NOISE_STEPS * steps)

    def apply(self, image: NDArray[np.uint8], chaser: int, number: int) -> NDArray[np.uint8]:
        """Image ``number`` of chaser ``chaser`` (both from 0), as the camera gives it (h, w), uint8.

        The given image is not changed. Raises ValueError for another size or type than stated before.
        """
        if image.shape != self._shape or image.dtype != np.uint8:
            raise ValueError(f"expected a uint8 image of {self._shape}, got {image.dtype} {image.shape}")
        out = image
        if self.effects.gain != 1.0:
            out = np.asarray(cv2.convertScaleAbs(out, alpha=self.effects.gain), dtype=np.uint8)
        if self.effects.point_spread_px > 0.0:
            out = blurred(out, self.effects.point_spread_px)
        if self._bank is not None:
            # The 1 keeps these streams apart from the bank's own.
            seeds = np.random.SeedSequence([self.seed, 1, chaser, number]).generate_state(3)
            row, column = int(seeds[0]) % (_SPARE_ROWS + 1), int(seeds[1]) % (_SPARE_COLUMNS + 1)
            noise = self._bank[row : row + self._shape[0], column : column + self._shape[1]]
            sign = 1.0 if seeds[2] & 1 else -1.0
            # Grey levels are whole, so noise rounded to whole ones before it is added is no loss.
            out, noisy = np.ascontiguousarray(out), np.empty(self._shape, dtype=np.uint8)
            function("add_noise")(
                c_void_p(out.ctypes.data), c_void_p(noise.ctypes.data), c_int64(self._bank.shape[1]),
                address(self._sigma), c_double(sign * self._to_levels), *map(c_int64, self._shape), address(noisy),
            )  # fmt: skip
            return noisy
        return np.array(out, dtype=np.uint8) if out is image else np.asarray(out, dtype=np.uint8)


@cache
def blur_taps(sigma_px: float) -> NDArray[np.uint16]:
    """Weights (2 r + 1,) of a Gaussian blur, in 256ths, of sum 256; r: three sigma, rounded up.

    As OpenCV has them for 8-bit images: rounded from the outside inwards, each error passed on to the next weight.
    """
    radius = int(np.ceil(3.0 * sigma_px))
    exact = 256.0 * cv2.getGaussianKernel(2 * radius + 1, sigma_px).ravel()
    taps, error = np.zeros(2 * radius + 1, dtype=np.uint16), 0.0
    for i, weight in enumerate(exact[:radius].tolist()):
        taps[i] = taps[-1 - i] = whole = round(weight + error)
        error += weight - whole
    taps[radius] = 256 - 2 * int(taps[:radius].sum())
    return taps


def blurred(image: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    """The image (h, w) with a Gaussian blur of ``sigma_px``, beyond its borders as at them: to the bit what
    cv2.GaussianBlur gives, but quick where an image is even, as most of space is."""
    taps = blur_taps(sigma_px)
    (rows, columns), width = image.shape, len(taps)
    if width // 2 > _BLOCK_PX:  # the kernel looks no farther; such a blur is rare
        out = cv2.GaussianBlur(image, (width, width), sigma_px, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(out, dtype=np.uint8)
    image, out = np.ascontiguousarray(image), np.empty((rows, columns), dtype=np.uint8)
    blocks = -(-columns // _BLOCK_PX)
    sums = np.empty((width, blocks, _BLOCK_PX), dtype=np.float32)
    levels, made = (
        np.empty((width + 4, blocks + 2), dtype=np.int32),
        np.empty((width, blocks), dtype=np.int32),
    )
    function("blur")(
        c_void_p(image.ctypes.data), c_int64(rows), c_int64(columns), address(taps), c_int64(width // 2),
        address(sums), address(levels), address(made), address(out),
    )  # fmt: skip
    return out
