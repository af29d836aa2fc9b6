# SPDX-License-Identifier: Apache-2.0
"""Certificates of coasts against densely sampled motion and against random errors of the state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import (
    CoastModel,
    CoastNoise,
    DisturbedMotion,
    coast_covariance,
    disturbed,
)
from chaserdock_models.relative_motion import cw_matrix, cw_response, cw_transition
from hypothesis import given, settings
from hypothesis import strategies as st
from runge_kutta import rk4

N = 1.13e-3
TWO_ORBITS_S = 4.0 * math.pi / N
SMALL = disturbed(np.diag([1e-6] * 3 + [1e-12] * 3))


@given(
    st.tuples(*[st.floats(-100.0, 100.0)] * 3),
    st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    st.sampled_from([0.0, N]),
)
@settings(max_examples=15, deadline=None)
def test_distance_bounds_the_densely_sampled_coast(
    position: tuple[float, ...], velocity: tuple[float, ...], n: float
) -> None:
    state = np.array([*position, *velocity])
    times = np.arange(0.0, 2000.0 + 0.25, 0.5)
    away = np.linalg.norm((cw_transition(n, times) @ state)[:, :3], axis=1)
    # Isotropic position errors only: the smallest margin is at the smallest distance.
    covariance = np.zeros((6, 6))
    model = CoastModel(n, 2000.0)
    covariance[:3, :3] = 1e-6 * np.eye(3)
    if n == 0.0:
        found = model.certify(state[None], disturbed(covariance), 0.35)
        assert found.distance_m <= away.min() + 1e-9
        assert found.distance_m >= away.min() - 0.25 * float(np.linalg.norm(velocity)) - 1e-9
    else:
        found = model.certify(state[None], disturbed(covariance), 0.0)
        index = int(found.time_s / 0.5)
        # The coast is not faster than 1.2 m/s here: within half a sample it moves by less than 0.3
        # m.
        assert found.distance_m <= away[index] + 0.3
        assert found.distance_m >= away[index] - 0.4


def test_hold_in_free_space_is_safe_and_closing_is_not() -> None:
    model = CoastModel(0.0, 600.0)
    hold = model.certify(np.array([[-1.0, 0, 0, 0, 0, 0]]), SMALL, 0.35)
    assert hold.margin_sigmas > 3.0
    closing = model.certify(
        np.array([[-1.0, 0, 0, 0, 0, 0], [-1.0, 0, 0, 0.01, 0, 0]]), SMALL, 0.35
    )
    assert closing.margin_sigmas < 0.0
    assert (closing.loss, closing.distance_m) == (1, 0.0)
    assert closing.time_s == pytest.approx(100.0, abs=10.0)


def test_hold_above_the_target_drifts_back_without_hitting_it_and_hold_on_v_bar_stays() -> None:
    model = CoastModel(N, TWO_ORBITS_S)
    along = model.certify(np.array([[0.0, -50.0, 0, 0, 0, 0]]), SMALL, 0.35)
    assert along.distance_m == pytest.approx(50.0, abs=1e-3)
    # On V-bar a push towards the target (+Y) loops over its origin ahead of schedule: it returns
    # near the target.
    pushed = model.certify(
        np.array([[0.0, -10.0, 0, 0, 10.0 * N / (6.0 * math.pi), 0]]), SMALL, 0.35
    )
    assert pushed.distance_m > 0.35  # this push goes backwards
    hit = model.certify(np.array([[0.0, -10.0, 0, 0, -10.0 * N / (6.0 * math.pi), 0]]), SMALL, 0.35)
    assert hit.margin_sigmas < 0.0
    assert hit.time_s == pytest.approx(
        2.0 * math.pi / N, rel=0.02
    )  # after one orbit, at the target


def test_margin_in_sigmas_is_the_share_of_random_errors_that_enter() -> None:
    """Nominal coasts two sigmas from the sphere enter it in 2.3 % of random errors: at the end,
    where the sphere is flat.
    """
    model, generator = CoastModel(0.0, 100.0), np.random.default_rng(3)
    covariance = np.diag([1e-2**2] * 3 + [2e-4**2] * 3)
    state = np.array([-20.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    keep_out_m = 10.0 - 2.0 * math.hypot(1e-2, 100.0 * 2e-4)
    found = model.certify(state[None], disturbed(covariance), keep_out_m)
    assert found.margin_sigmas == pytest.approx(2.0, abs=1e-3)
    assert found.time_s == pytest.approx(100.0)
    states = state + generator.normal(0.0, np.sqrt(np.diag(covariance)), (20000, 6))
    ends = states[:, :3] + 100.0 * states[:, 3:]
    entered = float(np.mean(np.linalg.norm(ends, axis=1) < keep_out_m))
    assert entered == pytest.approx(0.02275, abs=0.004)


def small_steps(n: float, x: Array, acceleration: Array, duration_s: float, h: float) -> Array:
    """Positions and velocities (K, 6) of a coast under a constant acceleration, in steps of RK4."""
    states, matrix = [x], cw_matrix(n)

    def slope(y: Array) -> Array:
        return matrix @ y + np.concatenate([np.zeros(3), acceleration])

    for _ in range(round(duration_s / h)):
        states.append(rk4(slope, states[-1], h, 1))
    return np.array(states)


def correlated(rng: np.random.Generator, position_m: float, speed_m_s: float, push: float) -> Array:
    """A covariance (9, 9) with correlations, of about these standard deviations."""
    half = rng.normal(size=(9, 9)) / 3.0 * np.repeat([position_m, speed_m_s, push], 3)[:, None]
    return half @ half.T


@pytest.mark.parametrize("n", [0.0, N])
def test_a_constant_acceleration_moves_a_coast_as_small_steps_do(n: float) -> None:
    push = np.array([3e-6, -2e-6, 5e-6])
    fine = small_steps(n, np.zeros(6), push, 3000.0, 5.0)
    times = np.arange(len(fine)) * 5.0
    np.testing.assert_allclose(cw_response(n, times) @ push, fine, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("n", [0.0, N])
def test_noise_of_a_coast_is_that_of_small_steps(n: float) -> None:
    noise, h = CoastNoise(2e-6, 7e-8, 150.0), 0.5
    found = coast_covariance(n, 60.0, 11, noise)
    # Density of each component times a step, moved on by the linear equations.
    change = np.zeros((9, 9))
    change[:6, :6], change[3:6, 6:], change[6:, 6:] = cw_matrix(n), np.eye(3), -np.eye(3) / 150.0
    density = np.diag([0.0] * 3 + [4e-12] * 3 + [2.0 * 49e-16 / 150.0] * 3)
    step = np.eye(9) + h * change + 0.5 * h * h * change @ change
    now = np.zeros((9, 9))
    for k in range(1, 1 + round(600.0 / h)):
        now = step @ (now + 0.5 * h * density) @ step.T + 0.5 * h * density
        if k % 120 == 0:
            expected = now[:3, :3]
            np.testing.assert_allclose(
                found[k // 120], expected, rtol=1e-3, atol=1e-3 * expected.max()
            )
    assert not found[0].any()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [0.0, N])
def test_chaser_that_3_mN_push_into_the_keep_out_is_not_certified(n: float, seed: int) -> None:
    """It is 3 m away and drifts off slowly; without the force it would never come nearer."""
    rng, keep_out_m = np.random.default_rng(seed), 0.75
    away, aside = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    state = np.concatenate([3.0 * away, 2e-4 * away + 1e-4 * aside])
    push = -(3e-3 / 17.8) * (math.cos(0.1) * away + math.sin(0.1) * aside)
    spread = correlated(rng, 5e-3, 5e-5, 1e-5)
    model = CoastModel(n, 300.0)
    free = model.certify(state[None], disturbed(spread[:6, :6]), keep_out_m)
    assert free.margin_sigmas > 40.0
    assert free.distance_m > 2.9
    fine = small_steps(n, state, push, 300.0, 0.2)
    nearest = int(np.argmin(np.linalg.norm(fine[:, :3], axis=1)))
    nearest_m = float(np.linalg.norm(fine[nearest, :3]))
    assert nearest_m < 0.6
    found = model.certify(state[None], DisturbedMotion(push, spread), keep_out_m)
    assert found.margin_sigmas < 0.0
    # Errors of the position alone: the smallest margin is at the smallest distance.
    known = DisturbedMotion(push, np.diag([1e-6] * 3 + [0.0] * 6))
    coast = CoastModel(n, 300.0, 1.0).certify(state[None], known, keep_out_m)
    assert coast.distance_m == pytest.approx(nearest_m, abs=0.01)
    assert coast.time_s == pytest.approx(0.2 * nearest, abs=1.0)


@pytest.mark.parametrize("n", [0.0, N])
def test_margin_divides_the_room_by_the_spread_of_state_force_and_noise(n: float) -> None:
    """At the time of the smallest margin of a fine search, in general position."""
    rng, keep_out_m, h = np.random.default_rng(11), 5.0, 2.0
    noise = CoastNoise(2e-6, 4e-7, 200.0)
    state = np.concatenate([rng.uniform(20.0, 40.0, 3), rng.uniform(-0.02, 0.02, 3)])
    motion = DisturbedMotion(rng.normal(0.0, 4e-6, 3), correlated(rng, 0.05, 1e-4, 1e-6))
    fine = small_steps(n, state, motion.acceleration_m_s2, 1200.0, h)
    whole = np.zeros((9, 9))
    whole[:6, :6], whole[3:6, 6:] = cw_matrix(n), np.eye(3)
    step = np.eye(9) + h * whole + 0.5 * h * h * whole @ whole + h**3 / 6.0 * whole @ whole @ whole
    spread, added = motion.covariance, coast_covariance(n, h, len(fine), noise)
    margins = []
    for x, more in zip(fine, added, strict=True):
        line = x[:3] / np.linalg.norm(x[:3])
        sigma = math.sqrt(line @ (spread[:3, :3] + more) @ line)
        margins.append((float(np.linalg.norm(x[:3])) - keep_out_m) / sigma)
        spread = step @ spread @ step.T
    found = CoastModel(n, 1200.0, noise=noise).certify(state[None], motion, keep_out_m)
    assert found.margin_sigmas == pytest.approx(min(margins), rel=5e-3)
    assert found.margin_sigmas <= min(margins) + 1e-3


def entered(
    n: float,
    state: Array,
    motion: DisturbedMotion,
    noise: CoastNoise,
    duration_s: float,
    keep_out_m: float,
    rng: np.random.Generator,
) -> float:
    """Share of 300 coasts, with errors and noise drawn at random, that enter the keep-out."""
    h, draws, varying = 10.0, 300, np.zeros((300, 3))
    errors = rng.multivariate_normal(np.zeros(9), motion.covariance, draws, method="cholesky")
    x, push = state + errors[:, :6], motion.acceleration_m_s2 + errors[:, 6:]
    phi, response, kept = cw_transition(n, h), cw_response(n, h), math.exp(-h / noise.varying_s)
    nearest = np.linalg.norm(x[:, :3], axis=1)
    for _ in range(round(duration_s / h)):
        fresh = noise.varying_m_s2 * math.sqrt(1.0 - kept * kept) * rng.normal(size=(draws, 3))
        then = kept * varying + fresh
        kick = noise.white_m_s2_sqrt_s * math.sqrt(h) * rng.normal(size=(draws, 3))
        moved = x @ phi.T + (push + 0.5 * (varying + then)) @ response.T
        moved += np.concatenate([0.5 * h * kick, kick], axis=1)
        step = moved[:, :3] - x[:, :3]
        share = np.clip(-(x[:, :3] * step).sum(axis=1) / (step * step).sum(axis=1), 0.0, 1.0)
        near = x[:, :3] + share[:, None] * step
        nearest = np.minimum(nearest, np.linalg.norm(near, axis=1))
        x, varying = moved, then
    return float(np.mean(nearest < keep_out_m))


@pytest.mark.parametrize(
    "n", [pytest.param(0.0, id="free"), pytest.param(N, id="orbit", marks=pytest.mark.slow)]
)
def test_share_that_enters_is_at_most_that_of_the_certified_margin(n: float) -> None:
    """Of chasers certified at 1 to 2 sigmas, with a keep-out that fits: the tail of the normal
    distribution, and not much less, on average.
    """
    rng, stated, found = np.random.default_rng(2), [], []
    scale, duration_s, push = (1.0, 600.0, 1e-5) if n == 0.0 else (20.0, 11120.0, 1e-7)
    noise = CoastNoise(1e-5 if n == 0.0 else 2e-6, push, 200.0)
    model = CoastModel(n, duration_s, noise=noise)
    while len(found) < 14:
        away = rng.normal(size=3)
        place = scale * rng.uniform(3.0, 8.0) * away / np.linalg.norm(away)
        state = np.concatenate([place, scale * 2e-3 * rng.normal(size=3)])
        spread = correlated(rng, 0.02 * scale, 3e-4, push)
        motion = DisturbedMotion(push * rng.normal(size=3), spread)
        sigmas, low, high = rng.uniform(1.0, 2.0), 0.0, float(np.linalg.norm(place))
        for _ in range(30):
            keep_out_m = 0.5 * (low + high)
            kept = model.certify(state[None], motion, keep_out_m).margin_sigmas > sigmas
            low, high = (keep_out_m, high) if kept else (low, keep_out_m)
        if low < 0.1 * scale:
            continue  # not safe at this margin for any keep-out
        stated.append(0.5 * math.erfc(sigmas / math.sqrt(2.0)))
        found.append(entered(n, state, motion, noise, duration_s, low, rng))
    assert 0.4 * np.mean(stated) < np.mean(found) <= 1.05 * np.mean(stated)
