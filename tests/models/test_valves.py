# SPDX-License-Identifier: Apache-2.0
"""Valves and what thrusters give through them, in closed form."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from chaserdock_models.arrays import Array
from chaserdock_models.thruster_model import G0_M_S2, Valves, merge_spans, subtract_span
from chaserdock_protocol.scenario.thrusters import Thruster
from hypothesis import given, settings
from hypothesis import strategies as st

MS = 1_000_000
quick = settings(derandomize=True, deadline=None, max_examples=80)


def thruster(rise_ms: float = 2.0, fall_ms: float = 2.0, thrust_N: float = 2.0) -> Thruster:
    return Thruster(
        position_m=(0.0, 0.0, 0.0),
        direction=(1.0, 0.0, 0.0),
        thrust_N=thrust_N,
        rise_s=rise_ms / 1e3,
        fall_s=fall_ms / 1e3,
        isp_s=100.0,
    )


def given_N_s(valves: Valves, from_ms: float = 0.0, to_ms: float = 10_000.0) -> Array:
    return valves.impulses(np.array([from_ms * MS, to_ms * MS]))[0]


def test_a_pulse_gives_thrust_times_width_and_half_of_fall_less_rise() -> None:
    for rise, fall in ((0.0, 0.0), (2.0, 2.0), (1.0, 5.0), (6.0, 0.0)):
        valves = Valves([thruster(rise, fall)])
        assert valves.pulse(0, 100 * MS, 140 * MS)
        assert given_N_s(valves)[0] == pytest.approx(2.0 * (0.040 + (fall - rise) / 2e3), rel=1e-12)


@pytest.mark.parametrize(("from_ms", "to_ms"), [(80.0, 240.0), (103.0, 138.0), (126.0, 200.0)])
def test_first_moment_is_the_integral_of_thrust_by_time_to_the_middle(
    from_ms: float, to_ms: float
) -> None:
    """Two thrusters with pulses that begin before, end after or lie within the interval."""
    valves = Valves([thruster(4.0, 8.0), thruster(0.0, 3.0, 5.0)])
    for number, begin, end in ((0, 100, 120), (0, 135, 230), (1, 90, 110), (1, 180, 195)):
        assert valves.pulse(number, begin * MS, end * MS)
    valves.fail(1, "weak", 150 * MS, 0.4)
    edges = np.linspace(from_ms, to_ms, 4001) * MS
    given, at_s = valves.impulses(edges), (edges[:-1] + edges[1:]) / 2e9
    expected = ((from_ms + to_ms) / 2e3 - at_s) @ given
    found = valves.first_moments(round(from_ms * MS), round(to_ms * MS))
    assert np.abs(expected).min() > 1e-5
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@given(
    st.lists(st.tuples(st.integers(0, 1), st.integers(0, 900), st.integers(2, 200)), max_size=8),
    st.lists(st.integers(1, 1999), min_size=2, max_size=12, unique=True),
    st.one_of(st.none(), st.integers(0, 1500)),
)
@quick
def test_impulses_and_moments_of_many_intervals_are_those_of_each(
    pulses: list[tuple[int, int, int]], edges: list[int], shut_ms: int | None
) -> None:
    valves = Valves([thruster(4.0, 8.0), thruster(6.0, 0.0, 5.0)])
    for number, begin, width in pulses:
        valves.pulse(number, begin * MS, (begin + width) * MS)
    if shut_ms is not None:
        valves.set_shut((1,), shut_ms * MS)
        valves.fail(0, "stuck_on", (shut_ms + 100) * MS)
    times = [t * MS for t in sorted(edges)]
    impulses, moments = valves.impulses_and_moments(np.array(times))
    for k, (begin_ns, end_ns) in enumerate(pairwise(times)):
        each = valves.impulses(np.array([begin_ns, end_ns]))[0]
        np.testing.assert_allclose(impulses[k], each, rtol=1e-9, atol=1e-12)
        each = valves.first_moments(begin_ns, end_ns)
        np.testing.assert_allclose(moments[k], each, rtol=1e-9, atol=1e-12)


def test_thrust_rises_and_falls_linearly() -> None:
    valves = Valves([thruster(4.0, 8.0)])
    valves.pulse(0, 100 * MS, 120 * MS)
    edges = np.arange(99.0, 131.0) * MS
    force_N = valves.impulses(edges)[:, 0] / 1e-3
    np.testing.assert_allclose(force_N[:6], [0.0, 0.25, 0.75, 1.25, 1.75, 2.0], atol=1e-9)
    np.testing.assert_allclose(
        force_N[20:31], [2.0, *(2.0 - 0.125 - 0.25 * np.arange(8)), 0.0, 0.0], atol=1e-9
    )


@given(
    st.lists(st.tuples(st.integers(0, 900), st.integers(10, 200)), max_size=6),
    st.lists(st.integers(1, 1999), max_size=12, unique=True),
    st.sampled_from([None, "stuck_off", "stuck_on", "weak"]),
    st.one_of(st.none(), st.integers(0, 1500)),
)
@quick
def test_no_splitting_of_time_changes_what_is_given_and_never_more_than_full_thrust(
    pulses: list[tuple[int, int]], cuts: list[int], failure, shut_ms: int | None
) -> None:
    valves = Valves([thruster()])
    for begin, width in pulses:
        assert valves.pulse(0, begin * MS, (begin + width) * MS)
    valves.fail(0, failure, 400 * MS, 0.5)
    if shut_ms is not None:
        valves.set_shut([0], shut_ms * MS)
    edges = np.array([0.0, *sorted(cuts), 2000.0]) * MS
    parts = valves.impulses(edges)[:, 0]
    assert parts.sum() == pytest.approx(given_N_s(valves, 0, 2000)[0], abs=1e-12)
    assert np.all(parts >= -1e-12)
    assert np.all(parts <= 2.0 * np.diff(edges) * 1e-9 + 1e-12)


def test_pulses_that_touch_are_one_and_short_ones_none() -> None:
    valves = Valves([thruster()])
    assert valves.pulse(0, 0, 100 * MS)
    assert valves.pulse(0, 101 * MS, 200 * MS)  # a gap of 1 ms: no time to fall
    assert not valves.pulse(0, 300 * MS, 309 * MS)
    assert not valves.pulse(1, 300 * MS, 400 * MS)
    assert not valves.pulse(0, 400 * MS, 300 * MS)
    assert given_N_s(valves)[0] == pytest.approx(0.4, rel=1e-12)
    np.testing.assert_allclose(valves.open_s(0, 10**9), [0.2])


def test_stuck_on_thrusts_until_its_shut_off_valve_closes_and_again_when_it_opens() -> None:
    valves = Valves([thruster(), thruster()])
    valves.fail(0, "stuck_on", 100 * MS)
    valves.pulse(0, 150 * MS, 160 * MS)  # asked for or not
    valves.set_shut([0], 200 * MS)
    valves.set_shut([0], 250 * MS)  # repeated command: no change
    assert given_N_s(valves, 0, 1000)[0] == pytest.approx(0.2, rel=1e-12)
    assert valves.shut_at(199 * MS) == ()
    assert valves.shut_at(200 * MS) == (0,)
    valves.set_shut([], 500 * MS)
    assert given_N_s(valves, 0, 600)[0] == pytest.approx(0.4 - 2.0 * 0.001, rel=1e-9)
    assert given_N_s(valves)[1] == 0.0


def test_stuck_off_and_weak() -> None:
    valves = Valves([thruster(), thruster()])
    for k in range(2):
        valves.pulse(k, 0, 100 * MS)
        valves.pulse(k, 200 * MS, 300 * MS)
    valves.fail(0, "stuck_off", 150 * MS)
    valves.fail(1, "weak", 150 * MS, 0.25)
    np.testing.assert_allclose(given_N_s(valves), [0.2, 0.2 + 0.05], rtol=1e-12)
    valves.fail(1, None, 0)
    np.testing.assert_allclose(given_N_s(valves), [0.2, 0.4], rtol=1e-12)


def test_a_weak_thruster_is_weak_in_the_pulses_that_begin_with_its_failure_or_later() -> None:
    fails_ns = 150 * MS + 7
    begins_ns = (fails_ns - 1, fails_ns, fails_ns + 1)
    valves = Valves([thruster(1.0, 3.0, thrust_N) for thrust_N in (1.5, 2.0, 2.5)])
    for k, begin_ns in enumerate(begins_ns):
        valves.fail(k, "weak", fails_ns, 0.25)
        assert valves.pulse(k, begin_ns, begin_ns + 40 * MS)
    # A pulse of 40 ms, and half of the fall less the rise.
    expected_N_s = np.array([1.5, 0.25 * 2.0, 0.25 * 2.5]) * 0.041
    np.testing.assert_allclose(given_N_s(valves), expected_N_s, rtol=1e-12)


def test_stop_ends_pulses_but_not_what_is_stuck() -> None:
    valves = Valves([thruster(), thruster()])
    valves.pulse(0, 0, 500 * MS)
    valves.fail(1, "stuck_on", 0)
    valves.stop(100 * MS)
    np.testing.assert_allclose(given_N_s(valves, 0, 1000), [0.2, 2.0 - 0.002], rtol=1e-9)


def test_propellant_is_impulse_by_exhaust_velocity() -> None:
    valves = Valves([thruster(), thruster()])
    assert valves.propellant_kg(np.array([3.0, 4.0])) == pytest.approx(7.0 / (100.0 * G0_M_S2))


@given(st.lists(st.integers(100, 3000), max_size=5))
@quick
def test_forgetting_changes_nothing_that_comes(pulses: list[int]) -> None:
    valves, other = Valves([thruster()]), Valves([thruster()])
    for v in (valves, other):
        for begin in pulses:
            v.pulse(0, begin * MS, (begin + 50) * MS)
    valves.forget_before(1000 * MS)
    np.testing.assert_allclose(given_N_s(valves, 1000), given_N_s(other, 1000), atol=1e-12)


def test_spans() -> None:
    assert merge_spans([(5, 8), (0, 2), (3, 4)], 1) == [(0, 8)]
    assert merge_spans([(5, 8), (0, 2), (3, 4)], 0) == [(0, 2), (3, 4), (5, 8)]
    assert merge_spans([(0, 9), (1, 2)], 0) == [(0, 9)]
    assert subtract_span([(0, 10)], (3, 4)) == [(0, 3), (4, 10)]
    assert subtract_span([(0, 10), (20, 30)], (5, 25)) == [(0, 5), (25, 30)]
    assert subtract_span([(0, 10)], (0, 10)) == []
