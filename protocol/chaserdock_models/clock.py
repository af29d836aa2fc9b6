# SPDX-License-Identifier: Apache-2.0
"""Simulated time in whole physics steps, which avoids accumulated rounding."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """Physics steps, ticks and latencies of a mission.

    ``rate_hz``: ticks per second, a divisor of ``physics_hz``. ``image_hz``: images per second, a
    divisor of ``rate_hz``. ``latency_steps``: time from exposure to actuation in physics steps.
    """

    physics_hz: int
    rate_hz: int
    image_hz: int
    latency_steps: int

    @property
    def steps_per_tick(self) -> int:
        return self.physics_hz // self.rate_hz

    @property
    def ticks_per_image(self) -> int:
        return self.rate_hz // self.image_hz

    def step_of_tick(self, tick: int) -> int:
        return tick * self.steps_per_tick

    def time_ns(self, step: int) -> int:
        """Return the simulated time of a physics step, nanoseconds, rounded down."""
        return step * 1_000_000_000 // self.physics_hz

    def tick_time_ns(self, tick: int) -> int:
        return self.time_ns(self.step_of_tick(tick))

    def effective_ns(self, tick: int) -> int:
        """Return the simulated time, nanoseconds, at which a command for ``tick`` takes effect."""
        return self.time_ns(self.step_of_tick(tick) + self.latency_steps)

    def step_of_time(self, time_ns: int) -> int:
        """Return the first physics step at or after a simulated time."""
        return -(-time_ns * self.physics_hz // 1_000_000_000)

    def ticks_in(self, duration_s: float) -> int:
        return round(duration_s * self.rate_hz)

    def has_images(self, tick: int) -> bool:
        return tick % self.ticks_per_image == 0
