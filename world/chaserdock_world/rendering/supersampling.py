"""Several samples to a pixel: a part of an image as its samples, and their means as that part again.

The arithmetic is a kernel (native/samples.c), to the bit cv2.resize's with INTER_NEAREST and INTER_AREA and several times as
fast.
"""

from __future__ import annotations

from ctypes import c_int64, c_void_p

import numpy as np
from chaserdock_models.native import address
from numpy.typing import NDArray

from .native import function


def spread(view: NDArray[np.uint8], samples: int) -> NDArray[np.uint8]:
    """Samples (samples * h, samples * w) of the ``view`` (h, w) of an image, each of its pixel's level; 2 or 4."""
    (rows, columns), place, stride = view.shape, *_place(view, samples)
    fine = np.empty((samples * rows, samples * columns), dtype=np.uint8)
    function("spread_samples")(
        place, stride, c_int64(rows), c_int64(columns), c_int64(samples), address(fine)
    )
    return fine


def take_means(fine: NDArray[np.uint8], samples: int, view: NDArray[np.uint8]) -> None:
    """Gives every pixel of the ``view`` (h, w) of an image the mean of its ``samples`` x ``samples`` samples; 2 or 4.

    Raises ValueError when there are other than (samples * h, samples * w) samples.
    """
    (rows, columns), place, stride = view.shape, *_place(view, samples)
    if fine.shape != (samples * rows, samples * columns) or fine.dtype != np.uint8:
        raise ValueError(f"not {samples} samples to a pixel of {view.shape}: {fine.dtype} {fine.shape}")
    function("mean_of_samples")(
        address(fine), c_int64(rows), c_int64(columns), c_int64(samples), place, stride
    )


def _place(view: NDArray[np.uint8], samples: int) -> tuple[c_void_p, c_int64]:
    """Where a view begins, and how far its rows are apart."""
    if samples not in (2, 4) or view.dtype != np.uint8 or view.strides[1] != 1:
        raise ValueError(f"{samples} samples to a pixel of {view.dtype}, strides {view.strides}")
    return c_void_p(view.ctypes.data), c_int64(view.strides[0])
