# SPDX-License-Identifier: Apache-2.0
"""Smooth motions of a reference pose: polynomials in time between states. Pure functions.

From rest to rest: the fifth-degree polynomial of least jerk (T. Flash and N. Hogan, 1985). From a
moving state: the same plus the polynomial that brings the present motion to rest. A single
polynomial with initial acceleration would overshoot more, the longer it takes, and might never keep
a speed limit. Acceleration is continuous, and so is the feed-forward.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.relative_motion import cw_acceleration, cw_transition
from msgspec import Struct
from numpy.typing import ArrayLike

PEAK_SPEED = 1.875
"""Ratio of peak to mean speed in a move of least jerk."""
_RAMP_S = 2.0
"""Time, s, of each change of speed of an approach. Peak acceleration is 1.5 dv / _RAMP_S: smaller
needs more force, larger makes the approach longer.
"""
_SHORTEST_S = 2.0
"""Shortest duration, s, of a move. Peak acceleration is 5.8 d / _SHORTEST_S^2 for a distance d:
smaller needs more force, larger delays small corrections.
"""
_STOP_S = 3.0
"""Time, s, in which a moving chaser comes to rest. From speed v it covers v _STOP_S / 2 and brakes
with at most 1.5 v / _STOP_S: smaller needs more force, larger more room.
"""
# Factors of the derivatives of powers 1 to 5, and 2 to 5.
_FIRST = np.arange(1.0, 6.0)[:, None]
_SECOND = np.array([2.0, 6.0, 12.0, 20.0])[:, None]
_SAMPLES_PER_PART = np.linspace(0.0, 1.0, 41)


class Part(Struct, frozen=True, eq=False, dict=True):
    """A polynomial of position over ``duration_s``, at rest afterwards. ``coefficients`` (6, 3): of
    powers 0 to 5 of time, m and s.
    """

    duration_s: float
    coefficients: Array

    @cached_property
    def _rests(self) -> dict[int, Array]:
        return {}

    def rest(self, count: int) -> Array:
        """Return the end position, repeated (count, 3)."""
        end = self._rests.get(count)
        if end is None:
            end = self._rests[count] = _powers(np.full(count, self.duration_s)) @ self.coefficients
        return end


def _powers(times_s: Array) -> Array:
    """Return the powers 0 to 5 (K, 6) of times (K,). `numpy.vander` takes twice as long."""
    powers = np.empty((len(times_s), 6))
    powers[:, 0] = 1.0
    powers[:, 1:] = times_s[:, None]
    np.multiply.accumulate(powers[:, 1:], axis=1, out=powers[:, 1:])
    return powers


@lru_cache(maxsize=8)
def _at_rest(count: int) -> Array:
    """Return velocities or accelerations (count, 3) of zero, read-only."""
    zero = np.zeros((count, 3))
    zero.setflags(write=False)
    return zero


class Move(Struct, frozen=True, eq=False, tag=True):
    """A move: the sum of ``parts``, all of which begin at ``start_s``."""

    start_s: float
    parts: tuple[Part, ...]

    @property
    def duration_s(self) -> float:
        """Return the time until the last part ends."""
        return max(part.duration_s for part in self.parts)

    @property
    def goal_m(self) -> Array:
        """Return the end position (3,)."""
        return self.at(np.array([self.start_s + self.duration_s]))[0][0]

    def at(self, times_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (K, 3) at times (K,); at rest before and
        after.
        """
        t = np.asarray(times_s, dtype=float) - self.start_s
        earliest_s = float(t.min(initial=math.inf))
        if all(
            earliest_s > part.duration_s for part in self.parts
        ):  # the most frequent case: a chaser that holds
            position = sum((part.rest(len(t)) for part in self.parts), start=np.zeros((len(t), 3)))
            return position, _at_rest(len(t)), _at_rest(len(t))
        position, velocity, acceleration = np.zeros((3, len(t), 3))
        for part in self.parts:
            if earliest_s > part.duration_s:
                position += part.rest(len(t))
                continue
            inside = ((t >= 0.0) & (t <= part.duration_s))[:, None]
            c = part.coefficients
            powers = _powers(np.minimum(np.maximum(t, 0.0), part.duration_s))
            position += powers @ c
            velocity += np.where(inside, powers[:, :5] @ (c[1:] * _FIRST), 0.0)
            acceleration += np.where(inside, powers[:, :4] @ (c[2:] * _SECOND), 0.0)
        return position, velocity, acceleration

    def over_at(self, time_s: float) -> bool:
        """Return whether the move is complete."""
        return time_s >= self.start_s + self.duration_s

    def _fastest(self) -> float:
        times = np.concatenate(
            [self.start_s + part.duration_s * _SAMPLES_PER_PART for part in self.parts]
        )
        return float(np.linalg.norm(self.at(times)[1], axis=1).max())


