# SPDX-License-Identifier: Apache-2.0
"""Thrusts into pulses: what is given follows what is asked for, in whole steps and never too
short.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_agents.chaser.thrusters.modulation import Modulator
from chaserdock_models.arrays import Array
from chaserdock_models.thruster_model import Valves
from chaserdock_protocol.messages import ThrusterPulse
from chaserdock_protocol.scenario.thrusters import thrusts_max
from hypothesis import given, settings
from hypothesis import strategies as st
from thruster_cases import mission

quick = settings(derandomize=True, deadline=None, max_examples=40)
MS = 1_000_000
RATES = (10, 15, 30)


class Bench:
    """A modulator of tetra12 and what its pulses give."""

    def __init__(self, rate_hz: int, **modulation: Any) -> None:
        s = mission(
            time={"rate_hz": rate_hz, "image_hz": rate_hz}, chaser={"modulation": modulation}
        )
        self.timing, self.layout = s.timing, s.chaser.thrusters
        self.full = thrusts_max(self.layout)
        self.least = self.full * [t.min_on_s for t in self.layout]
        self.modulator, self.valves = (
            Modulator(self.layout, s.chaser.modulation, s.timing),
            Valves(self.layout),
        )
        self.asked = [np.zeros(len(self.full))]
        self.pulses: list[ThrusterPulse] = []

    def tick(self, tick: int, thrusts: Array, can: Array | None = None) -> list[ThrusterPulse]:
        begin, end = self.timing.effective_ns(tick), self.timing.effective_ns(tick + 1)
        out = self.modulator.pulses(thrusts, self.full if can is None else can, begin, end)
        self.asked.append(self.asked[-1] + thrusts * (end - begin) * 1e-9)
        for p in out:
            assert self.valves.pulse(p.thruster, p.open_ns, p.close_ns)
        self.pulses += out
        return out

    def given(self, from_tick: int, to_tick: int) -> Array:
        edges = [self.timing.effective_ns(k) for k in (from_tick, to_tick)]
        return self.valves.impulses(np.array(edges, dtype=float))[0]


@pytest.mark.parametrize("rate_hz", RATES)
@given(seed=st.integers(0, 2**31))
@quick
def test_within_any_second_one_minimum_pulse_of_what_was_asked_for(rate_hz: int, seed: int) -> None:
    """Thrusts that stay a second each; a second begins with a carrier period, which no tick splits
    there.
    """
    bench, rng = Bench(rate_hz), np.random.default_rng(seed)
    thrusts = np.zeros(len(bench.full))
    for tick in range(8 * rate_hz):
        if tick % rate_hz == 0:
            thrusts = bench.full * rng.uniform(0.0, 0.95, len(bench.full)) ** 3
        bench.tick(tick, thrusts)
    for second in range(7):
        a, b = second * rate_hz, (second + 1) * rate_hz
        wanted = bench.asked[b] - bench.asked[a]
        assert np.all(np.abs(bench.given(a, b) - wanted) <= bench.least * 1.001)


@pytest.mark.parametrize("rate_hz", RATES)
@given(seed=st.integers(0, 2**31))
@quick
def test_nothing_is_lost_when_every_tick_asks_for_something_else(rate_hz: int, seed: int) -> None:
    """The account bounds the difference for ever: one minimum pulse and what a period's change can
    be.
    """
    bench, rng = Bench(rate_hz), np.random.default_rng(seed)
    ticks = 6 * rate_hz
    for tick in range(ticks):
        bench.tick(tick, bench.full * rng.uniform(0.0, 0.6, len(bench.full)))
    difference = bench.given(0, ticks) - bench.asked[ticks]
    assert np.all(np.abs(difference) <= bench.least + 0.6 * bench.full * 0.1)


@pytest.mark.parametrize(
    ("rate_hz", "carrier_hz"), [(10, 10), (15, 10), (30, 10), (15, 15), (30, 15)]
)
@given(seed=st.integers(0, 2**31))
@quick
def test_off_time_beyond_a_minimum_pulse_follows_a_later_demand(
    rate_hz: int, carrier_hz: int, seed: int
) -> None:
    """Thrusts new every tick: given less asked, over any second, is within a minimum pulse but for
    what the thrusts of the last period of either end have changed within it. Where a tick is a
    period nothing has."""
    bench, rng = Bench(rate_hz, carrier_hz=carrier_hz), np.random.default_rng(seed)
    level = bench.full * rng.uniform(0.0, 0.7, len(bench.full))
    thrusts = [level * rng.uniform(0.8, 1.2, len(level)) for _ in range(5 * rate_hz)]
    for tick, asked in enumerate(thrusts):
        bench.tick(tick, asked)

    def late(second: int) -> Array:
        end_ns = bench.timing.effective_ns(second * rate_hz)
        begin_ns, out, first = end_ns - 1_000_000_000 // carrier_hz, np.zeros(len(bench.full)), None
        for tick in range((second - 1) * rate_hz, second * rate_hz):
            a, b = bench.timing.effective_ns(tick), bench.timing.effective_ns(tick + 1)
            if (held_ns := b - max(a, begin_ns)) > 10:
                first = thrusts[tick] if first is None else first
                out = out + (thrusts[tick] - first) * (held_ns * 1e-9)
        return out

    for second in range(1, 4):
        a, b = second * rate_hz, (second + 1) * rate_hz
        off = bench.given(a, b) - (bench.asked[b] - bench.asked[a])
        changed = late(second + 1) - late(second)
        assert np.all(np.abs(off + changed) <= bench.least * 1.001)
        assert rate_hz != carrier_hz or not changed.any()


@given(seed=st.integers(0, 2**31), rate_hz=st.sampled_from(RATES))
@quick
def test_pulses_are_whole_steps_centred_long_enough_and_one_a_period(
    seed: int, rate_hz: int
) -> None:
    bench, rng = Bench(rate_hz), np.random.default_rng(seed)
    for tick in range(2 * rate_hz):
        bench.tick(tick, bench.full * rng.uniform(0.0, 1.0, len(bench.full)))
    seen = set()
    for p in bench.pulses:
        width = p.close_ns - p.open_ns
        assert width % MS == 0
        assert 10 * MS <= width <= 100 * MS
        middle = (p.open_ns + p.close_ns) / 2 - bench.timing.effective_ns(0)
        assert middle % (100 * MS) == pytest.approx(50 * MS, abs=2)
        assert (p.thruster, middle // MS) not in seen
        seen.add((p.thruster, middle // MS))
    assert len(seen) > 12 * 15


@pytest.mark.parametrize("rate_hz", RATES)
def test_full_thrust_is_full_thrust(rate_hz: int) -> None:
    bench = Bench(rate_hz)
    for tick in range(rate_hz):
        bench.tick(tick, bench.full)
    whole = bench.full * (1.0 - 0.002 / 2)  # less the first rise; the last fall comes after
    np.testing.assert_allclose(bench.given(0, rate_hz), whole, rtol=1e-6)


def test_too_little_waits_until_it_is_worth_a_pulse() -> None:
    """1 % of full thrust: a minimum pulse of 10 ms every ten periods of 100 ms, the first when half
    of it is owed.
    """
    bench = Bench(10)
    times = []
    for tick in range(40):
        for p in bench.tick(tick, bench.full * np.eye(12)[4] * 0.01):
            assert p.thruster == 4
            times.append(tick)
    assert times == [4, 14, 24, 34]


def test_a_thruster_that_cannot_gets_no_pulses_and_is_owed_nothing() -> None:
    bench = Bench(10)
    can = bench.full.copy()
    can[3] = 0.0
    for tick in range(10):
        assert 3 not in {p.thruster for p in bench.tick(tick, bench.full * 0.3, can)}
    assert bench.modulator.deficit_N_s[3] == pytest.approx(0.0)


def test_a_weak_thruster_opens_longer() -> None:
    bench = Bench(10)
    can = bench.full * 0.5
    pulses = bench.tick(0, bench.full * 0.2, can)
    assert [p.close_ns - p.open_ns for p in pulses] == [40 * MS] * 12


def test_a_thruster_asked_for_too_much_is_not_behind_for_ever() -> None:
    bench = Bench(10)
    for tick in range(20):
        bench.tick(tick, bench.full * 2.0)
    widths = [
        sum(p.close_ns - p.open_ns for p in bench.tick(20 + k, bench.full * 0.0)) for k in range(4)
    ]
    assert widths[-1] == 0


def test_two_commands_for_one_tick_plan_a_period_once() -> None:
    bench = Bench(10)
    first = bench.tick(0, bench.full * 0.5)
    assert len(first) == 12
    assert bench.tick(0, bench.full * 0.5) == []


def test_nothing_is_owed_for_ticks_without_a_command() -> None:
    bench = Bench(15)
    bench.tick(0, bench.full * 0.5)
    begin, end = bench.timing.effective_ns(45), bench.timing.effective_ns(46)
    bench.modulator.pulses(np.zeros(12), bench.full, begin, end)
    assert np.abs(bench.modulator.deficit_N_s).max() < 1.5 * 0.1


@pytest.mark.parametrize(("share", "width_ms"), [(0.2034, 20), (0.2066, 21)])
def test_on_times_are_rounded_to_the_nearest_step(share: float, width_ms: int) -> None:
    bench = Bench(10)
    pulses = bench.tick(0, bench.full * share)
    assert [p.close_ns - p.open_ns for p in pulses] == [width_ms * MS] * 12
