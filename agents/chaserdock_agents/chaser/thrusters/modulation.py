"""Thrusts into pulses, one carrier period after the other (docs/thrusters.md).

Every thruster has an account of what was asked of it and has not been given. A period's pulse pays the account and the
thrust asked for now, held to the period's end; when the thrust changes within a period, the account takes up the
difference. So what is given follows what is asked for, whatever the ratio of tick rate and carrier.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.clock import Timing
from chaserdock_protocol.messages import ThrusterPulse
from chaserdock_protocol.scenario.thrusters import Modulation, Thruster, thrusts_max
from numpy.typing import NDArray


class Modulator:
    """The accounts of one chaser's thrusters; carrier periods begin where a command can take effect first."""

    def __init__(self, thrusters: Sequence[Thruster], modulation: Modulation, timing: Timing) -> None:
        self._m, self._timing = modulation, timing
        self._period_steps = timing.physics_hz // modulation.carrier_hz
        self._first_step = timing.latency_steps % self._period_steps
        self._full_N = thrusts_max(thrusters)
        self._lag_s = np.array([(t.rise_s - t.fall_s) / 2.0 for t in thrusters])
        self._shortest_s = np.array([t.min_on_s for t in thrusters])
        self._shortest_gap_s = np.array([t.fall_s for t in thrusters])
        self.owed_N_s = np.zeros(len(thrusters))
        self._asked_N = np.zeros(len(thrusters))
        self._open = np.zeros(len(thrusters), dtype=bool)
        self._accounted_ns = 0
        self._until_ns = 0
        self._next = 0
        self._paid_N, self._paid_until_ns = np.zeros(len(thrusters)), 0
        self.period_s = self._period_steps / timing.physics_hz

    def paid_ahead_N_s(self, now_ns: int) -> Array:
        """(n,): what the pulses under way give instead of thrust that will be asked for only after ``now_ns``."""
        return self._paid_N * (max(self._paid_until_ns - now_ns, 0) * 1e-9)

    def _account(self, until_ns: int) -> None:
        """Books the thrust asked for up to a time; it was asked for only while its command acted."""
        held_ns = min(until_ns, self._until_ns) - self._accounted_ns
        self.owed_N_s += self._asked_N * (max(held_ns, 0) * 1e-9)
        self._accounted_ns = max(self._accounted_ns, until_ns)

    def pulses(
        self, thrusts_N: Array, can_N: Array, begin_ns: int, end_ns: int, extra_N_s: Array | None = None
    ) -> list[ThrusterPulse]:
        """Pulses of the periods that begin while thrusts (n,) are asked for: from ``begin_ns`` up to ``end_ns``.

        ``can_N`` (n,) is what the thrusters really give when open; a thruster that gives nothing gets no pulses. Every period
        gets its pulses once. ``extra_N_s`` (n,) is asked for beside the thrusts, as soon as a period begins.
        """
        self._account(begin_ns)
        if extra_N_s is not None:
            self.owed_N_s += extra_N_s
        self._asked_N, self._until_ns = thrusts_N.copy(), end_ns
        able = can_N > 0.0
        self.owed_N_s[~able] = 0.0
        out: list[ThrusterPulse] = []
        step = self._timing.step_of_time(begin_ns)
        k = max(self._next, -(-(step - self._first_step) // self._period_steps))
        while (period_ns := self._begin_ns(k)) < end_ns:
            self._account(period_ns)
            out += self._period(period_ns, self._begin_ns(k + 1) - period_ns, can_N, able)
            k += 1
        self._next = max(self._next, k)
        return out

    def _begin_ns(self, period: int) -> int:
        return self._timing.time_ns(self._first_step + period * self._period_steps)

    def _period(
        self, begin_ns: int, period_ns: int, can_N: Array, able: NDArray[np.bool_]
    ) -> list[ThrusterPulse]:
        period_s = period_ns * 1e-9
        self._paid_N, self._paid_until_ns = self._asked_N, begin_ns + period_ns
        force_N = np.where(able, can_N, 1.0)
        held_N_s = self._asked_N * period_s
        wanted_N_s = held_N_s + self.owed_N_s
        if self._m.modulator == "schmitt":
            threshold = np.where(self._open, self._m.schmitt_off, self._m.schmitt_on)
            width_s = np.where(wanted_N_s >= threshold * force_N * period_s, period_s, 0.0)
        else:
            width_s = self._widths_s(wanted_N_s / force_N, period_s)
        width_s = np.where(able, width_s, 0.0)
        full = width_s >= period_s - 0.5e-9
        # Where a thruster stays open from period to period it neither falls nor rises between them.
        given_s = np.where(width_s > 0.0, width_s - self._lag_s, 0.0) + np.where(
            full & self._open, self._lag_s, 0.0
        )
        self._open = full
        # Beyond a period of full thrust nothing is owed: a thruster that was asked for too much is not behind for ever.
        most_N_s = force_N * period_s
        owed = np.clip(wanted_N_s - given_s * force_N, -most_N_s, most_N_s)
        self.owed_N_s = np.where(able, (owed if self._m.carry_over else 0.0) - held_N_s, 0.0)
        out = []
        for thruster in np.flatnonzero(width_s > 0.0):
            width_ns = min(round(width_s[thruster] * 1e9), period_ns)
            open_ns = begin_ns + (period_ns - width_ns) // 2
            out.append(ThrusterPulse(thruster=int(thruster), open_ns=open_ns, close_ns=open_ns + width_ns))
        return out

    def _widths_s(self, wanted_s: Array, period_s: float) -> Array:
        """Pulse widths (n,) for on-times (n,) at full thrust: whole steps, none below the minimum or above the period."""
        resolution_s = self._m.resolution_s
        exact = (wanted_s + self._lag_s) / resolution_s
        steps = np.floor(exact + 0.5)
        width_s = np.where(wanted_s > 0.0, steps * resolution_s, 0.0)
        # Below the minimum, to the nearest, too: thrusters that were asked for little together then fire together.
        nearest_s = np.where(wanted_s + self._lag_s >= 0.5 * self._shortest_s, self._shortest_s, 0.0)
        width_s = np.where(width_s < self._shortest_s, nearest_s, width_s)
        # A gap in which the thrust could not fall is none.
        return np.where(width_s > period_s - np.maximum(self._shortest_gap_s, 0.5e-9), period_s, width_s)
