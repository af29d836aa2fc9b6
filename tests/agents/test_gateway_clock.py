# SPDX-License-Identifier: Apache-2.0
"""The clock of a device is found from stamps and arrivals."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_agents.gateway.clock import DeviceClock

MS = 1e-3


def deliver(
    clock: DeviceClock,
    seconds: float,
    rate_hz: float,
    offset_s: float,
    drift: float = 0.0,
    least_delay_s: float = 0.0,
    jitter_s: float = 2 * MS,
    seed: int = 1,
    begin_s: float = 1000.0,
) -> list[bool]:
    """Stamps of a clock that is ``offset_s`` behind the host's, with random delays."""
    rng = np.random.default_rng(seed)
    steps = []
    for k in range(round(seconds * rate_hz)):
        host_s = begin_s + k / rate_hz
        stamp_s = (host_s - offset_s) * (1.0 - drift)
        arrived_s = host_s + least_delay_s + rng.exponential(jitter_s)
        steps.append(clock.add(round(stamp_s * 1e9), round(arrived_s * 1e9)))
    return steps


@pytest.mark.parametrize("rate_hz", [15, 30, 100])
@pytest.mark.parametrize("seed", range(3))
def test_an_offset_of_50_ms_is_found_to_1_ms_within_10_s(rate_hz: float, seed: int) -> None:
    clock = DeviceClock()
    deliver(clock, 10.0, rate_hz, 0.05, seed=seed)
    assert abs(clock.offset_s - 0.05) < 1 * MS


def test_the_stated_least_delay_is_no_offset() -> None:
    clock = DeviceClock(least_delay_s=0.03)
    deliver(clock, 10.0, 30, -2.4, least_delay_s=0.03)
    assert abs(clock.offset_s + 2.4) < 1 * MS


@pytest.mark.parametrize("drift", [-8e-5, 5e-5])
def test_drift_is_found_and_leaves_no_error_at_the_newest_stamp(drift: float) -> None:
    clock = DeviceClock()
    deliver(clock, 90.0, 30, 0.3, drift, begin_s=10.0)
    assert abs(clock.drift - drift) < 2e-5
    newest_host_s = 10.0 + (90.0 * 30 - 1) / 30
    stamp_ns = round((newest_host_s - 0.3) * (1.0 - drift) * 1e9)
    assert abs(clock.host_ns(stamp_ns) / 1e9 - newest_host_s) < 1 * MS
    for shift_ns in (-40_000_000, 0, 90_000_000):
        assert abs(clock.stamp_ns(clock.host_ns(stamp_ns + shift_ns)) - stamp_ns - shift_ns) <= 2


@pytest.mark.parametrize("step_s", [-0.7, 0.7])
def test_a_step_of_the_clock_is_noticed_within_a_second(step_s: float) -> None:
    clock = DeviceClock()
    deliver(clock, 5.0, 30, 0.05)
    steps = deliver(clock, 5.0, 30, 0.05 + step_s, begin_s=1005.0)
    assert steps.index(True) <= 30
    assert sum(steps) == 1
    assert clock.steps == 1
    assert abs(clock.offset_s - 0.05 - step_s) < 1.5 * MS


def test_a_short_burst_of_delays_is_no_step() -> None:
    clock = DeviceClock()
    deliver(clock, 5.0, 30, 0.05)
    deliver(clock, 0.4, 30, 0.05, least_delay_s=0.2, begin_s=1005.0)
    deliver(clock, 2.0, 30, 0.05, begin_s=1005.4)
    assert clock.steps == 0
    assert abs(clock.offset_s - 0.05) < 1 * MS


def test_a_device_that_falls_behind_and_catches_up_has_not_stepped() -> None:
    """Its messages come later and later, then in a burst: as on a machine that is overloaded."""
    clock, rate_hz = DeviceClock(), 100
    deliver(clock, 5.0, rate_hz, 0.05)
    behind_s = [*np.linspace(0.0, 0.2, 2 * rate_hz), *np.linspace(0.2, 0.0, rate_hz // 4)]
    for k, late_s in enumerate(behind_s):
        host_s = 1005.0 + k / rate_hz
        stamp_ns = round((host_s - 0.05) * 1e9)
        assert not clock.add(stamp_ns, round((host_s + late_s) * 1e9))
        assert abs(clock.host_ns(stamp_ns) / 1e9 - host_s) < 1.5 * MS
