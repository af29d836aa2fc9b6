# SPDX-License-Identifier: Apache-2.0
"""Trajectories of moves: straight, smooth from any state to rest, within the speed limit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.guidance.trajectories import Move, move_to, stay, stop
from flight_cases import at, points, quick
from hypothesis import example, given
from hypothesis import strategies as st


@given(points, points, st.floats(0.0, 100.0), st.floats(0.01, 0.2))
@quick
def test_move_from_rest_is_straight_and_ends_at_rest(
    start: Any, goal: Any, now: float, speed: float
) -> None:
    move = move_to(stay(start, 0.0), goal, now, speed)
    end = move.start_s + move.duration_s
    for t, place in ((now, start), (end, goal)):
        p, v, a = at(move, t)
        np.testing.assert_allclose(p, place, rtol=0, atol=1e-9)
        np.testing.assert_allclose(v, 0.0, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(move.goal_m, goal, rtol=0, atol=1e-9)
    assert move.over_at(end)
    assert not move.over_at(end - 1e-3)
    # At rest before its start and after its end.
    np.testing.assert_allclose(at(move, now - 5.0)[0], start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(at(move, end + 5.0)[0], goal, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(at(move, end + 5.0)[1:], np.zeros((2, 3)))
    times = np.linspace(now, end, 500)
    positions, velocities, _ = move.at(times)
    assert np.linalg.norm(velocities, axis=1).max() <= speed * 1.002
    # On the straight line from start to goal, monotonic.
    path = np.subtract(goal, start)
    if np.linalg.norm(path) > 1e-3:
        along = (positions - start) @ path / (path @ path)
        np.testing.assert_allclose(
            positions, np.add(start, along[:, None] * path), rtol=0, atol=1e-8
        )
        assert np.all(np.diff(along) >= -1e-9)


def fastest(move: Move) -> float:
    times = np.linspace(move.start_s, move.start_s + move.duration_s, 3000)
    return float(np.linalg.norm(move.at(times)[1], axis=1).max())


@given(
    points,
    points,
    points,
    st.floats(0.0, 1.0),
    st.floats(0.01, 0.2),
    st.sampled_from([0.5, 1.0, 2.0]),
)
@example(
    (-1, 0, 0), (0, 0, 0.5), (-0.4, 0, 0), 0.2, 0.06, 0.5
)  # a slower move begins during acceleration
@example((0, 0, 0), (-0.6, 0, 0), (0, 0, 0), 0.21, 0.03, 1.0)  # reversed at peak acceleration
@quick
def test_move_that_replaces_another_is_smooth_with_bounded_speed(
    a: Any, b: Any, c: Any, share: float, speed: float, factor: float
) -> None:
    """Position, velocity and acceleration are continuous; it ends at rest; speed and duration are
    bounded.
    """
    first = move_to(stay(a, 0.0), b, 0.0, speed)
    now = share * first.duration_s
    second = move_to(first, c, now, speed * factor)
    for was, now_is in zip(at(first, now), at(second, now), strict=True):
        np.testing.assert_allclose(now_is, was, rtol=0, atol=1e-9)
    p, v, acceleration = at(second, now + second.duration_s)
    np.testing.assert_allclose(p, c, rtol=0, atol=1e-8)
    np.testing.assert_allclose(v, 0.0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(acceleration, 0.0, rtol=0, atol=1e-8)
    stopping = fastest(stop(first, now))
    assert fastest(second) <= max(speed * factor, stopping) * 1.01
    assert stopping <= speed * 1.3
    assert second.duration_s <= 10.0 + 3.0 * 1.875 * math.dist(p, at(first, now)[0]) / (
        speed * factor
    )


@given(points, points, st.floats(0.0, 1.0))
@quick
def test_velocity_and_acceleration_are_the_positions_derivatives(
    a: Any, b: Any, share: float
) -> None:
    move = move_to(stay(a, 0.0), b, 3.0, 0.1)
    t, h = 3.0 + move.duration_s * (0.01 + 0.98 * share), 1e-3 * move.duration_s
    (p0, v0, _), (_, v, acc), (p1, v1, _) = at(move, t - h), at(move, t), at(move, t + h)
    np.testing.assert_allclose((p1 - p0) / (2 * h), v, rtol=0, atol=1e-5)
    np.testing.assert_allclose((v1 - v0) / (2 * h), acc, rtol=0, atol=1e-5)


@given(points, points, st.floats(0.0, 1.2))
@quick
def test_stop_ends_at_rest_within_bounds(a: Any, b: Any, share: float) -> None:
    first = move_to(stay(a, 0.0), b, 0.0, 0.05)
    now = share * first.duration_s
    stopping = stop(first, now)
    for was, now_is in zip(at(first, now), at(stopping, now), strict=True):
        np.testing.assert_allclose(now_is, was, rtol=0, atol=1e-9)
    p, v, acceleration = at(stopping, now + stopping.duration_s)
    np.testing.assert_allclose(np.concatenate([v, acceleration]), 0.0, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(p, stopping.goal_m)
    assert np.linalg.norm(p - at(first, now)[0]) <= 0.12
    assert stopping.duration_s <= 3.0


def test_ended_move_stays_at_its_goal() -> None:
    move = move_to(stay([0.3, -0.2, 0.7], 2.0), [0.6, 0.1, 0.5], 2.0, 0.03)
    end_s = move.start_s + move.duration_s
    for count in (1, 16):
        later = np.linspace(1e-6, 5.0, count) + end_s
        # A time before the end in the array bypasses the cached end state.
        both = [part[1:] for part in move.at(np.array([end_s - 1.0, *later]))]
        for held, expected in zip(move.at(later), both, strict=True):
            np.testing.assert_allclose(held, expected, rtol=0, atol=1e-15)


def test_duration_follows_from_distance_and_speed() -> None:
    # The quintic's peak is 15/8 of its mean speed.
    assert move_to(stay([0, 0, 0], 0.0), [0.6, 0, 0], 0.0, 0.03).duration_s == pytest.approx(37.5)
    assert move_to(stay([0, 0, 0], 0.0), [1e-6, 0, 0], 0.0, 0.03).duration_s >= 1.0


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_speed_must_be_positive(speed: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        move_to(stay([0, 0, 0], 0.0), [1, 0, 0], 0.0, speed)
