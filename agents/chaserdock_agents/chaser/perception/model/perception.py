# SPDX-License-Identifier: Apache-2.0
"""Run the perception `model`: acquire the target by its shape and track it.

It returns to acquisition when the gate rejects the pose.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.pose_image import UnusableImage
from numpy.typing import ArrayLike, NDArray

from ..pipeline import GeometryInformation, PerceptionResult
from ..pnp import TargetPose
from ..refine import PoseInCamera
from .acquisition import Acquisition
from .alignment import Alignment, Pyramid
from .geometry import GeometryCorrection
from .lighting import light_steps
from .mesh import TrackerMesh
from .rendering import Lighting
from .steps import Steps
from .tracking import (
    is_valid,
    levels_of,
    pose_steps,
    prior_steps,
    start_steps,
    starts_around,
    track_points,
    turn_between,
)

_KEY_EVERY = 8
"""Images between two renderings of a view, at most: its control points are reused in between."""
_KEY_TURN_RAD = 0.04
"""Rotation (rad) of the target since a view was rendered, above which its points are not reused."""
_STOPGAP_TURN_RAD = 0.08
"""Rotation (rad) up to which a view's points are reused where the gate rejects the next view, as in
changing weak light.
"""
_LOST_AFTER = 3
"""Images in a row without a valid pose after which a track ends."""
_PER_IMAGE_MS = 30.0
"""Expected CPU time per image, ms, beyond which work continues at the next image; a single step may
take longer.
"""
_POINTS_MS = 6.0
"""Expected CPU time to align the points of the last view, ms; 3.9 ms an image at 3 m were measured
in flights (docs/evidence/markerless.md).
"""
_MOST_WAITING = 120
"""Most images that wait for the end of an acquisition; beyond, it is replaced by an acquisition in
the newest image. More: longer acquisitions succeed; fewer: a hopeless one ends sooner.
"""
_MOST_WAITING_PREDICTED, _MOST_FAILED = 30, 15
"""The same where a pose is predicted; and number of images in a row in which a start from it fails
before an acquisition is tried.
"""
_WORSE = 0.1
"""Score, below the best one's, at which an ambiguous pose is dropped."""


@dataclass(frozen=True)
class PoseTrack:
    """One hypothesis of the target's pose.

    ``last``, ``light``: last alignment and light. ``before``: the pose before it, if any. ``age``:
    images since its view was rendered. ``missed``: images since it was valid.
    """

    last: Alignment
    light: Lighting
    before: PoseInCamera | None = None
    age: int = 0
    missed: int = 0

    def predicted(self) -> PoseInCamera:
        """Return the pose in the next image, at a constant rate per image; the last pose after a
        miss.
        """
        now = self.last.pose
        if self.before is None or self.missed:
            return now
        turn = rotations.from_matrix(now.rotation @ self.before.rotation.T)
        step = rotations.to_matrix(rotations.normalize(turn))
        return PoseInCamera(2.0 * now.position - self.before.position, step @ now.rotation)


@dataclass(frozen=True)
class _WaitingImage:
    """An image (h, w) that waits, and the pose that others predict in it, if any.

    Pose: position (3,) in IRF and rotation (4,), TRF to IRF.
    """

    image: NDArray[np.uint8]
    predicted: tuple[ArrayLike, ArrayLike] | None


