# SPDX-License-Identifier: Apache-2.0
"""Path of the film's camera, and its clock: where it looks from at each time of a flight, and how
fast time passes. Pure functions of the recorded motion; both renderers film along the same path.

Far from contact the camera orbits slowly around all bodies. From the beginning of an approach it
frames target and chaser from the side of the docking axis, a little in front of the port's face, so
that neither body hides the gap; it turns with the target and closes in as the bodies do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.targets import Box, cuboid_corners
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import NDArray

from .chase_camera import BodyPose, Viewpoint, interpolated
from .motion import Track

APPROACHING = frozenset({"align", "approach", "final", "contact", "latched", "docked"})
"""Phases from the beginning of an approach to the end of the test of the latch."""


@dataclass(frozen=True)
class ChaseTuning:
    """How the camera moves."""

    orbit_rad_s: float = math.radians(1.5)  # a quarter turn a minute: seen, but not followed
    close_orbit_rad_s: float = math.radians(0.8)  # slower: the eye is on the gap
    elevation_rad: float = math.radians(22.0)  # shows top and side of a cuboid
    steepest_rad: float = math.radians(42.0)  # steeper views are avoided: bodies look flat
    most_forward_rad: float = math.radians(20.0)  # in front of the port's face; more: gap shortens
    blend_s: float = 5.0  # from overview to approach and back, without haste
    linger_s: float = 1.5  # on a chaser after `verified`, to read it
    docked_s: float = 4.0  # on a chaser that is docked at a distance: nothing moves any more
    reach_m: float = 3.0  # chasers farther from the target must not shrink all others
    filled: float = 0.84  # share of the free picture that bodies fill; more: they touch the text
    held: float = 0.95  # share in which port and probe are held, whatever the rest does
    nearest_m: float = 0.35  # of the camera to what it looks at: the rasterizer's near plane
    step_s: float = 0.1  # between computed poses of the camera, interpolated linearly
    smooth_s: float = 0.8  # standard deviation of the smoothing of the distance: no sudden zoom


TUNING = ChaseTuning()


@dataclass(frozen=True)
class ClockTuning:
    """How time slows down around contact."""

    slower: float = 3.0  # 12 mm/s at contact become 4 mm a second of film
    before_s: float = 1.5  # 18 mm of the approach at 12 mm/s
    after_s: float = 1.0  # the latch closes, bodies rebound
    ramp_s: float = 1.0  # from full speed to slow and back


CLOCK = ClockTuning()


class FilmClock:
    """Map between film time and flight time, both s; film time begins with 0."""

    def __init__(
        self, begin_s: float, end_s: float, contacts_s: Sequence[float] = (), speed: float = 1.0
    ) -> None:
        steps = max(2, math.ceil((end_s - begin_s) / 0.02) + 1)  # a third of a frame, or finer
        self._flight_s = np.linspace(begin_s, end_s, steps)
        slow = np.zeros(steps)
        for contact_s in contacts_s:
            before = (contact_s - CLOCK.before_s - self._flight_s) / CLOCK.ramp_s
            after = (self._flight_s - contact_s - CLOCK.after_s) / CLOCK.ramp_s
            slow = np.maximum(slow, 1.0 - _eased(np.maximum(before, after)))
        pace = (1.0 + (CLOCK.slower - 1.0) * slow) / speed  # seconds of film per second of flight
        pieces = 0.5 * (pace[1:] + pace[:-1]) * np.diff(self._flight_s)
        self._film_s = np.concatenate([[0.0], np.cumsum(pieces)])
        self._speed = speed

    @property
    def duration_s(self) -> float:
        """Duration of the film without its last card."""
        return float(self._film_s[-1])

    def flight_time(self, film_s: float) -> float:
        """Return the time of the flight that is shown at a time of the film."""
        return float(np.interp(film_s, self._film_s, self._flight_s))

    def slowdown(self, film_s: float) -> float:
        """Return by what factor the film is slower than elsewhere: 1 away from contact."""
        early, late = (np.interp(film_s + d, self._film_s, self._flight_s) for d in (-0.02, 0.02))
        begin_s, end_s = max(film_s - 0.02, 0.0), min(film_s + 0.02, self.duration_s)
        return float((end_s - begin_s) * self._speed / max(late - early, 1e-9))


@dataclass(frozen=True)
class FilmedApproach:
    """An approach of a chaser to its port. ``port_m``, ``axis`` (3,): in TRF; without a port, the
    chaser docks at a distance. ``contact_s``: inf without contact.
    """

    chaser: int
    begin_s: float
    contact_s: float
    end_s: float
    port_m: Array | None
    axis: Array | None


def approaches(
    scenario: FlightScenario, phases: Mapping[int, Sequence[tuple[float, str]]], end_s: float
) -> tuple[FilmedApproach, ...]:
    """Return the approaches in the phases (start in s, name) of the chasers, by time of contact."""
    out = []
    for chaser, changes in phases.items():
        port = scenario.docking.port_of(chaser)
        place = (None, None) if port is None else (np.array(port.position_m), np.array(port.axis))
        starts = [t for t, _ in changes]
        begin_s: float | None = None
        contact_s = math.inf
        for (start_s, name), until_s in zip(changes, [*starts[1:], end_s], strict=False):
            if name in APPROACHING:
                begin_s = start_s if begin_s is None else begin_s
                if name in ("contact", "latched", "docked"):
                    contact_s = min(contact_s, start_s)
                if until_s < end_s:
                    continue
            if begin_s is not None:
                done_s = until_s if name in APPROACHING else start_s
                if math.isfinite(contact_s) and port is None:
                    done_s = min(done_s, contact_s + TUNING.docked_s)
                out.append(FilmedApproach(chaser, begin_s, contact_s, done_s, *place))
            begin_s, contact_s = None, math.inf
    return tuple(sorted(out, key=lambda a: (a.contact_s, a.begin_s, a.chaser)))


class ChasePath:
    """Where the camera is at each time of a flight.

    ``target``, ``chasers``: recorded motion. ``size_px``: of the picture; ``free_px``: left, top,
    right and bottom of its part without text and insets, in whose middle the scene is. ``to_sun``,
    ``to_earth`` (3,), WRF: a view of the lit sides, before the Earth, is preferred.
    """

    def __init__(
        self,
        scenario: FlightScenario,
        target: Track,
        chasers: Mapping[int, Track],
        found: Sequence[FilmedApproach],
        size_px: tuple[int, int],
        free_px: tuple[int, int, int, int],
        to_sun: Array,
        to_earth: Array | None = None,
    ) -> None:
        self.approaches = tuple(a for a in found if a.chaser in chasers)
        self._target, self._chasers = target, chasers
        left, top, right, bottom = free_px
        self._size, self._free_px = size_px, np.array([right - left, bottom - top])
        self._middle_px = 0.5 * (left + right), 0.5 * (top + bottom)
        self._sun, self._earth = to_sun, to_earth
        self._tip = np.array([scenario.chaser.probe_reach_m, 0.0, 0.0])
        self._bodies = scenario.target_model().boxes, scenario.chaser.boxes()[:1]
        self._front_m = scenario.chaser.size_m[0] / 2.0
        self._half_m = max(scenario.chaser.size_m[1:]) / 2.0
        begin_s, end_s = float(target.time_s[0]), float(target.time_s[-1])
        self._times = np.linspace(
            begin_s, end_s, max(2, math.ceil((end_s - begin_s) / TUNING.step_s) + 1)
        )
        self._shots = self._schedule(end_s)
        self._compute()

    def focus(self, time_s: float) -> FilmedApproach | None:
        """Return the approach that the camera shows, until its chaser is verified."""
        active = [a for b, e, a in self._shots if b <= time_s <= e]
        return active[-1] if active else None

    def gap(self, approach: FilmedApproach, time_s: float) -> tuple[Array, Array, Array]:
        """Return the port (the target's centre without one), the probe's tip, and the outward axis
        of the port, (3,) each, in WRF.
        """
        at, own = (interpolated(t, time_s) for t in (self._target, self._chasers[approach.chaser]))
        tip = rotations.rotate(own[1], self._tip) + own[0]
        if approach.port_m is None or approach.axis is None:
            axis = own[0] - at[0]
            return at[0], tip, axis / max(float(np.linalg.norm(axis)), 1e-9)
        port = rotations.rotate(at[1], approach.port_m) + at[0]
        return port, tip, rotations.rotate(at[1], approach.axis)

    def viewpoint(self, time_s: float) -> Viewpoint:
        """Return the camera at a time. From the beginning of an approach to its end port and probe
        are in the free part of the picture.
        """
        values = [float(np.interp(time_s, self._times, column)) for column in self._table.T]
        look = self._look(np.array(values[:3]), math.exp(values[3]), values[4], values[5])
        held = [
            point
            for a in self.approaches
            if a.begin_s <= time_s <= a.end_s + TUNING.linger_s
            for point in self.gap(a, time_s)[:2]
        ]
        if held:
            least_m = self._fitting(look, np.array(held), TUNING.held)
            look = self._look(look.centre_m, max(look.distance_m, least_m), *values[4:])
        return look

    def close_up(self, time_s: float, width_px: int, height_px: int) -> Viewpoint | None:
        """Return a view of the gap between port and probe while an approach is shown."""
        focus = self.focus(time_s)
        if focus is None:
            return None
        look = self.viewpoint(time_s)
        port, tip, _ = self.gap(focus, time_s)
        gap_m = float(np.linalg.norm(tip - port))
        focal_px = Viewpoint(port, 1.0, 0.0, 0.0, width_px, height_px).focal_px
        # The gap fills half of the height, and the picture is at least 0.2 m high.
        distance_m = max(gap_m / 0.5, 0.2) * focal_px / height_px
        centre, distance_m = 0.5 * (port + tip), max(distance_m, TUNING.nearest_m)
        return Viewpoint(
            centre, distance_m, look.azimuth_rad, look.elevation_rad, width_px, height_px
        )

    def hidden(self, look: Viewpoint, approach: FilmedApproach, time_s: float) -> bool:
        """Return whether a body's cuboid is between the camera and the port or the probe's tip."""
        port, tip, axis = self.gap(approach, time_s)
        return self._hidden(look.eye_m, np.stack([port + 1e-3 * axis, tip + 1e-3 * axis]), time_s)

    def _schedule(self, end_s: float) -> list[tuple[float, float, FilmedApproach]]:
        """Return one shot after the other: begin, end, what is shown."""
        shots: list[tuple[float, float, FilmedApproach]] = []
        for approach in self.approaches:
            begin_s = max(approach.begin_s, shots[-1][1] if shots else -math.inf)
            until_s = min(approach.end_s + TUNING.linger_s, end_s)
            if until_s - begin_s >= 2.0:  # shorter than that, nothing would be seen
                shots.append((begin_s, until_s, approach))
        return shots

    def _compute(self) -> None:
        times = self._times
        overview = [self._corners(t, None) for t in times]
        centres = np.array([points.mean(axis=0) for points in overview])
        azimuth, elevation = self._overview_direction()
        distance = np.array(
            [
                self._fitting(self._look(c, 1.0, float(a), float(e)), points, TUNING.filled)
                for c, a, e, points in zip(centres, azimuth, elevation, overview, strict=True)
            ]
        )
        for begin_s, end_s, approach in self._shots:
            rows = np.flatnonzero(
                (times >= begin_s - TUNING.blend_s) & (times <= end_s + TUNING.blend_s)
            )
            weight = _eased((times[rows] - begin_s) / TUNING.blend_s + 0.5) * _eased(
                (end_s - times[rows]) / TUNING.blend_s + 1.0
            )
            directions = self._close_direction(approach, rows)
            for row, w, direction in zip(rows, weight, directions, strict=True):
                a, e = _angles(direction)
                a = azimuth[row] + w * math.remainder(a - azimuth[row], 2.0 * math.pi)
                e = elevation[row] + w * (e - elevation[row])
                points = self._corners(times[row], approach.chaser)
                centre = centres[row] + w * (points.mean(axis=0) - centres[row])
                fit_m = self._fitting(self._look(centre, 1.0, a, e), points, TUNING.filled)
                azimuth[row], elevation[row], centres[row] = a, e, centre
                distance[row] = math.exp((1.0 - w) * math.log(distance[row]) + w * math.log(fit_m))
        smooth = _smoothed(np.log(distance), TUNING.smooth_s / TUNING.step_s)
        self._table = np.column_stack(
            [centres, smooth, np.unwrap(azimuth), _smoothed(elevation, 2.0)]
        )

    def _overview_direction(self) -> tuple[Array, Array]:
        """Return azimuth and elevation (K,), rad, of the orbit around all bodies. It leads into the
        first approach.
        """
        meet_s, start = self._times[0], math.atan2(self._sun[1], self._sun[0]) + math.radians(50.0)
        if self._shots:
            meet_s, _, approach = self._shots[0]
            row = int(np.searchsorted(self._times, meet_s))
            start = _angles(self._close_direction(approach, np.array([row]))[0])[0]
        azimuth = start + TUNING.orbit_rad_s * (self._times - meet_s)
        return azimuth, np.full(len(azimuth), TUNING.elevation_rad)

    def _close_direction(self, approach: FilmedApproach, rows: NDArray[np.intp]) -> Array:
        """Return unit vectors (K, 3), WRF, to the camera beside the docking axis. It is turned
        about that axis to where no body hides the gap, the sun shines, and the Earth is behind.
        """
        times = self._times
        begin = int(np.searchsorted(times, approach.begin_s - TUNING.blend_s))
        shown_s = approach.end_s if math.isinf(approach.contact_s) else approach.contact_s
        axes = np.array([self.gap(approach, t)[2] for t in times])
        across = _transported(axes, begin)
        length_m = float(self._tip[0]) - self._front_m
        forward = min(TUNING.most_forward_rad, 0.5 * math.atan2(length_m, self._half_m))
        if approach.port_m is None:
            forward = 0.0

        def direction(row: int, roll: float) -> Array:
            roll += TUNING.close_orbit_rad_s * (times[row] - shown_s)
            side = across[row] * math.cos(roll) + np.cross(axes[row], across[row]) * math.sin(roll)
            return math.cos(forward) * side + math.sin(forward) * axes[row]

        judged = np.flatnonzero((times >= shown_s - 6.0) & (times <= approach.end_s))[::5]
        judged = judged if len(judged) else np.array([len(times) - 1])

        def fault(roll: float) -> float:
            total = 0.0
            for row in judged.tolist():
                to_camera, time_s = direction(row, roll), float(times[row])
                port, tip, axis = self.gap(approach, time_s)
                points = np.stack([port, tip]) + 1e-3 * axis
                total += 10.0 * self._hidden(points.mean(0) + 1.5 * to_camera, points, time_s)
                total += 4.0 * max(0.0, abs(_angles(to_camera)[1]) - TUNING.steepest_rad)
                total += 0.8 * abs(float(to_camera @ self._sun) - 0.5)  # lit, and with shadows
                if self._earth is not None:
                    total += 0.5 * (1.0 + float(to_camera @ self._earth))
            return total

        best = min((fault(k * math.pi / 18.0), k * math.pi / 18.0) for k in range(36))[1]
        return np.array([direction(int(row), best) for row in rows])

    def _corners(self, time_s: float, chaser: int | None) -> Array:
        """Return the corners (K, 3), WRF, of the bodies in the picture: target and one chaser, or
        all within reach.
        """
        at = interpolated(self._target, time_s)
        out = [_corners_of(self._bodies[0], at)]
        for i, track in self._chasers.items():
            pose = interpolated(track, time_s)
            near = float(np.linalg.norm(pose[0] - at[0])) < TUNING.reach_m
            if i == chaser or (chaser is None and near):
                out.append(_corners_of(self._bodies[1], pose))
        return np.concatenate(out)

    def _look(
        self, centre: Array, distance_m: float, azimuth: float, elevation: float
    ) -> Viewpoint:
        return Viewpoint(centre, distance_m, azimuth, elevation, *self._size, self._middle_px)

    def _fitting(self, look: Viewpoint, points_m: Array, share: float) -> float:
        """Return the least distance, m, at which points (K, 3), WRF, are in a share of the free
        picture.
        """
        local = (points_m - look.centre_m) @ look.axes().T
        half = 0.5 * share * self._free_px / look.focal_px
        needed = local[:, 2] + (np.abs(local[:, :2]) / half).max(axis=1)
        return max(float(needed.max()), TUNING.nearest_m)

    def _hidden(self, eye: Array, points: Array, time_s: float) -> bool:
        bodies = [(self._bodies[0], interpolated(self._target, time_s))]
        bodies += [(self._bodies[1], interpolated(t, time_s)) for t in self._chasers.values()]
        return any(
            _crosses(box, pose, eye, point)
            for boxes, pose in bodies
            for box in boxes
            for point in points
        )


def _eased(share: Array) -> Array:
    """Return 0 below 0, 1 above 1, and a smooth step between."""
    s = np.clip(share, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def _angles(direction: Array) -> tuple[float, float]:
    """Return azimuth and elevation, rad, of a unit vector (3,)."""
    x, y, z = direction.tolist()
    return math.atan2(y, x), math.asin(max(-1.0, min(1.0, z)))


def _smoothed(values: Array, sigma: float) -> Array:
    """Return values (K,) smoothed by a Gaussian of ``sigma`` rows; the ends are continued."""
    reach = math.ceil(3.0 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(
        np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), mode="valid"),
        dtype=float,
    )


def _transported(axes: Array, begin: int) -> Array:
    """Return unit vectors (K, 3) across unit ``axes`` (K, 3) that turn about them as little as
    possible. The one in row ``begin`` is as near to up as can be.
    """
    begin = min(begin, len(axes) - 1)
    out = np.zeros_like(axes)
    up = np.eye(3)[2 if abs(axes[begin][2]) < 0.95 else 0]
    for rows in (range(begin, len(axes)), range(begin, -1, -1)):
        last = up
        for row in rows:
            last = last - (last @ axes[row]) * axes[row]
            last = last / np.linalg.norm(last)
            out[row] = last
    return out


def _corners_of(boxes: Sequence[Box], pose: BodyPose) -> Array:
    own = [rotations.rotate(b.q_wxyz, cuboid_corners(b.size_m)) + b.position_m for b in boxes]
    return rotations.rotate(pose[1], np.concatenate(own)) + pose[0]


def _crosses(box: Box, pose: BodyPose, begin: Array, end: Array) -> bool:
    """Return whether the line between two points (3,), WRF, passes through a box of a body."""
    ends = rotations.rotate_inverse(pose[1], np.stack([begin, end]) - pose[0])
    ends = rotations.rotate_inverse(box.q_wxyz, ends - box.position_m)
    along, half = ends[1] - ends[0], np.array(box.size_m) / 2.0
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    near, far = np.sort(np.stack([(-half - ends[0]) / along, (half - ends[0]) / along]), axis=0)
    return bool(max(near.max(), 0.0) < min(far.min(), 1.0))
