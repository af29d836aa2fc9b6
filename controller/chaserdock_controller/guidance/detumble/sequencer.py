# SPDX-License-Identifier: Apache-2.0
"""Fires the thrusters of a stack one after the other where together they would exceed the load
limits of a port.
"""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import FlightScenario

from .port_loads import LoadModel, fire_in_turn

_KEPT = 0.7
"""Share of what a thruster could not give in a carrier period that it may still give later."""
_WIDEST = 0.94
"""Longest pulse as a share of its carrier period: a pulse that scatters must not last into the next
one, when others fire.
"""


class Sequencer:
    """Chooses which thrusters fire in every carrier period of the modulation; the impulse of the
    others waits.

    The modulation gives what was commanded and not yet given in later periods, when others fire.
    Therefore the command changes only in ticks in which a period begins, and what it amounts to
    until the next such tick fits into the pulses of these periods.

    ``limits``: force and torque by chaser, infinite without a limit; ``tips_m``: the ports (TRF).
    """

    def __init__(self, scenario: FlightScenario) -> None:
        ports = scenario.docking.ports
        self.limits = {
            p.chaser: (p.force_limit_N or np.inf, p.torque_limit_N_m or np.inf) for p in ports
        }
        self.tips_m = {p.chaser: np.array(p.position_m) for p in ports}
        self.limited = any(np.isfinite(limit).any() for limit in self.limits.values())
        self._timing = scenario.timing
        self._period_steps = scenario.timing.physics_hz // scenario.chaser.modulation.carrier_hz
        self._pending_N_s = np.zeros(0)
        self._thrusts_N = np.zeros(0)

    def reset(self) -> None:
        """Forget what waits."""
        self._pending_N_s, self._thrusts_N = np.zeros(0), np.zeros(0)

    def in_turn(self, model: LoadModel, wanted_N: Array, limits_N: Array, tick: int) -> Array:
        """Return thrusts (n,) that keep the limits, of those wanted; the choice changes only when a
        carrier period begins.
        """
        if len(self._pending_N_s) != len(wanted_N):
            self._pending_N_s = np.zeros(len(wanted_N))
            self._thrusts_N = np.zeros(len(wanted_N))
        periods, span_s = self._span(tick)
        if periods:
            most = limits_N * min(
                span_s, _WIDEST * periods * self._period_steps / self._timing.physics_hz
            )
            pending = np.minimum(_KEPT * self._pending_N_s + wanted_N * span_s, 2.0 * most)
            pending[wanted_N <= 0.0] = 0.0
            chosen = fire_in_turn(model, pending, limits_N)
            given = np.where(chosen, np.minimum(pending, most), 0.0)
            self._pending_N_s, self._thrusts_N = pending - given, given / span_s
        return np.minimum(self._thrusts_N, limits_N)

    def _span(self, tick: int) -> tuple[int, float]:
        """Return how many carrier periods begin while a tick's command acts, and the time until
        that of the next tick in which one begins; none and zero if none begins."""
        begun = self._begun(tick)
        periods, last = self._begun(tick + 1) - begun, tick + 1
        if not periods:
            return 0, 0.0
        while self._begun(last + 1) == self._begun(last):
            last += 1
        return periods, (last - tick) / self._timing.rate_hz

    def _begun(self, tick: int) -> int:
        """Return how many carrier periods have begun before a tick's command takes effect."""
        step = self._timing.step_of_tick(tick) + self._timing.latency_steps
        return -(-(step - self._timing.latency_steps % self._period_steps) // self._period_steps)
