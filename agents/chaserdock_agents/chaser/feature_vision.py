# SPDX-License-Identifier: Apache-2.0
"""Look at a target of unknown shape: follow its points for the mapper, measure its pose by the map.
No I/O.

What the mapper knows comes back in its maps, by which points are found again when a face returns.
In lock-step a map counts from a fixed age on, so that equal flights use equal maps.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.messages import (
    AGE_STEP_S,
    PX_STEP,
    FeatureTracks,
    Image,
    LandmarkMap,
    MappedMotion,
    Odometry,
    SightedMap,
    Sighting,
    TargetEstimate,
    Tick,
)
from chaserdock_protocol.pose_image import UnusableImage
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.topics import Topic
from numpy.typing import ArrayLike

from .bodies_in_view import Disc, chaser_discs, probe_discs
from .perception.features import (
    FeatureTracker,
    ImageEllipses,
    KnownTarget,
    NoMapPose,
    PointDescriptions,
    SeenLandmarks,
    TrackedPoints,
    describe,
    find_ellipses,
    pose_by_map,
    region_around,
)
from .perception.refine import PoseInCamera
from .sighting import BadImage, decode_image, pose_solution, without_sighting
from .vision import REMEMBERED_IMAGES, Vision

_DESCRIBED_PERIOD_S = 5.2
"""Between images whose points are described: 64 bytes a point and second, of 45 in all."""
_ELLIPSE_PERIOD_S = 2.6
"""Between images in which ellipses are sought: 8 to 13 degrees of turn at 3 to 5 deg/s. With 5.2 s
half of the rings of a flight are missed; every second costs 20 ms (docs/evidence/unknown.md)."""
_OLD_NS = 1_000_000_000
"""Age from which an estimate does not tell where other chasers are: at 3 cm/s they move by half of
the margin about them."""
_MOST_MAPS = 100
"""Maps that may have arrived and not count yet: a minute of attempts at a first map."""


@dataclass(frozen=True, eq=False)
class MappedPath:
    """Poses of a mapped target at constant rates from ``time_s`` on."""

    time_s: float
    motion: MappedMotion

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Return positions (n, 3), WRF, and rotations (n, 3, 3), TRF to WRF, at times (n,)."""
        after, m = np.asarray(time_s, dtype=float)[:, None] - self.time_s, self.motion
        turns = rotations.exp(np.array(m.omega_rad_s) * after)
        attitudes = rotations.to_matrix(rotations.multiply(m.q_wxyz, turns))
        return np.array(m.position_m) + np.array(m.velocity_m_s) * after, attitudes

    def covariance_at(self, time_s: float) -> Array:
        """Return the covariance (6, 6) of position, WRF, and dtheta, TRF, at a time."""
        by = np.zeros((6, 12))
        by[:3, :3] = by[3:, 6:9] = np.eye(3)
        by[:3, 3:6] = by[3:, 9:] = (time_s - self.time_s) * np.eye(3)
        return by @ np.array(self.motion.covariance).reshape(12, 12) @ by.T


@dataclass(frozen=True, eq=False)
class CountingMap:
    """A map that counts, and what it says of one chaser's points: None without landmarks.

    ``covariances_m2`` (n, 3, 3): of the known landmarks, TRF.
    """

    message: LandmarkMap
    known: KnownTarget | None = None
    path: MappedPath | None = None
    covariances_m2: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))


