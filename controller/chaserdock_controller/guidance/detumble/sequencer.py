# SPDX-License-Identifier: Apache-2.0
"""Fires thrusters of a stack in turn where together they would exceed a port's load limits."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import FlightScenario

from .port_loads import LoadModel, fire_in_turn

_KEPT = 0.7
"""Share of an undelivered thrust that is carried over to the next carrier period."""
_WIDEST = 0.94
"""Longest pulse as a share of its carrier period. A pulse that scatters must end before others fire
in the next period.
"""


class Sequencer:
    """Selects which thrusters fire in every carrier period of the modulation; the impulse of the
    others waits.

    The modulation delivers undelivered impulse in later periods, when other thrusters fire.
    Therefore the command changes only in ticks in which a period begins, and it fits into the
    pulses of the periods up to the next such tick.

    ``limits``: force and torque by chaser, infinite if unlimited. ``tips_m``: the ports (TRF).
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
        """Discard the waiting impulse."""
        self._pending_N_s, self._thrusts_N = np.zeros(0), np.zeros(0)

    def in_turn(self, model: LoadModel, wanted_N: Array, limits_N: Array, tick: int) -> Array:
        """Return thrusts (n,), chosen from those wanted, that keep the limits. The choice changes
        only when a carrier period begins.
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
        """Return how many carrier periods begin while a tick's command acts, and the time (s) until
        the next tick in which one begins; zeros if none begins.
        """
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
