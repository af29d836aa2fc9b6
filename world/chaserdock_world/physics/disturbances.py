# SPDX-License-Identifier: Apache-2.0
"""Apply forces and torques that nobody commands: constant ones, and noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import Scenario

from chaserdock_world.plant import Plant
from chaserdock_world.random_draws import GaussMarkov, Stream


class Disturbances:
    """Disturb all bodies. Noise changes once a tick."""

    def __init__(self, scenario: Scenario, plants: Mapping[str, Plant]) -> None:
        self._steps_per_tick = scenario.timing.steps_per_tick
        self._constant = {n: p.disturbance for n, p in plants.items() if p.disturbance.any()}
        sigma = scenario.truth.mismatch("chaser")
        self._sigma = np.repeat([sigma.force_noise_N, sigma.torque_noise_N_m], 3)
        times_s, period_s = [sigma.disturbance_time_s] * 6, 1.0 / scenario.time.rate_hz
        self._noise = {
            f"chaser/{i}": GaussMarkov(scenario.seed, Stream.DISTURBANCE, i, times_s, period_s)
            for i in range(len(scenario.chasers))
            if self._sigma.any()
        }

    def added_to(self, wrench: Array, name: str, step: int) -> Array:
        """Return a wrench (6,), at a body's origin in its axes, with its disturbances at a step."""
        if name in self._constant:
            wrench = wrench + self._constant[name]
        if name in self._noise:
            wrench = wrench + self._sigma * self._noise[name].at(step // self._steps_per_tick)
        return wrench

    def next_change(self, step: int) -> int | None:
        """Return the first step after ``step`` at which a disturbance changes, None if all are
        constant.
        """
        return (step // self._steps_per_tick + 1) * self._steps_per_tick if self._noise else None
