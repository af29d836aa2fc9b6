# SPDX-License-Identifier: Apache-2.0
"""The clock: steps, ticks, images and their times in whole nanoseconds."""

from __future__ import annotations

from fractions import Fraction

from chaserdock_models.clock import Timing
from hypothesis import given, settings
from hypothesis import strategies as st

quick = settings(derandomize=True, deadline=None, max_examples=100)


@st.composite
def timings(draw: st.DrawFn) -> Timing:
    image_hz = draw(st.integers(1, 60))
    rate_hz = image_hz * draw(st.integers(1, 8))
    physics_hz = rate_hz * draw(st.integers(1, 200))
    return Timing(physics_hz, rate_hz, image_hz, draw(st.integers(0, 4 * physics_hz)))


@given(timings(), st.integers(0, 10**9))
@quick
def test_every_step_has_its_time_and_every_time_its_step(timing: Timing, step: int) -> None:
    time_ns = timing.time_ns(step)
    assert timing.step_of_time(time_ns) == step
    assert timing.time_ns(step + 1) > time_ns
    assert timing.step_of_time(time_ns + 1) == step + 1
    exact = Fraction(step * 10**9, timing.physics_hz)
    assert exact - 1 < time_ns <= exact


@given(timings(), st.integers(0, 10**6))
@quick
def test_ticks_are_whole_steps(timing: Timing, tick: int) -> None:
    assert timing.steps_per_tick * timing.rate_hz == timing.physics_hz
    assert timing.step_of_tick(tick) == tick * timing.physics_hz // timing.rate_hz
    assert timing.step_of_time(timing.tick_time_ns(tick)) == timing.step_of_tick(tick)
    answered = timing.step_of_time(timing.effective_ns(tick))
    assert answered == timing.step_of_tick(tick) + timing.latency_steps


@given(timings())
@quick
def test_images_come_at_their_rate(timing: Timing) -> None:
    ticks = range(3 * timing.rate_hz)
    assert sum(timing.has_images(t) for t in ticks) == 3 * timing.image_hz
    assert timing.has_images(0)


@given(st.integers(0, 10**18))
@quick
def test_step_of_time_is_the_first_at_or_after(time_ns: int) -> None:
    timing = Timing(1920, 15, 15, 64)
    step = timing.step_of_time(time_ns)
    assert timing.time_ns(step) >= time_ns
    assert step == 0 or timing.time_ns(step - 1) < time_ns


def test_whole_seconds_are_exact_at_the_default_rates() -> None:
    timing = Timing(physics_hz=1920, rate_hz=15, image_hz=15, latency_steps=64)
    assert timing.ticks_in(120.0) == 1800
    assert timing.tick_time_ns(1800) == 120_000_000_000
    assert timing.effective_ns(0) == 33_333_333
    assert timing.ticks_in(0.1) == 2  # 1.5 ticks; rounded to even
