# SPDX-License-Identifier: Apache-2.0
"""Perception `model`: acquire and track a target by its shape, and return to acquisition when the gate rejects it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import ArrayLike, NDArray

from ..pipeline import GeometryInformation, PerceptionResult
from ..pnp import TargetPose
from ..refine import PoseInCamera
from .acquisition import Acquisition
from .alignment import Alignment, Pyramid
from .geometry import GeometryCorrection
from .lighting import light_at
from .mesh import TrackerMesh
from .rendering import Lighting
from .tracking import (
    is_valid,
    levels_of,
    refine_from_prior,
    refine_from_starts,
    refine_pose,
    starts_around,
    track_points,
    turn_between,
)

_KEY_EVERY = 8
"""A view is rendered at least at every eighth image; between, its control points are reused."""
_KEY_TURN_RAD = 0.04
"""Points of a view are not reused when the target has turned by more since."""
_LOST_AFTER = 3
"""Number of images in a row without a valid pose after which a track ends."""
_ACQUIRE_EVERY = 5
"""After a failed acquisition, the next one runs at the fifth image: it takes as long as many images."""
_WORSE = 0.1
"""An ambiguous pose is dropped when its score falls this far below the best one's."""


@dataclass(frozen=True)
class PoseTrack:
    """One hypothesis: last alignment and light, the pose before it, and the numbers of images since its view and since it was
    valid."""

    last: Alignment
    light: Lighting
    before: PoseInCamera | None = None
    age: int = 0
    missed: int = 0

    def predicted(self) -> PoseInCamera:
        """Return the pose in the next image at a constant rate per image; the last pose after a miss."""
        now = self.last.pose
        if self.before is None or self.missed:
            return now
        turn = rotations.from_matrix(now.rotation @ self.before.rotation.T)
        step = rotations.to_matrix(rotations.normalize(turn))
        return PoseInCamera(2.0 * now.position - self.before.position, step @ now.rotation)


class ModelPerception:
    """Estimates the pose of the target from its shape. Stateful: equal sequences of images give equal results.

    One instance belongs to one camera; ``acquisition``, of the same camera and mesh, may be shared. ``solutions`` are ambiguous
    poses, the best first, and without markers.
    """

    def __init__(self, camera: Camera, mesh: TrackerMesh, acquisition: Acquisition | None = None) -> None:
        self.camera, self.mesh = camera, mesh
        self._acquisition = acquisition or Acquisition(camera, mesh)
        self._tracks: tuple[PoseTrack, ...] = ()
        self._until_acquisition = 0
        self._uncorrected = mesh
        self._correction: GeometryCorrection | None = None

    def prepare(self) -> None:
        """Compute what depends on the mesh alone; takes one to two seconds, which the first image would take otherwise."""
        self._acquisition.prepare()
        _ = self.mesh.suns

    def correct_geometry(self, mean: Array, covariance: Array) -> None:
        """Correct the mesh by its estimated errors (k,) with covariance (k, k), in its standard deviations; tracks go on.

        Raises ValueError for another number of errors than the mesh has, or a covariance that is not positive definite.
        """
        k = len(self._uncorrected.modes_m)
        if mean.shape != (k,) or covariance.shape != (k, k) or not np.linalg.eigvalsh(covariance)[0] > 0.0:
            raise ValueError(f"the mesh has {k} errors; {len(mean)} or their covariance do not fit")
        if self._correction is not None and self._correction.is_of(mean):
            return
        self._correction = GeometryCorrection(mean, covariance)
        self.mesh = self._correction.applied(self._uncorrected)
        self._tracks = tuple(
            replace(t, last=replace(t.last, modes=np.zeros(k)), age=_KEY_EVERY) for t in self._tracks
        )

    def reset(self) -> None:
        """Forget all tracks: the next image is searched without a prior."""
        self._tracks, self._until_acquisition = (), 0

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> PerceptionResult:
        """Estimate the target's pose in a grey image (h, w), uint8; ``predicted`` is not used, as tracks predict themselves.

        Raises ValueError for an image of another shape or type than the camera's.
        """
        shape = (self.camera.height_px, self.camera.width_px)
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != shape:
            got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise ValueError(f"expected a uint8 image of {shape}, got {got}")
        if self._tracks:
            pyramid = Pyramid(image, self.camera)
            updated = [advance(pyramid, self.mesh, track) for track in self._tracks]
            self._tracks = _distinct([t for t in updated if t.missed < _LOST_AFTER])
            self._until_acquisition = 0
        elif self._until_acquisition > 0:
            self._until_acquisition -= 1
        else:
            self._tracks = tuple(PoseTrack(*found) for found in self._acquisition.find(image))
            self._until_acquisition = _ACQUIRE_EVERY - 1
        valid = [_target_pose(t.last) for t in self._tracks if t.missed == 0]
        geometry = self._geometry()
        return PerceptionResult(tuple(valid), np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), (), geometry)

    def _geometry(self) -> GeometryInformation | None:
        """Return what the image tells about the errors of the mesh before corrections: if the view of the only track is new."""
        if len(self._tracks) != 1 or self._tracks[0].age or self._tracks[0].missed:
            return None
        found = self._tracks[0].last.geometry
        if not len(found.vector):
            return None
        return found if self._correction is None else self._correction.of_uncorrected(found)


def advance(pyramid: Pyramid, mesh: TrackerMesh, track: PoseTrack) -> PoseTrack:
    """Return a track after the next image: with the points of its view while they hold, else by a new one, else from several
    starts."""
    prior, modes = track.predicted(), track.last.modes
    missed = replace(track, missed=track.missed + 1)
    fresh = track.age + 1 < _KEY_EVERY and turn_between(prior, track.last.points.pose) < _KEY_TURN_RAD
    if fresh and not track.missed:
        found = track_points(pyramid, track.last.points, prior, modes)
        if is_valid(found):
            return PoseTrack(found, track.light, track.last.pose, track.age + 1)
    levels = levels_of(pyramid, mesh, prior)
    light = light_at(pyramid, mesh, prior, levels[0], track.light) if levels else None
    if light is None:
        return missed
    found = refine_pose(pyramid, mesh, prior, light, levels[-1:], modes=modes)
    if is_valid(found):
        return PoseTrack(found, light, track.last.pose)
    refined = refine_from_prior(pyramid, mesh, prior, modes)
    if refined and is_valid(refined[0]):
        return PoseTrack(*refined)
    light = refined[1] if refined else light
    found = refine_from_starts(pyramid, mesh, starts_around(prior), light)
    return PoseTrack(found, light) if is_valid(found) else missed


def _distinct(tracks: list[PoseTrack]) -> tuple[PoseTrack, ...]:
    """Return the tracks, best first, without those that have become equal to a better one or much worse than the best."""
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
