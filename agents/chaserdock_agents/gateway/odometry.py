# SPDX-License-Identifier: Apache-2.0
"""Odometry of a body at a tick, from the poses that a device measured at its own times. No I/O.

Each odometry is computed from the poses since the tick before alone, so that its noise is new in
every tick, as the message promises. Velocity and rate are slopes of straight lines through these
poses (least squares), or the device's own where it states them.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array

from .axes import MeasuredPose

_LEAST_POSES = 4
"""Fewest poses in a line: at 100 Hz and 15 ticks a second there are six or seven."""
_LEAST_SPAN_NS = 20_000_000
"""Shortest time of a line, ns: noise of 0.5 mm at its ends is then a velocity of 35 mm/s; poses
whose times a clock's estimate has pushed together would give any velocity.
"""
_MOST_POSES = 512
"""Poses that are kept: half a second at 1000 Hz; bounds the memory."""
_LEAST_JUMPS = 5
"""Poses in a row that must agree with each other before they replace those they contradict."""


@dataclass(frozen=True, eq=False)
class FittedState:
    """State of a body at a time. position_m, velocity_m_s (3,) in WRF; q_wxyz (4,) CRF to WRF,
    omega_rad_s (3,) in CRF. Covariances (3, 3), of attitude and rate in CRF.
    """

    time_ns: int
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    position_covariance_m2: Array
    velocity_covariance_m2_s2: Array
    attitude_covariance_rad2: Array
    omega_covariance_rad2_s2: Array


@dataclass(frozen=True)
class MotionBounds:
    """How a body can move. ``jump_m``: what a position may differ from that. ``velocity_sigma_m_s``
    and ``rate_sigma_rad_s``: noise of stated velocities.
    """

    speed_m_s: float
    jump_m: float
    velocity_sigma_m_s: float
    rate_sigma_rad_s: float


_time_ns = attrgetter("time_ns")


class BodyTrack:
    """Newest poses of one body. ``rejected``: poses that no motion explains, since the start.
    ``jumped_m``: how far the body's poses have jumped for good, until it is set to 0.
    """

    def __init__(self, bounds: MotionBounds) -> None:
        self._bounds = bounds
        self._poses: list[MeasuredPose] = []  # oldest first
        self._jumped: list[MeasuredPose] = []
        self._newest_state: FittedState | None = None
        self.rejected = 0
        self.jumped_m = 0.0

    @property
    def newest_ns(self) -> int | None:
        """Return the time of the newest pose, None without one."""
        return self._poses[-1].time_ns if self._poses else None

    def newest_state(self) -> FittedState | None:
        """Return the state at the newest pose, None if there are too few for a velocity. Computed
        once for each pose, as robots are guarded far more often.
        """
        newest_ns = self.newest_ns
        if self._newest_state is None and newest_ns is not None:
            self._newest_state = self.at(newest_ns, newest_ns - 1)
        return self._newest_state

    def newest_poses(self) -> list[MeasuredPose]:
        """Return the poses of the last half second, oldest first."""
        return [p for p in self._poses if p.time_ns > self._poses[-1].time_ns - 500_000_000]

    def add(self, pose: MeasuredPose) -> bool:
        """Take a pose, in any order of time. Returns False if it is not used: a copy, older than
        what is kept, or a jump; poses that have jumped replace the others once they agree.
        """
        poses = self._poses
        place = bisect_left(poses, pose.time_ns, key=_time_ns)
        if place < len(poses) and poses[place].time_ns == pose.time_ns:
            return False
        if poses and not self._is_reachable(poses[-1], pose):
            self.rejected += 1
            if self._jumped and not self._is_reachable(self._jumped[-1], pose):
                self._jumped.clear()
            self._jumped.append(pose)
            if len(self._jumped) < _LEAST_JUMPS:
                return False
            self.jumped_m = float(np.linalg.norm(pose.position_m - poses[-1].position_m))
            poses[:] = sorted(self._jumped, key=_time_ns)
            self._newest_state = None
            self._jumped.clear()
            return True
        self._jumped.clear()
        self._newest_state = None
        poses.insert(place, pose)
        return len(poses) <= _MOST_POSES or poses.pop(0) is not pose

    def _is_reachable(self, known: MeasuredPose, pose: MeasuredPose) -> bool:
        apart_m = float(np.linalg.norm(pose.position_m - known.position_m))
        between_s = abs(pose.time_ns - known.time_ns) / 1e9
        return apart_m <= self._bounds.jump_m + self._bounds.speed_m_s * between_s

    def at(self, time_ns: int, since_ns: int) -> FittedState | None:
        """Return the state at ``time_ns`` from the poses after ``since_ns``, None if there are
        none, or too few for a velocity.
        """
        first, after = (bisect_right(self._poses, t, key=_time_ns) for t in (since_ns, time_ns))
        fresh = self._poses[first:after]
        if not fresh:
            return None
        if all(p.velocity_m_s is not None and p.omega_rad_s is not None for p in fresh):
            return self._by_velocities(fresh, time_ns)
        while first and not _is_line(fresh):
            first -= 1
            fresh.insert(0, self._poses[first])
        return _by_line(fresh, time_ns) if _is_line(fresh) else None

    def _by_velocities(self, poses: list[MeasuredPose], time_ns: int) -> FittedState:
        """Return the mean of the poses, each moved on by its own velocity and rate."""
        newest = poses[-1]
        places, turns, velocities, omegas = [], [], [], []
        for p in poses:
            ahead_s = (time_ns - p.time_ns) / 1e9
            assert p.velocity_m_s is not None
            assert p.omega_rad_s is not None
            places.append(p.position_m + p.velocity_m_s * ahead_s)
            q = rotations.integrate(p.q_wxyz, p.omega_rad_s, ahead_s)
            turns.append(rotations.log(rotations.multiply(rotations.conjugate(newest.q_wxyz), q)))
            velocities.append(p.velocity_m_s)
            omegas.append(p.omega_rad_s)
        n, b = len(poses), self._bounds
        ahead_s = float(np.mean([time_ns - p.time_ns for p in poses])) / 1e9
        # Velocities of an estimator share their errors: their mean is no better than one.
        velocity_noise = np.eye(3) * b.velocity_sigma_m_s**2
        rate_noise = np.eye(3) * b.rate_sigma_rad_s**2
        return FittedState(
            time_ns,
            np.mean(places, axis=0),
            np.mean(velocities, axis=0),
            rotations.multiply(newest.q_wxyz, rotations.exp(np.mean(turns, axis=0))),
            np.mean(omegas, axis=0),
            np.mean([p.position_covariance_m2 for p in poses], axis=0) / n
            + velocity_noise * ahead_s**2,
            velocity_noise,
            np.mean([p.attitude_covariance_rad2 for p in poses], axis=0) / n
            + rate_noise * ahead_s**2,
            rate_noise,
        )


def _is_line(poses: list[MeasuredPose]) -> bool:
    """Return whether poses, oldest first, give a velocity."""
    return len(poses) >= _LEAST_POSES and poses[-1].time_ns - poses[0].time_ns >= _LEAST_SPAN_NS


def _by_line(poses: list[MeasuredPose], time_ns: int) -> FittedState:
    """Return the state at ``time_ns`` on lines through the positions and the attitudes."""
    at_s = np.array([(p.time_ns - time_ns) / 1e9 for p in poses])
    mean_s = float(at_s.mean())
    spread_s2 = float(((at_s - mean_s) ** 2).sum())
    weights = (at_s - mean_s) / spread_s2
    middle = poses[len(poses) // 2]
    places = np.array([p.position_m for p in poses])
    turns = np.array(
        [
            rotations.log(rotations.multiply(rotations.conjugate(middle.q_wxyz), p.q_wxyz))
            for p in poses
        ]
    )
    velocity, rate = weights @ places, weights @ turns
    place = places.mean(axis=0) - velocity * mean_s
    turn = turns.mean(axis=0) - rate * mean_s
    share = 1.0 / len(poses) + mean_s**2 / spread_s2
    position_noise = np.mean([p.position_covariance_m2 for p in poses], axis=0)
    attitude_noise = np.mean([p.attitude_covariance_rad2 for p in poses], axis=0)
    return FittedState(
        time_ns,
        place,
        velocity,
        rotations.multiply(middle.q_wxyz, rotations.exp(turn)),
        rate,
        position_noise * share,
        position_noise / spread_s2,
        attitude_noise * share,
        attitude_noise / spread_s2,
    )
