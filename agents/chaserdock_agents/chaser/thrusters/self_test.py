"""Which thrusters have shown lately that they work, and test burns for those that have not (docs/thrusters.md).

A thruster that is hardly used shows its failure only when it is needed. A test burn opens it for one least pulse together
with the cheapest other thrusters that cancel its wrench: healthy thrusters leave the motion as it is, a dead one among them shows.
No I/O; times are simulated nanoseconds.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from chaserdock_models.arrays import Array
from numpy.typing import NDArray

from .allocation import Allocator

Flags = NDArray[np.bool_]

_LOOKS = 2
"""Least number of looks at a thruster that make it known: one alone might be a bump."""
_APART_NS = 500_000_000
"""Between two burns: the first has been flown and looked at when the second is commanded."""
_ROOM = 0.9
"""Part of a carrier period of full thrust up to which a burn and what is asked for anyway may fill it."""


class ThrusterSelfTest:
    """What is known of each of a chaser's thrusters; ``every_s``: for how long it counts (0: no tests are asked for).

    ``enough``: information (N s squared over the noise's covariance, see ``ThrusterFaultDetector.information``) from which on the
    part of its thrust that a thruster has lost is known.
    """

    def __init__(self, allocator: Allocator, least_N_s: Array, every_s: float, enough: float) -> None:
        self._allocator, self._least_N_s = allocator, least_N_s
        self._every_ns = round(every_s * 1e9)
        self._enough = enough
        self._heard: list[deque[tuple[int, float]]] = [deque() for _ in least_N_s]
        self._burnt_ns = -_APART_NS
        self._first = 0

    def heard(self, information: Array, now_ns: int) -> None:
        """Notes how much a look at the motion up to ``now_ns`` has told of every thruster, (n,)."""
        for thruster in np.flatnonzero(information > 0.0):
            self._heard[thruster].append((now_ns, float(information[thruster])))
        self._forget_before(now_ns - self._every_ns)

    def _forget_before(self, time_ns: int) -> None:
        for looks in self._heard:
            while looks and looks[0][0] < time_ns:
                looks.popleft()

    def unproved(self, now_ns: int) -> Flags:
        """Thrusters (n,) of which too little has been heard within the last ``every_s``."""
        self._forget_before(now_ns - self._every_ns)
        return np.array([len(x) < _LOOKS or sum(i for _, i in x) < self._enough for x in self._heard])

    def burn(
        self, now_ns: int, suspects: Flags, can_N: Array, asked_N: Array, period_s: float
    ) -> Array | None:
        """Impulses (n,), N s, of a test burn beside thrusts ``asked_N`` (n,); None if there is nothing to test now.

        ``suspects`` (n,): thrusters whose failure could be found; ``can_N`` (n,): what they give when open, as far as known;
        ``period_s``: of the carrier.
        """
        if self._every_ns == 0 or now_ns < self._burnt_ns + _APART_NS:
            return None
        due = np.flatnonzero(self.unproved(now_ns) & suspects & (can_N > 0.0))
        # In turn, so that a thruster that cannot be tested now keeps nobody waiting.
        for thruster in sorted(due.tolist(), key=lambda j: (j - self._first) % len(can_N)):
            impulses = self._balanced(thruster, can_N * period_s)
            if impulses is not None and np.all(impulses + asked_N * period_s <= _ROOM * can_N * period_s):
                self._burnt_ns, self._first = now_ns, thruster + 1
                return impulses
        return None

    def _balanced(self, thruster: int, most_N_s: Array) -> Array | None:
        """A least pulse of ``thruster`` and what cancels it, (n,) N s; None where the thrusters left cannot."""
        others = most_N_s.copy()
        others[thruster] = 0.0
        push = self._allocator.matrix[:, thruster] * self._least_N_s[thruster]
        cancelling = self._allocator.allocate(-push, others)
        if not cancelling.exact:
            return None
        cancelling.thrusts_N[thruster] = self._least_N_s[thruster]
        return cancelling.thrusts_N
