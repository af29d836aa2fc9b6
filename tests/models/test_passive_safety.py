# SPDX-License-Identifier: Apache-2.0
"""Certificates of coasts against densely sampled motion and against random errors of the state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_models.passive_safety import CoastModel, disturbed
from chaserdock_models.relative_motion import cw_transition
from hypothesis import given, settings
from hypothesis import strategies as st

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
        assert found.distance_m >= away.min() - 0.5 * 0.25 * float(np.linalg.norm(velocity)) - 1e-9
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
