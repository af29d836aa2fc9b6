# SPDX-License-Identifier: Apache-2.0
"""Modulate thrusts to pulses, one carrier period after the other (docs/thrusters.md).

Every thruster has an impulse deficit: what was commanded and not yet delivered. The pulse of a
period delivers the deficit and the current thrust, held to the period's end; when the thrust
changes within a period, the deficit takes up the difference. So the delivered impulse follows the
commanded one for any ratio of tick rate and carrier frequency.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.clock import Timing
from chaserdock_protocol.messages import ThrusterPulse
from chaserdock_protocol.scenario.thrusters import Modulation, Thruster, thrusts_max
from numpy.typing import NDArray

_RESOLUTION_S = 0.001
"""Pulse widths are multiples of this, s: a tenth of the minimum on-time of `tetra12`."""


class Modulator:
    """Modulate the thrusters of one chaser.

    The first carrier period begins when a command can first take effect. ``deficit_N_s`` (n,):
    commanded minus delivered impulse.
    """

    def __init__(
        self, thrusters: Sequence[Thruster], modulation: Modulation, timing: Timing
    ) -> None:
        self._timing = timing
        self._period_steps = timing.physics_hz // modulation.carrier_hz
        self._first_step = timing.latency_steps % self._period_steps
        self._full_N = thrusts_max(thrusters)
        self._lag_s = np.array([(t.rise_s - t.fall_s) / 2.0 for t in thrusters])
        self._shortest_s = np.array([t.min_on_s for t in thrusters])
        self._shortest_gap_s = np.array([t.fall_s for t in thrusters])
        self.deficit_N_s = np.zeros(len(thrusters))
        self._commanded_N = np.zeros(len(thrusters))
        self._open = np.zeros(len(thrusters), dtype=bool)
        self._accounted_ns = 0
        self._until_ns = 0
        self._next = 0
        self._period_thrust_N, self._period_end_ns = np.zeros(len(thrusters)), 0
        self.period_s = self._period_steps / timing.physics_hz

    def advance_N_s(self, now_ns: int) -> Array:
        """Return the impulse (n,) of current pulses that belongs to thrust commanded after
        ``now_ns``.
        """
        return self._period_thrust_N * (max(self._period_end_ns - now_ns, 0) * 1e-9)

    def _account(self, until_ns: int) -> None:
        """Add the impulse commanded up to a time, while its command acts, to the deficit."""
        held_ns = min(until_ns, self._until_ns) - self._accounted_ns
        self.deficit_N_s += self._commanded_N * (max(held_ns, 0) * 1e-9)
        self._accounted_ns = max(self._accounted_ns, until_ns)

    def pulses(
        self,
        thrusts_N: Array,
        available_N: Array,
        begin_ns: int,
        end_ns: int,
        extra_N_s: Array | None = None,
    ) -> list[ThrusterPulse]:
        """Return the pulses of the periods that begin while thrusts (n,) are commanded: from
        ``begin_ns`` to ``end_ns``.

        ``available_N`` (n,): thrust of open thrusters; those without thrust get no pulses. Every
        period gets its pulses once. ``extra_N_s`` (n,): impulse in addition to the thrusts,
        delivered from the next period on.
        """
        self._account(begin_ns)
        if extra_N_s is not None:
            self.deficit_N_s += extra_N_s
        self._commanded_N, self._until_ns = thrusts_N.copy(), end_ns
        able = available_N > 0.0
        self.deficit_N_s[~able] = 0.0
        out: list[ThrusterPulse] = []
        step = self._timing.step_of_time(begin_ns)
        k = max(self._next, -(-(step - self._first_step) // self._period_steps))
        while (period_ns := self._begin_ns(k)) < end_ns:
            self._account(period_ns)
            out += self._period(period_ns, self._begin_ns(k + 1) - period_ns, available_N, able)
            k += 1
        self._next = max(self._next, k)
        return out

    def _begin_ns(self, period: int) -> int:
        return self._timing.time_ns(self._first_step + period * self._period_steps)

    def _period(
        self, begin_ns: int, period_ns: int, available_N: Array, able: NDArray[np.bool_]
    ) -> list[ThrusterPulse]:
        period_s = period_ns * 1e-9
        self._period_thrust_N, self._period_end_ns = self._commanded_N, begin_ns + period_ns
        force_N = np.where(able, available_N, 1.0)
        held_N_s = self._commanded_N * period_s
        wanted_N_s = held_N_s + self.deficit_N_s
        width_s = np.where(able, self._widths_s(wanted_N_s / force_N, period_s), 0.0)
        full = width_s >= period_s - 0.5e-9
        # A thruster that stays open between periods has neither rise nor fall between them.
        given_s = np.where(width_s > 0.0, width_s - self._lag_s, 0.0) + np.where(
            full & self._open, self._lag_s, 0.0
        )
        self._open = full
        # The deficit is limited to a period of full thrust, so that saturation does not accumulate.
        most_N_s = force_N * period_s
        deficit = np.clip(wanted_N_s - given_s * force_N, -most_N_s, most_N_s)
        self.deficit_N_s = np.where(able, deficit - held_N_s, 0.0)
        out = []
        for thruster in np.flatnonzero(width_s > 0.0):
            width_ns = min(round(width_s[thruster] * 1e9), period_ns)
            open_ns = begin_ns + (period_ns - width_ns) // 2
            out.append(
                ThrusterPulse(thruster=int(thruster), open_ns=open_ns, close_ns=open_ns + width_ns)
            )
        return out

    def _widths_s(self, wanted_s: Array, period_s: float) -> Array:
        """Return pulse widths (n,) for on-times (n,) at full thrust: whole steps between the
        minimum and the period.
        """
        exact = (wanted_s + self._lag_s) / _RESOLUTION_S
        steps = np.floor(exact + 0.5)
        width_s = np.where(wanted_s > 0.0, steps * _RESOLUTION_S, 0.0)
        # Widths below the minimum are also rounded to the nearest, so that thrusters with small
        # equal commands fire together.
        nearest_s = np.where(
            wanted_s + self._lag_s >= 0.5 * self._shortest_s, self._shortest_s, 0.0
        )
        width_s = np.where(width_s < self._shortest_s, nearest_s, width_s)
        # A gap too short for the thrust to fall is closed.
        return np.where(
            width_s > period_s - np.maximum(self._shortest_gap_s, 0.5e-9), period_s, width_s
        )
