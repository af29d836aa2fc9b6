# SPDX-License-Identifier: Apache-2.0
"""Map a target from the points that chasers track, from nothing, as the points arrive.

``Mapper.update`` adjusts everything to the kept views. Memory is bounded: old views are thinned
out, and tracks without a kept view are forgotten.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_protocol.messages import MapStatus
from numpy.typing import NDArray

from .adjustment import (
    CAMERA,
    Adjusted,
    AdjustmentTuning,
    Problem,
    adjust,
    fit,
    triangulate,
    with_landmarks,
)
from .merging import Merges, MergingTuning, medians
from .starting import StartTuning, candidate_motions, middle_of_lines, motion_px
from .types import (
    CameraUncertainty,
    CameraViews,
    ConstantRates,
    ImageTracks,
    MapEstimate,
    Observations,
)

MAP_STATUS: tuple[MapStatus, ...] = ("scale unknown", "mapped")


@dataclass(frozen=True)
class MapperTuning:
    """Numbers of the mapper, with units and reasons."""

    recent_s: float = 8.0
    recent_period_s: float = 0.4
    """The last eight seconds keep a view every 0.4 s: a start needs tracks that are seen often."""
    period_s: float = 1.2
    """Older views: a turn of 4 degrees at 3.2 deg/s."""
    most_views: int = 120
    """Views kept of a chaser: beyond, every second of the older half goes. An adjustment of two
    chasers takes 0.5 s with as many (benchmarks/unknown.py)."""
    most_landmarks: int = 1000
    """Landmarks adjusted: those seen most often."""
    least_views: int = 4
    """Views that a landmark needs: two more than its unknowns fill."""
    landmark_sigma_m: float = 0.03
    """Landmarks less certain along their worst direction are left out: errors are not linear."""
    residual_px: float = 0.8
    """Landmarks whose median residual is larger slide along edges or shadows."""
    first_residual_px: float = 4.0
    """The same before a start is adjusted."""
    slide_px: float = 3.0
    """Standard deviation of the slide of a point, px for a turn of 1 rad: 1 to 4 between 3 and 15 s
    after it was found (docs/evidence/unknown.md)."""
    fresh_px: float = 0.3
    slide_px_s: float = 0.02
    """Standard deviation of a point at first, and of what it strays beside a constant slide: 0.15
    to 0.3 px in 8 s and more (docs/evidence/unknown.md)."""
    noise_px: float = 1.2
    """Noise of a coordinate as if views were independent. Points stray by 0.25 px, but alike in
    some ten views in a row, and neighbours together (NEES: docs/evidence/unknown.md)."""
    open_factor: float = 2.5
    """Factor of the motion's standard deviations until a side of the target has returned: slides of
    points that are alike look like motion (NEES: docs/evidence/unknown.md)."""
    closing_tracks: int = 100
    """Tracks that must be found again before a side has returned: a third of those in an image.
    With 30, when the first recalls arrive, the motion is not corrected yet (NEES 22)."""
    start_s: float = 4.0
    """Shortest span of views from which a start is tried."""
    least_points: int = 40
    """Points in an image below which a target has too little texture."""
    start_share: float = 0.6
    """Share of the tracks that a start must explain: 0.75 to 0.9 of a right one."""
    start_margin: float = 1.25
    """Factor by which the cost of any other motion must exceed that of the best: a target's wrong
    twins had 1.5 to 3 after 8 s."""
    agree_sigmas: float = 4.0
    """Consecutive estimates of the rate must agree so far, with ``agree_share`` added."""
    agree_share: float = 0.02
    """Share of the rate within which consecutive estimates always agree."""
    rate_share: float = 0.03
    """Standard deviation of the rate, as a share, of a first estimate."""
    scale_share: float = 0.02
    """Standard deviation of the scale above which it counts as unknown: 4 cm at 2 m."""
    spread_m: float = 2.5
    """Landmarks farther from the middle are not of this target, or have no depth."""


@dataclass(frozen=True, eq=False)
class TargetMap:
    """What is known at ``time_s``.

    ``motion`` and what follows are None, empty or infinite without a map. ``covariance`` (9, 9): of
    the motion's vector. ``cameras`` (chasers, 9): see `MapEstimate`. ``keys`` (n,): of landmarks,
    ``landmarks_m`` (n, 3), TRF, ``covariances_m2`` (n, 3, 3). ``scale_share``: standard deviation
    of all distances. ``closed``: whether a side of the target was seen again after a turn; before,
    the size of the rate is some tenths of a percent wrong.
    """

    time_s: float
    status: MapStatus
    motion: ConstantRates | None = None
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    cameras: Array = field(default_factory=lambda: np.zeros((0, CAMERA)))
    keys: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmarks_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    covariances_m2: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    scale_share: float = float("inf")
    residual_px: float = float("inf")
    merges: int = 0
    closed: bool = False


class Mapper:
    """Estimates motion and map of one target from several chasers' tracks.

    Equal input gives equal output.
    """

    def __init__(
        self,
        cameras: Sequence[CameraUncertainty],
        focal_px: float,
        tuning: MapperTuning | None = None,
        starts: StartTuning | None = None,
    ) -> None:
        self._starts = starts or StartTuning()
        self.tuning = tuning or MapperTuning()
        self._cameras, self._focal_px = tuple(cameras), focal_px
        self._views: list[list[ImageTracks]] = [[] for _ in cameras]
        self.merges = Merges(MergingTuning())
        self._prior: ConstantRates | None = None
        self._last: Adjusted | None = None
        self._keys = np.zeros(0, dtype=np.int64)
        self._turns: dict[tuple[int, float], Array] = {}
        self._candidate: tuple[ConstantRates, Adjusted] | None = None

    @property
    def motion(self) -> ConstantRates | None:
        """The motion as last estimated, None before a map."""
        return None if self._last is None else self._last.estimate.motion

    def known_tracks(self, chaser: int) -> tuple[IntArray, IntArray]:
        """Return the ids (n,), ascending, of a chaser's tracks that are landmarks, and the rows
        (n,) of these in the last map.
        """
        views = self._views[chaser]
        if self._last is None or not views:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        ids = np.unique(np.concatenate([v.ids for v in views]))
        roots = self.merges.roots(_keys(chaser, ids))
        at = np.minimum(np.searchsorted(self._keys, roots), len(self._keys) - 1)
        mapped = self._keys[at] == roots
        return ids[mapped], at[mapped]

    def known_points(self, chaser: int) -> tuple[IntArray, Array]:
        """Return the ids (n,), ascending, of a chaser's tracks that are landmarks, and where these
        are, (n, 3), TRF.
        """
        ids, rows = self.known_tracks(chaser)
        if self._last is None:
            return ids, np.zeros((0, 3))
        return ids, self._last.estimate.landmarks_m[rows]

    def add(self, tracks: ImageTracks) -> None:
        """Take the points of one image; images of a chaser come in the order of time."""
        kept, tuning = self._views[tracks.chaser], self.tuning
        if kept and tracks.time_s - kept[-1].time_s < tuning.recent_period_s - _SLACK_S:
            return
        kept.append(tracks)
        limit = tracks.time_s - tuning.recent_s
        out: list[ImageTracks] = []
        for view in kept:
            old = view.time_s < limit
            if old and out and view.time_s - out[-1].time_s < tuning.period_s - _SLACK_S:
                continue
            out.append(view)
        if len(out) > tuning.most_views:
            half = len(out) // 2
            out = out[:half:2] + out[half:]
        self._views[tracks.chaser] = out

    def kept_views(self) -> tuple[tuple[ImageTracks, ...], ...]:
        """Return the views of each chaser that are kept, by time."""
        return tuple(tuple(views) for views in self._views)

    def observations(self) -> tuple[CameraViews, Observations, IntArray]:
        """Return what the kept views show: views, observations and the keys (n,) of landmarks."""
        return self._gathered(self._views)

    def describe(
        self, chaser: int, time_s: float, ids: IntArray, values: NDArray[np.uint8]
    ) -> None:
        """Take descriptions (n, 128) of tracks in an image."""
        self.merges.add(time_s, _keys(chaser, ids), values)

    def update(self, time_s: float) -> TargetMap:
        """Return the map from all that was added."""
        if self._last is None:
            return self._start(time_s)
        return self._extend(time_s)

    # -- From nothing ------------------------------------------------------------------------------

    def _start(self, time_s: float) -> TargetMap:
        tuning = self.tuning
        windows = [[v for v in w if v.time_s >= time_s - tuning.recent_s] for w in self._views]
        windows = [w for w in windows if w]
        spans = [w[-1].time_s - w[0].time_s for w in windows]
        if not spans or max(spans) < tuning.start_s:
            return TargetMap(time_s, "gathering")
        if max(np.median([len(v.ids) for v in w]) for w in windows) < tuning.least_points:
            return TargetMap(time_s, "no texture")
        if motion_px(windows, self._focal_px) < self._starts.least_motion_px:
            return TargetMap(time_s, "does not turn")
        middle = [w[len(w) // 2] for w in windows]
        position = middle_of_lines(middle)
        if position is None:
            position = middle[0].position_w_m + middle[0].rotation @ np.array([0, 0, _ASSUMED_M])
        velocity = np.mean(
            [(w[-1].position_w_m - w[0].position_w_m) / (w[-1].time_s - w[0].time_s)
             for w in windows if len(w) > 1], axis=0,
        )  # fmt: skip
        found = candidate_motions(
            windows, self._focal_px, position, velocity, middle[0].time_s, self._starts
        )
        tried = [self._tried(windows, m, ConstantRates(m.time_s, position, velocity, m.omega_rad_s))
                 for _, m in found]  # fmt: skip
        trials = sorted((t for t in tried if t is not None), key=lambda t: t[0])
        if not trials or trials[0][1] < tuning.start_share:
            return TargetMap(time_s, "inconsistent")
        cost, _, best, keys, prior = trials[0]
        omega = best.estimate.motion.omega_rad_s
        size = float(np.linalg.norm(omega))
        for other in trials[1:]:
            apart = float(np.linalg.norm(other[2].estimate.motion.omega_rad_s - omega))
            if apart > self._starts.apart * size and other[0] < tuning.start_margin * cost:
                return TargetMap(time_s, "ambiguous")
        before, self._candidate = self._candidate, (best.estimate.motion, best)
        if before is None or not self._agree(before, best):
            return TargetMap(time_s, "inconsistent")
        sigma = float(np.sqrt(np.linalg.eigvalsh(best.covariance[6:9, 6:9])[-1]))
        if sigma > tuning.rate_share * size:
            return TargetMap(time_s, "ambiguous")
        self._prior, self._last, self._keys = prior, best, keys
        return self._extend(time_s)

    def _agree(self, before: tuple[ConstantRates, Adjusted], now: Adjusted) -> bool:
        tuning = self.tuning
        rate, other = now.estimate.motion.omega_rad_s, before[0].omega_rad_s
        spread = np.sqrt(np.linalg.eigvalsh(before[1].covariance[6:9, 6:9])[-1])
        allowed = tuning.agree_sigmas * spread + tuning.agree_share * np.linalg.norm(rate)
        return bool(np.linalg.norm(rate - other) < allowed)

    def _tried(
        self, windows: Sequence[Sequence[ImageTracks]], motion: ConstantRates, prior: ConstantRates
    ) -> tuple[float, float, Adjusted, IntArray, ConstantRates] | None:
        """Return cost, explained share and adjustment from a candidate motion with its landmarks'
        keys and prior; None if it explains nothing.
        """
        views, observations, keys = self._gathered(windows)
        problem = self._problem(views, observations, prior, motion)
        estimate = MapEstimate(
            motion, np.zeros((len(self._cameras), CAMERA)), np.zeros((len(views.time_s), 3)),
            np.zeros((0, 3)),
        )  # fmt: skip
        adjusted, chosen, limit = None, keys, self.tuning.first_residual_px
        for _ in range(_START_ROUNDS):
            part, estimate, chosen = self._selected(problem, estimate, keys, limit)
            if part is None:
                return None
            adjusted = adjust(part, estimate, AdjustmentTuning(steps=8))
            if adjusted is None:
                return None
            estimate, limit = adjusted.estimate, self.tuning.residual_px
        every, _ = triangulate(problem, estimate, len(keys))
        whole = with_landmarks(estimate, every)
        off = np.minimum(_off_px(problem, whole), _CAP_PX)
        median = medians(off, observations.landmark, len(keys))
        share = float((median < self.tuning.residual_px).mean())
        assert adjusted is not None
        return float(np.log1p(off**2).mean()), share, adjusted, chosen, prior

    # -- With a map --------------------------------------------------------------------------------

    def _extend(self, time_s: float) -> TargetMap:
        assert self._last is not None
        assert self._prior is not None
        views, observations, keys = self.observations()
        last = self._last.estimate
        problem = self._problem(views, observations, self._prior, last.motion)
        seen_at = list(zip(views.chaser.tolist(), views.time_s.tolist(), strict=True))
        turns = np.array([self._turns.get(at, np.zeros(3)) for at in seen_at])
        start = MapEstimate(last.motion, last.cameras, turns, last.landmarks_m)
        part, start, chosen = self._selected(
            problem, start, keys, self.tuning.first_residual_px, self._keys
        )
        # Wide first: what is seen again after a turn disagrees with all tracks at once.
        wide = part and adjust(part, start, AdjustmentTuning(robust_px=4.0, steps=4))
        if not wide:
            return TargetMap(time_s, "inconsistent")
        part, start, chosen = self._selected(
            problem, wide.estimate, keys, self.tuning.residual_px, chosen
        )
        adjusted = part and adjust(part, start)
        if part is None or adjusted is None:
            return TargetMap(time_s, "inconsistent")
        self._turns = dict(zip(seen_at, adjusted.estimate.turns, strict=True))
        self._last, self._keys = adjusted, chosen
        self.merges.check(part.observations, adjusted.residual_px, chosen)
        self.merges.find(part.observations, adjusted, chosen)
        self.merges.forget(np.unique(observations.track))
        closed = self._closed(part, adjusted.estimate.motion)
        return self._described(time_s, adjusted, chosen, closed)

    def _closed(self, problem: Problem, motion: ConstantRates) -> bool:
        """Return whether enough tracks were found again after a part of a turn without them."""
        of, seen_s = problem.tracks.of, problem.views.time_s[problem.observations.view]
        order = np.lexsort((seen_s, of))
        turned = np.diff(seen_s[order]) * float(np.linalg.norm(motion.omega_rad_s))
        again = (np.diff(of[order]) == 0) & (turned > _UNSEEN_RAD)
        return len(np.unique(of[order][1:][again])) >= self.tuning.closing_tracks

    def _described(self, time_s: float, found: Adjusted, keys: IntArray, closed: bool) -> TargetMap:
        estimate = found.estimate
        factor = 1.0 if closed else self.tuning.open_factor
        away = [v[-1].position_w_m for v in self._views if v]
        line = found.centre_m - away[0] if away else found.centre_m
        range_m = float(np.linalg.norm(line))
        scale = float(np.sqrt(line @ found.centre_covariance_m2 @ line)) / range_m**2
        status: MapStatus = "mapped" if scale < self.tuning.scale_share else "scale unknown"
        return TargetMap(
            time_s, status, estimate.motion, factor**2 * found.covariance[:9, :9],
            estimate.cameras, keys, estimate.landmarks_m, found.landmark_covariances_m2, scale,
            float(np.median(found.residual_px)), self.merges.count, closed,
        )  # fmt: skip

    # -- Gathering ---------------------------------------------------------------------------------

    def _problem(
        self,
        views: CameraViews,
        observations: Observations,
        prior: ConstantRates,
        motion: ConstantRates,
    ) -> Problem:
        """Return the adjustment of observations to a target about as fast as ``motion``."""
        slide_px_s = self.tuning.slide_px * float(np.linalg.norm(motion.omega_rad_s))
        return Problem(
            views, observations, self._cameras, self._focal_px, prior, self.tuning.noise_px,
            max(slide_px_s, _LEAST_SLIDE_PX_S),
        )  # fmt: skip

    def _gathered(
        self, windows: Sequence[Sequence[ImageTracks]]
    ) -> tuple[CameraViews, Observations, IntArray]:
        """Return views, observations and the keys (n,) of the landmarks, of tracks that enough
        views show.
        """
        images = [v for w in windows for v in w]
        tracks = np.concatenate([_keys(v.chaser, v.ids) for v in images])
        keys = self.merges.roots(tracks)
        number = np.repeat(np.arange(len(images)), [len(v.ids) for v in images])
        rays = np.concatenate([v.rays for v in images])
        views = CameraViews(
            np.array([v.chaser for v in images]),
            np.array([v.time_s for v in images]),
            np.array([v.position_w_m for v in images]),
            np.array([v.rotation for v in images]),
        )
        ages_s = np.concatenate([v.ages_s for v in images])
        # Of merged tracks that one view shows both, the younger point counts.
        order = np.lexsort((ages_s, keys, number))
        same = (np.diff(keys[order]) == 0) & (np.diff(number[order]) == 0)
        single = np.sort(order[np.append(True, ~same)])
        tracks, keys, number = tracks[single], keys[single], number[single]
        rays, ages_s = rays[single], ages_s[single]
        unique, landmark, counts = np.unique(keys, return_inverse=True, return_counts=True)
        enough = _most_seen(counts, counts >= self.tuning.least_views, _MOST_TRACKS)
        place = np.cumsum(enough) - 1
        weight = 1.0 / np.hypot(1.0, ages_s * self.tuning.slide_px_s / self.tuning.fresh_px)
        seen = Observations(number, landmark, rays, tracks, weight, ages_s).by_landmark(
            place, enough
        )
        return views, seen, unique[enough]

    def _selected(
        self,
        problem: Problem,
        estimate: MapEstimate,
        keys: IntArray,
        limit_px: float,
        known: IntArray | None = None,
    ) -> tuple[Problem | None, MapEstimate, IntArray]:
        """Return the problem and start of the landmarks that fit the estimate, and their keys; None
        if these are too few.

        ``known``: keys of the estimate's landmarks, which are kept; others are triangulated.
        """
        tuning, seen = self.tuning, problem.observations
        points, sigma = triangulate(problem, estimate, len(keys))
        if known is not None and len(known):
            at = np.searchsorted(known, keys)
            at = np.minimum(at, len(known) - 1)
            same = known[at] == keys
            points[same] = estimate.landmarks_m[at[same]]
        start = with_landmarks(estimate, points)
        median = medians(_off_px(problem, start), seen.landmark, len(keys))
        good = (median < limit_px) & (sigma < tuning.landmark_sigma_m)
        if good.any():
            middle = np.median(points[good], axis=0)
            good &= np.linalg.norm(points - middle, axis=1) < tuning.spread_m
        counts = np.bincount(seen.landmark, minlength=len(keys))
        good = _most_seen(counts, good, tuning.most_landmarks)
        if int(good.sum()) < _LEAST_LANDMARKS:
            return None, start, keys
        place = np.cumsum(good) - 1
        part = seen.by_landmark(place, good)
        return replace(problem, observations=part), with_landmarks(start, points[good]), keys[good]


_LEAST_SLIDE_PX_S = 1e-3
"""Slide of points on a target that hardly turns."""
_UNSEEN_RAD = 2.0
"""Turn without a point after which it has returned: a side is out of view for more than half a
turn."""
_SLACK_S = 1e-6
"""Difference of two times, s, that are the same but for rounding."""
_ASSUMED_M = 2.0
"""Range from which a single camera starts: it cannot tell."""
_START_ROUNDS = 3
"""Selections and adjustments of a start."""
_BEHIND_M, _CAP_PX = 0.1, 10.0
"""Depth of a landmark that counts as behind a camera, and the largest residual, px."""
_LEAST_LANDMARKS = 30
"""Landmarks without which nothing is adjusted: three times what fixes all unknowns."""
_MOST_TRACKS = 4000
"""Tracks considered, those seen most often."""


def _off_px(problem: Problem, estimate: MapEstimate) -> Array:
    """Return by how much each observation (k,) is off its landmark; the cap for one behind."""
    found = fit(problem, estimate, AdjustmentTuning().robust_px)
    off = np.linalg.norm(found.residual, axis=1)
    off[found.depth_m < _BEHIND_M] = _CAP_PX
    return off


def _most_seen(counts: IntArray, good: NDArray[np.bool_], most: int) -> NDArray[np.bool_]:
    """Return ``good`` (n,) without all but the ``most`` of the largest counts (n,)."""
    if int(good.sum()) <= most:
        return good
    out = np.zeros(len(good), dtype=bool)
    out[np.argsort(-(counts * good), kind="stable")[:most]] = True
    return out


def _keys(chaser: int, ids: IntArray) -> IntArray:
    """Return keys (n,) of tracks, unique over all chasers."""
    return (np.int64(chaser) << np.int64(40)) + np.asarray(ids, dtype=np.int64)
