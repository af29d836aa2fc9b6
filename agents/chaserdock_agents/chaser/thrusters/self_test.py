# SPDX-License-Identifier: Apache-2.0
"""Test thrusters that have not been observed recently (docs/thrusters.md).

A thruster that is rarely used would show a failure only when it is needed. A test burn fires it for
one minimum pulse together with the cheapest other thrusters that cancel its wrench: healthy
thrusters do not change the motion, a failed one does. No I/O; times are simulated nanoseconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from chaserdock_models.arrays import Array

from .allocation import Allocator
from .fault_detection import MAX_TICKS, Flags

MAX_TEST_PULSES = 10
"""Pulses within the period of a test after which a thruster is not tested again: if they do not
tell, more of the same do not either.
"""
_INTERVAL_NS = 500_000_000
"""Time between two burns, ns, in which the first is executed and evaluated."""
_MAX_DUTY = 0.9
"""Share of a carrier period that a burn and the commanded thrust may fill together."""


class ThrusterSelfTest:
    """Schedule test burns for thrusters of which the last ``every_s`` do not tell whether they
    work.

    0: no tests. ``ticks_to_tell``: of how many latest ticks with pulses of a thruster the motion
    tells whether it works (``ThrusterFaultDetector.ticks_to_tell``).
    """

    def __init__(
        self,
        allocator: Allocator,
        min_pulse_N_s: Array,
        every_s: float,
        ticks_to_tell: Callable[[int], int | None],
    ) -> None:
        self._allocator, self._min_pulse_N_s = allocator, min_pulse_N_s
        self._every_ns = round(every_s * 1e9)
        self._ticks_to_tell = ticks_to_tell
        self._fired_ns: list[deque[int]] = []
        self._known_until_ns = np.full(len(min_pulse_N_s), -1)
        self._changed = np.zeros(len(min_pulse_N_s), dtype=np.bool_)
        self._last_burn_ns = -_INTERVAL_NS
        self._first = 0
        self.reset()

    def reset(self) -> None:
        """Discard the motion so far; what it told about thrusters stays."""
        self._fired_ns = [deque(maxlen=MAX_TICKS) for _ in self._min_pulse_N_s]

    def add_pulses(self, fired: Flags, now_ns: int) -> None:
        """Add the motion up to ``now_ns``, with pulses of the thrusters ``fired`` (n,)."""
        self._changed |= fired
        for thruster in np.flatnonzero(fired):
            self._fired_ns[thruster].append(now_ns)

    def untested(self, now_ns: int) -> Flags:
        """Return the thrusters (n,) of which the last ``every_s`` do not tell whether they work."""
        for thruster in np.flatnonzero(self._changed & (self._known_until_ns < now_ns)):
            self._changed[thruster] = False
            times = self._fired_ns[thruster]
            ticks = min(self._ticks_to_tell(int(thruster)) or MAX_TEST_PULSES, MAX_TEST_PULSES)
            if ticks <= len(times):
                self._known_until_ns[thruster] = times[-ticks] + self._every_ns
        return self._known_until_ns < now_ns

    def schedule(
        self, now_ns: int, suspects: Flags, available_N: Array, commanded_N: Array, period_s: float
    ) -> Array | None:
        """Return impulses (n,), N s, of a test burn to add to ``commanded_N`` (n,); None if none is
        due.

        ``suspects`` (n,): thrusters whose failure can be detected. ``available_N`` (n,): their
        known thrust when open. ``period_s``: carrier period.
        """
        if self._every_ns == 0 or now_ns < self._last_burn_ns + _INTERVAL_NS:
            return None
        due = np.flatnonzero(self.untested(now_ns) & suspects & (available_N > 0.0))
        # In turn, as a thruster that cannot be tested now must not block the others.
        for thruster in sorted(due.tolist(), key=lambda j: (j - self._first) % len(available_N)):
            impulses = self._balanced(thruster, available_N * period_s)
            if impulses is not None and np.all(
                impulses + commanded_N * period_s <= _MAX_DUTY * available_N * period_s
            ):
                self._last_burn_ns, self._first = now_ns, thruster + 1
                return impulses
        return None

    def _balanced(self, thruster: int, max_N_s: Array) -> Array | None:
        """Return a minimum pulse of ``thruster`` with the pulses that cancel it, (n,) N s; None if
        impossible.
        """
        others = max_N_s.copy()
        others[thruster] = 0.0
        push = self._allocator.matrix[:, thruster] * self._min_pulse_N_s[thruster]
        cancelling = self._allocator.allocate(-push, others)
        if not cancelling.exact:
            return None
        cancelling.thrusts_N[thruster] = self._min_pulse_N_s[thruster]
        return cancelling.thrusts_N