def stay(position_m: ArrayLike, time_s: float) -> Move:
    """Return a move that stays at a position (3,)."""
    coefficients = np.zeros((6, 3))
    coefficients[0] = position_m
    return Move(time_s, (Part(0.0, coefficients),))


class Glide(Struct, frozen=True, eq=False, tag=True):
    """A straight motion from rest to rest at piecewise constant speeds with smooth changes.

    It begins at ``from_m`` (3,) along the unit vector ``along`` (3,). ``speeds_m_s`` (n,) are held
    for ``holds_s`` (n,). Ramps of ``ramps_s`` (n + 1,) come before, between and after them: cubics
    in speed with zero slope at both ends.
    """

    start_s: float
    from_m: Array
    along: Array
    speeds_m_s: tuple[float, ...]
    holds_s: tuple[float, ...]
    ramps_s: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        return sum(self.holds_s) + sum(self.ramps_s)

    @property
    def goal_m(self) -> Array:
        """Return the end position (3,)."""
        return self.at(np.array([self.start_s + self.duration_s]))[0][0]

    def over_at(self, time_s: float) -> bool:
        """Return whether the move is complete."""
        return time_s >= self.start_s + self.duration_s

    def at(self, times_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (K, 3) at times (K,); at rest before and
        after.
        """
        t = np.asarray(times_s, dtype=float) - self.start_s
        distance, speed, acceleration = np.zeros((3, len(t)))
        begin, v = 0.0, 0.0
        for ramp_s, following, hold_s in zip(
            self.ramps_s, (*self.speeds_m_s, 0.0), (*self.holds_s, 0.0), strict=True
        ):
            x, step = np.clip((t - begin) / ramp_s, 0.0, 1.0), following - v
            distance += ramp_s * (v * x + step * (x**3 - x**4 / 2.0))
            inside = (t >= begin) & (t < begin + ramp_s)
            speed += np.where(inside, v + step * (3.0 * x**2 - 2.0 * x**3), 0.0)
            acceleration += np.where(inside, step * 6.0 * (x - x**2) / ramp_s, 0.0)
            begin, v = begin + ramp_s, following
            distance += v * np.clip(t - begin, 0.0, hold_s)
            speed += np.where((t >= begin) & (t < begin + hold_s), v, 0.0)
            begin += hold_s
        along = self.along
        return (
            self.from_m + distance[:, None] * along,
            speed[:, None] * along,
            acceleration[:, None] * along,
        )


class Escape(Struct, frozen=True, eq=False, tag=True):
    """An abort, relative to the target's centre in WRF: a burn of constant acceleration for
    ``burn_s`` on top of a coast, then the coast alone.

    ``state`` (6,): position and velocity at ``start_s``. ``acceleration_m_s2`` (3,): of the burn.
    The coast obeys Clohessy-Wiltshire; in free space (``mean_motion_rad_s`` = 0) it is a straight
    line. After ``duration_s`` the motion counts as complete but continues.
    """

    start_s: float
    state: Array
    acceleration_m_s2: Array
    burn_s: float
    mean_motion_rad_s: float
    duration_s: float

    @property
    def goal_m(self) -> Array:
        """Return the position (3,) at the end of ``duration_s``."""
        return self.at(np.array([self.start_s + self.duration_s]))[0][0]

    def over_at(self, time_s: float) -> bool:
        """Return whether the motion is complete."""
        return time_s >= self.start_s + self.duration_s

    @property
    def impulse_m_s(self) -> float:
        """Return the change of velocity by the burn."""
        return float(np.linalg.norm(self.acceleration_m_s2)) * self.burn_s

    def burnt_out(self) -> Array:
        """Return the state (6,) at the end of the burn."""
        p, v, _ = self.at(np.array([self.start_s + self.burn_s]))
        return np.concatenate([p[0], v[0]])

    def at(self, times_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (K, 3) at times (K,), in WRF."""
        t = np.maximum(np.asarray(times_s, dtype=float) - self.start_s, 0.0)
        burning, after = np.minimum(t, self.burn_s), np.maximum(t - self.burn_s, 0.0)
        n, burn = self.mean_motion_rad_s, self.acceleration_m_s2
        coast = cw_transition(n, burning) @ self.state
        states = coast.copy()
        states[:, :3] += 0.5 * burning[:, None] ** 2 * burn
        states[:, 3:] += burning[:, None] * burn
        states = (cw_transition(n, after) @ states[:, :, None])[:, :, 0]
        positions, velocities = states[:, :3], states[:, 3:]
        during = cw_acceleration(n, coast[:, :3], coast[:, 3:]) + burn
        burns = (t < self.burn_s)[:, None]
        accelerations = np.where(burns, during, cw_acceleration(n, positions, velocities))
        return positions, velocities, accelerations


class Circuit(Struct, frozen=True, eq=False, tag=True):
    """One turn about an axis through TRF's origin, from rest to rest; the angle follows the
    polynomial of least jerk.

    ``from_m`` (3,): start. ``axis`` (3,): unit vector. Over the first quarter of the time the
    distance from the origin changes, likewise smoothly, to ``distance_m``. The turn ends in the
    direction of the start.
    """

    start_s: float
    from_m: Array
    axis: Array
    distance_m: float
    duration_s: float

    @property
    def goal_m(self) -> Array:
        """Return the end position (3,)."""
        return self.from_m * (self.distance_m / float(np.linalg.norm(self.from_m)))

    def over_at(self, time_s: float) -> bool:
        """Return whether the turn is complete."""
        return time_s >= self.start_s + self.duration_s

    def at(self, times_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (K, 3) at times (K,); at rest before and
        after.
        """
        t = np.asarray(times_s, dtype=float) - self.start_s
        angle, rate, angular = (2.0 * math.pi * x for x in _least_jerk(t, self.duration_s))
        start_m = float(np.linalg.norm(self.from_m))
        change = (self.distance_m - start_m) / start_m
        factor, speed, acceleration = (change * x for x in _least_jerk(t, 0.25 * self.duration_s))
        factor = 1.0 + factor
        along = self.axis * float(self.axis @ self.from_m)
        across, beside = self.from_m - along, np.cross(self.axis, self.from_m)
        cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
        p = along + cosine * across + sine * beside
        ahead = cosine * beside - sine * across
        v = rate[:, None] * ahead
        a = angular[:, None] * ahead - rate[:, None] ** 2 * (p - along)
        k, k1, k2 = factor[:, None], speed[:, None], acceleration[:, None]
        return k * p, k1 * p + k * v, k2 * p + 2.0 * k1 * v + k * a


def _least_jerk(t: Array, duration_s: float) -> tuple[Array, Array, Array]:
    """Return the least-jerk polynomial from 0 to 1 at times (K,), with its first and second
    derivative.
    """
    x = np.clip(t / duration_s, 0.0, 1.0)
    value = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    first = 30.0 * x**2 * (1.0 - x) ** 2 / duration_s
    second = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / duration_s**2
    return value, first, second


def circuit(
    from_m: ArrayLike, axis: ArrayLike, distance_m: float, now_s: float, speed_m_s: float
) -> Circuit:
    """Return a turn from rest at ``from_m`` (3,) about ``axis`` (3,), of any length. ``speed_m_s``:
    largest speed at the equator.

    The duration does not depend on the start, so that chasers that start together keep their angles
    to each other. Raises ValueError for a speed or a distance that is not positive.
    """
    if not (speed_m_s > 0.0 and distance_m > 0.0):
        raise ValueError(f"speed and distance must be positive, not {speed_m_s} and {distance_m}")
    unit = np.asarray(axis, dtype=float)
    duration_s = PEAK_SPEED * 2.0 * math.pi * distance_m / speed_m_s
    return Circuit(
        now_s, np.asarray(from_m, dtype=float), unit / np.linalg.norm(unit), distance_m, duration_s
    )


class Slew(Struct, frozen=True, eq=False, tag=True):
    """A turn of the body from elsewhere to its reference attitude, from rest to rest; the angle
    follows the polynomial of least jerk. ``turn_rad`` (3,): rotation away from the reference
    attitude at ``start_s``, in its body axes.
    """

    start_s: float
    turn_rad: Array
    duration_s: float

    def over_at(self, time_s: float) -> bool:
        """Return whether the turn is complete."""
        return time_s >= self.start_s + self.duration_s

    def at(self, times_s: ArrayLike) -> Array:
        """Return the rotations (K, 4) that are left at times (K,)."""
        done, _, _ = _least_jerk(np.asarray(times_s, dtype=float) - self.start_s, self.duration_s)
        return rotations.exp((1.0 - done)[:, None] * self.turn_rad)


def slew(turn_rad: Array, now_s: float, radius_m: float, speed_m_s: float) -> Slew:
    """Return the turn back from ``turn_rad`` (3,). Its largest rate is that of a line of sight to
    the target from a circle of ``radius_m`` around it, flown at ``speed_m_s``.
    """
    angle_rad = float(np.linalg.norm(turn_rad))
    duration_s = max(_SHORTEST_S, PEAK_SPEED * angle_rad * radius_m / speed_m_s)
    return Slew(now_s, turn_rad, duration_s)


Motion = Move | Glide | Escape | Circuit


def glide(
    from_m: ArrayLike,
    along: ArrayLike,
    now_s: float,
    fast: tuple[float, float],
    slow: tuple[float, float],
) -> Glide:
    """Return a glide from rest at ``from_m`` (3,) along a unit vector (3,): ``fast``, then
    ``slow``, each (length m, speed m/s).

    The ramp from fast to slow ends where the first length ends; the second length includes the
    stop. A length too short for its ramps is flown at the speed that it allows. Raises ValueError
    for lengths or speeds that are not positive.
    """
    if min(*fast, *slow) <= 0.0:
        raise ValueError(f"lengths and speeds must be positive, not {fast} and {slow}")
    v2 = min(slow[1], slow[0] / _RAMP_S)
    # Ramps cover their mean speed: v1/2 up, (v1 + v2)/2 down.
    v1 = min(fast[1], max(v2, fast[0] / _RAMP_S - v2 / 2.0))
    hold_1 = max(0.0, (fast[0] - _RAMP_S * (v1 + v2 / 2.0)) / v1)
    hold_2 = max(0.0, (slow[0] - _RAMP_S * v2 / 2.0) / v2)
    return Glide(
        now_s,
        np.asarray(from_m, dtype=float),
        np.asarray(along, dtype=float),
        (v1, v2),
        (hold_1, hold_2),
        (_RAMP_S,) * 3,
    )


def stop(current: Motion, now_s: float) -> Move:
    """Return a move that brings ``current`` to rest in ``_STOP_S``.

    Its velocity is the cubic that starts with the velocity and acceleration of ``current`` and ends
    with zeros of both.
    """
    p, v, a = (x[0] for x in current.at(np.array([now_s])))
    if not (v.any() or a.any()):
        return stay(p, now_s)
    t, none = _STOP_S, np.zeros(3)
    cubic, quartic = -(3.0 * v / t + 2.0 * a) / t / 3.0, (2.0 * v / t + a) / t**2 / 4.0
    return Move(now_s, (Part(t, np.array([p, v, a / 2.0, cubic, quartic, none])),))


def _straight(displacement: Array, duration_s: float) -> Part:
    share = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]) / duration_s ** np.arange(6)
    return Part(duration_s, np.outer(share, displacement))


def move_to(current: Motion, goal_m: ArrayLike, now_s: float, max_speed_m_s: float) -> Move:
    """Return a move from the state of ``current`` at ``now_s`` to rest at ``goal_m`` (3,), at most
    at ``max_speed_m_s``.

    If ``stop`` alone is faster, its peak speed is the limit (both to half a percent). Raises
    ValueError unless the speed is positive.
    """
    if not max_speed_m_s > 0.0:
        raise ValueError(f"max_speed_m_s must be positive, not {max_speed_m_s}")
    stopping = stop(current, now_s)
    displacement = np.asarray(goal_m, dtype=float) - stopping.goal_m
    limit = (
        max(max_speed_m_s, stopping._fastest()) * 1.005
    )  # more than what lies between two samples
    duration_s = max(_SHORTEST_S, PEAK_SPEED * float(np.linalg.norm(displacement)) / max_speed_m_s)
    move = Move(now_s, (*stopping.parts, _straight(displacement, duration_s)))
    # The loop ends: a longer displacement adds less to the speed of stopping.
    while move._fastest() > limit:
        duration_s *= 1.1
        move = Move(now_s, (*stopping.parts, _straight(displacement, duration_s)))
    return move
