# SPDX-License-Identifier: Apache-2.0
"""Odometry at ticks from poses at the device's own times."""

from __future__ import annotations

import math

import numpy as np
from chaserdock_agents.gateway.axes import MeasuredPose
from chaserdock_agents.gateway.odometry import BodyTrack, FittedState, MotionBounds
from chaserdock_models import rotations as rot

TICK_NS = 66_666_667
BOUNDS = MotionBounds(speed_m_s=0.5, jump_m=0.05, velocity_sigma_m_s=0.01, rate_sigma_rad_s=0.01)
SIGMA_M, SIGMA_RAD = 4e-4, 8e-4
V, W = np.array([0.11, -0.07, 0.05]), np.array([0.08, -0.11, 0.15])
Q0 = rot.normalize([0.4, -0.5, 0.6, 0.2])
P0 = np.array([1.0, -2.0, 0.5])


def truth(time_ns: int) -> tuple[np.ndarray, np.ndarray]:
    return P0 + V * time_ns / 1e9, rot.integrate(Q0, W, time_ns / 1e9)


def pose(rng: np.random.Generator, time_ns: int, velocities: bool = False) -> MeasuredPose:
    p, q = truth(time_ns)
    return MeasuredPose(
        time_ns,
        p + rng.normal(0, SIGMA_M, 3),
        rot.multiply(q, rot.exp(rng.normal(0, SIGMA_RAD, 3))),
        np.eye(3) * SIGMA_M**2,
        np.eye(3) * SIGMA_RAD**2,
        V + rng.normal(0, 0.01, 3) if velocities else None,
        W + rng.normal(0, 0.01, 3) if velocities else None,
    )


def normalized(state: FittedState) -> list[float]:
    """Squared normalized errors (of 3 each) of position, velocity, attitude and rate."""
    p, q = truth(state.time_ns)
    turn = rot.log(rot.multiply(rot.conjugate(state.q_wxyz), q))
    pairs = (
        (p - state.position_m, state.position_covariance_m2),
        (V - state.velocity_m_s, state.velocity_covariance_m2_s2),
        (turn, state.attitude_covariance_rad2),
        (W - state.omega_rad_s, state.omega_covariance_rad2_s2),
    )
    return [float(e @ np.linalg.solve(c, e)) for e, c in pairs]


def run(rate_hz: float, latency_ns: int, velocities: bool = False) -> np.ndarray:
    """Normalized errors (n, 4) over ticks, with poses that arrive late."""
    rng, track, found = np.random.default_rng(5), BodyTrack(BOUNDS), []
    waiting = [pose(rng, round(k * 1e9 / rate_hz), velocities) for k in range(round(20 * rate_hz))]
    used_ns = 0
    for tick in range(4, 290):
        now_ns = tick * TICK_NS
        while waiting and waiting[0].time_ns + latency_ns <= now_ns:
            track.add(waiting.pop(0))
        state = track.at(now_ns, used_ns)
        if state is not None:
            found.append(normalized(state))
            used_ns = track.newest_ns or now_ns
    return np.array(found)


def test_odometry_is_consistent_in_every_part() -> None:
    for rate_hz, latency_ns in ((100.0, 12_000_000), (240.0, 3_000_000), (60.0, 30_000_000)):
        errors = run(rate_hz, latency_ns)
        assert len(errors) > 250
        np.testing.assert_array_less(np.abs(errors.mean(axis=0) - 3.0), 0.75)


def test_errors_of_successive_ticks_are_not_correlated() -> None:
    rng, track, errors, used_ns = np.random.default_rng(6), BodyTrack(BOUNDS), [], 0
    for k in range(4000):
        track.add(pose(rng, k * 10_000_000))
        if k % 7 == 6 and k > 10:
            now_ns = k * 10_000_000 + 4_000_000
            state = track.at(now_ns, used_ns)
            assert state is not None
            used_ns = track.newest_ns or 0
            errors.append(np.concatenate([truth(now_ns)[0] - state.position_m]))
    e = np.array(errors)
    lagged = (e[1:] * e[:-1]).mean(axis=0) / (e**2).mean(axis=0)
    assert np.abs(lagged).max() < 3.5 / math.sqrt(len(e))


def test_stated_velocities_are_used_with_their_stated_noise() -> None:
    errors = run(50.0, 10_000_000, velocities=True)
    # No more than stated: the velocities of several poses may share their errors.
    np.testing.assert_array_less(errors.mean(axis=0), 3.5)
    np.testing.assert_array_less(0.4, errors.mean(axis=0))


def test_a_jump_is_refused_until_poses_agree_with_it() -> None:
    rng, track = np.random.default_rng(1), BodyTrack(BOUNDS)
    for k in range(20):
        assert track.add(pose(rng, k * 10_000_000))
    away = np.array([0.4, -0.3, 0.2])
    taken = []
    for k in range(20, 26):
        p = pose(rng, k * 10_000_000)
        moved = MeasuredPose(
            p.time_ns, p.position_m + away, p.q_wxyz, p.position_covariance_m2,
            p.attitude_covariance_rad2,
        )  # fmt: skip
        taken.append(track.add(moved))
    assert taken == [False] * 4 + [True] * 2
    assert track.rejected == 5


def test_doubled_and_disordered_poses_change_nothing() -> None:
    rng = np.random.default_rng(1)
    poses = [pose(rng, k * 10_000_000) for k in range(12)]
    a, b = BodyTrack(BOUNDS), BodyTrack(BOUNDS)
    for p in poses:
        a.add(p)
    for k in (0, 1, 3, 2, 4, 4, 5, 8, 6, 7, 9, 11, 10, 3):
        b.add(poses[k])
    x, y = a.at(120_000_000, 40_000_000), b.at(120_000_000, 40_000_000)
    assert x is not None
    assert y is not None
    np.testing.assert_array_equal(x.position_m, y.position_m)
    np.testing.assert_array_equal(x.q_wxyz, y.q_wxyz)


def test_without_new_poses_there_is_no_odometry() -> None:
    rng, track = np.random.default_rng(1), BodyTrack(BOUNDS)
    for k in range(12):
        track.add(pose(rng, k * 10_000_000))
    assert track.at(200_000_000, 110_000_000) is None
    assert BodyTrack(BOUNDS).at(200_000_000, 0) is None


def test_poses_whose_times_are_pushed_together_give_no_velocity() -> None:
    rng, track = np.random.default_rng(2), BodyTrack(BOUNDS)
    for k in range(8):
        track.add(pose(rng, 1_000_000_000 + k * 100_000))
    assert track.newest_state() is None
    for k in range(1, 4):
        track.add(pose(rng, 1_000_000_000 + k * 10_000_000))
    state = track.newest_state()
    assert state is not None
    assert np.linalg.norm(state.velocity_m_s - V) < 0.1
