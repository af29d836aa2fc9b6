# SPDX-License-Identifier: Apache-2.0
"""Describe the surroundings of points, so that they are known again when a face returns.

As SIFT (Lowe 2004): histograms of gradient directions in 4 x 4 cells. Orientation and size are not
those of the image, but of the target: the patch has a fixed width in metres, and its upper side
looks along a fixed direction of the target's axes. Both come from an estimate of the target's
attitude and range, without which nothing is described.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import DESCRIPTION_BYTES
from numpy.typing import NDArray

from ..refine import PoseInCamera


@dataclass(frozen=True)
class DescriptionTuning:
    """Numbers of the descriptions, with units and reasons."""

    width_m: float = 0.09
    """Width of a described patch on the target: 37 px at 2 m in an image of 960 px and 60 degrees;
    less is not distinctive, more reaches over edges."""
    samples: int = 24
    """Samples a side: six for each cell, a step of 1.5 px at 2 m."""
    most: float = 0.2
    """Limit of an element, as Lowe's: one strong edge must not decide."""
    axis: tuple[float, float, float] = (0.36, 0.48, 0.8)
    """Direction in the target's axes that is up in a patch; any that no face is likely to have as
    its normal."""


@dataclass(frozen=True, eq=False)
class PointDescriptions:
    """Descriptions of points: ``ids`` (n,), ``values`` (n, 128), uint8, of length 512."""

    ids: IntArray
    values: NDArray[np.uint8]


def describe(
    image: NDArray[np.uint8],
    camera: Camera,
    ids: IntArray,
    px: Array,
    predicted: PoseInCamera,
    tuning: DescriptionTuning | None = None,
) -> PointDescriptions:
    """Describe points at ideal pixels ``px`` (n, 2) of a grey image (h, w).

    ``predicted``: pose of the target. Points whose patch leaves the image are left out.
    """
    tuning = tuning or DescriptionTuning()
    n = tuning.samples
    up = camera.fx_px * (predicted.rotation @ np.array(tuning.axis))
    # Direction in which a short step along the axis moves a point of the image.
    rays = np.column_stack([camera.normalized(px), np.ones(len(px))])
    along = up[:2] - rays[:, :2] * up[2]
    length = np.linalg.norm(along, axis=1)
    along /= np.where(length > 0.0, length, 1.0)[:, None]
    side = np.column_stack([-along[:, 1], along[:, 0]])
    step_px = tuning.width_m * camera.fx_px / float(predicted.position[2]) / n
    offsets = (np.arange(n) - (n - 1) / 2.0) * step_px
    at = (
        px[:, None, None]
        + offsets[:, None, None] * along[:, None, None]
        + offsets[None, :, None] * side[:, None, None]
    )
    at = camera.distort(at).astype(np.float32)
    size = np.array([camera.width_px, camera.height_px])
    whole = ((at >= 0) & (at <= size - 1)).all(axis=(1, 2, 3)) & (length > 0.0)
    at, count = at[whole], int(whole.sum())
    if not count:
        return PointDescriptions(ids[:0], np.zeros((0, DESCRIPTION_BYTES), np.uint8))
    blurred = cv2.GaussianBlur(image, (0, 0), max(0.5 * step_px, 0.3))
    flat = at.reshape(count * n, n, 2)
    patches = cv2.remap(blurred, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR)
    values = _histograms(patches.reshape(count, n, n).astype(np.float32), tuning.most)
    return PointDescriptions(np.asarray(ids)[whole], values)


def _histograms(patches: NDArray[np.float32], most: float) -> NDArray[np.uint8]:
    """Return the descriptions (k, 128) of patches (k, n, n)."""
    count, n, _ = patches.shape
    dy, dx = np.gradient(patches, axis=(1, 2))
    place = (np.arange(n) + 0.5) / n * 4.0 - 0.5
    window = np.exp(-((place - 1.5) ** 2) / (2.0 * 2.0**2))
    weight = np.hypot(dx, dy) * window[:, None] * window
    direction = (np.arctan2(dy, dx) / (2.0 * np.pi) * 8.0) % 8.0
    low = np.floor(direction).astype(np.int64)
    share = direction - low
    by_direction = np.zeros((count, n, n, 8), np.float32)
    np.put_along_axis(by_direction, low[..., None] % 8, (weight * (1 - share))[..., None], axis=3)
    high = ((low + 1) % 8)[..., None]
    np.put_along_axis(by_direction, high, (weight * share)[..., None], axis=3)
    # A sample belongs to its two nearest cells along each axis, by its distance.
    to_cell = np.clip(1.0 - np.abs(place[:, None] - np.arange(4)), 0.0, None).astype(np.float32)
    cells = np.einsum("kabd,ai,bj->kijd", by_direction, to_cell, to_cell, optimize=True)
    vector = cells.reshape(count, DESCRIPTION_BYTES)
    for _ in range(2):
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        vector = np.minimum(vector / np.where(length > 0.0, length, 1.0), most)
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    vector = vector / np.where(length > 0.0, length, 1.0)
    return np.rint(np.minimum(vector * 512.0, 255.0)).astype(np.uint8)