class ModelPerception:
    """Estimate the pose of the target from its shape.

    Stateful: equal sequences of images give equal results. One instance belongs to one camera;
    ``acquisition``, of the same camera and mesh, may be shared. ``solutions`` are ambiguous poses,
    the best first, and without markers.

    Work that takes longer than the time of an image is spread over several: an acquisition, or
    starts around a lost pose. Until it ends, images wait and give no solution. Then the target is
    tracked through them, several at each new image, up to the newest one. Without a track, a pose
    that others predict is tried first; an acquisition follows when that has failed for about a
    second. With ``single_images``, which do not follow each other, an acquisition ends in the image
    in which it begins.
    """

    def __init__(
        self,
        camera: Camera,
        mesh: TrackerMesh,
        acquisition: Acquisition | None = None,
        single_images: bool = False,
    ) -> None:
        self.camera, self.mesh = camera, mesh
        self._per_image_ms = math.inf if single_images else _PER_IMAGE_MS
        self._acquisition = acquisition or Acquisition(camera, mesh)
        self._tracks: tuple[PoseTrack, ...] = ()
        self._waiting: deque[_WaitingImage] = deque()
        self._failed = 0
        self._work: Steps[None] | None = None
        self._next_ms = 0.0
        self._uncorrected = mesh
        self._correction: GeometryCorrection | None = None

    def prepare(self) -> None:
        """Compute what depends on the mesh alone, which the first image would do otherwise.

        Takes one to two seconds.
        """
        self._acquisition.prepare()
        _ = self.mesh.suns, self.mesh.few_suns

    def correct_geometry(self, mean: Array, covariance: Array) -> None:
        """Correct the mesh by its estimated errors (k,) with covariance (k, k), in standard
        deviations.

        Tracks continue. Raises ValueError for another number of errors than the mesh has, or a
        covariance that is not positive definite.
        """
        k = len(self._uncorrected.modes_m)
        if (
            mean.shape != (k,)
            or covariance.shape != (k, k)
            or not np.linalg.eigvalsh(covariance)[0] > 0.0
        ):
            raise ValueError(f"the mesh has {k} errors; {len(mean)} or their covariance do not fit")
        if self._correction is not None and self._correction.is_of(mean):
            return
        self._correction = GeometryCorrection(mean, covariance)
        self.mesh = self._correction.applied(self._uncorrected)
        if self._tracks:
            self._work = None  # begins again, with this mesh
        self._tracks = tuple(
            replace(t, last=replace(t.last, modes=np.zeros(k)), age=_KEY_EVERY)
            for t in self._tracks
        )

    def reset(self) -> None:
        """Forget all tracks: the next image is searched without a prior."""
        self._tracks, self._work, self._failed = (), None, 0
        self._waiting.clear()

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> PerceptionResult:
        """Estimate the target's pose in a grey image (h, w), uint8.

        ``predicted``: position in IRF (3,), metres, and rotation TRF to IRF (4,), if known; used as
        a start while there is no track.

        Raises ValueError for an image of another shape or type than the camera's.
        """
        shape = (self.camera.height_px, self.camera.width_px)
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != shape:
            got = (
                f"{image.dtype} {image.shape}"
                if isinstance(image, np.ndarray)
                else type(image).__name__
            )
            raise UnusableImage(f"expected a uint8 image of {shape}, got {got}")
        if len(self._waiting) >= (
            _MOST_WAITING if self._tracks or predicted is None else _MOST_WAITING_PREDICTED
        ):
            self._waiting.clear()
            self._work, self._tracks, self._failed = None, (), 0
        self._waiting.append(_WaitingImage(image, predicted))
        self._work_on()
        # Poses in an earlier image are no solutions of this one.
        tracks = () if self._waiting else self._tracks
        valid = [_target_pose(t.last) for t in tracks if t.missed == 0]
        geometry = self._geometry() if tracks else None
        no_ids, no_corners = np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
        return PerceptionResult(
            tuple(valid), no_ids, no_corners, (), geometry, acquiring=bool(self._waiting)
        )

    def _geometry(self) -> GeometryInformation | None:
        """Return what the image tells about the errors of the uncorrected mesh; None unless one
        track.

        The part that is independent of the pose is empty if the track's view is not new.
        """
        if len(self._tracks) != 1 or self._tracks[0].missed:
            return None
        found = self._tracks[0].last.geometry
        if not len(found.vector):
            return None
        if self._tracks[0].age:
            found = replace(found, matrix=np.zeros((0, 0)), vector=np.zeros(0))
        return found if self._correction is None else self._correction.of_uncorrected(found)

    def _work_on(self) -> None:
        """Take as many steps of the work as the time of one image allows, at least one."""
        spent_ms = 0.0
        while self._waiting:
            if self._work is None:
                if not self._tracks:  # the newest image is nearest to those to come
                    self._waiting = deque([self._waiting[-1]])
                self._work, self._next_ms = self._process(self._waiting[0]), 0.0
            if spent_ms > 0.0 and spent_ms + self._next_ms > self._per_image_ms:
                return
            spent_ms += self._next_ms
            try:
                self._next_ms = next(self._work)
            except StopIteration:
                self._work = None
                self._waiting.popleft()

    def _process(self, waiting: _WaitingImage) -> Steps[None]:
        """Update the tracks by an image, or acquire the target in it."""
        pyramid = Pyramid(waiting.image, self.camera)
        if not self._tracks:
            if waiting.predicted is not None and self._failed < _MOST_FAILED:
                self._tracks = yield from self._start(pyramid, *waiting.predicted)
            else:
                found = yield from self._acquisition.search(pyramid)
                self._tracks = tuple(PoseTrack(*one) for one in found)
            self._failed = 0 if self._tracks else (self._failed + 1) % (_MOST_FAILED + 1)
            return
        updated: list[PoseTrack] = []
        for track in self._tracks:
            updated.append((yield from advance(pyramid, self.mesh, track)))
        # A predicted pose is a better start in the next image than that of a lost track.
        lost_after = _LOST_AFTER if waiting.predicted is None else 1
        self._tracks = _distinct([t for t in updated if t.missed < lost_after])

    def _start(
        self, pyramid: Pyramid, position: ArrayLike, q: ArrayLike
    ) -> Steps[tuple[PoseTrack, ...]]:
        """Return the track that begins near a predicted pose, if the gate accepts one."""
        prior = PoseInCamera(
            np.array(position, dtype=float), rotations.to_matrix(np.array(q, dtype=float))
        )
        found = yield from prior_steps(pyramid, self.mesh, prior)
        return (PoseTrack(*found),) if found is not None and is_valid(found[0]) else ()


