# SPDX-License-Identifier: Apache-2.0
"""Track corner points of whatever moves in front of the background.

Points are found in reference images and followed from the last of these to each image by pyramidal
Lucas-Kanade, forward and back. Errors therefore add up from reference to reference only, not from
image to image. A point is published once it has moved against the stars as well as against the
image: stars, the Earth and the chaser's own probe never do. Once the target is known, to move
against the stars is enough, as a chaser may turn with it; its own body is then to be excluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from chaserdock_protocol.pose_image import UnusableImage
from numpy.typing import ArrayLike, NDArray

from .flow import FlowTuning, followed
from .memory import KnownTarget, ViewMemory

BYTES_PER_POINT = 9
"""Size of a published point: id (4), two coordinates in 1/64 px (2 each), age in 0.2 s (1)."""


@dataclass(frozen=True)
class TrackingTuning:
    """Numbers of the tracker, with units and reasons."""

    most_points: int = 400
    """Points followed at a time: 3.6 kB an image; more cost 15 ms per 400 (benchmarks/unknown.py)
    and add little, as neighbours slide together."""
    least_distance_px: int = 9
    """Distance of a new point from every other one: more than half a window, so that points do not
    share all of their pixels."""
    least_contrast: float = 0.012
    """Smaller eigenvalue of a corner as a share of the image's largest: noise of flat surfaces has
    a tenth of that."""
    flow: FlowTuning = field(default_factory=FlowTuning)
    reference_images: int = 6
    """Images after which a new reference is taken: 1.2 s at five a second, 4 degrees of turn."""
    reference_share: float = 0.75
    """Share of points that survive, below which a new reference is taken at once."""
    moved_px: float = 3.5
    """Motion that tells a point of the target from the background: five standard deviations of
    odometry of grade `lab` (0.05 degrees)."""
    still_images: int = 25
    """Images after which a point that has not moved is given up, and no other is sought there for
    as long: five seconds."""
    same_px: float = 5.0
    """Distance within which a point that is followed is the one found again there: half of
    ``least_distance_px``."""
    margin_px: int = 60
    """New points are sought so far around those that move: a part of 0.15 m at 2 m that shows no
    corner yet."""
    border_px: int = 12
    """Points nearer to the border of the image are dropped: their window is cut."""
    clip: float = 3.0
    """Limit of local contrast equalization: a shadow of grey level 10 gets usable contrast, noise
    stays below that of corners."""
    tiles: int = 6
    """Tiles a side of local contrast equalization."""


@dataclass(frozen=True, eq=False)
class TrackedPoints:
    """Points of one image: ``ids`` (n,), ascending, never reused; ``px`` (n, 2), ideal pixels;
    ``ages_s`` (n,): how long each was followed on the side of the target that is in view. Points
    slide while they are followed: on shading, edges and repeated patterns. A point found again
    after a turn has the age that it had when it was last seen so.
    """

    ids: IntArray
    px: Array
    ages_s: Array


class FeatureTracker:
    """Follows points of the target in the images of one camera.

    Equal images and attitudes give equal points. Memory: two images and ``most_points`` points.
    """

    def __init__(self, camera: Camera, tuning: TrackingTuning | None = None) -> None:
        self.camera, self.tuning = camera, tuning or TrackingTuning()
        self._memory = ViewMemory(camera)
        self._equalize = cv2.createCLAHE(self.tuning.clip, (self.tuning.tiles, self.tuning.tiles))
        self._next_id, self._age = 0, 0
        self._reference: NDArray[np.uint8] | None = None
        self._referenced = 0
        self._since_s = np.zeros(0)
        self._ids = np.zeros(0, dtype=np.int64)
        self._reference_px = np.zeros((0, 2), dtype=np.float32)
        self._px: NDArray[np.float32] = np.zeros((0, 2), dtype=np.float32)
        self._step_px = np.zeros((0, 2), dtype=np.float32)
        self._birth_px = np.zeros((0, 2))
        self._birth_w = np.zeros((0, 3))
        self._images = np.zeros(0, dtype=np.int64)
        self._moves = np.zeros(0, dtype=bool)
        self._still_px, self._still_left = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)

    def track(
        self,
        image: NDArray[np.uint8],
        time_s: float,
        position_w_m: ArrayLike,
        q_w_irf_wxyz: ArrayLike,
        known: KnownTarget | None = None,
        excluded: Sequence[tuple[float, float, float]] = (),
    ) -> TrackedPoints:
        """Return the points of the target in a grey image (h, w), uint8.

        ``position_w_m`` (3,), ``q_w_irf_wxyz`` (4,): pose of the camera by odometry. ``known``:
        what the mapper knows, by which old points are found again. ``excluded``: discs (x, y,
        radius), px, in which nothing is followed: other chasers and the own probe. Raises
        UnusableImage for an image of another size or type.
        """
        shape = (self.camera.height_px, self.camera.width_px)
        if image.dtype != np.uint8 or image.shape != shape:
            raise UnusableImage(
                f"expected a uint8 image of {shape}, got {image.dtype} {image.shape}"
            )
        equalized = np.asarray(self._equalize.apply(image), dtype=np.uint8)
        self._follow(equalized)
        self._drop_excluded(excluded)
        self._tell_background(q_w_irf_wxyz, known is not None)
        self._age += 1
        share = len(self._ids) / max(self._referenced, 1)
        if (
            self._reference is None
            or self._age >= self.tuning.reference_images
            or share < self.tuning.reference_share
        ):
            place, rotation = (
                np.asarray(position_w_m, dtype=float),
                rotations.to_matrix(q_w_irf_wxyz),
            )
            if known is not None:
                ids, px, ages_s = self._memory.recall(equalized, time_s, place, rotation, known)
                self._recall(ids, px, time_s - ages_s)
            self._take_reference(equalized, time_s, q_w_irf_wxyz, excluded)
            moving = self._moves
            self._memory.remember(
                equalized, self._ids[moving], self._px[moving], time_s - self._since_s[moving],
                time_s, place, rotation, known,
            )  # fmt: skip
        published = np.flatnonzero(self._moves)
        return TrackedPoints(
            self._ids[published],
            self.camera.undistort(self._px[published]),
            time_s - self._since_s[published],
        )

    def _follow(self, image: NDArray[np.uint8]) -> None:
        """Move the points to this image; drop those that are lost."""
        if self._reference is None or not len(self._ids):
            return
        tuning = self.tuning
        guess = self._px + self._step_px
        found, good = followed(self._reference, image, self._reference_px, guess, tuning.flow)
        size, border = np.array([self.camera.width_px, self.camera.height_px]), tuning.border_px
        inside = ((found > border) & (found < size - 1 - border)).all(axis=1)
        self._step_px, self._px = found - self._px, found
        self._keep(good & inside)
        self._images += 1

    def _keep(self, kept: NDArray[np.bool_] | IntArray) -> None:
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[kept])

    def _drop_excluded(self, discs: Sequence[tuple[float, float, float]]) -> None:
        inside = np.zeros(len(self._ids), dtype=bool)
        for x, y, radius in discs:
            inside |= ((self._px - (x, y)) ** 2).sum(axis=1) < radius * radius
        if inside.any():
            self._keep(~inside)

    def _tell_background(self, q_w_irf_wxyz: ArrayLike, known: bool) -> None:
        """Mark the points that have moved against the image and the stars; give up those that have
        not for long. Of a ``known`` target, with which the chaser may turn, motion against the
        stars is enough.
        """
        tuning = self.tuning
        ideal = self.camera.undistort(self._px)
        stars = self.camera.project_ideal(rotations.rotate_inverse(q_w_irf_wxyz, self._birth_w))
        by_image = np.linalg.norm(ideal - self._birth_px, axis=1)
        by_stars = np.linalg.norm(ideal - stars, axis=1)
        moved_here = known | (by_image > tuning.moved_px)
        self._moves |= moved_here & (by_stars > tuning.moved_px)
        self._still_left = self._still_left - 1
        still = ~self._moves & (self._images >= tuning.still_images)
        left = self._still_left > 0
        self._still_px = np.concatenate([self._still_px[left], self._px[still]])
        count = int(still.sum())
        self._still_left = np.concatenate(
            [self._still_left[left], np.full(count, tuning.still_images)]
        )
        if count:
            self._keep(~still)

    def _take_reference(
        self,
        image: NDArray[np.uint8],
        time_s: float,
        q_w_irf_wxyz: ArrayLike,
        excluded: Sequence[tuple[float, float, float]],
    ) -> None:
        """Follow points from this image on, with new ones where there are none."""
        tuning = self.tuning
        wanted = tuning.most_points - len(self._ids)
        mask = np.zeros(image.shape, np.uint8)
        left, top, right, bottom = self._searched()
        mask[top:bottom, left:right] = 255
        for x, y in np.concatenate([self._px, self._still_px]).round().astype(int).tolist():
            cv2.circle(mask, (x, y), tuning.least_distance_px, 0, -1)
        for x, y, radius in excluded:
            cv2.circle(mask, (round(x), round(y)), round(radius), 0, -1)
        new = None
        if wanted > 0:
            new = cv2.goodFeaturesToTrack(
                np.ascontiguousarray(image[top:bottom, left:right]), wanted,
                tuning.least_contrast, tuning.least_distance_px,
                mask=np.ascontiguousarray(mask[top:bottom, left:right]), blockSize=5,
            )  # fmt: skip
        px = np.zeros((0, 2), np.float32) if new is None else new.reshape(-1, 2).astype(np.float32)
        px = px + np.array([left, top], np.float32)
        ideal = self.camera.undistort(px)
        imaged = np.isfinite(ideal).all(axis=1)
        px, ideal, count = px[imaged], ideal[imaged], int(imaged.sum())
        rays = np.column_stack([self.camera.normalized(ideal), np.ones(count)])
        rays_w = rotations.rotate(q_w_irf_wxyz, rays)
        self._append(
            self._next_id + np.arange(count), px, ideal, rays_w, False,
            np.full(count, time_s),
        )  # fmt: skip
        self._next_id += count
        order = np.argsort(self._ids, kind="stable")
        self._keep(order)
        self._reference_px = self._px.copy()
        self._age = 0
        self._reference = image
        self._referenced = len(self._ids)

    def _append(
        self,
        ids: IntArray,
        px: NDArray[np.float32],
        ideal: Array,
        rays_w: Array,
        moves: bool,
        since_s: Array,
    ) -> None:
        count = len(ids)
        self._ids = np.concatenate([self._ids, ids])
        self._px = np.concatenate([self._px, px])
        self._reference_px = np.concatenate([self._reference_px, px])
        self._step_px = np.concatenate([self._step_px, np.zeros((count, 2), np.float32)])
        self._birth_px = np.concatenate([self._birth_px, ideal])
        self._birth_w = np.concatenate([self._birth_w, rays_w])
        self._since_s = np.concatenate([self._since_s, since_s])
        self._images = np.concatenate([self._images, np.zeros(count, dtype=np.int64)])
        self._moves = np.concatenate([self._moves, np.full(count, moves)])

    def _recall(self, ids: IntArray, px: NDArray[np.float32], since_s: Array) -> None:
        """Go on with old points where they were found again.

        A younger point at the same place ends: it is the same one. An old point that is still
        followed loses the errors that added up.
        """
        if not len(ids):
            return
        _, active, again = np.intersect1d(self._ids, ids, return_indices=True)
        near = np.linalg.norm(self._px[active] - px[again], axis=1) < self.tuning.same_px
        self._px[active[near]] = px[again[near]]
        self._since_s[active[near]] = since_s[again[near]]
        new = np.ones(len(ids), dtype=bool)
        new[again] = False
        ids, px, since_s = ids[new], px[new], since_s[new]
        off = np.linalg.norm(self._px[:, None] - px, axis=2) if len(px) else np.zeros((0, 0))
        if len(px) and len(self._ids):
            fresh = ~np.isin(np.arange(len(self._ids)), active)
            self._keep(~((off < self.tuning.same_px).any(axis=1) & fresh))
        room = max(self.tuning.most_points - len(self._ids), 0)
        ids, px, since_s = ids[:room], px[:room], since_s[:room]
        ideal = self.camera.undistort(px)
        self._append(ids, px, ideal, np.tile([0.0, 0.0, 1.0], (len(ids), 1)), True, since_s)

    def _searched(self) -> tuple[int, int, int, int]:
        """Return left, top, right and bottom, px, of where new points are sought: around those
        that move, or everywhere.
        """
        tuning, border = self.tuning, self.tuning.border_px
        low = np.array([border, border])
        high = np.array([self.camera.width_px, self.camera.height_px]) - border
        moving = self._px[self._moves]
        if len(moving) >= tuning.most_points // 8:
            low = np.maximum(low, moving.min(axis=0) - tuning.margin_px)
            high = np.minimum(high, moving.max(axis=0) + tuning.margin_px)
        left, top, right, bottom = [round(float(v)) for v in (*low, *high)]
        return left, top, right, bottom


_COLUMNS = (
    "_ids", "_reference_px", "_px", "_step_px", "_birth_px", "_birth_w", "_images", "_moves",
    "_since_s",
)  # fmt: skip
