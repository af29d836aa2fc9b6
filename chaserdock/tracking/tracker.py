# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose of a target in images, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import DEFAULT_DICTIONARY, TargetModel
from chaserdock_protocol.scenario.files import load_camera
from numpy.typing import NDArray

from .motion import ConstantVelocity
from .subjects import Subject, TrackError, subjects_of

TrackStatus = Literal["tracked", "ambiguous", "searching", "lost"]


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """A pose of a target in the camera.

    ``position_m`` (3,): the target's origin in the camera's frame (x right, y down, z forward).
    ``q_wxyz`` (4,): rotation from the target's axes to the camera's, scalar first. ``covariance``
    (6, 6): of position, m, in the camera's axes, then of a rotation vector, rad, in the target's
    axes, q_true = q (x) exp(dtheta). ``residual_px``: root mean square distance of what is seen
    from where the pose places it.
    """

    position_m: Array
    q_wxyz: Array
    covariance: Array
    residual_px: float

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position, all axes together, m."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of the attitude, all axes together, rad."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))


@dataclass(frozen=True, eq=False)
class TrackedTarget:
    """What an image shows of one target.

    ``name``: the target's, or ``marker-7``. ``status``: ``tracked``; ``ambiguous``, if several
    poses are about as likely, as of a small marker seen from the front; ``searching``, while a
    shape is being searched in an earlier image; ``lost``, without a trustworthy pose. ``poses``:
    best first.
    ``marker_ids`` (n,) and ``corners_px`` (n, 4, 2): of the used markers. ``rejected_ids``: of
    markers that were seen and not used.
    """

    name: str
    status: TrackStatus
    poses: tuple[TrackedPose, ...]
    marker_ids: NDArray[np.int64]
    corners_px: Array
    rejected_ids: tuple[int, ...]

    @property
    def pose(self) -> TrackedPose | None:
        """The best pose, None without any."""
        return self.poses[0] if self.poses else None


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """What an image of time ``time_ns`` shows of each target, in the tracker's order."""

    time_ns: int
    targets: tuple[TrackedTarget, ...]

    @property
    def pose(self) -> TrackedPose | None:
        """The best pose of the first target, which is the only one but for several markers."""
        return self.targets[0].pose


class Tracker:
    """Estimates the pose of a target in images from anywhere, by the perception that chasers fly.

    Args:
        camera: a calibration file of OpenCV, ROS or Kalibr, or a ``Camera``
            (``chaserdock_models.camera``).
        target: a target file (``….toml``), a mesh (``….stl`` and others), the name of a known
            target, or single markers: ``{id: side in m}``.
        perception: ``default`` (by markers), ``model`` (by the shape), or one that is installed; by
            default by markers if the target has any.
        dictionary: ArUco dictionary of single markers.
        margin_m: white border of single markers, m, where something darker follows; by default
            at least half a cell of the marker.
        mesh_scale: factor from the unit of length of a mesh file to m.
        live: images come at the pace of a camera. A shape is then searched over several images, as
            that takes seconds; otherwise every image gets its answer at once.

    ``camera``, ``names`` and ``models``: as read. Raises ScenarioError for an invalid file, and
    ChaserdockError for an unknown perception and for what does not fit together.
    """

    def __init__(
        self,
        camera: str | Path | Camera,
        target: str | Path | TargetModel | Mapping[int, float],
        *,
        perception: str | None = None,
        dictionary: str = DEFAULT_DICTIONARY,
        margin_m: float | None = None,
        mesh_scale: float = 1.0,
        live: bool = False,
    ) -> None:
        self.camera = camera if isinstance(camera, Camera) else load_camera(Path(camera))
        self._calibration = "the camera" if isinstance(camera, Camera) else str(camera)
        self._subjects = subjects_of(
            self.camera, target, perception, dictionary, margin_m, mesh_scale, live
        )
        self._motions: tuple[ConstantVelocity, ...] = ()
        self.reset()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the targets."""
        return tuple(s.name for s in self._subjects)

    @property
    def models(self) -> tuple[TargetModel, ...]:
        """Geometry and markers of the targets."""
        return tuple(s.model for s in self._subjects)

    def track(self, image: NDArray[np.uint8], time_ns: int) -> TrackedImage:
        """Return what an image shows.

        Args:
            image: uint8, grey (h, w) or BGR (h, w, 3) as OpenCV reads it, of the camera's size.
            time_ns: time of exposure. A target is expected where it would be at constant velocity,
                and searched elsewhere if it is not there; an image before the last one, or much
                later, is searched as a whole.

        Raises ChaserdockError for an image that is not of the camera.
        """
        grey = self._grey(image)
        seen = [
            self._look(subject, motion, grey, time_ns)
            for subject, motion in zip(self._subjects, self._motions, strict=True)
        ]
        return TrackedImage(time_ns, tuple(seen))

    def reset(self) -> None:
        """Forget all earlier images."""
        self._motions = tuple(ConstantVelocity() for _ in self._subjects)
        for subject in self._subjects:
            getattr(subject.perception, "reset", lambda: None)()

    @staticmethod
    def _look(
        subject: Subject, motion: ConstantVelocity, grey: NDArray[np.uint8], time_ns: int
    ) -> TrackedTarget:
        found = subject.perception.estimate(grey, motion.predicted(time_ns))
        by_markers = len(found.marker_ids) > 0
        # A shape's poses are ranked by more than their residuals.
        ranked = motion.take(time_ns, found.solutions if by_markers else found.solutions[:1])
        solutions = ranked if by_markers else found.solutions
        status: TrackStatus = "lost"
        if solutions:
            status = "tracked" if len(solutions) == 1 else "ambiguous"
        elif found.acquiring:
            status = "searching"
        poses = tuple(
            TrackedPose(s.position_irf_m, s.q_irf_trf_wxyz, s.covariance, s.reprojection_rms_px)
            for s in solutions
        )
        return TrackedTarget(
            subject.name, status, poses, found.marker_ids, found.corners_px, found.rejected_ids
        )

    def _grey(self, image: Any) -> NDArray[np.uint8]:
        """Return the image as grey. Raises TrackError unless it is one of the camera."""
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
            raise TrackError(f"an image must be an array of uint8, not {kind}")
        if image.ndim not in (2, 3) or image.shape[2:] not in ((), (1,), (3,)):
            raise TrackError(f"an image must be (h, w) or (h, w, 3), not {image.shape}")
        height, width = image.shape[:2]
        if (width, height) != (self.camera.width_px, self.camera.height_px):
            raise TrackError(
                f"the image has {width} x {height} pixels, {self._calibration} is calibrated for "
                f"{self.camera.width_px} x {self.camera.height_px}: calibrate at the resolution in "
                "use"
            )
        if image.shape[2:] == (3,):
            return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        return image.reshape(height, width)