class FeatureVision(Vision):
    """Follow points of the target in the images of chaser ``chaser``, and measure its pose once
    there is a map with distances.
    """

    def __init__(self, scenario: FlightScenario, chaser: int) -> None:
        super().__init__(None)
        timing, self._errors = scenario.timing, scenario.navigation.errors()
        self._chaser, self._camera = chaser, scenario.camera_model()
        self._tracker = FeatureTracker(self._camera)
        self._boxes = scenario.chaser.boxes()
        self._probe = probe_discs(self._camera, self._boxes[1])
        self._estimate: TargetEstimate | None = None
        self._latency_ticks = round(scenario.mapping.latency_s * timing.rate_hz)
        self._odometry: deque[Odometry] = deque(maxlen=REMEMBERED_IMAGES)
        self._maps: deque[LandmarkMap] = deque(maxlen=_MOST_MAPS)
        self._counting: CountingMap | None = None
        self._first_id: int | None = None
        self._described_s = self._searched_s = 0.0

    def take(self, message: Odometry | LandmarkMap | TargetEstimate) -> None:
        """Take the chaser's own state, a map, or an estimate that states where chasers are."""
        if isinstance(message, TargetEstimate):
            self._estimate = message
            return
        known = self._odometry if isinstance(message, Odometry) else self._maps
        if not known or message.tick > known[-1].tick:
            known.append(message)  # pyright: ignore[reportArgumentType]

    def missing(self, image: Image, tick: Tick | None, realtime: bool) -> Topic | None:
        """Return ``ODOMETRY`` until the state at exposure is known and, in lock-step, ``MAP`` until
        the map has arrived that counts by then.
        """
        odometry = self._odometry
        if not odometry or odometry[-1].sim_time_ns < image.sim_time_ns:
            return topics.ODOMETRY
        if realtime or tick is None or not tick.mapper or image.tick < tick.tick:
            return None
        newest = self._maps[-1] if self._maps else None
        own = newest is not None and newest.instance == tick.mapper
        due = newest.next_tick if newest is not None and own else tick.since.get("mapper", 0)
        return topics.MAP if due + self._latency_ticks <= image.tick else None

    def without_image(self, missed: Sighting) -> None:
        """Let the mapper not wait for the points of an image that will not come."""
        pose = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        if self._odometry:
            pose = self._camera_pose(missed.sim_time_ns)
        self.tracks = self._tracks(missed, "bad_image", *pose)

    def look(self, image: Image) -> Sighting | None:
        """Follow the points into an image. Return a sighting, without a pose while there is no map;
        None if the image of its exposure was processed before.
        """
        with self._looking:
            exposure = (image.tick, image.sim_time_ns)
            if exposure in self._processed:
                return None
            self._processed.append(exposure)
            self.sighting = self._follow(image)
            return self.sighting

    def _follow(self, image: Image) -> Sighting:
        time_s, pose = image.sim_time_ns / 1e9, self._camera_pose(image.sim_time_ns)
        counting = self._map_at(image.tick)
        known = None if counting is None else counting.known
        try:
            pixels = decode_image(image)
            excluded = (*self._probe, *self._others(image.sim_time_ns))
            seen = self._tracker.track(pixels, time_s, *pose, known, excluded)
        except (BadImage, UnusableImage) as error:
            self.tracks = self._tracks(image, "bad_image", *pose)
            return without_sighting(image, str(error), "bad_image")
        described = None
        if known is not None and time_s - self._described_s >= _DESCRIBED_PERIOD_S:
            self._described_s = time_s
            at, turned = known.motion.at([time_s])
            axes = rotations.to_matrix(pose[1])
            expected = PoseInCamera(axes.T @ (at[0] - pose[0]), axes.T @ turned[0])
            described = describe(pixels, self._camera, seen.ids, seen.px, expected)
        ellipses = None
        if known is not None and time_s - self._searched_s >= _ELLIPSE_PERIOD_S:
            self._searched_s = time_s
            ellipses = find_ellipses(pixels, self._camera, region_around(self._camera, seen.px))
        if self._first_id is None:
            # No point of an earlier process of this chaser has such an id.
            self._first_id = max(image.tick, 0) * self._tracker.tuning.most_points
        self.tracks = self._tracks(
            image, "seen" if len(seen.ids) else "nothing", *pose, seen, described, ellipses
        )
        sighting = self._sighting_by(counting, image, seen, pose)
        return msgspec.structs.replace(sighting, map=self._sighted(counting))

    def _others(self, time_ns: int) -> tuple[Disc, ...]:
        """Return the discs that cover other chasers in an image; none if nobody knows where they
        are.
        """
        estimate = self._estimate
        if estimate is None or time_ns - estimate.sim_time_ns > _OLD_NS:
            return ()
        return chaser_discs(self._camera, self._boxes, self._chaser, estimate)

    def _sighted(self, counting: CountingMap | None) -> SightedMap | None:
        """Return what the map that counts says to the controller."""
        if counting is None or counting.message.motion is None:
            return None
        ports = counting.message.ports
        own = next((p for p in ports if p.chaser == self._chaser), None)
        return SightedMap(closed=counting.message.closed, port=own)

    def _sighting_by(
        self,
        counting: CountingMap | None,
        image: Image,
        seen: TrackedPoints,
        camera_pose: tuple[Array, Array],
    ) -> Sighting:
        """Return the pose of the target by a map, or why there is none."""
        if counting is None or counting.known is None or counting.path is None:
            status = "gathering" if counting is None else counting.message.status
            return without_sighting(image, f"no map of the target: {status}")
        if counting.message.status != "mapped":
            return without_sighting(image, f"no distances in the map: {counting.message.status}")
        time_s, known = image.sim_time_ns / 1e9, counting.known
        axes = rotations.to_matrix(camera_pose[1])
        at, turned = counting.path.at([time_s])
        predicted = PoseInCamera(axes.T @ (at[0] - camera_pose[0]), axes.T @ turned[0])
        _, mine, theirs = np.intersect1d(
            seen.ids, known.ids, assume_unique=True, return_indices=True
        )
        landmarks = SeenLandmarks(
            seen.px[mine],
            seen.ages_s[mine],
            known.landmarks_m[theirs],
            counting.covariances_m2[theirs],
        )
        covariance = self._in_camera(counting.path.covariance_at(time_s), axes, predicted)
        try:
            pose = pose_by_map(self._camera, landmarks, predicted, covariance)
        except NoMapPose as error:
            return without_sighting(image, str(error))
        return msgspec.structs.replace(
            without_sighting(image, ""), status="seen", solutions=(pose_solution(pose),)
        )

    def _in_camera(self, covariance: Array, axes: Array, pose: PoseInCamera) -> Array:
        """Return the covariance (6, 6) of a pose in the camera from that in WRF; adds the errors of
        odometry and mounting. ``axes`` (3, 3): IRF to WRF.
        """
        e = self._errors
        turn_rad = float(np.hypot(e.camera_turn_rad, e.attitude_noise_rad))
        shift_m = float(np.hypot(e.camera_shift_m, e.position_noise_m))
        to_irf = np.eye(6)
        to_irf[:3, :3] = axes.T
        out = to_irf @ covariance @ to_irf.T
        range_m = float(np.linalg.norm(pose.position))
        out[:3, :3] += np.eye(3) * (shift_m**2 + (turn_rad * range_m) ** 2)
        out[3:, 3:] += np.eye(3) * turn_rad**2
        return out

    def _camera_pose(self, time_ns: int) -> tuple[Array, Array]:
        """Return optical centre (3,) and attitude (4,), IRF to WRF, by odometry at a time."""
        before = [o for o in self._odometry if o.sim_time_ns <= time_ns]
        own = before[-1] if before else self._odometry[0]
        if own.sim_time_ns != time_ns:
            own = extrapolate(own, own.tick, time_ns)
        return self._camera.irf_pose_in_world(own.position_m, own.q_wxyz)

    def _map_at(self, tick: int) -> CountingMap | None:
        """Return the newest map that counts at a tick; None before the first one."""
        arrived = [m for m in tuple(self._maps) if m.tick + self._latency_ticks <= tick]
        if arrived and (self._counting is None or self._counting.message is not arrived[-1]):
            self._counting = self._read(arrived[-1])
        return self._counting

    def _read(self, message: LandmarkMap) -> CountingMap:
        own = next((t for t in message.tracks if t.chaser == self._chaser), None)
        if message.motion is None or own is None or self._first_id is None:
            return CountingMap(message)
        landmarks = np.array(message.landmarks_m).reshape(-1, 3)
        moments = np.array(message.moments_m2).reshape(-1, 6)
        rows, n = np.array(own.landmarks, dtype=np.int64), len(landmarks)
        if len(rows) != len(own.ids) or len(moments) != n or (rows >= n).any():
            return CountingMap(message)
        path = MappedPath(message.sim_time_ns / 1e9, message.motion)
        ids = np.array(own.ids, dtype=np.int64) - self._first_id
        mine = ids >= 0
        rows = rows[mine]
        known = KnownTarget(path, ids[mine], landmarks[rows])
        spread = moments[:, (0, 3, 4, 3, 1, 5, 4, 5, 2)].reshape(-1, 3, 3)
        return CountingMap(message, known, path, _without_common(spread)[rows])

    def _tracks(
        self,
        image: Image | Sighting,
        status: Literal["seen", "nothing", "bad_image"],
        position_w_m: Array,
        q_w_irf_wxyz: Array,
        seen: TrackedPoints | None = None,
        described: PointDescriptions | None = None,
        ellipses: ImageEllipses | None = None,
    ) -> FeatureTracks:
        head = FeatureTracks(
            tick=image.tick,
            sim_time_ns=image.sim_time_ns,
            chaser=self._chaser,
            status=status,
            position_m=vector(position_w_m),
            q_wxyz=vector(q_w_irf_wxyz),
        )
        if seen is None:
            return head
        first = self._first_id or 0
        return msgspec.structs.replace(
            head,
            ids=tuple((seen.ids + first).tolist()),
            places=tuple(np.rint(seen.px / PX_STEP).astype(np.int64).ravel().tolist()),
            ages=tuple(np.rint(seen.ages_s / AGE_STEP_S).astype(np.int64).tolist()),
            described=() if described is None else tuple((described.ids + first).tolist()),
            descriptions=b"" if described is None else described.values.tobytes(),
            ellipses=() if ellipses is None else tuple(ellipses.rows().ravel().tolist()),
        )


def _without_common(covariances_m2: Array) -> Array:
    """Return covariances (n, 3, 3) of landmarks without what all have in common: where the frame
    is on the target. It is at most that of the most certain one.
    """
    if not len(covariances_m2):
        return covariances_m2
    least = covariances_m2[np.argmin(np.trace(covariances_m2, axis1=1, axis2=2))]
    values, vectors = np.linalg.eigh(covariances_m2 - least)
    return (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
