# SPDX-License-Identifier: Apache-2.0
"""Find points again when the target shows a side that was seen before.

The chaser keeps images of the target from all sides, with the points that it tracked there. Where
map and motion predict a similar view, the kept image is warped to it and its points are followed
into the new image. A point so found again carries its old id and none of the errors that added up
since: this closes the loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from numpy.typing import ArrayLike, NDArray

from .flow import FlowTuning, followed


class SupposedMotion(Protocol):
    """Where a target is: see `at`."""

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Return positions (n, 3), WRF, and rotations (n, 3, 3), TRF to WRF, at times (n,)."""
        ...


@dataclass(frozen=True, eq=False)
class KnownTarget:
    """What the mapper knows of the target: its motion, and the landmarks (n, 3), TRF, of this
    chaser's points ``ids`` (n,), ascending.
    """

    motion: SupposedMotion
    ids: IntArray
    landmarks_m: Array


@dataclass(frozen=True)
class MemoryTuning:
    """Numbers of the memory, with units and reasons."""

    most_views: int = 60
    """Kept images of a chaser, 0.2 MB each: a turn in steps of 6 degrees."""
    apart_rad: float = 0.09
    """Turn between kept views, 5 degrees: patches look alike on half of it."""
    similar_rad: float = 0.14
    """Largest turn, 8 degrees, from a kept view to one in which its points are found again."""
    least_age_s: float = 12.0
    """Views that are younger tell nothing that tracking does not."""
    least_points: int = 15
    """Points that must be found again together; fewer may be wrong alike."""
    flow: FlowTuning = field(default_factory=FlowTuning)
    astray_px: float = 3.0
    """Distance from the common displacement of all points beyond which one is wrong: less than half
    a cell of a solar panel at 2 m."""
    margin_px: int = 30
    """Border of a kept image around its points: window and search."""


@dataclass(frozen=True, eq=False)
class _View:
    time_s: float
    position_w_m: Array
    rotation: Array
    ids: IntArray
    px: NDArray[np.float32]
    ages_s: Array
    image: NDArray[np.uint8]
    corner_px: Array


class ViewMemory:
    """Kept images of the target from the sides that one chaser has seen."""

    def __init__(self, camera: Camera, tuning: MemoryTuning | None = None) -> None:
        self.camera, self.tuning = camera, tuning or MemoryTuning()
        self._views: list[_View] = []

    def remember(
        self,
        image: NDArray[np.uint8],
        ids: IntArray,
        px: NDArray[np.float32],
        ages_s: Array,
        time_s: float,
        position_w_m: Array,
        rotation: Array,
        known: KnownTarget | None,
    ) -> None:
        """Keep an image (h, w) with points ``px`` (n, 2) of ``ages_s`` (n,), unless a similar one
        is kept.

        ``position_w_m`` (3,) and ``rotation`` (3, 3), IRF to WRF, of the camera. Without a known
        target all are kept, as far as there is room.
        """
        tuning = self.tuning
        if len(ids) < tuning.least_points or len(self._views) >= tuning.most_views:
            return
        if known is not None and self._views:
            turns = self._turns(time_s, rotation, known)
            if float(turns.min()) < tuning.apart_rad:
                return
        low = np.maximum(px.min(axis=0).astype(int) - tuning.margin_px, 0)
        high = px.max(axis=0).astype(int) + tuning.margin_px
        part = image[low[1] : high[1], low[0] : high[0]].copy()
        self._views.append(
            _View(
                time_s,
                position_w_m,
                rotation,
                ids.copy(),
                px.copy(),
                ages_s,
                part,
                low.astype(float),
            )
        )

    def recall(
        self,
        image: NDArray[np.uint8],
        time_s: float,
        position_w_m: Array,
        rotation: Array,
        known: KnownTarget,
    ) -> tuple[IntArray, NDArray[np.float32], Array]:
        """Return ids (n,), pixels (n, 2) and ages (n,), s, of kept points that an image shows
        again.
        """
        none = np.zeros(0, dtype=np.int64), np.zeros((0, 2), np.float32), np.zeros(0)
        view = self._similar(time_s, rotation, known)
        if view is None:
            return none
        _, mine, theirs = np.intersect1d(
            view.ids, known.ids, assume_unique=True, return_indices=True
        )
        landmarks = known.landmarks_m[theirs]
        before = self._projected(landmarks, view.time_s, view.position_w_m, view.rotation, known)
        now = self._projected(landmarks, time_s, position_w_m, rotation, known)
        px = view.px[mine].astype(float)
        predicted = px + now - before
        size = np.array([self.camera.width_px, self.camera.height_px])
        border = self.tuning.margin_px / 2.0
        with np.errstate(invalid="ignore"):
            good = ((predicted > border) & (predicted < size - border)).all(axis=1)
        mine, px, predicted = mine[good], px[good], predicted[good]
        if len(mine) < self.tuning.least_points:
            return none
        found, fits = self._followed(image, view, px, predicted)
        if int(fits.sum()) < self.tuning.least_points:
            return none
        return view.ids[mine][fits], found[fits], view.ages_s[mine][fits]

    def _turns(self, time_s: float, rotation: Array, known: KnownTarget) -> Array:
        """Return the angles (k,) by which kept views differ from one at a time."""
        times = np.array([view.time_s for view in self._views])
        _, turned = known.motion.at(np.append(times, time_s))
        # Rotations TRF to IRF of all views.
        cameras = np.array([*(view.rotation for view in self._views), rotation])
        seen = cameras.transpose(0, 2, 1) @ turned
        trace = np.einsum("kij,ij->k", seen[:-1], seen[-1])
        return np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))

    def _similar(self, time_s: float, rotation: Array, known: KnownTarget) -> _View | None:
        if not self._views:
            return None
        turns = self._turns(time_s, rotation, known)
        ages = time_s - np.array([view.time_s for view in self._views])
        turns = np.where(ages < self.tuning.least_age_s, np.inf, turns)
        best = int(np.argmin(turns))
        return self._views[best] if turns[best] < self.tuning.similar_rad else None

    def _projected(
        self, landmarks: Array, time_s: float, position: Array, rotation: Array, known: KnownTarget
    ) -> Array:
        places, turned = known.motion.at([time_s])
        at = (landmarks @ turned[0].T + places[0] - position) @ rotation
        return self.camera.project(at)

    def _followed(
        self, image: NDArray[np.uint8], view: _View, px: Array, predicted: Array
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the pixels (n, 2) of a kept view's points in an image, and whether they fit."""
        tuning = self.tuning
        matrix, _ = cv2.estimateAffine2D(
            px.astype(np.float32), predicted.astype(np.float32), method=cv2.LMEDS
        )
        if matrix is None or not 0.5 < float(np.linalg.det(matrix[:, :2])) < 2.0:
            return px.astype(np.float32), np.zeros(len(px), dtype=bool)
        shifted = matrix.copy()
        shifted[:, 2] += matrix[:, :2] @ view.corner_px
        height, width = image.shape
        warped = np.asarray(
            cv2.warpAffine(view.image, shifted, (width, height), flags=cv2.INTER_LINEAR),
            dtype=np.uint8,
        )
        start = (px @ matrix[:, :2].T + matrix[:, 2]).astype(np.float32)
        guess = predicted.astype(np.float32)
        found, fits = followed(warped, image, start, guess, tuning.flow)
        if not fits.any():
            return found, fits
        moved = found - predicted
        fits &= np.linalg.norm(moved - np.median(moved[fits], axis=0), axis=1) < tuning.astray_px
        return found, fits