def advance(pyramid: Pyramid, mesh: TrackerMesh, track: PoseTrack) -> Steps[PoseTrack]:
    """Return a track after the next image.

    Tries in this order: the points of its view, while they hold; a new view; the old points once
    more; a rough prior; before the track is lost, several starts.
    """
    prior, modes = track.predicted(), track.last.modes
    missed = replace(track, missed=track.missed + 1)
    fresh = (
        track.age + 1 < _KEY_EVERY and turn_between(prior, track.last.points.pose) < _KEY_TURN_RAD
    )
    # The light of a new view is estimated one image before, which leaves more time for the view.
    view_is_next = track.age + 2 == _KEY_EVERY
    if fresh and not track.missed:
        yield _POINTS_MS
        found = track_points(pyramid, track.last.points, prior, modes)
        if is_valid(found):
            near = _light_near(pyramid, mesh, found.pose, track.light)
            light = (yield from near) if view_is_next else None
            return PoseTrack(found, light or track.light, track.last.pose, track.age + 1)

    levels = levels_of(pyramid, mesh, prior)
    if not levels:
        return missed
    known = track.age + 1 == _KEY_EVERY and not track.missed
    light = track.light if known else (yield from _light_near(pyramid, mesh, prior, track.light))
    if light is None:
        return missed
    found = yield from pose_steps(pyramid, mesh, prior, light, levels[-1:], modes=modes)
    if is_valid(found):
        return PoseTrack(found, light, track.last.pose)

    if not track.missed and turn_between(prior, track.last.points.pose) < _STOPGAP_TURN_RAD:
        yield _POINTS_MS
        found = track_points(pyramid, track.last.points, prior, modes)
        if is_valid(found):
            return PoseTrack(found, track.light, track.last.pose, track.age + 1)

    refined = yield from prior_steps(pyramid, mesh, prior, modes)
    if refined and is_valid(refined[0]):
        return PoseTrack(*refined)
    if missed.missed < _LOST_AFTER:
        return missed
    found = yield from start_steps(
        pyramid, mesh, starts_around(prior), refined[1] if refined else light
    )
    return PoseTrack(found, light) if is_valid(found) else missed


def _light_near(
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, light: Lighting
) -> Steps[Lighting | None]:
    """Return, in steps, the light on a target at ``pose``, searched near a previous one.

    None if too little of the target is in view.
    """
    levels = levels_of(pyramid, mesh, pose)
    return (yield from light_steps(pyramid, mesh, pose, levels[0], light)) if levels else None


def _distinct(tracks: list[PoseTrack]) -> tuple[PoseTrack, ...]:
    """Return the tracks that differ from all better ones and are not much worse than the best.

    The best comes first.
    """
    kept: list[PoseTrack] = []
    for track in sorted(tracks, key=lambda t: (t.missed > 0, -t.last.score)):
        if kept and (track.missed or track.last.score < kept[0].last.score - _WORSE):
            continue
        if all(turn_between(track.last.pose, other.last.pose) > 0.05 for other in kept):
            kept.append(track)
    return tuple(kept)


def _target_pose(alignment: Alignment) -> TargetPose:
    pose = alignment.pose
    q = rotations.from_matrix(pose.rotation)
    return TargetPose(pose.position, q, alignment.covariance, alignment.rms_px)
