# SPDX-License-Identifier: Apache-2.0
"""Fires the thrusters of a stack one after the other where together they would exceed the load limits of a port."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import FlightScenario

from .port_loads import LoadModel, fire_in_turn

_KEPT = 0.7
"""Share of what a thruster could not give in a carrier period that it may still give in the next one."""


class Sequencer:
    """Chooses in every carrier period of the modulation which thrusters fire; the impulse of the others waits.

    ``limits``: force and torque by chaser, infinite without a limit; ``tips_m``: the ports (TRF).
    """

    def __init__(self, scenario: FlightScenario) -> None:
        ports = scenario.docking.ports
        self.limits = {p.chaser: (p.force_limit_N or np.inf, p.torque_limit_N_m or np.inf) for p in ports}
        self.tips_m = {p.chaser: np.array(p.position_m) for p in ports}
        self.limited = any(np.isfinite(limit).any() for limit in self.limits.values())
        self._ticks = max(1, scenario.time.rate_hz // scenario.chaser.modulation.carrier_hz)
        self._period_s = self._ticks / scenario.time.rate_hz
        self._pending_N_s = np.zeros(0)
        self._thrusts_N = np.zeros(0)

    def reset(self) -> None:
        """Forget what waits."""
        self._pending_N_s, self._thrusts_N = np.zeros(0), np.zeros(0)

    def in_turn(self, model: LoadModel, wanted_N: Array, limits_N: Array, tick: int) -> Array:
        """Return thrusts (n,) that keep the limits, of those wanted; the choice changes at the begin of a carrier period only."""
        if len(self._pending_N_s) != len(wanted_N):
            self._pending_N_s = np.zeros(len(wanted_N))
            self._thrusts_N = np.zeros(len(wanted_N))
        if tick % self._ticks == 0:
            most = limits_N * self._period_s
            pending = np.minimum(_KEPT * self._pending_N_s + wanted_N * self._period_s, 2.0 * most)
            pending[wanted_N <= 0.0] = 0.0
            chosen = fire_in_turn(model, pending, limits_N)
            given = np.where(chosen, np.minimum(pending, most), 0.0)
            self._pending_N_s, self._thrusts_N = pending - given, given / self._period_s
        return np.minimum(self._thrusts_N, limits_N)
