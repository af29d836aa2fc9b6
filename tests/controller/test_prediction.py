# SPDX-License-Identifier: Apache-2.0
"""Prediction: the rigid body, the commands under way, and the state they lead to."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_controller.ingest.chaser import ChaserIngest
from chaserdock_controller.ingest.latency_compensation import CommandHistory, predict_state
from chaserdock_controller.interfaces import ChaserInputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.scenario.bodies import Body
from flight_cases import odometry, quick, scenario, start
from hypothesis import given
from hypothesis import strategies as st
from runge_kutta import rk4

LONG = Body(mass_kg=12.0, inertia_kg_m2=(0.1, 0.5, 0.55))


def fine(x: Array, u: Array, body: Body, duration_s: float, steps: int = 4000) -> Array:
    """The rigid body's equations by RK4 in small steps, written with vectors and nothing of the
    module's.
    """
    moments, h = np.array(body.inertia), duration_s / steps

    def slope(s: Array) -> Array:
        q, w = s[6:10], s[10:13]
        return np.concatenate(
            [
                s[3:6],
                rotations.to_matrix(q / np.linalg.norm(q)) @ u[:3] / body.mass_kg,
                0.5 * rotations.multiply(q, np.array([0.0, *w])),
                (u[3:] - np.cross(w, moments * w)) / moments,
            ]
        )

    x = rk4(slope, x, h, steps)
    x[6:10] /= np.linalg.norm(x[6:10])
    return x


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("duration_s", [1 / 30, 0.5])
def test_integrate_agrees_with_fine_steps(seed: int, duration_s: float) -> None:
    x = start(seed)
    u = np.random.default_rng(seed + 100).uniform(-1, 1, 6) * [2, 2, 2, 0.05, 0.05, 0.05]
    result = propagate(x, u, LONG, duration_s)
    np.testing.assert_allclose(result, fine(x, u, LONG, duration_s, 500), rtol=0, atol=1e-7)
    assert abs(np.linalg.norm(result[6:10]) - 1.0) < 1e-15


def test_integrate_leaves_its_argument_alone_and_nothing_happens_in_no_time() -> None:
    x = start(1)
    before = x.copy()
    np.testing.assert_allclose(propagate(x, np.ones(6), LONG, 0.0), x, rtol=0, atol=1e-15)
    propagate(x, np.ones(6), LONG, 1.0)
    np.testing.assert_array_equal(x, before)


def wrench(value: float) -> Array:
    return np.full(6, value)


def test_history_gives_what_acts_between_two_times() -> None:
    history = CommandHistory()
    history.add(100, wrench(1.0))
    history.add(200, wrench(2.0))

    def segments_of(begin: int, end: int) -> list[tuple[int, int, float]]:
        return [(a, b, float(w[0])) for a, b, w in history.segments(begin, end)]

    assert segments_of(0, 50) == [(0, 50, 0.0)]
    assert segments_of(0, 300) == [(0, 100, 0.0), (100, 200, 1.0), (200, 300, 2.0)]
    assert segments_of(100, 200) == [(100, 200, 1.0)]
    assert segments_of(150, 250) == [(150, 200, 1.0), (200, 250, 2.0)]
    assert segments_of(200, 250) == [(200, 250, 2.0)]
    assert segments_of(500, 501) == [(500, 501, 2.0)]


def test_of_two_commands_for_one_time_the_last_counts() -> None:
    history = CommandHistory()
    history.add(100, wrench(1.0))
    history.add(100, wrench(2.0))
    assert [(a, b, float(w[0])) for a, b, w in history.segments(50, 150)] == [
        (50, 100, 0.0),
        (100, 150, 2.0),
    ]


def test_history_keeps_its_own_copy() -> None:
    history, u = CommandHistory(), wrench(1.0)
    history.add(0, u)
    u[:] = 5.0
    np.testing.assert_array_equal(history.segments(0, 1)[0][2], wrench(1.0))


@given(
    st.lists(st.integers(0, 1000), max_size=8).map(sorted),
    st.integers(0, 1000),
    st.integers(0, 500),
    st.integers(1, 500),
)
@quick
def test_forgetting_the_past_changes_nothing_from_then_on(
    times: list[int], now: int, later: int, span: int
) -> None:
    whole, short = CommandHistory(), CommandHistory()
    for k, t in enumerate(times):
        whole.add(t, wrench(float(k + 1)))
        short.add(t, wrench(float(k + 1)))
    short.forget_before(now)

    def segments_of(history: CommandHistory) -> list[tuple[int, int, float]]:
        begin = now + later
        return [(a, b, float(w[0])) for a, b, w in history.segments(begin, begin + span)]

    assert segments_of(short) == segments_of(whole)
    kept = [float(w[0]) for _, _, w in short.segments(0, 2000)]
    assert len(kept) <= 2 + sum(t > now for t in times)


def test_prediction_flies_the_commands_that_are_under_way() -> None:
    """Two commands take effect between odometry and prediction, as with a latency of more than a
    tick.
    """
    o = odometry(time_ns=1_000_000_000)
    history = CommandHistory()
    early = np.array([1.0, -0.5, 0.2, 0.01, -0.02, 0.005])
    late = np.array([-1.0, 2.0, 0.0, -0.05, 0.03, 0.01])
    history.add(990_000_000, early)
    history.add(1_040_000_000, late)
    history.add(1_200_000_000, wrench(1.0))  # after the time asked for
    predicted = predict_state(o, history.ahead(o.sim_time_ns, 1_100_000_000), np.zeros(6), LONG)
    x = np.array([*o.position_m, *o.velocity_m_s, *o.q_wxyz, *o.omega_rad_s])
    x = fine(fine(x, early, LONG, 0.04, 200), late, LONG, 0.06, 200)
    np.testing.assert_allclose(predicted, x, rtol=0, atol=1e-9)


def test_without_commands_a_chaser_coasts() -> None:
    o = odometry(time_ns=5, omega_rad_s=(0.0, 0.0, 0.1))
    x = predict_state(o, CommandHistory().ahead(5, 5 + 2_000_000_000), np.zeros(6), Body())
    np.testing.assert_allclose(x[:3], [1.06, 1.88, 3.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        x[6:10], rotations.integrate(o.q_wxyz, [0, 0, 0.1], 2.0), rtol=0, atol=1e-9
    )


def test_commands_that_change_within_a_tick_have_a_moment_about_its_middle() -> None:
    """Half a tick of latency at 15 Hz: the command before acts in the first half of the tick."""
    s = scenario()
    period_ns = round(1e9 / s.time.rate_hz)
    history, first, second = CommandHistory(), wrench(1.0), wrench(-0.4)
    history.add(0, first)
    history.add(round(1.5 * period_ns), second)
    inputs = ChaserInputs(0, odometry=odometry(tick=2))
    seen, _ = ChaserIngest(s, 0).observe(inputs, 2, 2 * period_ns, history)
    half_s = 0.5 * period_ns / 1e9
    assert seen.impulse is not None
    np.testing.assert_allclose(seen.impulse.impulse, half_s * (first + second), rtol=1e-6)
    np.testing.assert_allclose(
        seen.impulse.moment, half_s**2 / 2.0 * (first - second), rtol=1e-6, atol=1e-12
    )
    np.testing.assert_allclose(
        seen.impulse.magnitude, half_s * (np.abs(first) + np.abs(second)), rtol=1e-6
    )
