# SPDX-License-Identifier: Apache-2.0
"""Test thrusters that have not been observed recently (docs/thrusters.md).

A thruster that is rarely used would show a failure only when it is needed. A test burn fires it for
one minimum pulse together with the cheapest other thrusters that cancel its wrench: healthy
thrusters do not change the motion, a failed one does. No I/O; times are simulated nanoseconds.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from chaserdock_models.arrays import Array

from .allocation import Allocator
from .fault_detection import Flags

_MIN_OBSERVATIONS = 2
"""Observations after which a thruster counts as known: a single one may be a disturbance."""
_INTERVAL_NS = 500_000_000
"""Time between two burns, ns, in which the first is executed and evaluated."""
_MAX_DUTY = 0.9
"""Share of a carrier period that a burn and the commanded thrust may fill together."""


class ThrusterSelfTest:
    """Schedule test burns for thrusters with too little information within the last ``every_s``.

    0: no tests. ``sufficient``: information (see ``ThrusterFaultDetector.information``) from which
    a thruster's loss is known.
    """

    def __init__(
        self, allocator: Allocator, min_pulse_N_s: Array, every_s: float, sufficient: float
    ) -> None:
        self._allocator, self._min_pulse_N_s = allocator, min_pulse_N_s
        self._every_ns = round(every_s * 1e9)
        self._sufficient = sufficient
        self._observations: list[deque[tuple[int, float]]] = [deque() for _ in min_pulse_N_s]
        self._last_burn_ns = -_INTERVAL_NS
        self._first = 0

    def add_information(self, information: Array, now_ns: int) -> None:
        """Add the information (n,) about every thruster from the motion up to ``now_ns``."""
        for thruster in np.flatnonzero(information > 0.0):
            self._observations[thruster].append((now_ns, float(information[thruster])))
        self._forget_before(now_ns - self._every_ns)

    def _forget_before(self, time_ns: int) -> None:
        for observations in self._observations:
            while observations and observations[0][0] < time_ns:
                observations.popleft()

    def untested(self, now_ns: int) -> Flags:
        """Return the thrusters (n,) with too little information within the last ``every_s``."""
        self._forget_before(now_ns - self._every_ns)
        return np.array(
            [
                len(x) < _MIN_OBSERVATIONS or sum(i for _, i in x) < self._sufficient
                for x in self._observations
            ]
        )

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
