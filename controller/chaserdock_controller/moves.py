"""Smooth changes of a reference position: fifth-degree polynomials between states of motion. Pure functions.

A quintic that starts with given position, velocity and acceleration and ends at rest is the motion of least
jerk between them (T. Flash and N. Hogan, 1985); continuous acceleration keeps the feed-forward continuous.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SHORTEST_S = 2.0
_LONGEST_S = 1e5
# Factors of the derivatives of powers 1 to 5, and 2 to 5.
_FIRST = np.arange(1.0, 6.0)[:, None]
_SECOND = np.array([2.0, 6.0, 12.0, 20.0])[:, None]
_SAMPLES = np.linspace(0.0, 1.0, 41)


@dataclass(frozen=True)
class Move:
    """From ``start_s`` on, ``duration_s`` long; ``coefficients`` (6, 3) of powers of time, metres and seconds."""

    start_s: float
    duration_s: float
    coefficients: Array

    @property
    def goal_m(self) -> Array:
        """Where it ends, (3,)."""
        return self.at(np.array([self.start_s + self.duration_s]))[0][0]

    def at(self, times_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Positions, velocities, accelerations (K, 3) at times (K,); at rest before and after."""
        t = np.asarray(times_s, dtype=float) - self.start_s
        inside = ((t >= 0.0) & (t <= self.duration_s))[:, None]
        c = self.coefficients
        powers = np.vander(np.clip(t, 0.0, self.duration_s), 6, increasing=True)
        position = powers @ c
        velocity = powers[:, :5] @ (c[1:] * _FIRST)
        acceleration = powers[:, :4] @ (c[2:] * _SECOND)
        return position, np.where(inside, velocity, 0.0), np.where(inside, acceleration, 0.0)

    def over_at(self, time_s: float) -> bool:
        """Whether it has ended."""
        return time_s >= self.start_s + self.duration_s


def stay(position_m: ArrayLike, time_s: float) -> Move:
    """A move that stays where it is."""
    coefficients = np.zeros((6, 3))
    coefficients[0] = position_m
    return Move(time_s, 0.0, coefficients)


def _quintic(p: Array, v: Array, a: Array, goal: Array, duration_s: float) -> Array:
    t = duration_s
    rest = np.array([goal - p - v * t - a * t * t / 2.0, -v - a * t, -a])
    system = np.array([[t**3, t**4, t**5], [3 * t**2, 4 * t**3, 5 * t**4], [6 * t, 12 * t**2, 20 * t**3]])
    return np.asarray(np.vstack([p, v, a / 2.0, np.linalg.solve(system, rest)]), dtype=np.float64)


def move_to(current: Move, goal_m: ArrayLike, now_s: float, max_speed_m_s: float) -> Move:
    """A move from wherever ``current`` is at ``now_s`` to rest at ``goal_m`` (3,), never faster than ``max_speed_m_s``.

    If ``current`` is faster than that now, it is never faster than now. Raises ValueError unless the speed is positive.
    """
    if not max_speed_m_s > 0.0:
        raise ValueError(f"max_speed_m_s must be positive, not {max_speed_m_s}")
    p, v, a = (x[0] for x in current.at(np.array([now_s])))
    goal = np.asarray(goal_m, dtype=float)
    speed = max(max_speed_m_s, float(np.linalg.norm(v)))
    duration = max(_SHORTEST_S, 1.875 * float(np.linalg.norm(goal - p)) / max_speed_m_s)
    while True:
        move = Move(now_s, duration, _quintic(p, v, a, goal, duration))
        fastest = np.linalg.norm(move.at(now_s + duration * _SAMPLES)[1], axis=1).max()
        if fastest <= speed * 1.001 or duration > _LONGEST_S:
            return move
        duration *= 1.1


def stop(current: Move, now_s: float, max_speed_m_s: float) -> Move:
    """A move that brings ``current`` to rest a little further on its way."""
    p, v, _ = (x[0] for x in current.at(np.array([now_s])))
    return move_to(current, p + v * 1.5, now_s, max_speed_m_s)
